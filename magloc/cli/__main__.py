"""The program ``magloc``, and ``python -m magloc.cli``."""

import sys

from magloc.cli.entry import entered


def main() -> int:
    """Run one command; its exit status."""
    return entered("magloc")


if __name__ == "__main__":
    sys.exit(main())
