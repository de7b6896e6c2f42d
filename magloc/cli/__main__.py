"""The program ``magloc``, and ``python -m magloc.cli``."""

import sys

from magloc.cli.entry import run_program


def main() -> int:
    """Run one command, and return its exit status."""
    return run_program("magloc")


if __name__ == "__main__":
    sys.exit(main())
