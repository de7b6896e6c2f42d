"""Readings of a magnet of known shape, instead of a dipole.

Its field is exact (:mod:`magloc.fields.shapes`), so that it may be as near to a sensor as its own size. The magnet is
magnetised along its axis and turns with its moment: the state is a dipole's, position and moment. A cuboid also
has a roll about its axis, an unknown of each row besides the state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.fields.shapes import Shape, aligned_fields
from magloc.measurement.whitened import WhitenedModel

UNKNOWN_ROLL_RAD = math.radians(90.0) / math.sqrt(12.0)
"""Standard deviation of a uniform roll of a cuboid with four-fold symmetry."""
LARGEST_M = 0.5
"""Length beyond that of all single magnets [m], unless the array is larger."""
_KEPT = 2
_LARGEST_ROLL_STEP_RAD = math.radians(15.0)


@dataclass(frozen=True)
class ArrayNearMagnet(SensorArray):
    """Array of sensors whose source is a magnet of known shape.

    The shape is part of the model of the readings, and goes where the array goes.

    Attributes
    ----------
    magnet : Shape, optional
    """

    magnet: Shape | None = None

    __hash__ = SensorArray.__hash__


def array_near(array: SensorArray, magnet: Shape | None) -> SensorArray:
    """Return the array with the shape of its source; without one the array itself."""
    if magnet is None:
        return array
    magnet.check_aligned()
    if magnet.length_m > max(LARGEST_M, 2.0 * array.circumradius):
        raise ValueError(
            f"Input size_m must be the size of a magnet in metres; instead received {[*magnet.size_m]}, larger than the"
            f" array of {2.0 * array.circumradius:.3g} m. 10 mm are 0.01 m."
        )
    return ArrayNearMagnet(**{one.name: getattr(array, one.name) for one in fields(SensorArray)}, magnet=magnet)


def magnet_of(array: SensorArray) -> Shape | None:
    """Return the shape of the array's source; None for a dipole."""
    return array.magnet if isinstance(array, ArrayNearMagnet) else None


def check_without_roll(array: SensorArray) -> None:
    """Raise ValueError for a source whose roll is not a state of a track."""
    magnet = magnet_of(array)
    if magnet is not None and magnet.kind == "cuboid":
        diameter_m = 2.0 * magnet.size_m[0] / math.sqrt(math.pi)
        raise ValueError(
            "Input magnet must be a cylinder, a ring or a sphere in a track, which has no state of its roll; instead"
            f" received a cuboid of size_m {[*magnet.size_m]}. Locate it in every row, or track the cylinder of equal"
            f" volume, of size_m [{diameter_m:.4g}, {magnet.size_m[2]:g}]: it is off by a hundredth of a length"
            " at a gap of one length."
        )


def source_field(array: SensorArray, position_m: FloatArray, moment_Am2: FloatArray) -> FloatArray:
    """Return the field (..., N, 3) [T] of sources (..., 3) at the sensors."""
    magnet, p, m = magnet_of(array), position_m[..., None, :], moment_Am2[..., None, :]
    if magnet is None:
        return dipole.field(array.positions, p, m)
    return aligned_fields(magnet, array.positions, p, m)[0]


def source_jacobian(array: SensorArray, position_m: FloatArray, moment_Am2: FloatArray) -> FloatArray:
    """Return the derivative (..., N, 3, 6) of :func:`source_field` by (p, m)."""
    magnet, p, m = magnet_of(array), position_m[..., None, :], moment_Am2[..., None, :]
    if magnet is None:
        return dipole.field_jacobian(array.positions, p, m)
    return aligned_fields(magnet, array.positions, p, m)[1][..., :6]


@dataclass(frozen=True, eq=False, kw_only=True)
class MagnetModel(WhitenedModel):
    """Whitened model of magnets of one known shape.

    Attributes
    ----------
    magnet : Shape
    roll_rad : ndarray, shape (b, 1, 1), optional
        Roll of a single cuboid about its moment; by default its field is the mean over all rolls.
    """

    magnet: Shape
    roll_rad: FloatArray | None = None
    _last: dict[tuple[bytes, bytes, bytes | None], tuple[FloatArray, FloatArray]] = field(
        default_factory=dict, init=False
    )

    @classmethod
    def near(cls, model: WhitenedModel, magnet: Shape) -> MagnetModel:
        """Return the model of a dipole's readings with a magnet in its place."""
        return cls(**{one.name: getattr(model, one.name) for one in fields(WhitenedModel)}, magnet=magnet)

    @property
    def has_kernels(self) -> bool:
        """False: kernels fit dipoles."""
        return False

    def rows(self, index: NDArray[np.intp]) -> MagnetModel:
        """Return the model of some rows, which may be repeated."""
        some = super().rows(index)
        assert isinstance(some, MagnetModel)
        return some if self.roll_rad is None else replace(some, roll_rad=self.roll_rad[index])

    def source_fields(self, q: FloatArray, mu: FloatArray) -> FloatArray:
        """Return the summed field of the magnets (b, K, ...) at the sensors, (b, N, 3) [T]; NaN inside one."""
        return np.asarray(self._fields(q, mu, self.roll_rad)[0].sum(axis=1))

    def _fields(self, q: FloatArray, mu: FloatArray, roll_rad: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return the field (b, K, N, 3) of every magnet and its Jacobian.

        A step of a fit asks for them at two states, several times at each: the last two results are kept.
        """
        key = q.tobytes(), mu.tobytes(), None if roll_rad is None else roll_rad.tobytes()
        if key not in self._last:
            sensors = self.centroid + self.radius * self.sensors
            position, moment = self.position(q)[:, :, None], self.moment(q, mu)[:, :, None]
            if len(self._last) == _KEPT:
                del self._last[next(iter(self._last))]
            self._last[key] = aligned_fields(self.magnet, sensors, position, moment, roll_rad)
        return self._last[key]

    def _by_state(self, q: FloatArray, mu: FloatArray, gain: FloatArray) -> FloatArray:
        """Return the derivative (b, K, C, 7) of the channels by (p, m) and the roll of every magnet."""
        slope = self._fields(q, mu, self.roll_rad)[1][:, :, self.channel_sensor]
        return np.asarray((gain[:, None, :, None] @ slope)[:, :, :, 0])

    def moment_jacobian(self, q: FloatArray, gain: FloatArray, mu: FloatArray | None = None) -> FloatArray:
        """Return the derivative (b, C, 3 K) of the predictions by μ."""
        assert mu is not None
        return self._whiten_columns(
            self._by_state(q, mu, gain)[..., 3:6] * self.moment(q, np.ones_like(mu))[:, :, None]
        )

    def position_jacobian(self, q: FloatArray, mu: FloatArray, gain: FloatArray, tangent: FloatArray) -> FloatArray:
        """Return the derivative (b, C, 3 K) of the predictions along tangents (b, K, 4, 3) of q."""
        s, along_s = q[:, :, 3, None, None], tangent[:, :, 3:]
        of_position = self.radius / s * (tangent[:, :, :3] - q[:, :, :3, None] / s * along_s)
        of_moment = -3.0 / s * self.moment(q, mu)[..., None] * along_s
        along = np.concatenate([of_position, of_moment], axis=2)
        return self._whiten_columns(self._by_state(q, mu, gain)[..., :6] @ along)

    def _whiten_columns(self, columns: FloatArray) -> FloatArray:
        """Whiten columns (b, K, C, n) of channels to (b, C, n K)."""
        n_fits, _, n_channels, _ = columns.shape
        return self.whiten(columns.transpose(0, 2, 1, 3).reshape(n_fits, n_channels, -1))

    def roll_errors(self, q: FloatArray, mu: FloatArray) -> FloatArray:
        """Return the effects (b, C, n) of a cuboid's unknown roll, one σ each in units of the noise; n may be 0.

        With a roll there is one column, for its error; otherwise two, for cosine and sine of the first harmonic.
        """
        gain = self.linear_gain(self.source_fields(q, mu))
        if self.magnet.kind != "cuboid":
            return np.zeros((*gain.shape[:2], 0))
        if self.roll_rad is not None:
            return UNKNOWN_ROLL_RAD * self._by_state(q, mu, gain)[:, 0, :, 6:]
        angles = np.radians([0.0, 22.5, 45.0, 67.5])
        rolled = [self._fields(q, mu, np.full((len(q), 1, 1), angle))[0][:, 0] for angle in angles]
        halves = np.stack([rolled[0] - rolled[2], rolled[1] - rolled[3]], axis=-1)
        return np.asarray((gain[:, :, None] @ (math.sqrt(0.125) * halves[:, self.channel_sensor]))[:, :, 0])

    def with_roll(self, q: FloatArray, mu: FloatArray, y: FloatArray) -> MagnetModel:
        """Return the model with the rolls that explain whitened readings (b, C) of this model best, to first order."""
        gain = self.linear_gain(self.source_fields(q, mu))
        by_state = self.whiten(self._by_state(q, mu, gain)[:, 0, :, :6])
        by_state = by_state / np.linalg.norm(by_state, axis=1, keepdims=True)
        columns = np.concatenate([by_state, self.whiten(self.roll_errors(q, mu))], axis=2)
        residual = y - self.predict(self.source_fields(q, mu))
        prior = np.diag([1e-12] * by_state.shape[2] + [1.0] * (columns.shape[2] - by_state.shape[2]))
        errors = np.linalg.solve(columns.mT @ columns + prior, columns.mT @ residual[..., None])[:, 6:, 0]
        if self.roll_rad is None:
            return replace(self, roll_rad=0.25 * np.arctan2(errors[:, 1:, None], errors[:, :1, None]))
        step = np.clip(UNKNOWN_ROLL_RAD * errors[:, :1, None], -_LARGEST_ROLL_STEP_RAD, _LARGEST_ROLL_STEP_RAD)
        return replace(self, roll_rad=self.roll_rad + step)


def model_near(array: SensorArray, model: WhitenedModel) -> WhitenedModel:
    """Return the model of a dipole's readings with the array's magnet in its place, if it has one."""
    magnet = magnet_of(array)
    return model if magnet is None else MagnetModel.near(model, magnet)
