"""Result of a check of a field log: properties, the table of checks, and the faults among them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.results import Result
from arrays.io.tables import align
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.deliverables.coverage import Coverage
from magloc.deliverables.heading import HeadingError
from magloc.measurement.plausibility import EARTH_T, alternates, robust_sigma
from magloc.navigation.crossovers import ClockShift
from magloc.navigation.flight_lines import FlightLine
from magloc.surveying.clock import ClockLag
from magloc.surveying.fit.sensor_noise import NOISY, white_noise_T

GAP = 3.0
"""Shortest gap, in usual intervals."""
_JITTER, _MISSING, _SPIKES = 0.1, 0.01, 1e-3  # shares that are faults
_SIGNIFICANT = 3.0  # standard deviations of the heading error
_ZONE_S = 1800.0  # times of zones differ by multiples of it
_WIDE = 1.7  # times the spacing of lines


class Check(NamedTuple):
    """Property of a log, with a remark if it is a fault."""

    name: str
    sensor: str
    value: float
    unit: str
    remark: str


class Gaps(NamedTuple):
    """Starts [s], durations [s] and lengths [m] of gaps (k,)."""

    start_s: FloatArray
    duration_s: FloatArray
    way_m: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class Quality(Result):
    """Quality of a field log.

    Attributes
    ----------
    array : SensorArray
        Array with the stated noise.
    time_s : ndarray, shape (n,)
        Times of the rows.
    place_m : ndarray, shape (n, 3)
        Places of the array's origin in the world frame, interpolated between fixes.
    height_m : ndarray, shape (n,)
        Height of the array's origin above the ground.
    gaps : Gaps
        Intervals longer than three usual ones.
    lines_flown : list of FlightLine
        Lines in the order of time.
    fourth_T : ndarray, shape (n, N)
        Fourth difference of each sensor's modulus, divided by √70: white noise keeps its standard deviation. NaN beside
        gaps and unusable readings.
    missing, stuck, spikes : ndarray of bool, shape (n, N)
        Readings that a survey leaves out.
    heading : list of HeadingError or None
        For each sensor; None if the lines do not determine it.
    lag : ClockLag, optional
        Delay of the readings after their poses, by targets and by opposite lines; its σ is infinite if neither
        determines it. None without targets or an ambient field.
    coverage : Coverage, optional
        None for a single line.
    field_T : ndarray, shape (N,)
        Median modulus of each sensor; NaN without any.
    held : float
        Share of rows whose place stands still between fixes of the receiver.
    level_share : float
        Horizontal share of the ambient field: the heading error by a level field of 1 that is fixed to the array.
    clock : ClockShift, optional
        Agreement of lines flown in opposite directions, and the time of the places with which it is better.
    anomalies_T : ndarray, shape (N,)
        Standard deviation of each sensor's modulus around the medians of lines.
    weaker_below : tuple of str
        For each sensor, another sensor below it whose anomalies are smaller; "" without one. The field of the ground
        decays upwards.
    exchanged : tuple of str
        Two sensors beside each other that appear exchanged, or none.
    clipped : ndarray of bool, shape (n, N)
        Readings that repeat the largest or smallest one, which a survey leaves out as well.
    earlier : ndarray of int, shape (n,)
        The earlier row that each row repeats in a block, or -1.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
    >>> quality = magloc.check_quality(field.array, field.readings)
    >>> [round(1e9 * float(noise), 1) for noise in quality.noise_T]
    [0.2, 0.2]
    """

    figure = "magloc.deliverables.quality_figure:quality_figure"
    command = "qc"
    dimension = "check"
    frame = "world"

    array: SensorArray
    time_s: FloatArray
    place_m: FloatArray
    height_m: FloatArray
    gaps: Gaps
    lines_flown: list[FlightLine]
    fourth_T: FloatArray
    missing: BoolArray
    stuck: BoolArray
    spikes: BoolArray
    heading: list[HeadingError | None]
    lag: ClockLag | None
    coverage: Coverage | None
    field_T: FloatArray
    held: float
    level_share: float = 1.0
    clock: ClockShift | None = None
    anomalies_T: FloatArray = field(default_factory=lambda: np.zeros(0))
    weaker_below: tuple[str, ...] = ()
    exchanged: tuple[str, ...] = ()
    clipped: BoolArray = field(default_factory=lambda: np.zeros((1, 0), np.bool_))
    earlier: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def interval_s(self) -> float:
        """Usual interval between rows."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def jitter_s(self) -> float:
        """Standard deviation of the intervals without gaps."""
        steps = np.diff(self.time_s)
        return float(np.std(steps[steps < GAP * self.interval_s]))

    @property
    def noise_T(self) -> FloatArray:
        """Noise of each sensor (N,) from the fourth differences; NaN without any."""
        return self.noise_in(slice(None))

    def noise_in(self, rows: slice | IntArray) -> FloatArray:
        """Return the noise of each sensor (N,) in some rows."""
        return np.array([robust_sigma(column) for column in self.fourth_T[rows].T])

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """All properties, in the order of the table."""
        return (*self._sampling(), *self._way(), *self._sensors())

    @property
    def flags(self) -> list[str]:
        """Names of the properties that are faults, in the order of the table; an unknown value is none."""
        return list(dict.fromkeys(check.name for check in self.checks if check.remark and not math.isnan(check.value)))

    def _sampling(self) -> Iterator[Check]:
        def check(name: str, value: float, unit: str, remark: str = "") -> Check:
            return Check(name, "", value, unit, remark)

        yield check("rows", len(self.time_s), "")
        again = np.flatnonzero(self.earlier >= 0)
        if again.size:
            now_s, then_s = self.time_s[[again[0], self.earlier[again[0]]]]
            yield check("repeated rows", again.size, "", f"the row at {now_s:.10g} s is the same as at {then_s:.10g} s")
        yield check("duration", float(np.ptp(self.time_s)), "s")
        yield check("rate", 1.0 / self.interval_s, "Hz")
        share = self.jitter_s / self.interval_s
        remark = f"{100.0 * share:.0f} % of the interval" if share > _JITTER else ""
        yield check("jitter", 1e3 * self.jitter_s, "ms", remark)
        gaps = self.gaps
        yield check("gaps", len(gaps.start_s), "")
        if len(gaps.start_s):
            longest, farthest = int(gaps.duration_s.argmax()), int(gaps.way_m.argmax())
            spacing_m = math.inf if self.coverage is None else self.coverage.spacing_m
            rest_s = math.remainder(gaps.duration_s[longest] - self.interval_s, _ZONE_S)
            is_leap = gaps.duration_s[longest] > _ZONE_S / 2.0 and abs(rest_s) < GAP * self.interval_s
            is_leap &= bool(gaps.way_m[longest] < _WIDE * spacing_m)
            remark = f"the clock leaps by half hours or days at {gaps.start_s[longest]:.10g} s" if is_leap else ""
            yield check("longest gap", float(gaps.duration_s[longest]), "s", remark)
            way_m = float(gaps.way_m[farthest])
            remark = f"the carrier moved on, at {gaps.start_s[farthest]:.10g} s" if way_m > _WIDE * spacing_m else ""
            yield check("way in a gap", way_m, "m", remark)
        yield check("held places", 100.0 * self.held, "%")
        is_late = False
        if self.lag is not None and math.isfinite(self.lag.sigma_s):
            is_late = self.lag.is_significant
            remark = self.lag.doubt or ("readings and poses differ in time" if is_late else "")
            yield check("lag", 1e3 * self.lag.s, "ms", remark)
            yield check("lag ±", 1e3 * self.lag.sigma_s, "ms")
        else:
            yield check("lag", math.nan, "ms", "not determined by this log")
        if self.clock is not None:
            is_shifted = self.clock.is_significant and (self.clock.is_leap or not is_late)
            share = 100.0 * max(self.clock.agreement_now, 0.0)
            yield check("agreement of lines", share, "%", self.clock.remark if is_shifted else "")

    def _way(self) -> Iterator[Check]:
        def check(name: str, value: float, unit: str, remark: str = "") -> Check:
            return Check(name, "", value, unit, remark)

        speeds = [line.speed_m_s for line in self.lines_flown] or [0.0]
        times = Counter(line.name for line in self.lines_flown)
        repeated = ", ".join(name for name, n in times.items() if n > 1)
        yield check("lines", len(self.lines_flown), "", f"flown more than once: {repeated}" if repeated else "")
        length_m = float(np.linalg.norm(np.diff(self.place_m[:, :2], axis=0), axis=1).sum())
        yield check("length", length_m, "m", "" if length_m else "the place does not change")
        for name, values, unit in (("speed", np.array(speeds), "m/s"), ("height", self.height_m, "m")):
            yield check(name, float(np.mean(values)), unit)
            yield check(f"least {name}", float(np.min(values)), unit)
            yield check(f"largest {name}", float(np.max(values)), unit)
        if self.coverage is not None:
            spacing_m, widest_m = self.coverage.spacing_m, self.coverage.widest_m
            yield check("line spacing", spacing_m, "m")
            remark = f"{widest_m / spacing_m:.1f} times the spacing" if widest_m > _WIDE * spacing_m else ""
            yield check("widest strip", widest_m, "m", remark)
            yield check("covered", 100.0 * self.coverage.covered, "%")

    def _sensors(self) -> Iterator[Check]:
        for i, sensor in enumerate(self.array.sensors):
            field_T = float(self.field_T[i])
            if math.isfinite(field_T):
                is_whole = self.array.common_field_T is None
                remark = "" if not is_whole or EARTH_T[0] < field_T < EARTH_T[1] else "not the Earth's field: is it nT?"
                yield Check("field", sensor.id, 1e9 * field_T, "nT", remark)
            stated_T = float(white_noise_T(self.array)[self.array.channel_sensor == i].max())
            noise_T = float(self.noise_T[i])
            times = f"{noise_T / stated_T:.1f} times the stated noise: noise_nT = {1e9 * noise_T:.2g}"
            times = "two levels in turn: two instruments in one column?" if alternates(self.fourth_T[:, i]) else times
            remark = times if noise_T > NOISY * stated_T else ""
            yield Check("noise", sensor.id, 1e9 * noise_T, "nT", remark)
            lower = self.weaker_below[i]
            remark = f"larger than those of {lower} below it: exchanged?" if lower else ""
            if sensor.id in self.exchanged[:1]:
                remark = f"appears exchanged with {self.exchanged[1]}: check columns, positions and course"
            yield Check("anomalies", sensor.id, 1e9 * float(self.anomalies_T[i]), "nT", remark)
            for name, which, most in (
                ("missing", self.missing, _MISSING),
                ("stuck", self.stuck, 0.0),
                ("spikes", self.spikes, _SPIKES),
                *([("clipped", self.clipped, 0.0)] if self.clipped.any() else []),
            ):
                share = float(which[:, i].mean())
                remark = f"{which[:, i].sum()} readings" if share > most else ""
                yield Check(name, sensor.id, 100.0 * share, "%", remark)
            error = self.heading[i]
            if error is not None:
                least_T = max(_SIGNIFICANT * error.sigma_T, NOISY * stated_T, sensor.offset_uncertainty_T)
                state = f"offset_uncertainty_nT = {1e9 * error.amplitude_T / self.level_share:.2g}"
                yield Check(
                    "heading error",
                    sensor.id,
                    1e9 * error.amplitude_T,
                    "nT",
                    f"changes with the course: {state}" if error.amplitude_T > least_T else "",
                )
                yield Check("heading error ±", sensor.id, 1e9 * error.sigma_T, "nT", "")

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of the table, of at most `most` checks."""
        rows = [["check", "sensor", "value", "unit", "remark"]]
        rows += [
            [c.name, c.sensor, f"{c.value:.4g}" if c.unit else f"{c.value:.0f}", c.unit, c.remark]
            for c in self.checks[:most]
        ]
        return align(rows)

    def columns(self) -> dict[str, Column]:
        """Return the columns of qc.csv."""
        names, sensors, values, units, remarks = zip(*self.checks, strict=True)
        columns: dict[str, Column] = {"check": list(names), "sensor": list(sensors), "value": np.array(values)}
        return columns | {"unit": list(units), "remark": list(remarks)}

    @property
    def entries(self) -> dict[str, Any]:
        """Checks, lines, gaps and flags as ``magloc qc --json`` prints them."""
        lines = [line._asdict() | {"rows": line.rows.stop - line.rows.start} for line in self.lines_flown]
        gaps = zip(*map(np.ndarray.tolist, self.gaps), strict=True)
        return {
            "checks": [check._asdict() for check in self.checks],
            "lines": lines,
            "gaps": [dict(zip(Gaps._fields, gap, strict=True)) for gap in gaps],
            "flags": self.flags,
        }
