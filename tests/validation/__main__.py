"""Repeat tables of docs/validation: ``python -m tests.validation [WORD]``."""

import sys

from tests.validation import main
from tests.validation.tables import TABLES

sys.exit(main(" ".join(sys.argv[1:]), TABLES))
