"""Types of command-line arguments, checked as they are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from cyclopts import Parameter, Token
from cyclopts.validators import Number

_TOO_LARGE = 10**18


def whole_number(_: type, tokens: Sequence[Token]) -> int:
    """Convert one argument; cyclopts alone would round 1.5, and pass what no float or int64 can hold."""
    try:
        number = int(tokens[0].value)
        if abs(number) < _TOO_LARGE:
            return number
    except ValueError:
        pass
    raise ValueError(f"found {tokens[0].value!r}, expected a whole number of at most 18 digits.")


Flag = Annotated[bool, Parameter(show_default=False)]
# Ten million of anything would never end.
Count = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1, lt=10_000_000))]
Seed = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=0))]
