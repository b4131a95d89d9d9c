/* Reads inputs from standard input, and writes actions and the seconds that they took to standard output. */
#include "$stem.h"
#include <stdio.h>
#include <time.h>

$arrays

int main(void) {
	struct timespec one, two;
	while ($reads) {
		$starts
		clock_gettime(CLOCK_MONOTONIC, &one);
		${name}_act($arguments);
		clock_gettime(CLOCK_MONOTONIC, &two);
		double seconds = (double)(two.tv_sec - one.tv_sec) + 1e-9 * (double)(two.tv_nsec - one.tv_nsec);
		fwrite(action, sizeof action, 1, stdout);
		fwrite(&seconds, sizeof seconds, 1, stdout);
		fflush(stdout);
	}
	return 0;
}
