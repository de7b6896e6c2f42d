"""Commercial magnetometers, with the figures of their data sheets.

``presets.toml`` has only figures that were checked against the named document. For all others, the user of such a
sensor states the figure.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from arrays.sensor import SensorKind


@dataclass(frozen=True)
class SensorPreset:
    """Data of a kind of sensor.

    Attributes
    ----------
    kind : {"vector", "scalar"}
    source : str
        Source of the figures.
    noise_nT : float, optional
        Standard deviation of one reading, per axis [nT].
    noise_nT_rtHz : float, optional
        Spectral density of white noise [nT/√Hz], for sensors whose readings may come at any rate.
    saturation_nT : float, optional
        Largest field that is measured [nT].

    Examples
    --------
    >>> import arrays
    >>> preset = arrays.SENSOR_PRESETS["rm3100"]
    >>> preset.kind, preset.noise_of_reading_nT(rate_Hz=10.0)
    ('vector', 15.0)
    """

    kind: SensorKind
    source: str
    noise_nT: float | None = None
    noise_nT_rtHz: float | None = None
    saturation_nT: float | None = None

    def noise_of_reading_nT(self, rate_Hz: float) -> float | None:
        """Return the noise of one reading [nT] at a rate, white up to half of it; None if unknown."""
        if self.noise_nT is not None or self.noise_nT_rtHz is None:
            return self.noise_nT
        return float(f"{self.noise_nT_rtHz * math.sqrt(0.5 * rate_Hz):.3g}")


SENSOR_PRESETS: Mapping[str, SensorPreset] = MappingProxyType(
    {
        name: SensorPreset(**table)
        for name, table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items()
    }
)
"""Sensors by their names for ``magloc new-array --sensor``."""
