"""The program ``magloc``, and ``python -m magloc.cli``: Ctrl-C ends it in order while it still loads, too."""

import sys


def main() -> int:
    """Run one command; its exit status."""
    try:
        from magloc.cli import app

        return app.main()
    except KeyboardInterrupt:
        print("magloc: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
