"""What is raised for files that cannot be used."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from arrays.typing import FloatArray

PACKAGES = ("arrays", "magloc", "adcs", "sims")
LARGEST = 1e30
"""Of the numbers in files: more than anything measured, and less than what double precision cannot raise to a power."""


class InputError(ValueError):
    """Bad input from outside: a file, a command's option.

    The text is one sentence that names the file, the line or key, what was found and what was expected, fit to be shown
    to a user as it is.

    Examples
    --------
    >>> import arrays
    >>> try:
    ...     arrays.read_array("nowhere.toml")
    ... except arrays.InputError as error:
    ...     print(error)
    nowhere.toml does not exist, expected a TOML file of an array.
    """


def own_sentence(error: ValueError) -> str:
    """Return what the library refuses, without its first word; raise any other error again, no file is to blame for it.

    NumPy and SciPy raise ValueErrors too, whose words say nothing to a user.
    """
    text = str(error)
    if not text.startswith(("Input ", "Inputs ")) and type(error).__module__.partition(".")[0] not in PACKAGES:
        raise error
    return text.removeprefix("Input ").removeprefix("Inputs ")


@contextmanager
def naming(place: str, **others: object) -> Iterator[None]:
    """Turn what the library refuses into bad input at a place of a file or command.

    `others` are the places of arguments that come from elsewhere, by their names, the first words of such sentences.
    """
    try:
        yield
    except InputError:
        raise
    except ValueError as error:
        sentence = own_sentence(error)
        raise InputError(f"{others.get(sentence.partition(' ')[0], place)}: {sentence}") from None


@contextmanager
def naming_options(*names: str) -> Iterator[None]:
    """Turn errors of the library about arguments into errors about the options of these names."""
    try:
        yield
    except ValueError as error:
        parts = re.match(r"Input (\w+)(?: must be (.*); instead received (.*)\.$)?", str(error))
        if parts is None or parts[1] not in names:
            raise
        rest = f": found {parts[3]}, expected {parts[2]}." if parts[2] else str(error)[parts.end() :]
        raise InputError(f"--{parts[1].replace('_', '-')}{rest}") from None


@contextmanager
def of_extra(extra: str, what: str) -> Iterator[None]:
    """Name the extra that brings what is imported here, for whoever did not install it."""
    try:
        yield
    except ModuleNotFoundError:
        raise InputError(f'{what} needs the extra "{extra}": pip install "magloc[{extra}]".') from None


def check_positive(**values: float) -> None:
    """Raise ValueError for the first of some arguments that is not positive and finite."""
    for name, value in values.items():
        if not 0.0 < value < math.inf:
            raise ValueError(f"Input {name} must be positive and finite; instead received {value}.")


def check_not_negative(**values: float) -> None:
    """Raise ValueError for the first of some arguments that is not 0 or more and finite."""
    for name, value in values.items():
        if not 0.0 <= value < math.inf:
            raise ValueError(f"Input {name} must be 0 or more and finite; instead received {value}.")


def _vector(name: str, value: ArrayLike) -> FloatArray:
    import numpy as np

    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"Input {name} must be finite and have shape (3,); instead received {vector.tolist()}.")
    return vector


def _vectors(name: str, values: ArrayLike) -> FloatArray:
    import numpy as np

    # A length of 1 would broadcast to nonsense.
    vectors = np.asarray(values, dtype=np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ValueError(f"Input {name} must have shape (..., 3); instead received shape {vectors.shape}.")
    return vectors
