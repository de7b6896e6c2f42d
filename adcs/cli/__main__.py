"""The program ``adcs``, and ``python -m adcs.cli``."""

import sys

from magloc.cli.entry import run_program


def main() -> int:
    """Run one command, and return its exit status."""
    return run_program("adcs")


if __name__ == "__main__":
    sys.exit(main())
