"""Fixes with all sensors, whatever they read."""

from __future__ import annotations

from typing import Any

from arrays.array import SensorArray
from magloc.localization.locator import Locator


def plain_locator(array: SensorArray, **options: Any) -> Locator:
    """A locator that leaves out no sensor."""
    return Locator(array, exclude_faulty=False, **options)
