"""Methods and settings of the mock-up's runs; this module imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["paper", "velocity-corrected", "ekf", "camera", "imu"]
METHODS: tuple[Method, ...] = get_args(Method)
METHOD_WORDS = {
    "paper": "integration again from each exposure",
    "velocity-corrected": "integration again, velocity corrected",
    "ekf": "delayed filter",
    "camera": "camera alone",
    "imu": "samples alone",
}
Unknowns = Literal["two", "six", "drift"]
UNKNOWNS: tuple[Unknowns, ...] = get_args(Unknowns)
SETTLED_S = 10.0
"""Time after which errors count."""
