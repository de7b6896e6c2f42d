"""Sensors and arrays of them: where they stand, how they are turned, how noisy they are and how they are calibrated.

Everything here is immutable, validated when it is made, and compares, hashes and pickles by value. Positions, rotations
and fields refer to the array's own frame; all quantities are SI.
"""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
AnyArray = TypeVar("AnyArray", bound=NDArray[Any])

SensorKind = Literal["vector", "scalar"]

FLICKER_DECADES = 3
"""Decades of frequency that 1/f noise is counted in: above them white noise is stronger, below them drift."""

AMBIENT_CHANNELS = ("ambient_x", "ambient_y", "ambient_z")
"""Names of a readings file's columns that no channel may take."""

_SINGULAR_RTOL = 1e-12
_UNIT_QUATERNION_ATOL = 1e-6
_SAME_PLACE_RTOL = 1e-9
_GRADIENT_RTOL = 1e-6


@dataclass(frozen=True)
class Calibration:
    """Affine response of a sensor: ``reading = scale @ field_in_sensor_axes + offset``.

    A scalar sensor responds to the modulus of the field instead. :meth:`of` accepts shorter forms.

    Attributes
    ----------
    scale : tuple of tuples, shape (n, n)
        Scale factors on the diagonal, misalignments and cross-talk off it; n = 3 for a vector sensor, 1 for a scalar
        one.
    offset_T : tuple, shape (n,)
        Reading in zero field [T].

    Raises
    ------
    ValueError
        The shapes do not agree, a number is not finite, or ``scale`` is singular.
    """

    scale: tuple[tuple[float, ...], ...]
    offset_T: tuple[float, ...]

    def __post_init__(self) -> None:
        n = np.size(self.offset_T)
        if n not in (1, 3):
            raise ValueError(f"Input offset_T must have 3 numbers, or 1 for a scalar sensor; instead received {n}.")
        scale = _finite("scale", self.scale, (n, n))
        singular_values = np.linalg.svd(scale, compute_uv=False)
        if singular_values[-1] <= _SINGULAR_RTOL * singular_values[0]:
            raise ValueError(f"Input scale must be a regular matrix; instead received {_plain(self.scale)}.")
        object.__setattr__(self, "scale", tuple(map(tuple, scale.tolist())))
        object.__setattr__(self, "offset_T", tuple(_finite("offset_T", self.offset_T, (n,)).tolist()))

    @classmethod
    def of(cls, kind: SensorKind, scale: ArrayLike = 1.0, offset_T: ArrayLike = 0.0) -> Calibration:
        """Calibration of a kind of sensor, from short forms; by default the identity.

        Parameters
        ----------
        kind : {"vector", "scalar"}
            Sets the number of channels n, 3 or 1.
        scale : array-like, shape (), (n,) or (n, n)
            One factor for all channels, one for each, or the matrix.
        offset_T : array-like, shape () or (n,)
            Reading in zero field [T].

        Returns
        -------
        Calibration
        """
        n = _n_channels(kind)
        factors, offsets = _numbers("scale", scale), _numbers("offset_T", offset_T)
        if factors.shape not in ((), (n,), (n, n)):
            expected = "a number, 3 numbers or a 3×3 matrix" if n == 3 else "a number"
            raise ValueError(f"Input scale must be {expected}; instead received {_plain(scale)}.")
        if offsets.shape not in ((), (n,)):
            expected = "a number or 3 numbers" if n == 3 else "a number"
            raise ValueError(f"Input offset_T must be {expected}; instead received {_plain(offset_T)}.")
        matrix = factors if factors.ndim == 2 else np.diag(np.broadcast_to(factors, n))
        return cls(matrix, np.broadcast_to(offsets, n))  # type: ignore[arg-type]  # made tuples there


@dataclass(frozen=True)
class Sensor:
    """One magnetometer of an array.

    Vectors may be given as any array-like; they are stored as tuples.

    Attributes
    ----------
    id : str
        Names the columns of its readings.
    kind : {"vector", "scalar"}
        Whether it reads the three components of the field, or its modulus.
    position_m : tuple, shape (3,)
        In the array's frame [m].
    noise_T : float
        Standard deviation of a reading, per channel and sample, in the reading's units before calibration is undone
        [T].
    rotation_xyzw : tuple, shape (4,)
        Unit quaternion from the sensor's axes to the array's frame.
    calibration : Calibration
        None stands for the identity.
    saturation_T : float, optional
        A reading whose modulus reaches it is no measurement, in the reading's units [T]. None: the sensor never
        saturates.
    misalignment_rad : float
        Standard deviation, per axis, of a small constant rotation of the sensor's axes that the calibration does not
        know [rad]; 0 for a scalar sensor, which has no axes.
    gain_uncertainty : float
        Standard deviation of the relative error of the gain, independent per axis.
    offset_uncertainty_T : float
        Standard deviation, per axis, of an unknown field at the sensor that is fixed to the array, such as that of what
        carries it; for a vector sensor the same as an error of its offsets [T].
    flicker_T : float
        Standard deviation of what 1/f noise adds in every decade of frequency, per channel [T].
    drift_T_rth : float
        Random walk of the offset, per channel: its standard deviation after an hour [T/√h].

    Raises
    ------
    ValueError
        A number is not finite, a shape is wrong, the noise or the saturation is not positive, the misalignment or the
        gain's uncertainty is negative or not below 1, one of the last three is negative, a scalar sensor has a
        misalignment, the quaternion's norm differs from 1 by more than 1e-6, or the id cannot name a column.
    """

    id: str
    kind: SensorKind
    position_m: tuple[float, float, float]
    noise_T: float
    rotation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    calibration: Calibration = None  # type: ignore[assignment]  # replaced in __post_init__
    saturation_T: float | None = None
    misalignment_rad: float = 0.0
    gain_uncertainty: float = 0.0
    offset_uncertainty_T: float = 0.0
    flicker_T: float = 0.0
    drift_T_rth: float = 0.0

    def __post_init__(self) -> None:
        _check_id(self.id)
        n = _n_channels(self.kind)
        object.__setattr__(self, "position_m", tuple(_finite("position_m", self.position_m, (3,)).tolist()))
        for name in ("noise_T", "saturation_T"):
            value = getattr(self, name)
            if value is not None or name == "noise_T":
                object.__setattr__(self, name, _finite_number(name, value))
                if value <= 0.0:
                    raise ValueError(f"Input {name} must be positive; instead received {value}.")
        for name in ("misalignment_rad", "gain_uncertainty"):
            object.__setattr__(self, name, _finite_number(name, getattr(self, name)))
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"Input {name} must be from 0 to below 1; instead received {getattr(self, name)}.")
        for name in ("offset_uncertainty_T", "flicker_T", "drift_T_rth"):
            object.__setattr__(self, name, _finite_number(name, getattr(self, name)))
            if getattr(self, name) < 0.0:
                raise ValueError(f"Input {name} must not be negative; instead received {getattr(self, name)}.")
        if self.kind == "scalar" and self.misalignment_rad:
            raise ValueError(
                f"Input misalignment_rad must be 0 for a scalar sensor; instead received {self.misalignment_rad}."
            )
        object.__setattr__(self, "rotation_xyzw", _unit_quaternion(self.rotation_xyzw))
        if self.calibration is None:
            object.__setattr__(self, "calibration", Calibration.of(self.kind))
        if len(self.calibration.offset_T) != n:
            raise ValueError(
                f"Input calibration must have {n} channel{'s' if n > 1 else ''} for a {self.kind} sensor; "
                f"instead received {len(self.calibration.offset_T)}."
            )

    @property
    def row_noise_T(self) -> float:
        """Standard deviation of a channel in one row by itself: noise, 1/f noise and error of the offset [T]."""
        return math.hypot(self.noise_T, self.offset_uncertainty_T, math.sqrt(FLICKER_DECADES) * self.flicker_T)

    @property
    def n_channels(self) -> int:
        """Numbers in one reading: 3 of a vector sensor, 1 of a scalar one."""
        return _n_channels(self.kind)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """``("s1_x", "s1_y", "s1_z")`` of a vector sensor s1, ``("s1",)`` of a scalar one."""
        return tuple(f"{self.id}_{axis}" for axis in "xyz") if self.kind == "vector" else (self.id,)


@dataclass(frozen=True)
class SensorArray:
    """Sensors that are rigidly connected.

    Properties per channel are in the order of the sensors, x y z within a vector sensor; C is the number of channels, N
    that of sensors. The arrays that they return are read-only.

    Attributes
    ----------
    sensors : tuple of Sensor
        With different ids and not all in one place. One alone can be calibrated; differences need two.
    name : str
        One line of text, or empty.
    noise_fraction : float
        Noise proportional to the field: variance = noise² + (fraction · |B|)².
    common_field_T : float, optional
        Standard deviation, per axis, of the field that is common to all sensors [T]. None: nothing is known of it, and
        only differences between sensors carry information.
    ambient_T : tuple, shape (3,), optional
        Known ambient field in the array's frame, at its origin [T].
    ambient_gradient_T_m : tuple of tuples, shape (3, 3), optional
        Known gradient tensor dB_i/dx_j of the ambient field in the array's frame [T/m]: symmetric and traceless, as
        that of any field whose sources are elsewhere. None stands for a uniform field.

    Raises
    ------
    ValueError
        Any of this does not hold.
    """

    sensors: tuple[Sensor, ...]
    name: str = ""
    noise_fraction: float = 0.0
    common_field_T: float | None = None
    ambient_T: tuple[float, float, float] | None = None
    ambient_gradient_T_m: tuple[tuple[float, float, float], ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", tuple(self.sensors))
        if not (isinstance(self.name, str) and self.name.isprintable()):
            raise ValueError(f"Input name must be one line of printable text; instead received {self.name!r}.")
        for name in ("noise_fraction", "common_field_T"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _finite_number(name, value))
                if value < 0.0:
                    raise ValueError(f"Input {name} must not be negative; instead received {value}.")
        if self.ambient_T is not None:
            object.__setattr__(self, "ambient_T", tuple(_finite("ambient_T", self.ambient_T, (3,)).tolist()))
        if self.ambient_gradient_T_m is not None:
            object.__setattr__(self, "ambient_gradient_T_m", _gradient_tensor(self.ambient_gradient_T_m))
        if not self.sensors:
            raise ValueError("Input sensors must be at least 1; instead received 0.")
        _check_distinct_names(self)
        if self.n_sensors > 1 and self.circumradius <= _SAME_PLACE_RTOL * np.abs(self.positions).max():
            raise ValueError(
                f"Input sensors must stand in two places at least; instead received {self.n_sensors} sensors "
                f"at {_plain(self.positions[0])} m."
            )

    def __getstate__(self) -> dict[str, Any]:
        # Cached arrays are left out: they would come back writeable.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Ids of the sensors."""
        return tuple(sensor.id for sensor in self.sensors)

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
        from scipy.spatial.transform import Rotation  # a third of a second to import

        return _read_only(Rotation.from_quat([sensor.rotation_xyzw for sensor in self.sensors]).as_matrix())

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
        """Whether each channel reads the modulus of the field, shape (C,)."""
        return _read_only(np.array([sensor.kind == "scalar" for sensor in self.sensors])[self.channel_sensor])

    @cached_property
    def channel_noise_T(self) -> FloatArray:
        """Standard deviation of each channel in one row by itself, shape (C,) [T]."""
        return _read_only(np.array([sensor.row_noise_T for sensor in self.sensors])[self.channel_sensor])

    @cached_property
    def channel_saturation_T(self) -> FloatArray:
        """Modulus at which each channel saturates, infinite where it never does, shape (C,) [T]."""
        limits = [np.inf if sensor.saturation_T is None else sensor.saturation_T for sensor in self.sensors]
        return _read_only(np.array(limits)[self.channel_sensor])

    @property
    def noise_depends_on_reading(self) -> bool:
        """Whether the covariance of the readings changes with them; else it is diagonal, with the channels' noise."""
        uncertain = any(sensor.misalignment_rad or sensor.gain_uncertainty for sensor in self.sensors)
        return bool(self.noise_fraction) or uncertain

    @cached_property
    def ambient_fields(self) -> FloatArray:
        """Known ambient field at every sensor, ``ambient_T + ambient_gradient_T_m @ position``: (N, 3) [T].

        What is not known counts as zero.
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
    def channel_gain(self) -> FloatArray:
        """What each channel reads of the field, shape (C, 3).

        For a vector channel the row a of ``reading - offset = a · B`` with B in the array's frame: calibration and
        rotation of its sensor in one. For a scalar channel (g, 0, 0) of ``reading - offset = g |B|``.
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

    def subset(self, ids: Sequence[str]) -> SensorArray:
        """The array reduced to some of its sensors.

        Parameters
        ----------
        ids : sequence of str
            Two at least, each once. Their order becomes the order of the sensors.

        Returns
        -------
        SensorArray
            With everything else as in this array.

        Raises
        ------
        ValueError
            An id is unknown, or the remaining sensors are no array.
        """
        by_id = dict(zip(self.ids, self.sensors, strict=True))
        for name in ids:
            if name not in by_id:
                nearest = difflib.get_close_matches(name, self.ids, n=1)
                hint = f" (the nearest is {nearest[0]})" if nearest else ""
                raise ValueError(f"Input ids must be ids of sensors of the array; instead received {name!r}{hint}.")
        if len(ids) < 2:
            raise ValueError(f"Input sensors must be at least 2; instead received {len(ids)}.")
        return replace(self, sensors=tuple(by_id[name] for name in ids))

    def readings_of(self, fields: ArrayLike) -> FloatArray:
        """Readings without noise.

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
        readings: FloatArray = np.einsum("...cj,cj->...c", seen, self.channel_gain)
        readings[..., scalar] = self.channel_gain[scalar, 0] * np.linalg.norm(seen[..., scalar, :], axis=-1)
        return readings + self.channel_offset_T

    def calibrated_field(self, readings: ArrayLike) -> FloatArray:
        """Fields that the vector sensors saw: calibration undone, rotated to the array's frame.

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


def _n_channels(kind: str) -> int:
    if kind not in get_args(SensorKind):
        raise ValueError(f"Input kind must be 'vector' or 'scalar'; instead received {kind!r}.")
    return 3 if kind == "vector" else 1


def _check_id(name: object) -> None:
    usable = (
        isinstance(name, str) and name and name.isprintable() and name == name.strip() and not set(name) & set(',"')
    )
    if not usable:
        raise ValueError(
            "Input id must be printable text without commas, double quotes and outer spaces, because it names columns; "
            f"instead received {name!r}."
        )


def _check_distinct_names(array: SensorArray) -> None:
    """Ids must differ, and so must the channels' names: a scalar sensor a_x and a vector sensor a share a column."""
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


def _unit_quaternion(value: ArrayLike) -> tuple[float, ...]:
    quaternion = _finite("rotation_xyzw", value, (4,))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > _UNIT_QUATERNION_ATOL:
        raise ValueError(
            f"Input rotation_xyzw must be a quaternion of norm 1; instead received {_plain(value)} of norm {norm:.6g}."
        )
    # One that is normalised already keeps its last digits, or it would change whenever it is copied.
    unit = quaternion if abs(norm - 1.0) <= 4 * np.finfo(np.float64).eps else quaternion / norm
    return tuple(unit.tolist())


def _gradient_tensor(value: ArrayLike) -> tuple[tuple[float, ...], ...]:
    """Gradient of a field without sources or currents: its divergence and its curl vanish, to a part in a million."""
    tensor = _finite("ambient_gradient_T_m", value, (3, 3))
    largest = float(np.abs(tensor).max())
    for fault, what in ((np.abs(tensor - tensor.T).max(), "symmetric"), (abs(np.trace(tensor)), "traceless")):
        if fault > _GRADIENT_RTOL * largest:
            raise ValueError(
                f"Input ambient_gradient_T_m must be {what} to {_GRADIENT_RTOL:g} of its largest entry; "
                f"instead received {_plain(value)}."
            )
    return tuple(map(tuple, tensor.tolist()))


def _numbers(name: str, value: ArrayLike) -> FloatArray:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"Input {name} must be an array of numbers; instead received {_plain(value)}.") from None


def _finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    numbers = _numbers(name, value)
    if numbers.shape != shape:
        raise ValueError(f"Input {name} must have shape {shape}; instead received {_plain(value)}.")
    if not np.isfinite(numbers).all():
        raise ValueError(f"Input {name} must be finite; instead received {_plain(value)}.")
    return numbers


def _finite_number(name: str, value: float) -> float:
    if _numbers(name, value).ndim != 0:
        raise ValueError(f"Input {name} must be one number; instead received {_plain(value)}.")
    return float(_finite(name, value, ()))


def _plain(value: object) -> object:
    """A value as Python writes it, without numpy's own forms."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _read_only(array: AnyArray) -> AnyArray:
    array.flags.writeable = False
    return array
