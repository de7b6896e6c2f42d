"""Evaluation of designs on independent sources, and reference arrays for comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.geometries import GEOMETRIES
from arrays.typing import FloatArray
from magloc.bounds.over_moments import sigma_table
from magloc.design.descent import Sample
from magloc.design.task import DesignTask
from magloc.design.volumes import even_grid
from magloc.levels import TYPICAL_AND_BAD

REFERENCES = ("tetrahedron", "cube", "cross")
EVEN = "even grid"
"""Name of the reference with as many sensors as the design, spread evenly over its volume."""
_N_ATTITUDES = 24
_N_RESAMPLES = 200
_N_BEARINGS, _N_BEARING_MOMENTS = 1000, 16
_N_WORST = 6
_FITS_RTOL = 1e-9
_INFINITE = 1e300


class RangeSpread(NamedTuple):
    """Median, 95 % quantile and mean of the σ of the range over sources [m].

    Each has shape (k,) or is a number.
    """

    q50_m: FloatArray
    q95_m: FloatArray
    mean_m: FloatArray


@dataclass(frozen=True, eq=False)
class Judgement:
    """Accuracy of an array at several distances.

    Attributes
    ----------
    criterion_m : float
        The task's criterion on the independent sources.
    fits : bool
        True if all its sensors are within the task's volume.
    gain, gain_error : float
        Relative difference by which the design's criterion is lower, and its standard error from resampled sources.
        Zero for the design itself.
    distance_m : ndarray, shape (k,)
        Distance of the sources from the origin, in the directions of the task's region.
    sigma_range : RangeSpread
        Spread at these distances.
    bearing_q95_rad : ndarray, shape (k,)
        95 % quantile of the σ of the bearing.
    """

    name: str
    array: SensorArray
    criterion_m: float
    fits: bool
    gain: float
    gain_error: float
    distance_m: FloatArray
    sigma_range: RangeSpread
    bearing_q95_rad: FloatArray


def references(task: DesignTask, sample: Sample, rng: np.random.Generator) -> list[SensorArray]:
    """Return tetrahedron, cube and cross of the volume's span, and an even grid.

    Each shape has the best of 24 random attitudes for a sample.

    The shapes have the enclosing ball of the volume, and may not fit into it. The grid does.
    """
    arrays = []
    for name in REFERENCES:
        shape = task.volume.radius * unit_shape(name)
        turns = [random_rotation(rng) for _ in range(_N_ATTITUDES)]
        turned = [task.volume.centre + turn.apply(shape) for turn in turns]
        best = min(turned, key=lambda sensors: sample.value(task, sensors))
        arrays.append(task.array(best, name))
    return [*arrays, task.array(even_grid(task.volume, task.n_sensors, rng), EVEN)]


def judge(
    task: DesignTask, arrays: Sequence[SensorArray], sources: Sample, rng: np.random.Generator
) -> tuple[Judgement, ...]:
    """Compare arrays with the first one on independent sources; errors by resampling."""
    distances = comparison_distances(sources)
    own = sources.deviations(task, arrays[0].positions)
    result = []
    for array in arrays:
        theirs = own if array is arrays[0] else sources.deviations(task, array.positions)
        gain, error = (0.0, 0.0) if array is arrays[0] else _gain(task, own, theirs, rng)
        result.append(
            Judgement(
                name=array.name,
                array=array,
                criterion_m=task.criterion.of(theirs),
                fits=fits(task, array),
                gain=gain,
                gain_error=error,
                distance_m=distances,
                sigma_range=range_spread(task, array, sources, distances),
                bearing_q95_rad=np.array([_bearing_q95(array, sources, distance) for distance in distances]),
            )
        )
    return tuple(result)


def comparison_distances(sources: Sample) -> FloatArray:
    """Return distances [m] for comparisons: those of the sources, two and four times as far."""
    distance = np.linalg.norm(sources.positions, axis=1)
    near, middle, far = np.quantile(distance, [0.05, 0.5, 0.95])
    rounded = [float(f"{d:.3g}") for d in (near, middle, far, 2.0 * far, 4.0 * far)]
    return np.unique(rounded)


def worst_case(task: DesignTask, sensors: FloatArray, sample: Sample) -> float:
    """Return the largest σ of the range [m] that a simplex search over sources finds.

    It is only a lower bound of the worst case. If the Jacobian loses rank, it grows until rounding stops it.
    """
    worst = np.argsort(sample.deviations(task, sensors))[-_N_WORST:]
    return max(_worst_near(task, sensors, sample.positions[i], sample.moments[i]) for i in worst)


def _worst_near(task: DesignTask, sensors: FloatArray, position: FloatArray, moment: FloatArray) -> float:
    """Return the largest σ of the range [m] near a source, at its distance.

    Farther sources are worse even without a loss of rank.
    """
    distance, size = np.linalg.norm(position), np.linalg.norm(moment)

    def deviation(x: FloatArray) -> float:
        p, m = position / distance + x[:3], moment / size + x[3:]
        one = Sample((distance * p / np.linalg.norm(p))[None], (size * m / np.linalg.norm(m))[None])
        return float(one.deviations(task, sensors)[0])

    simplex = 0.02 * np.eye(7, 6, -1)
    options = {"maxiter": 2000, "maxfev": 2000, "xatol": 1e-12, "fatol": 1e-6, "initial_simplex": simplex}
    found = minimize(  # type: ignore[call-overload]
        lambda x: -np.log(min(deviation(x), _INFINITE)), np.zeros(6), method="Nelder-Mead", options=options
    )
    return deviation(found.x)


def _gain(task: DesignTask, own: FloatArray, theirs: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    """Return the gain over another array, and its standard error from resampled pairs."""
    value = task.criterion.of(theirs)
    if not np.isfinite(value):
        return 1.0, 0.0
    ratios = np.empty(_N_RESAMPLES)
    for k in range(_N_RESAMPLES):
        drawn = rng.integers(own.size, size=own.size)
        ratios[k] = task.criterion.of(own[drawn]) / task.criterion.of(theirs[drawn])
    return 1.0 - task.criterion.of(own) / value, float(np.std(ratios))


def fits(task: DesignTask, array: SensorArray) -> bool:
    """Return whether all sensors are within the task's volume."""
    inside = task.volume.nearest(array.positions)
    return bool(np.abs(inside - array.positions).max() <= _FITS_RTOL * task.volume.radius)


def _at(sources: Sample, distance: float) -> FloatArray:
    """Return positions of sources, moved to one distance from the origin."""
    return distance * sources.positions / np.linalg.norm(sources.positions, axis=1, keepdims=True)


def range_spread(task: DesignTask, array: SensorArray, sources: Sample, distance_m: FloatArray) -> RangeSpread:
    """Return the spread of σ of the range over sources at distances (k,) from the origin [m]."""
    spreads = []
    for distance in distance_m:
        deviations = Sample(_at(sources, distance), sources.moments).deviations(task, array.positions)
        quantiles = np.quantile(deviations, TYPICAL_AND_BAD, method="inverted_cdf")
        spreads.append([*quantiles, np.mean(deviations)])
    return RangeSpread(*np.array(spreads).T)


def _bearing_q95(array: SensorArray, sources: Sample, distance: float) -> float:
    """Return the 95 % quantile of the σ of the bearing at one distance, over some sources."""
    sigma = sigma_table(array, _at(sources, distance)[:_N_BEARINGS], sources.moments[:_N_BEARING_MOMENTS]).bearing_rad
    return float(np.quantile(sigma, 0.95, method="inverted_cdf"))


def random_rotation(rng: np.random.Generator) -> Rotation:
    """Return a uniformly distributed rotation."""
    return Rotation.from_quat(rng.normal(size=4))


def unit_shape(name: str) -> FloatArray:
    """Return points (n, 3) of a named geometry of circumradius 1 around its centroid."""
    array = GEOMETRIES[name].make(1.0)
    return (array.positions - array.centroid) / array.circumradius
