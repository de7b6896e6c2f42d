"""Errors of real sensors, with typical figures of their kinds.

The figures are of the order that makers publish for calibrated instruments of a kind, not those of one instrument: a
fluxgate such as Bartington's Mag-13, an optically pumped total-field sensor such as QuSpin's QTFM, an Overhauser sensor
such as GEM's GSM-19, a low-temperature SQUID, a magnetoresistive chip such as Memsic's MMC5983MA. A scenario may
replace each figure. Misalignment and gain error remain after a good calibration; the gain error of a scalar sensor
represents its heading error.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

from arrays.array import SensorArray
from arrays.sensor import Sensor, SensorKind
from magloc.measurement.nuisances import FASTEST_FLICKER_HZ
from sims.noise import flicker_sigma, white_sigma

_DIGITS = 12  # of a noise that comes from a square root: what was 0.2 nT is written as such again


@dataclass(frozen=True)
class SensorModel:
    """Errors of a sensor.

    Attributes
    ----------
    reads : {"vector", "scalar"}
        Three components of the field, or its modulus.
    noise_T_rtHz : float
        Square root of the one-sided spectral density of the white noise, per channel [T/√Hz].
    corner_Hz : float
        Frequency below which the noise has the density 1/f; 0 = it is white.
    bandwidth_Hz : float
        Bandwidth of a first-order low-pass for signal and noise; infinite = none.
    range_T : float
        Modulus at which a channel saturates; infinite = never.
    resolution_T : float
        Step of the readings; 0 = no rounding.
    misalignment_rad : float
        Standard deviation, per axis, of a constant rotation of a vector sensor's axes.
    gain_error : float
        Standard deviation of the relative error of the gain, per channel.
    drift_T_rth : float
        Random walk of a channel's offset, from zero [T/√h].
    offset_error_T : float
        Standard deviation, per axis, of a constant field at the sensor that is fixed to the array.
    """

    reads: SensorKind
    noise_T_rtHz: float
    corner_Hz: float = 0.0
    bandwidth_Hz: float = math.inf
    range_T: float = math.inf
    resolution_T: float = 0.0
    misalignment_rad: float = 0.0
    gain_error: float = 0.0
    drift_T_rth: float = 0.0
    offset_error_T: float = 0.0

    @property
    def flicker_T(self) -> float:
        """Standard deviation of 1/f noise in a decade of frequency: ``N √(f_c ln 10)`` [T]."""
        return self.noise_T_rtHz * math.sqrt(self.corner_Hz * math.log(10.0))

    def sigma_T(self, rate_Hz: float) -> float:
        """Standard deviation of errors that are independent between samples [T].

        White noise, rounding, and the 1/f noise above the decades that an array file states. The remaining 1/f noise
        depends on the length of the record.
        """
        white = white_sigma(rate_Hz, self.noise_T_rtHz, self.bandwidth_Hz)
        flicker = flicker_sigma(rate_Hz, self.noise_T_rtHz, self.corner_Hz, self.bandwidth_Hz, FASTEST_FLICKER_HZ)
        return float(f"{math.hypot(white, self.resolution_T / math.sqrt(12.0), flicker):.{_DIGITS}g}")

    def with_sigma(self, sigma_T: float, rate_Hz: float) -> SensorModel:
        """Return the model with white noise of this standard deviation in one sample."""
        return replace(self, noise_T_rtHz=sigma_T / white_sigma(rate_Hz, 1.0, self.bandwidth_Hz))


_FIGURES = tomllib.loads(Path(__file__).with_name("sensor_kinds.toml").read_text(encoding="utf-8"))
SENSOR_KINDS = {kind: SensorModel(**attributes) for kind, attributes in _FIGURES.items()}
"""Sensors by the name of their kind, of the file beside this module."""


def model_of(sensor: Sensor, rate_Hz: float) -> SensorModel:
    """Return the model of a sensor from an array file, without errors that it does not state.

    ``rate_Hz``: rate at which its noise is stated for one sample.
    """
    model = SensorModel(
        reads=sensor.kind,
        noise_T_rtHz=0.0,
        range_T=math.inf if sensor.saturation_T is None else sensor.saturation_T,
        misalignment_rad=sensor.misalignment_rad,
        gain_error=sensor.gain_uncertainty,
        drift_T_rth=sensor.drift_T_rth,
        offset_error_T=sensor.offset_uncertainty_T,
    ).with_sigma(sensor.noise_T, rate_Hz)
    return replace(model, corner_Hz=(sensor.flicker_T / model.noise_T_rtHz) ** 2 / math.log(10.0))


def nominal_array(array: SensorArray, models: tuple[SensorModel, ...], rate_Hz: float) -> SensorArray:
    """Return the array as its user knows it: noise, limits and uncertainties of the models.

    ``array``: where the sensors stand, and their nominal calibration. ``models``: one for each sensor.
    """
    return replace(
        array,
        sensors=tuple(
            replace(
                sensor,
                noise_T=model.sigma_T(rate_Hz),
                saturation_T=None if math.isinf(model.range_T) else model.range_T,
                misalignment_rad=model.misalignment_rad,
                gain_uncertainty=model.gain_error,
                offset_uncertainty_T=model.offset_error_T,
                flicker_T=model.flicker_T,
                drift_T_rth=model.drift_T_rth,
            )
            for sensor, model in zip(array.sensors, models, strict=True)
        ),
    )
