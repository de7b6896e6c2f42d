"""Sensors: position, rotation, noise and calibration.

All classes are immutable, validate their values, and compare, hash and pickle by value. Positions, rotations
and fields refer to the array's own frame; all quantities are SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import LARGEST
from arrays.typing import FloatArray

SensorKind = Literal["vector", "scalar"]
FLICKER_DECADES = 3
"""Decades of frequency of 1/f noise: above them white noise is stronger, below them drift."""
_SINGULAR_RTOL = 1e-12
_UNIT_QUATERNION_ATOL = 1e-6


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

    Examples
    --------
    >>> import arrays
    >>> arrays.Calibration.of("vector", [1.01, 1.0, 0.99], offset_T=2e-9).scale[0]
    (1.01, 0.0, 0.0)
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
        """Return the calibration of a kind of sensor, from short forms; by default the identity.

        Parameters
        ----------
        kind : {"vector", "scalar"}
            Sets the number of channels n, 3 or 1.
        scale : array-like, shape (), (n,) or (n, n)
            One factor for all channels, one for each, or the matrix.
        offset_T : array-like, shape () or (n,)
            Reading in zero field [T].
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
        Name in the columns of its readings.
    kind : {"vector", "scalar"}
        Reading of three components of the field, or of its modulus.
    position_m : tuple, shape (3,)
        Position in the array's frame [m].
    noise_T : float
        Standard deviation of a reading, per channel and sample, in the units of the raw reading [T].
    rotation_xyzw : tuple, shape (4,)
        Unit quaternion from the sensor's axes to the array's frame.
    calibration : Calibration
        Response of the sensor; None for the identity.
    saturation_T : float, optional
        Modulus at which the sensor saturates, in the units of the raw reading [T]; such readings are ignored. None: no
        limit.
    misalignment_rad : float
        Standard deviation, per axis, of a small constant rotation of the sensor's axes that the calibration does not
        include [rad]; 0 for a scalar sensor, which has no axes.
    gain_uncertainty : float
        Standard deviation of the relative error of the gain, independent per axis.
    offset_uncertainty_T : float
        Standard deviation, per axis, of an unknown field at the sensor that turns with the array, such as that of the
        carrier; for a vector sensor it is the same as an error of its offsets [T].
    flicker_T : float
        Standard deviation of 1/f noise in every decade of frequency, per channel [T].
    drift_T_rth : float
        Random walk of the offset, per channel: standard deviation after one hour [T/√h].
    noise_fraction : float, optional
        Noise proportional to the field, instead of the array's: variance = noise² + (fraction · |B|)².
    induced_uncertainty : float
        Standard deviation of every component of the field that the ambient field induces in the carrier, at the sensor
        in the array's axes, over the ambient field.
    eddy_uncertainty_s : float
        The same for eddy currents, over the derivative of the ambient field in the array's axes [s].

    Raises
    ------
    ValueError
        A number is not finite, a shape is wrong, the noise or the saturation is not positive, the misalignment or the
        gain's uncertainty is negative or not below 1, one of the last six is negative, a scalar sensor has a
        misalignment, the quaternion's norm differs from 1 by more than 1e-6, or the id cannot name a column.

    Examples
    --------
    >>> import arrays
    >>> sensor = arrays.Sensor("s1", "vector", (0.0, 0.0, 0.1), noise_T=1e-9)
    >>> sensor.channel_names
    ('s1_x', 's1_y', 's1_z')
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
    noise_fraction: float | None = None
    induced_uncertainty: float = 0.0
    eddy_uncertainty_s: float = 0.0

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
        for name in (
            "offset_uncertainty_T",
            "flicker_T",
            "drift_T_rth",
            "noise_fraction",
            "induced_uncertainty",
            "eddy_uncertainty_s",
        ):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _not_negative(name, getattr(self, name)))
        if self.kind == "scalar" and self.misalignment_rad:
            raise ValueError(
                f"Input misalignment_rad must be 0 for a scalar sensor; instead received {self.misalignment_rad}."
            )
        object.__setattr__(self, "rotation_xyzw", _unit_quaternion(self.rotation_xyzw))
        if self.calibration is None:
            object.__setattr__(self, "calibration", Calibration.of(self.kind))  # type: ignore[unreachable]
        if len(self.calibration.offset_T) != n:
            raise ValueError(
                f"Input calibration must have {n} channel{'s' if n > 1 else ''} for a {self.kind} sensor; "
                f"instead received {len(self.calibration.offset_T)}."
            )

    @property
    def row_noise_T(self) -> float:
        """Standard deviation of a channel in a single row: noise, 1/f noise and error of the offset [T]."""
        return math.hypot(self.noise_T, self.offset_uncertainty_T, math.sqrt(FLICKER_DECADES) * self.flicker_T)

    @property
    def n_channels(self) -> int:
        """Number of channels: 3 for a vector sensor, 1 for a scalar sensor."""
        return _n_channels(self.kind)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """``("s1_x", "s1_y", "s1_z")`` of a vector sensor s1, ``("s1",)`` of a scalar one."""
        return tuple(f"{self.id}_{axis}" for axis in "xyz") if self.kind == "vector" else (self.id,)


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


def _unit_quaternion(value: ArrayLike) -> tuple[float, ...]:
    quaternion = _finite("rotation_xyzw", value, (4,))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > _UNIT_QUATERNION_ATOL:
        raise ValueError(
            f"Input rotation_xyzw must be a quaternion of norm 1; instead received {_plain(value)} of norm {norm:.6g}."
        )
    # A normalised quaternion keeps its last digits, so that copies stay equal.
    unit = quaternion if abs(norm - 1.0) <= 4 * np.finfo(np.float64).eps else quaternion / norm
    return tuple(unit.tolist())


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
    if shape and not (np.abs(numbers) <= LARGEST).all():
        raise ValueError(f"Input {name} must be {LARGEST:g} at most; instead received {_plain(value)}.")
    return numbers


def _finite_number(name: str, value: float) -> float:
    if _numbers(name, value).ndim != 0:
        raise ValueError(f"Input {name} must be one number; instead received {_plain(value)}.")
    return float(_finite(name, value, ()))


def _not_negative(name: str, value: float) -> float:
    number = _finite_number(name, value)
    if number < 0.0:
        raise ValueError(f"Input {name} must not be negative; instead received {number}.")
    return number


def _plain(value: object) -> object:
    """Return a value without NumPy types, for error messages."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
