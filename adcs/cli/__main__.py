"""The program ``adcs``, and ``python -m adcs.cli``."""

import sys

from magloc.cli.entry import entered


def main() -> int:
    """Run one command; its exit status."""
    return entered("adcs")


if __name__ == "__main__":
    sys.exit(main())
