"""Envelope of the saved state of a filter, for a JSON file: a version, a checksum and text."""

from __future__ import annotations

import base64
import pickle
import zlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

_Read = TypeVar("_Read")


def seal(version: int, content: bytes, **values: object) -> dict[str, Any]:
    """Return a state with a version, values in plain text, and a content with its checksum."""
    text = base64.b64encode(content).decode()
    return {"version": version, **values, "crc32": zlib.crc32(content), "content": text}


def read_sealed(state: Mapping[str, Any], version: int, owner: str, read: Callable[[bytes], _Read]) -> _Read:
    """Return what a function reads from the content of a state.

    Raises
    ------
    ValueError
        The state has another version, is damaged, or is no state of the owner.
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"Input state must be one of {owner}.state(); instead received a {type(state).__name__}.")
    if (found := state.get("version")) != version:
        raise ValueError(f"Input state must have version {version}; instead received {found!r}.")
    try:
        content = base64.b64decode(state["content"], validate=True)
        if zlib.crc32(content) != state["crc32"]:
            raise ValueError("its checksum differs")
        return read(content)
    except (KeyError, TypeError, ValueError, EOFError, zlib.error, pickle.UnpicklingError, ImportError) as error:
        raise ValueError(f"Input state must be one of {owner}.state(); instead {error} contradicts it.") from error
