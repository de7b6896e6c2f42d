"""Attitude of an inertial unit with a magnetometer, one reading at a time.

The filter is C++, `magloc/core/include/adcs/attitude_filter.hpp`; a microcontroller runs the same source.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adcs import quaternion
from adcs.complementary.heading import HeadingModel
from adcs.complementary.inertial_magnetic import (
    LONGEST_LAG_S,
    InertialMagneticRecord,
    RecordMotion,
    check_units,
    magnetometer_lag,
)
from adcs.complementary.names import MAGNETS, Magnet
from adcs.satellite.telemetry import single_reading
from adcs.satellite.vector_record import GYRO_SAMPLES, GyroSamples
from arrays.io.values import numbers
from arrays.typing import BoolArray, FloatArray
from magloc import core
from magloc.saved_states import read_sealed, seal

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

FLAGS = (
    "starting",
    "field-left-out",
    "magnet-subtracted",
    "heading-lost",
    "heading-doubtful",
    "heading-relative",
    "moving-start",
    "gyro-silent",
    "accelerometer-silent",
    "magnetometer-silent",
)
"""Names of the bits of the flags, from the lowest one on."""
_VERSION = 1  # AttitudeFilter::version
_DISTURBANCES = {"auto": 0, "rejected": 1, "subtracted": 2, "kept": 3}
_BLOCK = 4000  # rows per call: some milliseconds
_REFUSALS = (
    "",
    "Input time_s must ascend and be finite; instead received {time_s:.17g} s after {last_s:.17g} s. Skip the row.",
    "Input gyro_rad_s must be at most 1e4 rad/s; instead received {0}. Use NaN where missing.",
    "Input acceleration_m_s2 must have a length, at most 1e6 m/s²; instead received {1}. Use NaN where missing.",
    "Input field_T must have a length, at most 1 T; instead received {2}. Use NaN where missing.",
)


@dataclass(frozen=True)
class AttitudeConfig:
    """Settings of an attitude filter.

    Attributes
    ----------
    magnet : str
        Treatment of a field that contradicts the filter, as in :func:`adcs.inertial_magnetic_filter`.
    gyro_samples : str
        Kind of a sample: the ``mean`` rate since the one before, or the rate at a ``point`` in time.
    lag_s : float
        Lag of the magnetometer behind the gyro, at most 40 ms. It is a constant of the instrument;
        :meth:`from_log` measures it.
    model : HeadingModel
        Noise and limits of the heading filter.

    Raises
    ------
    ValueError
        A name is unknown, or the lag is out of its range.

    Examples
    --------
    >>> import adcs
    >>> adcs.AttitudeConfig(magnet="rejected", lag_s=0.013).lag_s
    0.013
    """

    magnet: Magnet = "auto"
    gyro_samples: GyroSamples = "mean"
    lag_s: float = 0.0
    model: HeadingModel = field(default_factory=HeadingModel)

    def __post_init__(self) -> None:
        for name, names in (("magnet", MAGNETS), ("gyro_samples", GYRO_SAMPLES)):
            if (value := getattr(self, name)) not in names:
                raise ValueError(f"Input {name} must be one of {', '.join(names)}; instead received {value!r}.")
        if not 0.0 <= self.lag_s <= LONGEST_LAG_S:
            raise ValueError(f"Input lag_s must be within 0 and {LONGEST_LAG_S:g} s; instead received {self.lag_s!r}.")

    @classmethod
    def from_log(
        cls,
        time_s: ArrayLike,
        gyro_rad_s: ArrayLike,
        acceleration_m_s2: ArrayLike,
        field_T: ArrayLike,
        *,
        magnet: Magnet = "auto",
        gyro_samples: GyroSamples = "mean",
        model: HeadingModel | None = None,
    ) -> AttitudeConfig:
        """Return settings with the lag of the magnetometer in a log in which the unit rotates.

        Arguments as of :func:`adcs.inertial_magnetic_filter`. Raises ValueError as it does, so also if the unit or the
        axes of a sensor contradict the others.
        """
        times, rate, acceleration, field_ = map(numbers, (time_s, gyro_rad_s, acceleration_m_s2, field_T))
        record = InertialMagneticRecord(times, rate, acceleration, field_, gyro_samples)
        check_units(record)
        model = model or HeadingModel()
        return cls(magnet, gyro_samples, magnetometer_lag(record, RecordMotion.of(record, model)), model)


@dataclass(frozen=True, eq=False)
class AttitudeEstimate:
    """Attitude at one time.

    Attributes
    ----------
    time_s : float
        Time of the readings.
    q : ndarray, shape (4,)
        Attitude, east, north, up from body, scalar first.
    sigma_tilt_rad, sigma_heading_rad : float
        Standard deviations of the angle between up and its estimate, and of the angle about up.
    rate_rad_s, bias_rad_s : ndarray, shape (3,)
        Rate of the gyro without its bias, and the bias, body axes.
    offset_T : ndarray, shape (3,)
        Offset of the magnetometer, body axes; the field of a magnet that moves with the sensor.
    bits : int
        Flags, one a bit; :attr:`flags` has their names.

    Examples
    --------
    >>> import adcs
    >>> estimate = adcs.AttitudeFilter().update(0.0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.8], [0.0, 20e-6, -43e-6])
    >>> estimate.flags, estimate.disturbed
    (('starting',), False)
    """

    time_s: float
    q: FloatArray
    sigma_tilt_rad: float
    sigma_heading_rad: float
    rate_rad_s: FloatArray
    bias_rad_s: FloatArray
    offset_T: FloatArray
    bits: int

    @cached_property
    def rotation(self) -> Rotation:
        """Rotation, east, north, up from body."""
        return quaternion.to_rotation(self.q)

    @property
    def flags(self) -> tuple[str, ...]:
        """Names of what limits the estimate."""
        return tuple(name for i, name in enumerate(FLAGS) if self.bits >> i & 1)

    @property
    def disturbed(self) -> bool:
        """True if the field is ignored, or a magnet is subtracted."""
        return bool(self.bits & 6)


@dataclass(frozen=True, eq=False)
class AttitudeRows:
    """Attitudes of n rows; see :class:`AttitudeEstimate`."""

    q: FloatArray  # (n, 4)
    sigma: FloatArray  # (n, 2): tilt and heading [rad]
    corrected_rate: FloatArray  # (n, 3)
    bias: FloatArray  # (n, 3)
    offset: FloatArray  # (n, 3)
    flags: NDArray[np.int64]  # (n,)
    status: NDArray[np.int64]  # (n,)

    @classmethod
    def empty(cls, n: int) -> AttitudeRows:
        """Return rows that a kernel fills."""
        q, sigma, rate, bias, offset = (np.zeros((n, k)) for k in (4, 2, 3, 3, 3))
        return cls(q, sigma, rate, bias, offset, np.zeros(n, np.int64), np.zeros(n, np.int64))

    def has_flag(self, name: str) -> BoolArray:
        """Return the rows (n,) with a flag."""
        return np.asarray(self.flags >> FLAGS.index(name) & 1, dtype=np.bool_)


class AttitudeFilter:
    """Attitude of an inertial unit with a magnetometer, one reading at a time, also near magnets.

    :func:`adcs.inertial_magnetic_filter` has the same method without ``offline``, which runs this filter over a log.
    In the first second the unit should rest: it gives the gyro's bias, the direction up and north. After it, an
    estimate uses all readings so far.

    Parameters
    ----------
    config : AttitudeConfig
        Settings.

    Examples
    --------
    >>> import adcs
    >>> imu = adcs.datasets.load("imu")
    >>> filter = adcs.AttitudeFilter(adcs.AttitudeConfig(gyro_samples="point"))
    >>> for row in zip(imu.time_s, imu.gyro_rad_s, imu.acceleration_m_s2, imu.field_T):
    ...     estimate = filter.update(*row)
    >>> bool((estimate.rotation.inv() * imu.truth[-1]).magnitude() < 0.1)
    True
    """

    def __init__(self, config: AttitudeConfig | None = None) -> None:
        self.config = config or AttitudeConfig()
        self._time, self._readings = np.full(1, np.nan), np.full((3, 1, 3), np.nan)
        self._rows = AttitudeRows.empty(1)
        self._work, self._state = _problem(self.config, self._time, self._readings, self._rows)
        self._last_s = -math.inf

    def update(
        self,
        time_s: float,
        gyro_rad_s: ArrayLike | None,
        acceleration_m_s2: ArrayLike | None,
        field_T: ArrayLike | None,
    ) -> AttitudeEstimate:
        """Take the readings of a time and return the attitude.

        Parameters
        ----------
        time_s : float
            Time, later than the one before; steps may have any length. After a gap σ is larger.
        gyro_rad_s, acceleration_m_s2, field_T : array_like, shape (3,), optional
            Readings in body axes; at rest the acceleration is 9.8 m/s² upwards. None, and a reading with a component
            that is NaN, is missing.

        Returns
        -------
        AttitudeEstimate
            Attitude with its standard deviations and flags.

        Raises
        ------
        ValueError
            The time does not ascend, or a reading is infinite, too large, a zero vector or of another shape. The filter
            is then as before the call.
        """
        self._time[0] = time_s
        given = {"gyro_rad_s": gyro_rad_s, "acceleration_m_s2": acceleration_m_s2, "field_T": field_T}
        for place, (name, reading) in zip(self._readings, given.items(), strict=True):
            place[0] = single_reading(name, reading)
        core.run("attitude_filter", self._work, 1, block=1, workspace=self._state_memory)
        self._work.struct.resume = 1
        rows = self._rows
        if status := int(rows.status[0]):
            found = [values[0].tolist() for values in self._readings]
            raise ValueError(_REFUSALS[status].format(*found, time_s=self._time[0], last_s=self._last_s))
        self._last_s = float(self._time[0])
        tilt, heading = rows.sigma[0].tolist()
        q, rate, bias, offset = (v[0].copy() for v in (rows.q, rows.corrected_rate, rows.bias, rows.offset))
        return AttitudeEstimate(self._last_s, q, tilt, heading, rate, bias, offset, int(rows.flags[0]))

    def state(self) -> dict[str, Any]:
        """Return the state of the filter, for a JSON file and :meth:`from_state`."""
        return seal(
            _VERSION,
            self._state.tobytes(),
            config=asdict(self.config),
            last_s=self._last_s if math.isfinite(self._last_s) else None,
            is_started=bool(self._work.struct.resume),
        )

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> AttitudeFilter:
        """Return a filter that resumes from a state, bit for bit.

        Raises
        ------
        ValueError
            The state has another version, or is damaged.
        """

        def read(content: bytes) -> AttitudeFilter:
            config = dict(state["config"])
            found = cls(AttitudeConfig(**{**config, "model": HeadingModel(**config["model"])}))
            if len(content) != found._state.nbytes:
                raise ValueError(f"its length {len(content)}")
            last_s, found._work.struct.resume = state["last_s"], int(bool(state["is_started"]))
            found._state[:] = np.frombuffer(content, dtype=np.float64)
            found._last_s = -math.inf if last_s is None else float(last_s)
            return found

        return read_sealed(state, _VERSION, "AttitudeFilter", read)

    @property
    def _state_memory(self) -> Any:
        return self._work.struct.state


def filter_rows(
    config: AttitudeConfig,
    time_s: FloatArray,
    gyro_rad_s: FloatArray,
    acceleration_m_s2: FloatArray,
    field_T: FloatArray,
) -> AttitudeRows:
    """Return what :meth:`AttitudeFilter.update` returns for each of n rows; a row that it refuses has a status."""
    n = len(time_s)
    rows, readings = AttitudeRows.empty(n), (gyro_rad_s, acceleration_m_s2, field_T)
    work, _ = _problem(config, np.ascontiguousarray(time_s), [np.ascontiguousarray(v) for v in readings], rows)
    core.run("attitude_filter", work, n, block=_BLOCK, chain=n, workspace=work.struct.state)
    return rows


def _problem(
    config: AttitudeConfig, time_s: FloatArray, readings: Any, rows: AttitudeRows
) -> tuple[core.Problem, FloatArray]:
    """Return the description of rows to the kernel, and the filter's state."""
    model = np.array([getattr(config.model, one.name) for one in fields(config.model)])
    known: dict[str, Any] = {
        "model": model,
        "lag": config.lag_s,
        "is_point_sample": int(config.gyro_samples == "point"),
        "disturbance": _DISTURBANCES[config.magnet],
        "time": time_s,
        "rate": readings[0],
        "acceleration": readings[1],
        "field": readings[2],
        "resume": 0,
        **{one.name: getattr(rows, one.name) for one in fields(rows)},
    }
    size = core.workspace_size("attitude_filter", core.problem("attitude", state=None, **known))
    state = np.zeros(size)
    return core.problem("attitude", state=state, **known), state
