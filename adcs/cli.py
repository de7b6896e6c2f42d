"""The command line ``adcs``. It has no command yet: it answers --help and --version, and refuses the rest."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version

_HELP = """Usage: adcs [--help] [--version]

Satellite attitude determination. This version has no commands yet."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Those of the process by default.

    Returns
    -------
    int
        Exit status: 0 done, 2 bad input.
    """
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    if tokens in ([], ["--help"], ["-h"]):
        print(_HELP)
        return 0
    if tokens == ["--version"]:
        print(version("magloc"))
        return 0
    print(f"adcs: found {' '.join(tokens)!r}, expected --help or --version: no commands yet.", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
