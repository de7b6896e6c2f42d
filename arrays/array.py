"""The array: rigidly connected sensors, their channels, and the ambient field."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.columns import LogColumns
from arrays.pose import PoseUncertainty
from arrays.sensor import Sensor, _finite, _not_negative, _plain
from arrays.typing import BoolArray, FloatArray, IntArray

AnyArray = TypeVar("AnyArray", bound=NDArray[Any])
AMBIENT_CHANNELS = ("ambient_x", "ambient_y", "ambient_z")
_FARTHEST_M = 1e9
_SAME_PLACE_RTOL = 1e-9
_GRADIENT_RTOL = 1e-6
# Cached properties that depend on the ambient field.
_OF_AMBIENT_FIELD = ("_hash", "ambient_fields", "channel_ambient_T")


@dataclass(frozen=True)
class SensorArray:
    """Sensors that are rigidly connected.

    Properties per channel are in the order of the sensors, x y z within a vector sensor. C is the number of channels, N
    that of the sensors. The arrays that properties return are read-only.

    Attributes
    ----------
    sensors : tuple of Sensor
        Sensors with different ids, not all at one position. A single sensor can be calibrated; differences need two.
    name : str
        One line of text, or empty.
    noise_fraction : float
        Noise proportional to the field, for sensors without their own: variance = noise² + (fraction · |B|)².
    common_field_T : float, optional
        Standard deviation, per axis, of the field common to all sensors [T]. None: it is unknown, and only differences
        between sensors carry information.
    ambient_T : tuple, shape (3,), optional
        Known ambient field in the array's frame, at its origin [T].
    ambient_world_T : tuple, shape (3,), optional
        The same in the world frame of the readings' pose [T]; it has priority for readings with a pose.
    ambient_gradient_T_m : tuple of tuples, shape (3, 3), optional
        Known gradient tensor dB_i/dx_j of the ambient field in the array's frame [T/m], symmetric and traceless, as for
        all fields of distant sources. None: a uniform field.
    ambient_uncertainty_T : float
        Standard deviation, per axis, of the error of the ambient field, constant for all sensors and rows [T].
    ambient_uncertainty_white_T : float
        The same for an error that is new in every row [T].
    pose : PoseUncertainty, optional
        Errors of the pose in the readings; None: the pose is exact.
    columns : LogColumns, optional
        Names and units of the columns of its logs; None: the names in a readings file.

    Raises
    ------
    ValueError
        One of these conditions does not hold.

    Examples
    --------
    >>> import arrays
    >>> low = arrays.Sensor("low", "scalar", (0.0, 0.0, 0.0), noise_T=1e-11)
    >>> high = arrays.Sensor("high", "scalar", (0.0, 0.0, 0.5), noise_T=1e-11)
    >>> array = arrays.SensorArray((low, high))
    >>> array.channel_names, array.circumradius
    (('low', 'high'), 0.25)
    """

    sensors: tuple[Sensor, ...]
    name: str = ""
    noise_fraction: float = 0.0
    common_field_T: float | None = None
    ambient_T: tuple[float, float, float] | None = None
    ambient_gradient_T_m: tuple[tuple[float, float, float], ...] | None = None
    ambient_uncertainty_T: float = 0.0
    pose: PoseUncertainty | None = None
    columns: LogColumns | None = None
    ambient_world_T: tuple[float, float, float] | None = None
    ambient_uncertainty_white_T: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", tuple(self.sensors))
        if not (isinstance(self.name, str) and self.name.isprintable()):  # type: ignore[redundant-expr]
            raise ValueError(f"Input name must be one line of printable text; instead received {self.name!r}.")
        for name in ("noise_fraction", "common_field_T", "ambient_uncertainty_T", "ambient_uncertainty_white_T"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _not_negative(name, getattr(self, name)))
        for name in ("ambient_T", "ambient_world_T"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(_finite(name, getattr(self, name), (3,)).tolist()))
        if self.ambient_gradient_T_m is not None:
            object.__setattr__(self, "ambient_gradient_T_m", _gradient_tensor(self.ambient_gradient_T_m))
        if not self.sensors:
            raise ValueError("Input sensors must be at least 1; instead received 0.")
        _check_distinct_names(self)
        if np.abs(self.positions).max() > _FARTHEST_M:
            raise ValueError(f"Input sensors must stand within {_FARTHEST_M:g} m of the origin; instead they do not.")
        if self.n_sensors > 1 and self.circumradius <= _SAME_PLACE_RTOL * np.abs(self.positions).max():
            raise ValueError(
                f"Input sensors must stand in two places at least; instead received {self.n_sensors} sensors "
                f"at {_plain(self.positions[0])} m."
            )

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Hash of all fields, cached because every fix needs it."""
        return hash(tuple(getattr(self, field.name) for field in fields(self)))

    def __getstate__(self) -> dict[str, Any]:
        # Without the cached arrays, which would come back writeable.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Ids of the sensors."""
        return tuple(sensor.id for sensor in self.sensors)

    def __repr__(self) -> str:
        return f"<SensorArray {self.name!r}: {self.n_sensors} sensors, {self.n_channels} channels>"

    @property
    def n_sensors(self) -> int:
        """Number of sensors N."""
        return len(self.sensors)

    @property
    def n_channels(self) -> int:
        """Number of channels C: 3 for each vector sensor, 1 for each scalar one."""
        return len(self.channel_names)

    @cached_property
    def positions(self) -> FloatArray:
        """Positions of the sensors, shape (N, 3) [m]."""
        return _read_only(np.array([sensor.position_m for sensor in self.sensors]))

    @cached_property
    def centroid(self) -> FloatArray:
        """Mean position of the sensors, shape (3,) [m]."""
        return _read_only(self.positions.mean(axis=0))

    @cached_property
    def circumradius(self) -> float:
        """Greatest distance of a sensor from the centroid [m]."""
        return float(np.linalg.norm(self.positions - self.centroid, axis=1).max())

    @cached_property
    def rotation_matrices(self) -> FloatArray:
        """Rotations from the sensors' axes to the array's frame, shape (N, 3, 3)."""
        xyzw = np.array([sensor.rotation_xyzw for sensor in self.sensors])
        if not xyzw[:, :3].any():
            return _read_only(np.tile(np.eye(3), (self.n_sensors, 1, 1)))
        from scipy.spatial.transform import Rotation  # a tenth of a command that finds fixes, to import

        return _read_only(Rotation.from_quat(xyzw).as_matrix())

    @cached_property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels: ``s1_x, s1_y, s1_z`` of a vector sensor s1, ``s5`` of a scalar sensor s5."""
        return tuple(name for sensor in self.sensors for name in sensor.channel_names)

    @cached_property
    def channel_sensor(self) -> IntArray:
        """Index of each channel's sensor, shape (C,)."""
        return _read_only(np.repeat(np.arange(self.n_sensors), [sensor.n_channels for sensor in self.sensors]))

    @cached_property
    def sensor_channels(self) -> IntArray:
        """Channels of each sensor, shape (N, 3); -1 where a scalar sensor has none."""
        counts = [sensor.n_channels for sensor in self.sensors]
        first = np.cumsum([0, *counts[:-1]])
        axis = np.arange(3)
        return _read_only(np.where(axis < np.array(counts)[:, None], first[:, None] + axis, -1))

    @cached_property
    def channel_is_scalar(self) -> BoolArray:
        """Mask of the channels that read the modulus of the field, shape (C,)."""
        return _read_only(np.array([sensor.kind == "scalar" for sensor in self.sensors])[self.channel_sensor])

    @cached_property
    def channel_noise_T(self) -> FloatArray:
        """Standard deviation of each channel in a single row, shape (C,) [T]."""
        return _read_only(np.array([sensor.row_noise_T for sensor in self.sensors])[self.channel_sensor])

    @cached_property
    def channel_saturation_T(self) -> FloatArray:
        """Modulus at which each channel saturates, infinite where it never does, shape (C,) [T]."""
        limits = [np.inf if sensor.saturation_T is None else sensor.saturation_T for sensor in self.sensors]
        return _read_only(np.array(limits)[self.channel_sensor])

    @property
    def row_ambient_uncertainty_T(self) -> float:
        """Standard deviation, per axis, of the error of the ambient field in a single row [T]."""
        return math.hypot(self.ambient_uncertainty_T, self.ambient_uncertainty_white_T)

    @cached_property
    def noise_depends_on_reading(self) -> bool:
        """True if the covariance depends on the readings; otherwise it is diagonal and constant."""
        uncertain = any(s.misalignment_rad or s.gain_uncertainty or s.induced_uncertainty for s in self.sensors)
        return bool(self.noise_fractions.any()) or uncertain

    @cached_property
    def noise_fractions(self) -> FloatArray:
        """Noise proportional to the field of each sensor, its own or the array's, shape (N,)."""
        own = [sensor.noise_fraction for sensor in self.sensors]
        return _read_only(np.array([self.noise_fraction if fraction is None else fraction for fraction in own]))

    @cached_property
    def ambient_fields(self) -> FloatArray:
        """Known ambient field at every sensor, ``ambient_T + ambient_gradient_T_m @ position``: (N, 3) [T].

        Unknown parts count as zero.
        """
        fields = np.zeros((self.n_sensors, 3))
        if self.ambient_T is not None:
            fields += self.ambient_T
        if self.ambient_gradient_T_m is not None:
            fields += self.positions @ np.array(self.ambient_gradient_T_m).T
        return _read_only(fields)

    @cached_property
    def channel_offset_T(self) -> FloatArray:
        """Reading of each channel in zero field, shape (C,) [T]."""
        return _read_only(np.concatenate([sensor.calibration.offset_T for sensor in self.sensors]))

    @cached_property
    def channel_ambient_T(self) -> FloatArray:
        """Reading of vector channels in the known ambient field, of scalar ones in zero field, (C,) [T]."""
        of_field = np.vecdot(self.ambient_fields[self.channel_sensor], self.channel_gain)
        return _read_only(self.channel_offset_T + np.where(self.channel_is_scalar, 0.0, of_field))

    @cached_property
    def channel_gain(self) -> FloatArray:
        """Gain of each channel, shape (C, 3).

        For a vector channel the row a of ``reading - offset = a · B`` with B in the array's frame: calibration and
        rotation of its sensor. For a scalar channel (g, 0, 0) of ``reading - offset = g |B|``.
        """
        gain = np.zeros((self.n_channels, 3))
        for i, sensor in enumerate(self.sensors):
            scale = np.array(sensor.calibration.scale)
            channels = self.channel_sensor == i
            if sensor.kind == "vector":
                gain[channels] = scale @ self.rotation_matrices[i].T
            else:
                gain[channels, 0] = scale[0, 0]
        return _read_only(gain)

    def linear_gain(self, fields_T: FloatArray) -> FloatArray:
        """Return the gain of each channel for small changes of the fields (..., N, 3): (..., C, 3) or (C, 3).

        A modulus reads changes along its field; NaN in zero field.
        """
        if not self.channel_is_scalar.any():
            return self.channel_gain
        with np.errstate(invalid="ignore", divide="ignore"):
            direction = fields_T / np.linalg.norm(fields_T, axis=-1, keepdims=True)
        of_modulus = self.channel_gain[:, :1] * direction[..., self.channel_sensor, :]
        return np.where(self.channel_is_scalar[:, None], of_modulus, self.channel_gain)

    def subset(self, ids: Sequence[str]) -> SensorArray:
        """Return the array with some of its sensors.

        Parameters
        ----------
        ids : sequence of str
            At least two ids, or one if a common field has a prior; each once, in the new order of the sensors.

        Returns
        -------
        SensorArray
            Array with all other properties of this one.

        Raises
        ------
        ValueError
            An id is unknown, or the sensors are too few.
        """
        by_id = dict(zip(self.ids, self.sensors, strict=True))
        for name in ids:
            if name not in by_id:
                nearest = difflib.get_close_matches(name, self.ids, n=1)
                hint = f" (the nearest is {nearest[0]})" if nearest else ""
                raise ValueError(f"Input ids must be ids of sensors of the array; instead received {name!r}{hint}.")
        if not ids or (len(ids) < 2 and self.common_field_T is None):
            fewest = "1" if self.common_field_T is not None else "2 where no common field is known"
            raise ValueError(f"Input sensors must be at least {fewest}; instead received {len(ids)}.")
        return replace(self, sensors=tuple(by_id[name] for name in ids))

    def in_ambient_field(self, ambient_T: ArrayLike) -> SensorArray:
        """Return the array in another known ambient field, such as that of a row of a log.

        Cached properties of the sensors are shared, not computed again.

        Parameters
        ----------
        ambient_T : array-like, shape (3,)
            The field at the array's origin, in its frame [T].

        Returns
        -------
        SensorArray
            Array with all other properties of this one.

        Raises
        ------
        ValueError
            The field is not three finite numbers.
        """
        _ = self.channel_gain, self.channel_offset_T, self.channel_noise_T, self.circumradius
        kept = {name: value for name, value in vars(self).items() if name not in _OF_AMBIENT_FIELD}
        other = object.__new__(type(self))
        vars(other).update(kept, ambient_T=tuple(_finite("ambient_T", ambient_T, (3,)).tolist()))
        return other

    def readings_of(self, fields: ArrayLike) -> FloatArray:
        """Return readings without noise.

        Parameters
        ----------
        fields : array-like, shape (..., N, 3)
            Field at each sensor, in the array's frame [T].

        Returns
        -------
        ndarray, shape (..., C)
            Readings in the sensors' axes, calibration applied [T].
        """
        fields = np.asarray(fields, dtype=np.float64)
        if fields.shape[-2:] != (self.n_sensors, 3):
            raise ValueError(
                f"Input fields must have shape (..., {self.n_sensors}, 3); instead received {fields.shape}."
            )
        seen = fields[..., self.channel_sensor, :]
        scalar = self.channel_is_scalar
        readings: FloatArray = np.vecdot(seen, self.channel_gain)
        if scalar.any():
            readings[..., scalar] = self.channel_gain[scalar, 0] * np.linalg.norm(seen[..., scalar, :], axis=-1)
        return readings + self.channel_offset_T

    def calibrated_field(self, readings: ArrayLike) -> FloatArray:
        """Return the fields at the vector sensors: calibrated, and rotated to the array's frame.

        Parameters
        ----------
        readings : array-like, shape (..., C)
            Readings [T], NaN where one is missing.

        Returns
        -------
        ndarray, shape (..., N, 3)
            Field at each sensor, in the array's frame [T]. NaN for scalar sensors, and for vector sensors that miss any
            of their three readings.
        """
        readings = np.asarray(readings, dtype=np.float64)
        if readings.shape[-1:] != (self.n_channels,):
            raise ValueError(
                f"Input readings must have shape (..., {self.n_channels}); instead received {readings.shape}."
            )
        result = np.full((*readings.shape[:-1], self.n_sensors, 3), np.nan)
        vector = ~self.channel_is_scalar
        owners = self.channel_sensor[vector][::3]
        inverse = np.linalg.inv(self.channel_gain[vector].reshape(-1, 3, 3))
        responses = (readings - self.channel_offset_T)[..., vector].reshape(*readings.shape[:-1], owners.size, 3)
        # A missing reading spreads to all three components: NaN times zero is NaN.
        result[..., owners, :] = np.einsum("nij,...nj->...ni", inverse, responses)
        return result


def _check_distinct_names(array: SensorArray) -> None:
    """Refuse equal ids, and equal names of channels, as of a scalar sensor a_x and a vector sensor a."""
    name, count = Counter(array.ids).most_common(1)[0]
    if count > 1:
        raise ValueError(f"Input sensors must have different ids; instead received {name!r} {count} times.")
    owner = dict.fromkeys(AMBIENT_CHANNELS, "the ambient field")
    for sensor in array.sensors:
        for channel in sensor.channel_names:
            if channel in owner:
                raise ValueError(
                    "Input sensors must have different columns; instead received "
                    f"{owner[channel]} and {sensor.kind} sensor {sensor.id!r}, which both have the column {channel}_nT."
                )
            owner[channel] = f"{sensor.kind} sensor {sensor.id!r}"


def _gradient_tensor(value: ArrayLike) -> tuple[tuple[float, ...], ...]:
    """Return a gradient tensor; it must be symmetric and traceless to a part in a million."""
    tensor = _finite("ambient_gradient_T_m", value, (3, 3))
    largest = float(np.abs(tensor).max())
    for fault, what in ((np.abs(tensor - tensor.T).max(), "symmetric"), (abs(np.trace(tensor)), "traceless")):
        if fault > _GRADIENT_RTOL * largest:
            raise ValueError(
                f"Input ambient_gradient_T_m must be {what} to {_GRADIENT_RTOL:g} of its largest entry; "
                f"instead received {_plain(value)}."
            )
    return tuple(map(tuple, tensor.tolist()))


def _read_only(array: AnyArray) -> AnyArray:
    array.flags.writeable = False
    return array
