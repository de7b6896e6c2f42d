"""Magnetometers that can be bought, with the figures of their makers.

Only figures that were checked against the document that is named stand here; what could not be checked is left out, and
has to be given by whoever makes an array of such a sensor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from arrays.sensor import SensorKind


@dataclass(frozen=True)
class SensorPreset:
    """What is known of a kind of sensor.

    Attributes
    ----------
    kind : {"vector", "scalar"}
    source : str
        Where the figures stand.
    noise_nT : float, optional
        Standard deviation of one reading, per axis [nT].
    noise_nT_rtHz : float, optional
        Spectral density of white noise [nT/√Hz], for sensors whose readings may come at any rate.
    saturation_nT : float, optional
        Largest field that is measured [nT].
    """

    kind: SensorKind
    source: str
    noise_nT: float | None = None
    noise_nT_rtHz: float | None = None
    saturation_nT: float | None = None

    def noise_of_reading_nT(self, rate_Hz: float) -> float | None:
        """Noise of one reading [nT] at a rate, white up to half of it; None where no figure is known."""
        if self.noise_nT is not None or self.noise_nT_rtHz is None:
            return self.noise_nT
        return float(f"{self.noise_nT_rtHz * math.sqrt(0.5 * rate_Hz):.3g}")


_UNCHECKED = "no document at hand states its noise: give that of your data sheet"

SENSOR_PRESETS: Mapping[str, SensorPreset] = MappingProxyType(
    {
        "rm3100": SensorPreset(
            "vector",
            "PNI Sensor, 'Magneto-Inductive (MI) Technology Introduction' (support article): 15 nT RMS at 200 cycle"
            " counts; noise only",
            noise_nT=15.0,
        ),
        "lis3mdl": SensorPreset(
            "vector",
            "STMicroelectronics, LIS3MDL data sheet DocID024204: full scale ±4 gauss (features, page 1); RMS noise"
            " 4.1 mgauss along z, 3.2 along x and y, ultra-high-performance mode (its magnetic characteristics, as"
            " others quote them)",
            noise_nT=410.0,
            saturation_nT=400_000.0,
        ),
        "tlv493d": SensorPreset(
            "vector",
            f"Infineon, TLV493D-A1B6 product description: ±130 mT, 98 µT per digit; {_UNCHECKED}",
            saturation_nT=130e6,
        ),
        "mlx90393": SensorPreset("vector", f"Melexis, MLX90393: {_UNCHECKED}"),
        "fluxgate": SensorPreset("vector", f"fluxgates such as Bartington's Mag-13: {_UNCHECKED}"),
        "opm": SensorPreset("scalar", f"optically pumped sensors such as QuSpin's QTFM: {_UNCHECKED}"),
        "overhauser": SensorPreset(
            "scalar",
            "GEM Systems GSM-19 version 6, brochure of Aegis Instruments: 0.015 nT/√Hz",
            noise_nT_rtHz=0.015,
        ),
    }
)
"""Sensors by the name that ``magloc new-array --sensor`` takes."""
