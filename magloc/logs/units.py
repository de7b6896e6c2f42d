"""Units of logged numbers, and their values in SI."""

from __future__ import annotations

import math
import re
from typing import NamedTuple


class LoggedUnit(NamedTuple):
    """Unit in a log, the unit of its values in SI, and the factor between both."""

    logged: str
    si: str
    si_per_unit: float = 1.0


_RAD = math.pi / 180.0
NO_UNIT = LoggedUnit("", "")
PLACE = LoggedUnit("deg", "deg")
PLACE_E7 = LoggedUnit("1e-7 deg", "deg", 1e-7)
_UNITS = {
    **{name: ("T", size) for name, size in (("T", 1.0), ("mT", 1e-3), ("uT", 1e-6), ("µT", 1e-6), ("nT", 1e-9))},
    **{"G": ("T", 1e-4), "mG": ("T", 1e-7), "Gauss": ("T", 1e-4), "mGauss": ("T", 1e-7)},
    **{"rad": ("rad", 1.0), "deg": ("rad", _RAD), "cdeg": ("rad", 1e-2 * _RAD)},
    **{"rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", _RAD), "mrad/s": ("rad/s", 1e-3), "rad/s/s": ("rad/s2", 1.0)},
    **{"m": ("m", 1.0), "mm": ("m", 1e-3), "cm": ("m", 1e-2), "m/s": ("m/s", 1.0), "cm/s": ("m/s", 1e-2)},
    **{"m/s2": ("m/s2", 1.0), "m/s/s": ("m/s2", 1.0), "g": ("m/s2", 9.80665)},
    **{"s": ("s", 1.0), "ms": ("s", 1e-3), "us": ("s", 1e-6), "Hz": ("Hz", 1.0), "Pa": ("Pa", 1.0)},
    **{"A": ("A", 1.0), "mA": ("A", 1e-3), "V": ("V", 1.0), "mV": ("V", 1e-3), "mAh": ("C", 3.6)},
    **{"degC": ("degC", 1.0), "%": ("1", 1e-2), "1": ("1", 1.0)},
}
_ENDINGS = (
    (r"[\[(](.+)[\])]", None),
    (r"_ga|_[gG]auss", "G"),
    (r"_(nT|uT|µT|mT|T|mG)", None),
    (r"_rad_s", "rad/s"),
    (r"_(?:deg_s|dps)", "deg/s"),
    (r"_m_s2|_m_s_s|_mps2", "m/s2"),
    (r"_m_s|_mps", "m/s"),
    (r"_rad", "rad"),
    (r"_deg", "deg"),
    (r"_(?:a|A)", "A"),
    (r"_(?:v|V)", "V"),
    (r"_pa", "Pa"),
    (r"temperature|_cel[cs]ius", "degC"),
    (r"_(?:us|usec)", "us"),
    (r"_ms", "ms"),
    (r"_(?:m|meter)", "m"),
    (r"_s", "s"),
)
_INDEX = r"(?:\[\d+\])?$"


def logged_unit(name: str) -> LoggedUnit:
    """Return a unit by its name in a log; a name that is not known stays as it is."""
    si, size = _UNITS.get(name, (name, 1.0))
    return LoggedUnit(name, si, size)


def unit_of_field(field: str) -> LoggedUnit:
    """Return the unit that the end of a field's name states, such as ``magnetometer_ga[0]`` or ``current_a``."""
    for pattern, unit in _ENDINGS:
        if (found := re.search(f"(?:{pattern}){_INDEX}", field)) and (unit or not found[1].isdigit()):
            return logged_unit(unit or found[1])
    return NO_UNIT
