r"""Optimisation of the magnets of a body, and of the sensors about them, for the bound of the body's pose.

:func:`magloc.bounds.bodies.body_bounds` bounds a pose. Its two figures become one length,

.. math:: σ = \sqrt{σ_x^2 + (L σ_θ)^2},

with the largest standard deviation σ_x of the position along any direction, the largest one σ_θ of the rotation about
any axis, and a lever L: the rotation counts as the displacement of a point at the distance L. The criterion is a
quantile or the mean of σ over the limits of the body. Shapes and stated errors of magnets and sensors are included as
in ``magloc bounds --body``; therefore the criterion's slope is computed by central differences. The descent is as for
arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.io.values import accept_seed, seed_of
from arrays.typing import FloatArray, IntArray, Rng
from magloc.bodies.body import Magnet, MagnetBody
from magloc.bodies.field import placed_magnets
from magloc.bodies.locator import with_offsets_as_noise
from magloc.bodies.plausibility import check_reach
from magloc.bodies.search import spread_poses
from magloc.bounds.bodies import N_POSES, BodyBounds, body_bounds, pose_covariances
from magloc.design.body_task import BodyTask
from magloc.design.descent import descend_from_starts, is_spaced, move_into_volume, order_weights
from magloc.measurement.rows import check_magnitudes

_STEP = 1e-5  # of central differences, in radii of the volumes


@dataclass(frozen=True, eq=False)
class BodyProblem:
    """Criterion of a body and an array for poses, a :class:`magloc.design.descent.DesignProblem`.

    Points (n, 3) are positions of the K magnets in radii of their volume, then K unit vectors of their moments if
    directions are free, then positions of the sensors in radii of their volume if sensors move.

    Attributes
    ----------
    position_m, R : ndarray, shape (p, 3) and (p, 3, 3)
        Poses of the sample.
    """

    task: BodyTask
    array: SensorArray
    body: MagnetBody
    position_m: FloatArray
    R: FloatArray

    @property
    def radius(self) -> float:
        """Size of the set of allowed points."""
        return 1.0

    @cached_property
    def _ends(self) -> tuple[int, int]:
        """Ends of the points of the magnets, and of their directions."""
        n = len(self.body.magnets)
        return n, 2 * n if self.task.directions_are_free else n

    def points_of(self, array: SensorArray, body: MagnetBody) -> FloatArray:
        """Return the points of an array and a body."""
        parts = [body.positions_m / self.task.magnets.volume.radius]
        if self.task.directions_are_free:
            parts.append(body.moments_Am2 / np.linalg.norm(body.moments_Am2, axis=1, keepdims=True))
        if self.task.sensors is not None:
            parts.append(array.positions / self.task.sensors.volume.radius)
        return np.concatenate(parts)

    def device(self, points: FloatArray) -> tuple[SensorArray, MagnetBody]:
        """Return array and body of points."""
        n, end = self._ends
        places = (self.task.magnets.volume.radius * points[:n]).tolist()
        magnets = [replace(m, position_m=tuple(p)) for m, p in zip(self.body.magnets, places, strict=True)]
        if end > n:
            magnets = [
                turned_magnet(magnet, direction) for magnet, direction in zip(magnets, points[n:end], strict=True)
            ]
        body = replace(self.body, magnets=tuple(magnets))
        if self.task.sensors is None:
            return self.array, body
        stands = (self.task.sensors.volume.radius * points[end:]).tolist()
        sensors = (replace(s, position_m=tuple(p)) for s, p in zip(self.array.sensors, stands, strict=True))
        return replace(self.array, sensors=tuple(sensors)), body

    def move_inside(self, points: FloatArray) -> FloatArray:
        """Return points with magnets and sensors in their volumes and apart, and directions of length 1."""
        n, end = self._ends
        inside = points.copy()
        size = self.task.magnets.volume.radius
        inside[:n] = move_into_volume(self.task.magnets, size * points[:n]) / size
        inside[n:end] /= np.linalg.norm(points[n:end], axis=1, keepdims=True)
        if self.task.sensors is not None:
            size = self.task.sensors.volume.radius
            inside[end:] = move_into_volume(self.task.sensors, size * points[end:]) / size
        return inside

    def is_spaced(self, points: FloatArray) -> bool:
        """Return True if magnets and sensors have their least spacing."""
        n, end = self._ends
        spaced = is_spaced(self.task.magnets, self.task.magnets.volume.radius * points[:n])
        sensors = self.task.sensors
        return spaced and (sensors is None or is_spaced(sensors, sensors.volume.radius * points[end:]))

    def random_points(self, rng: np.random.Generator) -> FloatArray:
        """Return random points; :meth:`move_inside` gives directions the length 1."""
        n, end = self._ends
        parts = [self.task.magnets.volume.random(n, rng) / self.task.magnets.volume.radius]
        if end > n:
            parts.append(rng.normal(size=(n, 3)))
        if self.task.sensors is not None:
            volume = self.task.sensors.volume
            parts.append(volume.random(self.array.n_sensors, rng) / volume.radius)
        return np.concatenate(parts)

    def deviations(self, points: FloatArray, index: IntArray | slice = slice(None)) -> FloatArray:
        """Return σ [m] of the poses, or of some of them; infinite where a pose is not determined."""
        array, body = self.device(points)
        position_m, R = self.position_m[index], self.R[index]
        return self.task.deviations(BodyBounds(position_m, R, pose_covariances(array, body, position_m, R), ""))

    def value(self, points: FloatArray) -> float:
        """Return the smoothed criterion [m]."""
        deviations = self.deviations(points)
        index, weights = order_weights(self.task.criterion, deviations)
        return float(weights @ deviations[index])

    def log_value_and_slope(self, points: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of the criterion, and its derivative (n, 3) by the points."""
        deviations = self.deviations(points)
        index, weights = order_weights(self.task.criterion, deviations)
        value = float(weights @ deviations[index])
        slope = np.zeros_like(points)
        if not np.isfinite(value):
            return np.inf, slope
        for entry in np.ndindex(*points.shape):
            ends = []
            for step in (_STEP, -_STEP):
                shifted = points.copy()
                shifted[entry] += step
                ends.append(weights @ self.deviations(shifted, index))
            slope[entry] = (ends[0] - ends[1]) / (2.0 * _STEP * value)
        return float(np.log(value)), np.where(np.isfinite(slope), slope, 0.0)


def turned_magnet(magnet: Magnet, direction: FloatArray) -> Magnet:
    """Return a magnet that is rotated so that its moment has a direction; its shape turns with the moment."""
    turn, _ = Rotation.align_vectors([direction], [magnet.moment_Am2])
    return magnet.rotate(turn.as_matrix())


@dataclass(frozen=True, eq=False)
class BodyDesign:
    """Result of :func:`design_body`.

    Attributes
    ----------
    task : BodyTask
    array, body : SensorArray, MagnetBody
        The design; the array is the given one if sensors do not move.
    before, after : BodyBounds
        Bounds of the given device and of the design, for the same poses, which the descent did not use.
    nearest_m : tuple of 2 floats
        Least distance of a magnet's centre from a sensor over these poses, before and after [m].
    converged : bool
        True if the descent to the design converged.
    n_converged, n_descents : int
        Numbers of converged and of all descents from refined starts.
    """

    task: BodyTask
    array: SensorArray
    body: MagnetBody
    before: BodyBounds
    after: BodyBounds
    nearest_m: tuple[float, float]
    converged: bool
    n_converged: int
    n_descents: int

    @property
    def criterion_m(self) -> tuple[float, float]:
        """Criterion before and after [m]."""
        before, after = (self.task.criterion.of(self.task.deviations(each)) for each in (self.before, self.after))
        return before, after


@accept_seed
def design_body(
    task: BodyTask,
    array: SensorArray,
    body: MagnetBody,
    *,
    rng: Rng = 0,
    progress: Callable[[int], None] | None = None,
    better: Callable[[SensorArray, MagnetBody], None] = lambda *_: None,
) -> BodyDesign:
    """Place the magnets of a body, and the sensors if they move, for the smallest bound of the pose.

    Parameters
    ----------
    task : BodyTask
        Volumes, least distances and criterion; :func:`magloc.design.body_task.read_body_task` reads one.
    array : SensorArray
        Sensors about the body; the first start.
    body : MagnetBody
        Magnets of the first start. Its limits must have a box of positions. Moduli of the moments, shapes and errors
        remain.
    rng : int or numpy.random.Generator
        Seed or generator of the starts; the given device is the first of them.
    progress : callable, optional
        Called with steps done, of ``task.search.n_steps``.
    better : callable, optional
        Called with array and body of every design that is better than all before on the large sample.

    Returns
    -------
    BodyDesign
        Array and body of the best design, with the bounds before and after.

    Raises
    ------
    ValueError
        The limits have no box, the array's numbers are out of range, or no start determines the pose.
    """
    check_magnitudes(array)
    if not body.limits.is_bounded:
        raise ValueError("Input body must have limits of its position; instead received none in its table range.")
    check_reach(array, body.as_dipoles())
    search = task.search
    used = with_offsets_as_noise(array)
    position_m, R = (values[N_POSES:] for values in spread_poses(body, used, N_POSES + 2**search.log2_large))
    small, large = (
        BodyProblem(task, used, body, position_m[: 2**n], R[: 2**n]) for n in (search.log2_small, search.log2_large)
    )
    drawn = np.random.default_rng(seed_of(rng))
    starts = [large.points_of(array, body), *(large.random_points(drawn) for _ in range(search.n_starts - 1))]

    def design_of(points: FloatArray) -> tuple[SensorArray, MagnetBody]:
        """Return the array, with the offsets that it was given, and the body."""
        placed, magnets = large.device(points)
        sensors = zip(array.sensors, placed.sensors, strict=True)
        stands = tuple(replace(sensor, position_m=other.position_m) for sensor, other in sensors)
        return replace(array, sensors=stands), magnets

    found = descend_from_starts(
        small, large, starts, search, progress or (lambda _: None), lambda points: better(*design_of(points))
    )
    if found is None:
        raise ValueError(
            "Input task must allow magnets, least_spacing_m apart, that determine the pose; instead no start has such"
            " magnets."
        )
    new_array, new_body = design_of(found.best.points)
    devices = ((array, body), (new_array, new_body))
    before, after = (body_bounds(*device) for device in devices)
    near_m, nearer_m = (_nearest(*device, before.position_m, before.R) for device in devices)
    return BodyDesign(
        task,
        new_array,
        new_body,
        before,
        after,
        (near_m, nearer_m),
        found.best.converged,
        found.n_converged,
        found.n_refined,
    )


def _nearest(array: SensorArray, body: MagnetBody, position_m: FloatArray, R: FloatArray) -> float:
    """Return the least distance of a magnet from a sensor over poses [m]."""
    places, _ = placed_magnets(body, position_m, R)
    return float(np.linalg.norm(places[:, :, None] - array.positions, axis=-1).min())
