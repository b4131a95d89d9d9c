"""``python -m rejeu`` is the command ``rejeu``."""

import sys

from rejeu.lab.cli import main

if __name__ == "__main__":
    sys.exit(main())
