"""Arguments of callers: numbers and masked arrays, dates and durations, random generators."""

from __future__ import annotations

import datetime
import re
import warnings
from collections.abc import Callable
from functools import wraps
from operator import methodcaller
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from arrays.io.errors import InputError

SHOWN_CHARACTERS = 40
"""Largest number of characters of a cell in an error."""
LARGEST_T = 1e6
"""Largest modulus of a reading [T]; larger numbers are no fields."""

_MOST_DIGITS = 15  # of a number below 2^53
_BLOCK = 2**22  # characters of a text of numbers that are read at once

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from arrays.typing import FloatArray, IntArray, Rng

_P = ParamSpec("_P")
_R = TypeVar("_R")


def numbers(values: ArrayLike) -> FloatArray:
    """Return values as numbers, masked ones as NaN; TypeError for dates and durations."""
    import numpy as np

    mask = np.ma.getmask(values)
    given = np.asarray(values)
    if given.dtype.kind in "mM":
        raise TypeError(f"found the type {given.dtype}, expected numbers")
    if given.dtype != np.float64:
        given = np.asarray(values, dtype=np.float64)
    return given if mask is np.ma.nomask else np.where(mask, np.nan, given)


def fields(values_T: ArrayLike) -> FloatArray:
    """Return readings of fields [T] as numbers; NaN beyond the largest field."""
    import numpy as np

    given = numbers(values_T)
    with np.errstate(invalid="ignore"):
        is_field = np.abs(given) <= LARGEST_T
    return given if is_field.all() else np.where(is_field, given, np.nan)


def seconds(times: ArrayLike, *, name: str = "time_s", dates: bool = True) -> FloatArray:
    """Return times as seconds, missing ones as NaN.

    Durations (timedelta64) become seconds. Dates (datetime64, UTC) count from 1970; without `dates` they are refused.
    """
    import numpy as np

    mask = np.ma.getmask(times)
    given = np.asarray(times)
    if given.dtype.kind == "O":
        given = np.array([_of_object(time) for time in given.ravel().tolist()]).reshape(given.shape)
    if given.dtype.kind == "M":
        if not dates:
            raise ValueError(f"Input {name} must be seconds or durations from the start; instead received dates.")
        given = given - np.datetime64(0, "s")
    if given.dtype.kind == "m":
        given = given / np.timedelta64(1, "s")
    return numbers(given) if mask is np.ma.nomask else np.where(mask, np.nan, numbers(given))


def _of_object(time: Any) -> Any:
    """Return a date or duration of Python or pandas as NumPy's; anything else unchanged."""
    import numpy as np

    if isinstance(time, datetime.timedelta):
        return np.timedelta64(time)
    if isinstance(time, datetime.datetime):
        return np.datetime64(time.astimezone(datetime.UTC).replace(tzinfo=None) if time.tzinfo else time)
    return time


def unix_seconds(place: str, cell: str) -> str:
    """Return the seconds since 1970 of an instant, as text; also of 2026/11/21T7:00:00."""
    try:
        instant = datetime.datetime.fromisoformat(re.sub(r"T(?=\d:)", "T0", cell.strip().replace("/", "-")))
    except ValueError:
        found = repr(cell.strip()[:SHOWN_CHARACTERS])
        raise InputError(f"{place}: found {found}, expected a time such as 2026-11-21T12:00:00.5 (UTC).") from None
    return repr((instant if instant.tzinfo else instant.replace(tzinfo=datetime.UTC)).timestamp())


def plain_numbers(text: str, separator: str, decimal: str, columns: int) -> tuple[FloatArray, IntArray] | None:
    """Return the numbers (n, columns) of a text that has only numbers, and their lines (n,) from 0.

    None if a cell is empty or has no number, or if rows differ in length. Blank lines are ignored.
    """
    import numpy as np

    if not text.isascii() or separator == " " or decimal == separator:
        return None
    blocks, numbers, begin, line = [], [], 0, 0
    while begin < len(text):
        end = text.find("\n", begin + _BLOCK) + 1 or len(text)
        lines = text[begin:end].encode().split(b"\n")
        filled = [k for k, each in enumerate(lines) if each]
        values = _numbers_of_lines([lines[k] for k in filled], separator.encode(), decimal.encode(), columns)
        if values is None:
            return None
        blocks.append(values)
        numbers.append(np.array(filled, dtype=np.int64) + line)
        begin, line = end, line + len(lines) - 1
    return (np.concatenate(blocks), np.concatenate(numbers)) if any(map(len, blocks)) else None


def _numbers_of_lines(lines: list[bytes], separator: bytes, decimal: bytes, columns: int) -> FloatArray | None:
    """Return the numbers (n, columns) of lines that are not empty; None for other lines."""
    import numpy as np

    if not lines:
        return np.zeros((0, columns))
    joined = separator.join(lines)
    if joined.translate(None, b"0123456789+-eE" + separator + decimal):
        return None
    if set(map(methodcaller("count", separator), lines)) != {columns - 1}:
        return None
    if separator + separator in joined or joined.startswith(separator) or joined.endswith(separator):
        return None
    joined = joined.replace(decimal, b".")
    if (values := _fixed_point_numbers(joined, separator)) is None:
        try:
            with warnings.catch_warnings(
                action="ignore"
            ):  # older NumPy warns of text that is no number, and stops there
                values = np.fromstring(joined, sep=separator.decode())
        except ValueError:
            return None
    return values.reshape(-1, columns) if values.size == columns * len(lines) else None


def _fixed_point_numbers(joined: bytes, separator: bytes) -> FloatArray | None:
    """Return the numbers of cells such as -12.50, exactly as float() reads them; None for another cell.

    A whole number below 2^53 over a power of ten below 10^23 is rounded once.
    """
    import numpy as np

    text = np.frombuffer(joined + separator, np.uint8)
    end = np.flatnonzero(text == ord(separator))
    start = np.concatenate([[0], end[:-1] + 1])
    is_sign, dot = (text == ord("-")) | (text == ord("+")), np.flatnonzero(text == ord("."))
    is_digit = (text >= ord("0")) & (text <= ord("9"))
    signed = is_sign[start]
    if is_digit.sum() + signed.sum() + len(dot) + len(end) != len(text):
        return None
    decimals = np.zeros(len(end), np.int64)
    cell = np.searchsorted(end, dot)
    if (np.diff(cell) == 0).any():
        return None
    decimals[cell] = end[cell] - dot - 1
    digits = end - start - signed
    digits[cell] -= 1
    most = int(digits.max())
    if digits.min() < 1 or most > _MOST_DIGITS:
        return None
    figure, first = text[is_digit] - ord("0"), np.cumsum(digits) - digits
    whole = np.zeros(len(end), np.int64)
    for k in range(most):
        more = digits > k
        whole[more] = 10 * whole[more] + figure[first[more] + k]
    values = whole / 10.0 ** np.arange(_MOST_DIGITS + 1)[decimals]
    return np.where(text[start] == ord("-"), -values, values)


def seed_of(rng: Rng) -> int:
    """Return the seed that fixes all draws: ``rng`` itself, or one that a generator draws."""
    import numpy as np

    if isinstance(rng, int | np.integer):
        return int(rng)
    return int(np.random.default_rng(rng).integers(2**63))


def accept_seed(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function whose argument ``rng`` was called ``seed`` before: accept the old name with a warning."""

    @wraps(function)
    def wrapper(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if "seed" in kwargs:
            if "rng" in kwargs:
                raise TypeError(f"{function.__name__}() takes rng or seed, not both")
            warnings.warn(f"seed of {function.__name__}() is called rng now", DeprecationWarning, stacklevel=2)
            kwargs["rng"] = kwargs.pop("seed")
        return function(*args, **kwargs)

    return wrapper
