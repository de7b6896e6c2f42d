"""``python -m magloc.cli``."""

import sys

from magloc.cli.app import main

sys.exit(main())
