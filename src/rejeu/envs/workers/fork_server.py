"""Makes the fork server go on after requests to stop: it says whether its workers live. Elsewhere nothing changes."""

import sys

from rejeu.core import interrupt

if any("from multiprocessing.forkserver import main" in argument for argument in sys.orig_argv):
    interrupt.install(interrupt.disregard)
