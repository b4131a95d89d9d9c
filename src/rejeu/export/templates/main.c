/* Reads inputs from standard input, and writes actions and the seconds that they took to standard output. */
#include "$stem.h"
#include <stdio.h>
#include <time.h>
#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#endif

$arrays

int main(void) {
	struct timespec one, two;
#ifdef _WIN32
	_setmode(_fileno(stdin), _O_BINARY);
	_setmode(_fileno(stdout), _O_BINARY);
#define NOW(time) timespec_get(&time, TIME_UTC)
#else
#define NOW(time) clock_gettime(CLOCK_MONOTONIC, &time)
#endif
	while ($reads) {
		$starts
		NOW(one);
		${name}_act($arguments);
		NOW(two);
		double seconds = (double)(two.tv_sec - one.tv_sec) + 1e-9 * (double)(two.tv_nsec - one.tv_nsec);
		fwrite(action, sizeof action, 1, stdout);
		fwrite(&seconds, sizeof seconds, 1, stdout);
		fflush(stdout);
	}
	return 0;
}
