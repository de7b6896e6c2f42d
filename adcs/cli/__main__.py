"""``python -m adcs.cli``."""

import sys

from adcs.cli.app import main

sys.exit(main())
