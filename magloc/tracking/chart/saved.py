"""Saved state of a tracker, for a JSON file."""

from __future__ import annotations

import collections
import io
import pickle
import zlib
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from magloc.saved_states import read_sealed, seal

VERSION = 1
"""Version of the states; it changes with the classes that a tracker holds."""
_OURS = ("arrays.", "magloc.")
_OTHERS = {
    ("collections", "deque"): collections.deque,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}
_NUMPY = ("_reconstruct", "_frombuffer", "scalar")


class _Unpickler(pickle.Unpickler):
    """Unpickler of classes of this package and of arrays; it calls nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _OTHERS:
            return _OTHERS[module, name]
        if module.startswith("numpy.") and name in _NUMPY:
            return super().find_class(module, name)
        if module.startswith(_OURS) and "." not in name:
            found = getattr(import_module(module), name, None)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"found {module}.{name}")


def saved_state(values: Mapping[str, object]) -> dict[str, Any]:
    """Return values as a state: a version, a checksum and text."""
    return seal(VERSION, zlib.compress(pickle.dumps(dict(values), protocol=5)))


def values_of_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a state.

    Raises
    ------
    ValueError
        The state has another version, is damaged, or is no state of a tracker.
    """
    return read_sealed(
        state, VERSION, "Tracker", lambda content: dict(_Unpickler(io.BytesIO(zlib.decompress(content))).load())
    )
