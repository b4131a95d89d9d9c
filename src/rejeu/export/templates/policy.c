/* Made by rejeu. The contract of this policy:
$card
*/
#include "$stem.h"

#include <math.h>

$arrays

$signature {
$body
}

void ${name}_reset(void) {
$resets}
