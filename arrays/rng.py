"""Random arguments: ``rng`` is a seed or a generator, as in Scientific Python's SPEC 7."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeAlias, TypeVar

import numpy as np

Rng: TypeAlias = int | np.integer | np.random.SeedSequence | np.random.BitGenerator | np.random.Generator | None

_P = ParamSpec("_P")
_R = TypeVar("_R")


def seed_of(rng: Rng) -> int:
    """Return the seed that fixes all draws: ``rng`` itself, or one that a generator draws."""
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
