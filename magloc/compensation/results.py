"""Result of a compensation: coefficients, figures of merit, flags, and corrected readings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.results import Drawn
from arrays.io.tables import align, by_sigma
from arrays.typing import FloatArray
from magloc.compensation.figure_of_merit import HEADINGS, Manoeuvres
from magloc.compensation.fit import PlatformFit

LEAST_KNOWN = 0.5
"""Largest σ of a determined coefficient, in units of its prior's σ."""


@dataclass(frozen=True, eq=False)
class SensorCompensation:
    """Platform at one sensor.

    Attributes
    ----------
    sensor : str
    fit : PlatformFit
    manoeuvres : Manoeuvres
        Manoeuvres of the calibration.
    before_T, after_T : float
        Figure of merit of the calibration without and with the correction.
    """

    sensor: str
    fit: PlatformFit
    manoeuvres: Manoeuvres
    before_T: float
    after_T: float

    @classmethod
    def of(cls, sensor: str, fit: PlatformFit) -> SensorCompensation:
        """Return the platform at a sensor with its figures of merit."""
        field, time_s, read = fit.field_T, fit.rows.time_s, fit.rows.modulus_T
        done = Manoeuvres.of(time_s, field / np.linalg.norm(field, axis=1, keepdims=True))
        return cls(sensor, fit, done, done.figure_T(read), done.figure_T(read - fit.effect_T))

    @property
    def entries(self) -> Iterator[dict[str, Any]]:
        """Coefficients as entries of the JSON object."""
        terms, fit = self.fit.terms, self.fit
        for name, unit, printed, value, sigma, prior in zip(
            terms.names, terms.units, terms.printed, fit.values, fit.sigma, terms.sigma, strict=True
        ):
            yield {
                "name": f"{self.sensor} {name}",
                "value": printed * value,
                "sigma": printed * sigma,
                "determined": bool(sigma < LEAST_KNOWN * prior),
                "unit": unit,
            }


@dataclass(frozen=True, eq=False)
class Compensation(Drawn):
    """Compensated log.

    Attributes
    ----------
    array : SensorArray
    sensors : tuple of SensorCompensation
    time_s : ndarray, shape (n,)
        Times of the log.
    values_T : ndarray, shape (n, C)
        Readings without the field of the platform; NaN where the attitude is unknown.
    sigma_T : ndarray, shape (n, N)
        Standard deviation of the changes of the correction at every sensor, along the ambient field.
    flags : tuple of str
        Doubts, each a word and a sentence.
    """

    figure: ClassVar[str] = "magloc.plots.compensations:compensation"
    array: SensorArray
    sensors: tuple[SensorCompensation, ...]
    time_s: FloatArray
    values_T: FloatArray
    sigma_T: FloatArray
    flags: tuple[str, ...]

    @property
    def entries(self) -> list[dict[str, Any]]:
        """Coefficients of all sensors: name, value, sigma, determined, unit."""
        return [entry for sensor in self.sensors for entry in sensor.entries]

    @property
    def undetermined(self) -> list[str]:
        """Names of the terms that the flight does not determine."""
        return [entry["name"] for entry in self.entries if not entry["determined"]]

    @property
    def worst(self) -> SensorCompensation:
        """Platform with the largest figure of merit after the correction, of the scalar sensors if there are any."""
        scalar = {sensor.id for sensor in self.array.sensors if sensor.kind == "scalar"}
        judged = [of for of in self.sensors if of.sensor in scalar] or self.sensors
        return max(judged, key=lambda of: of.after_T)

    @property
    def figure_of_merit_before_T(self) -> float:
        """Figure of merit of the worst sensor without the correction [T]."""
        return self.worst.before_T

    @property
    def figure_of_merit_after_T(self) -> float:
        """Figure of merit of the worst sensor with the correction [T]."""
        return self.worst.after_T

    def columns(self) -> dict[str, Column]:
        """Return the columns that are added to the log."""
        added: dict[str, Column] = {
            f"{name}_compensated_nT": 1e9 * values
            for name, values in zip(self.array.channel_names, self.values_T.T, strict=True)
        }
        for name, sigma in zip(self.array.ids, self.sigma_T.T, strict=True):
            added[f"{name}_compensation_sigma_nT"] = 1e9 * sigma
        return added

    def report(self) -> dict[str, Any]:
        """Return the JSON object that ``magloc compensate --json`` prints."""
        return {
            "coefficients": self.entries,
            "figure_of_merit_before_nT": 1e9 * self.figure_of_merit_before_T,
            "figure_of_merit_after_nT": 1e9 * self.figure_of_merit_after_T,
            "flags": list(self.flags),
            "sensors": [
                {
                    "sensor": of.sensor,
                    "figure_of_merit_before_nT": 1e9 * of.before_T,
                    "figure_of_merit_after_nT": 1e9 * of.after_T,
                    "manoeuvres": of.manoeuvres.n_found,
                    "lag_s": of.fit.lag_s,
                    "lag_sigma_s": of.fit.lag_sigma_s,
                    "noise_nT": of.fit.background.noise_nT,
                }
                for of in self.sensors
            ],
        }

    def table(self) -> str:
        """Return coefficients with σ, figures of merit and flags as text."""
        rows = [["term", "value", "σ", "unit", ""]]
        for entry in self.entries:
            value, sigma = by_sigma(entry["value"], entry["sigma"])
            rows.append([entry["name"], value, sigma, entry["unit"], "" if entry["determined"] else "not determined"])
        lines = align(rows, left=1)
        for of in self.sensors:
            found = of.manoeuvres.n_found
            over = f"{found} of {3 * HEADINGS} manoeuvres" if found else "the whole record, without manoeuvres"
            lines.append(
                f"figure of merit of {of.sensor}: {1e9 * of.before_T:.3g} nT before, {1e9 * of.after_T:.3g} nT after,"
                f" over {over}"
            )
        return "\n".join(lines)
