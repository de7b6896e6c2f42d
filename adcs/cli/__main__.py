"""The program ``adcs``, and ``python -m adcs.cli``: Ctrl-C ends it in order while it still loads, too."""

import sys


def main() -> int:
    """Run one command; its exit status."""
    try:
        from adcs.cli import app

        return app.main()
    except KeyboardInterrupt:
        print("adcs: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
