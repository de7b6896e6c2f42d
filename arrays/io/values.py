"""Numbers and times of callers in double precision: masked arrays, dates, durations."""

from __future__ import annotations

import datetime
import re
from typing import TYPE_CHECKING, Any

from arrays.io.errors import InputError

SHOWN_CHARACTERS = 40
"""Largest number of characters of a cell in an error."""
LARGEST_T = 1e6
"""Largest modulus of a reading [T]; larger numbers are no fields."""

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from arrays.typing import FloatArray


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
