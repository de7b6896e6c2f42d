"""Errors of bad input, and contexts that name its place."""

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
"""Largest number in files: above all measurements, and its powers stay finite."""


class InputError(ValueError):
    """Bad input from outside: a file, a command's option.

    The text is one sentence for users. It names the file, the line or key, the value found and the value expected.

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
    """Return the sentence of an error of ours without its first word; raise any other error again.

    ValueErrors of NumPy and SciPy do not help a user.
    """
    text = str(error)
    if not text.startswith(("Input ", "Inputs ")) and type(error).__module__.partition(".")[0] not in PACKAGES:
        raise error
    return text.removeprefix("Input ").removeprefix("Inputs ")


@contextmanager
def naming(place: str, **others: object) -> Iterator[None]:
    """Turn an error of the library into bad input at a place of a file or command.

    `others`: places of arguments from elsewhere, by their names, which are the first words of such sentences.
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
    """Turn a failed import into an error that names the extra to install."""
    try:
        yield
    except ModuleNotFoundError:
        raise InputError(f'{what} needs the extra "{extra}": pip install "magloc[{extra}]".') from None


def check_positive(**values: float) -> None:
    """Refuse arguments that are not positive and finite."""
    for name, value in values.items():
        if not 0.0 < value < math.inf:
            raise ValueError(f"Input {name} must be positive and finite; instead received {value}.")


def check_not_negative(**values: float) -> None:
    """Refuse arguments that are negative or not finite."""
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

    # A length of 1 would broadcast silently.
    vectors = np.asarray(values, dtype=np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ValueError(f"Input {name} must have shape (..., 3); instead received shape {vectors.shape}.")
    return vectors
