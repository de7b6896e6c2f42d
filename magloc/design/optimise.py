r"""Optimisation of sensor positions for a task (:class:`magloc.design.task.DesignTask`).

The criterion is a quantile or the mean, over sources and directions of the moment, of the Cramér-Rao bound of the
range, which is the least accurate quantity. It is never the worst case, which is infinite for every array of four
vector sensors: their nine differences lose rank at isolated combinations of direction and moment
(:func:`magloc.design.evaluation.worst_case` approaches them).

Many starts, among them the references and other shapes, descend on a small sample of sources, the best of them on a
large one. Then design, starts and references are compared on independent sources, so that the gain of a design does
not depend on the sample of its optimisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import qmc

from arrays.array import SensorArray
from arrays.geometries import GEOMETRIES
from arrays.io.lazy import by_name
from arrays.io.values import accept_seed, seed_of
from arrays.typing import FloatArray, Rng
from magloc.design.descent import ArrayProblem, Sample, descend_from_starts
from magloc.design.evaluation import Judgement, fits, judge, random_rotation, references, unit_shape, worst_case
from magloc.design.task import N_DRAWN, DesignTask
from magloc.directions import fibonacci_directions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BEST_START = "best start"
NEAR_OPTIMAL = 0.1
"""Largest gain of a design over a reference that is called near-optimal."""
# Factor over the criterion above which a σ means a loss of rank.
_UNBOUNDED = 1e3


@dataclass(frozen=True, eq=False)
class Design:
    """Result of :func:`design_array`.

    Attributes
    ----------
    task : DesignTask
        Task of the design.
    array : SensorArray
        The design.
    fitted_m, start_m : float
        Criterion on the large sample: of the design, and of the best of its starts.
    converged : bool
        True if the descent to the design converged.
    n_converged, n_descents : int
        Numbers of converged and of all descents from refined starts.
    judged : tuple of Judgement
        The design first, then the best of its starts, then the references.
    worst_m : float
        Largest σ of the range that a search over sources found for the design.

    Examples
    --------
    >>> import magloc
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> design = magloc.design_array(task, starts=2)  # doctest: +SKIP
    >>> design.array, design.gain  # doctest: +SKIP
    """

    task: DesignTask
    array: SensorArray
    fitted_m: float
    start_m: float
    converged: bool
    n_converged: int
    n_descents: int
    judged: tuple[Judgement, ...]
    worst_m: float

    @property
    def gain(self) -> float:
        """Share by which the criterion is below that of the best reference.

        These are a tetrahedron, a cube and a cross of its span, and an even grid of as many sensors in its volume.
        """
        return min(other.gain for other in self.judged[2:])

    @property
    def worst_is_bounded(self) -> bool:
        """True if the worst case found is comparable to the other σ, so that it is no loss of rank."""
        return self.worst_m < _UNBOUNDED * self.judged[0].criterion_m

    @property
    def near_optimal(self) -> tuple[str, ...]:
        """Buildable references that the design improves by less than :data:`NEAR_OPTIMAL`."""
        return tuple(
            other.name
            for other in self.judged[2:]
            if other.fits and other.array.n_sensors <= self.array.n_sensors and other.gain < NEAR_OPTIMAL
        )

    @accept_seed
    def plot(self, rng: Rng = 0) -> Figure:
        """Plot the sensors in their volume, and σ of the range over the distance.

        `rng`: seed or generator of the sources of the plot.
        """
        return by_name("magloc.plots.designs:design")(self, rng)


@accept_seed
def design_array(
    task: DesignTask,
    *,
    starts: int | None = None,
    rng: Rng = 0,
    progress: Callable[[int], None] | None = None,
    better: Callable[[SensorArray], None] = lambda _: None,
) -> Design:
    """Design an array: place its sensors for the sources that it is to locate.

    Parameters
    ----------
    task : DesignTask
        Sensors, their noise and volume, and the sources; :meth:`DesignTask.read` reads one.
    starts : int, optional
        Number of shapes and random places to start from; by default that of ``task.search``.
    rng : int or numpy.random.Generator
        Seed or generator of starts and samples; the same seed gives the same array for any number of threads.
    progress : callable, optional
        Called with steps done, of ``task.search.n_steps``.
    better : callable, optional
        Called with every array that is better than all before on the large sample.

    Returns
    -------
    Design
        The array, and σ of the range [m] for it, its best start and the references.

    Raises
    ------
    ValueError
        No start leaves the sensors their least spacing, or determines the range of the sources.

    Examples
    --------
    >>> import magloc
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> design = magloc.design_array(task, starts=2)  # doctest: +SKIP
    >>> design.plot()  # doctest: +SKIP
    """
    search = task.search if starts is None else replace(task.search, n_starts=starts)
    step_done = progress or (lambda _: None)
    of_starts, of_small, of_large, of_references, of_judge = np.random.SeedSequence(seed_of(rng)).spawn(5)
    small = sobol_sample(task, search.log2_small, np.random.default_rng(of_small))
    large = sobol_sample(task, search.log2_large, np.random.default_rng(of_large))
    known = references(task, large, np.random.default_rng(of_references))
    buildable = [array.positions for array in known if array.n_sensors == task.n_sensors and fits(task, array)]
    shapes = starts_of(task, search.n_starts, np.random.default_rng(of_starts))
    found = descend_from_starts(
        ArrayProblem(task, small),
        ArrayProblem(task, large),
        [*buildable, *shapes][: search.n_starts],
        search,
        step_done,
        lambda sensors: better(task.array(sensors)),
    )
    if found is None:
        raise ValueError(
            "Input task must allow sensors, least_spacing_m apart, that determine the range of its sources; instead no"
            " start has such sensors."
        )
    array = task.array(found.best.points)
    return Design(
        task=task,
        array=array,
        fitted_m=found.best.value,
        start_m=found.first_value,
        converged=found.best.converged,
        n_converged=found.n_converged,
        n_descents=found.n_refined,
        judged=judge(
            task,
            (array, task.array(found.first, BEST_START), *known),
            random_sample(task, search.n_judged, np.random.default_rng(of_judge)),
            np.random.default_rng(of_judge.spawn(1)[0]),
        ),
        worst_m=worst_case(task, found.best.points, large),
    )


def sobol_sample(task: DesignTask, log2_n: int, rng: np.random.Generator) -> Sample:
    """Return sources of a task on scrambled Sobol points, which fill its region evenly."""
    return Sample(*task.sources(qmc.Sobol(N_DRAWN, rng=rng).random_base2(log2_n)))


def random_sample(task: DesignTask, n: int, rng: np.random.Generator) -> Sample:
    """Return independent random sources of a task."""
    return Sample(*task.sources(rng.random((n, N_DRAWN))))


def starts_of(task: DesignTask, n: int, rng: np.random.Generator) -> list[FloatArray]:
    """Return starts (N, 3) [m]: known shapes in random attitudes, then random places."""
    volume = task.volume
    shapes = [*_shapes(task.n_sensors), *_shapes(task.n_sensors)][: max(1, n // 2)]
    turned = [volume.centre + volume.radius * random_rotation(rng).apply(shape) for shape in shapes]
    return [*turned, *(volume.random(task.n_sensors, rng) for _ in range(n - len(turned)))]


def _shapes(n: int) -> list[FloatArray]:
    """Return shapes (n, 3) of n points within the unit ball."""
    named = [unit_shape(name) for name in GEOMETRIES]
    ring = 2.0 * np.pi * np.arange(n) / n
    flat = np.stack([np.cos(ring), np.sin(ring), np.zeros(n)], axis=1)
    return [*(shape for shape in named if len(shape) == n), fibonacci_directions(n), flat]
