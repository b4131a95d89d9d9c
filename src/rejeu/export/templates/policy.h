/* Made by rejeu. The contract of this policy:
$card
*/
#ifndef ${upper}_H
#define ${upper}_H

#include <stdint.h>

$sizes
#define ${upper}_REJEU "$rejeu"
#define ${upper}_WEIGHTS "$weights"

#ifdef __cplusplus
extern "C" {
#endif

/* Computes the action for an observation. Arrays are in C order. Not reentrant: its memory is static. */
$signature;

/* Starts an episode: a policy with memory forgets. The first episode needs no call. */
void ${name}_reset(void);

#ifdef __cplusplus
}
#endif
#endif
