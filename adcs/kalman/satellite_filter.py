"""Attitude of a satellite by an error-state Kalman filter, one reading at a time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.kalman.bank import EstimatorSettings
from adcs.kalman.error_state import AttitudeTracks, FilterSettings, ProcessNoise, SensorSet, start_near
from adcs.kalman.initialisation import KNOWN_RAD, largest_deviation_rad, vector_start
from adcs.kalman.mekf import filter_problem
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Record, Telemetry, orbital_from_eci, part, single_reading
from arrays.io.errors import check_not_negative, check_positive
from arrays.typing import FloatArray
from magloc import core
from magloc.saved_states import read_sealed, seal

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

SILENT_S = 60.0
"""Time without a reading of a sensor after which the estimate has a flag."""
_LARGEST_FIELD_T = 1.0  # a larger one is in another unit
_VERSION = 1
_ONLY = np.array([0])
_UNUSED = start_near(quaternion.IDENTITY[None], np.zeros((1, 3)), 1.0, 1.0)  # by a filter that goes on
_COLUMNS = ("star", "gyro_rad_s", "field_T", "sun", "wheels_Nms", "torquers_Am2")


@dataclass(frozen=True, eq=False)
class SatelliteEstimate:
    """Attitude of a satellite at one time; NaN while the filter has not started.

    Attributes
    ----------
    time_s : float
        Time since :attr:`adcs.Satellite.start`.
    q : ndarray, shape (4,)
        Attitude, inertial (J2000) from body, scalar first.
    rate_rad_s : ndarray, shape (3,)
        Rate against inertial space, body axes.
    states : mapping of str to ndarray
        Optional states by name, such as ``gyro-bias``.
    covariance : ndarray, shape (N, N)
        Covariance of a small rotation about the body's axes [rad], of the rate, and of the states in their order.
    sigma : mapping of str to ndarray
        Standard deviations by name: ``attitude`` [rad], ``rate``, and those of the states.
    nis : mapping of str to float
        Normalised innovation squared of each sensor; NaN without a reading.
    flags : tuple of str
        ``starting``: no attitude yet. ``restarted``: the filter started anew after a long gap. ``NAME-rejected``: the
        gate rejected the reading. ``NAME-silent``: no reading for a minute. NAME is ``st``, ``gyro``, ``mag``, ``sun``.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> filter = adcs.SatelliteFilter(log.satellite, sensors="st+gyro", step_s=1.0)
    >>> filter.update(0.0, gyro_rad_s=[0.0, 0.001, 0.0]).flags
    ('starting',)
    """

    time_s: float
    q: FloatArray
    rate_rad_s: FloatArray
    states: Mapping[str, FloatArray]
    covariance: FloatArray
    sigma: Mapping[str, FloatArray]
    nis: Mapping[str, float]
    flags: tuple[str, ...]

    @cached_property
    def rotation(self) -> Rotation:
        """Rotation, inertial from body."""
        return quaternion.to_rotation(self.q)


class SatelliteFilter:
    """Attitude and rate of a satellite by an error-state Kalman filter, one reading at a time.

    It is the multiplicative extended Kalman filter (``mekf``) of :func:`adcs.estimate`, with its gate: a reading that
    contradicts the prediction with a probability below one in a million is rejected. The filter starts at the first
    instant that determines an attitude: with a star tracker at its first reading, otherwise at the first reading of
    both field and Sun. Field and Sun are computed at each time. :func:`adcs.estimate` interpolates them, which changes
    them by less than 0.05 nT and 1e-7 rad; otherwise the numbers are the same.

    Parameters
    ----------
    satellite : Satellite
        Inertia, orbit, sensors and their noise.
    sensors : str or EstimatorSettings
        Sensors in use, of ``st`` (star tracker), ``gyro``, ``mag`` (magnetometer) and ``sun`` (Sun sensor), such as
        ``"st+gyro"``; or all settings of a filter ``mekf``, which replace ``states`` too.
    states : iterable of str
        States besides attitude and rate: ``gyro-bias`` [rad/s], ``field-bias`` (of the magnetometer) [T],
        ``disturbance`` (angular acceleration) [1/s²], ``field-model`` (error of the field model) [T], ``dipole`` (of
        the body) [A·m²], ``field-gain`` (gains and axes of the magnetometer).
    step_s : float
        Usual time between updates [s]. The process noise is stated for such a step, and longer steps are divided.
    horizon_s : float
        Largest delay of a late reading [s]; 0 refuses late readings. The filter keeps its states for this time, and
        repeats the updates after a late reading.

    Raises
    ------
    ValueError
        The sensors cannot observe the attitude at one instant, or a state.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> rows = log.telemetry
    >>> board = adcs.SatelliteFilter(
    ...     log.satellite, sensors="st+gyro", states=["gyro-bias"], step_s=rows.step_s
    ... )
    >>> for time_s, star, rate in zip(rows.time_s, rows.star, rows.gyro_rad_s):
    ...     estimate = board.update(time_s, star=star, gyro_rad_s=rate)
    >>> bool((estimate.rotation * log.truth[-1].inv()).magnitude() < 1e-3)
    True
    """

    def __init__(
        self,
        satellite: Satellite,
        *,
        sensors: str | EstimatorSettings,
        states: Iterable[str] = (),
        step_s: float,
        horizon_s: float = 0.0,
    ) -> None:
        check_positive(step_s=step_s)
        check_not_negative(horizon_s=horizon_s)
        inertia = satellite.body.inertia_kgm2
        chosen = (
            sensors
            if isinstance(sensors, EstimatorSettings)
            else EstimatorSettings.of(sensors, states, "mekf", inertia)
        )
        used = chosen.settings.sensors
        if chosen.filter != "mekf":
            raise ValueError(f"Input sensors must be settings of the filter mekf; instead received {chosen.filter}.")
        if not (used.star or (used.magnetometer and used.sun)):
            raise ValueError(
                f"Input sensors must be st or mag+sun, or more; instead received {used.sensors}, which determines no "
                "attitude at one instant. Use adcs.estimate on a log."
            )
        self.satellite, self.step_s, self.horizon_s = satellite, float(step_s), float(horizon_s)
        self.settings, self.longest_gap_s = chosen.settings, chosen.longest_gap_s
        self._progress, self._replay = _Progress(), tuple[_Taken, ...]()

    def update(
        self,
        time_s: float,
        *,
        star: Rotation | ArrayLike | None = None,
        star_covariance_rad2: ArrayLike | None = None,
        gyro_rad_s: ArrayLike | None = None,
        field_T: ArrayLike | None = None,
        sun: ArrayLike | None = None,
        wheels_Nms: ArrayLike | None = None,
        torquers_Am2: ArrayLike | None = None,
    ) -> SatelliteEstimate:
        """Take the readings of a time and return the attitude.

        Parameters
        ----------
        time_s : float
            Time since :attr:`adcs.Satellite.start`, later than the one before, or a late reading's, at most
            ``horizon_s`` before. Late readings with the time of an update are added to that update. After a gap that is
            longer than ``longest_gap_s`` of the settings, 600 s, the filter starts anew.
        star, star_covariance_rad2, gyro_rad_s, field_T, sun : optional
            Readings as in a row of :class:`adcs.Telemetry`. None, and a reading with a component that is NaN, is
            missing.
        wheels_Nms, torquers_Am2 : array_like, shape (3,), optional
            Momentum of the wheels and commanded moment of the torquers; None and NaN keep the value before.

        Returns
        -------
        SatelliteEstimate
            Attitude with its covariance and flags, at the latest time so far.

        Raises
        ------
        ValueError
            The time does not ascend and is not within the horizon, a reading is infinite, has no direction or another
            shape, a field is larger than 1 T, or the filter diverges. The filter is then as before the call.
        """
        given = (star, gyro_rad_s, field_T, sun, wheels_Nms, torquers_Am2)
        readings = {name: _reading(name, value) for name, value in zip(_COLUMNS, given, strict=True)}
        covariance = single_reading("star_covariance_rad2", star_covariance_rad2, (3, 3))
        before, rows = self._progress, [_Row(float(time_s), readings, covariance)]
        kept = self._replay
        if not before.last_s < rows[0].time_s < math.inf:
            before, rows, kept = self._rows_with_late(rows[0])
        for row in rows:
            kept = (*kept, _Taken(before, row))
            before, estimate = self._take(before, row)
        self._progress = before
        self._replay = tuple(
            one for one in kept if self.horizon_s > 0.0 and one.row.time_s >= before.last_s - self.horizon_s
        )
        return estimate

    def _rows_with_late(self, late: _Row) -> tuple[_Progress, list[_Row], tuple[_Taken, ...]]:
        """Return the state before a late row, that row and those after it, and the replay buffer before it."""
        since_s = self._progress.last_s - self.horizon_s
        later = [one for one in self._replay if one.row.time_s >= late.time_s]
        if not (later and late.time_s >= since_s and late.time_s > later[0].before.last_s):
            reach = (
                f", or be a late one's after {max(since_s, self._replay[0].before.last_s):.17g} s"
                if self._replay
                else ""
            )
            raise ValueError(
                f"Input time_s must ascend and be finite{reach}; instead received {late.time_s:.17g} s after "
                f"{self._progress.last_s:.17g} s. Skip the row."
            )
        rows = [one.row for one in later]
        rows = [rows[0].join(late), *rows[1:]] if rows[0].time_s == late.time_s else [late, *rows]
        return later[0].before, rows, self._replay[: len(self._replay) - len(later)]

    def _take(self, before: _Progress, row: _Row) -> tuple[_Progress, SatelliteEstimate]:
        """Return the state and the estimate after a row."""
        time_s = row.time_s
        is_late = time_s - before.last_s > max(self.longest_gap_s, self.step_s)
        is_restarted = is_late and bool(before.n_taken)
        if is_late:
            before = _Progress()
        record = self._record(time_s, before, row.readings, row.star_covariance_rad2)
        seen = np.array([there[0, -1] for there in record.readings.seen.values()])
        after = replace(
            before,
            first_s=before.first_s if math.isfinite(before.last_s) else time_s,
            last_s=time_s,
            wheels_Nms=_latest(row.readings["wheels_Nms"], before.wheels_Nms),
            torquers_Am2=_latest(row.readings["torquers_Am2"], before.torquers_Am2),
            read_s=np.where(seen | ~np.isfinite(before.read_s), time_s, before.read_s),
        )
        after, tracks = self._filter(record, after)
        return after, self._estimate(record, after, tracks, is_restarted=is_restarted)

    def state(self) -> dict[str, Any]:
        """Return the state of the filter, for a JSON file and :meth:`from_state`.

        It does not contain earlier states: after a restart, older readings are refused.
        """
        now = self._progress
        counts = np.array([now.first_s, now.last_s, now.n_taken])
        content = np.concatenate([counts, now.wheels_Nms, now.torquers_Am2, now.read_s, now.memory]).tobytes()
        settings = asdict(self.settings)
        return seal(
            _VERSION,
            content,
            settings=settings,
            step_s=self.step_s,
            longest_gap_s=self.longest_gap_s,
            horizon_s=self.horizon_s,
        )

    @classmethod
    def from_state(cls, state: Mapping[str, Any], satellite: Satellite) -> SatelliteFilter:
        """Return a filter that resumes from a state, bit for bit.

        Parameters
        ----------
        state : mapping
            State of :meth:`state`.
        satellite : Satellite
            The satellite of the saved filter; the state does not contain it.

        Raises
        ------
        ValueError
            The state has another version, or is damaged.
        """

        def read(content: bytes) -> SatelliteFilter:
            saved = dict(state["settings"])
            sensors = SensorSet(**{**saved["sensors"], "states": tuple(saved["sensors"]["states"])})
            settings = FilterSettings(**{**saved, "sensors": sensors, "noise": ProcessNoise(**saved["noise"])})
            chosen = EstimatorSettings(settings, longest_gap_s=float(state["longest_gap_s"]))
            found = cls(satellite, sensors=chosen, step_s=state["step_s"], horizon_s=state.get("horizon_s", 0.0))
            numbers_ = np.frombuffer(content, dtype=np.float64)
            first_s, last_s, n_taken = numbers_[:3]
            wheels, torquers, read_s, memory = np.split(numbers_[3:], [3, 6, 6 + len(SENSORS)])
            if memory.size != (found._memory_size(last_s) if n_taken else 0):
                raise ValueError(f"its length {len(content)}")
            held = (wheels.copy(), torquers.copy(), read_s.copy())
            found._progress = _Progress(float(first_s), float(last_s), int(n_taken), *held, _aligned(memory))
            return found

        return read_sealed(state, _VERSION, "SatelliteFilter", read)

    def _memory_size(self, time_s: float) -> int:
        """Return the number of doubles of the kernel's workspace."""
        missing = {name: _reading(name, None) for name in _COLUMNS}
        work, _ = filter_problem(self._record(time_s, _Progress(), missing, None), self.settings, _UNUSED)
        return core.workspace_size("mekf_runs", work)

    def _record(
        self, time_s: float, before: _Progress, row: Mapping[str, FloatArray], star_covariance_rad2: ArrayLike | None
    ) -> Record:
        """Return the input of the filter from the time before, if there is one, to a time."""
        is_first = not math.isfinite(before.last_s)
        last = {name: np.full(values.shape, np.nan) for name, values in row.items()}
        last |= {"wheels_Nms": before.wheels_Nms, "torquers_Am2": before.torquers_Am2}
        # The momentum before its first reading is that reading; a missing one keeps the value before.
        now = {**row, "wheels_Nms": _latest(row["wheels_Nms"], before.wheels_Nms)}
        columns = {name: np.stack([values] if is_first else [last[name], values]) for name, values in now.items()}
        times = [time_s] if is_first else [before.last_s, time_s]
        covariance = np.full((len(times), 3, 3), np.nan)
        covariance[-1] = single_reading("star_covariance_rad2", star_covariance_rad2, (3, 3))
        log = Telemetry(times, **columns, star_covariance_rad2=covariance, step_s=self.step_s)
        return log.record(self.satellite, time_s if is_first else before.first_s)

    def _filter(self, record: Record, after: _Progress) -> tuple[_Progress, AttitudeTracks | None]:
        """Return the progress after a record, and its tracks; None before the start."""
        start = _UNUSED
        if not after.n_taken:
            record = part(record, _ONLY, slice(-1, None))
            if not _is_determined(record, self.settings):
                return after, None
            start = vector_start(record, self.settings)
            if not self.settings.sensors.star and largest_deviation_rad(start)[0] > KNOWN_RAD:
                return after, None
        work, tracks = filter_problem(record, self.settings, start, n_before=after.n_taken)
        memory = _aligned(after.memory if after.n_taken else np.zeros(core.workspace_size("mekf_runs", work)))
        n = tracks.q.shape[1]
        core.run("mekf_runs", work, n, block=n, workspace=memory)
        last = tracks.at(-1)
        variance = np.diagonal(last.P[0])
        # An estimate scales the covariance by four, which must not overflow.
        if not (np.isfinite(last.q).all() and ((variance > 0.0) & (variance < 1e300)).all()):
            raise ValueError("Input readings must be such that an attitude explains them; instead the filter diverges.")
        return replace(after, n_taken=after.n_taken + n - bool(after.n_taken), memory=memory), tracks

    def _estimate(
        self, record: Record, after: _Progress, tracks: AttitudeTracks | None, *, is_restarted: bool
    ) -> SatelliteEstimate:
        """Return the estimate at the last instant of the tracks."""
        used = self.settings.sensors
        names = used.sensors.split("+")
        silent = dict(zip(SENSORS, after.last_s - after.read_s > SILENT_S, strict=True))
        flags = [f"{name}-silent" for name in names if silent[name]]
        if tracks is None:
            nothing = np.full(used.size, np.nan)
            split = used.split(nothing)
            states = {name: split[name] for name in used.states}
            nis, P = dict.fromkeys(SENSORS, math.nan), np.full((used.size, used.size), np.nan)
            return SatelliteEstimate(
                after.last_s, np.full(4, np.nan), nothing[:3], states, P, split, nis, ("starting", *flags)
            )
        last, rejected = tracks.at(-1), dict(zip(SENSORS, tracks.rejected[0, -1], strict=True))
        flags = [f"{name}-rejected" for name in names if rejected[name]] + flags
        to_rotation = np.where(np.arange(used.size) < 3, 2.0, 1.0)  # δq is half of the angle
        eci = quaternion.conjugate(orbital_from_eci(record.environment)[0, -1])
        return SatelliteEstimate(
            after.last_s,
            quaternion.multiply(eci, last.q[0]),
            last.w[0].copy(),
            {name: values[0].copy() for name, values in last.optional.items()},
            to_rotation[:, None] * last.P[0] * to_rotation,
            used.split(np.sqrt(np.diagonal(last.P[0]))),
            dict(zip(SENSORS, tracks.nis[0, -1].tolist(), strict=True)),
            ("restarted", *flags) if is_restarted else tuple(flags),
        )


@dataclass(frozen=True, eq=False)
class _Progress:
    """Memory of a filter after an update."""

    first_s: float = math.nan
    last_s: float = -math.inf
    n_taken: int = 0  # instants since the start
    wheels_Nms: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    torquers_Am2: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    read_s: FloatArray = field(default_factory=lambda: np.full(len(SENSORS), np.nan))  # last reading of each sensor
    memory: FloatArray = field(default_factory=lambda: np.zeros(0))  # of the kernel


@dataclass(frozen=True, eq=False)
class _Row:
    """Readings of a time, NaN where missing."""

    time_s: float
    readings: Mapping[str, FloatArray]
    star_covariance_rad2: FloatArray

    def join(self, late: _Row) -> _Row:
        """Return the row with its readings replaced by late ones of the same time."""
        readings = {name: _latest(values, self.readings[name]) for name, values in late.readings.items()}
        has_star = not np.isnan(late.readings["star"]).any()
        return _Row(self.time_s, readings, (late if has_star else self).star_covariance_rad2)


@dataclass(frozen=True, eq=False)
class _Taken:
    """Row, and the state of the filter before it."""

    before: _Progress
    row: _Row


def _reading(name: str, value: Any) -> FloatArray:
    """Return a reading (k,); NaN where it is missing."""
    if name == "star":
        return single_reading(name, value.as_quat() if hasattr(value, "as_quat") else value, (4,))
    found = single_reading(name, value)
    if name == "field_T" and (np.abs(found) > _LARGEST_FIELD_T).any():
        raise ValueError(
            f"Input field_T must be at most {_LARGEST_FIELD_T:g} T; instead received {found.tolist()}. "
            "Convert it to tesla."
        )
    return found


def _latest(now: FloatArray, before: FloatArray) -> FloatArray:
    """Return a value (3,), or where it is missing the value before."""
    return before if np.isnan(now).any() else now


def _is_determined(record: Record, settings: FilterSettings) -> bool:
    """Return whether a sensor in use reads the attitude at the first instant of a record."""
    used, seen = settings.sensors, record.readings.seen
    return any(seen[name][0, 0] for name in used.sensors.split("+") if name != "gyro")


def _aligned(values: FloatArray) -> FloatArray:
    """Return a copy that begins at a multiple of 64 bytes, as the kernel's workspace does."""
    room = np.empty(values.size + 8)
    first = (-room.ctypes.data % 64) // 8
    found = room[first : first + values.size]
    found[:] = values
    return found
