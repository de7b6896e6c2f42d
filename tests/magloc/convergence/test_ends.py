"""Tests of magloc.convergence.ends: many starts at once end as one start does alone, with all instruction sets.

| what | who checks it |
|---|---|
| one pass of `iekf` and `repeated`, ill-conditioned ones too | exact rational arithmetic, magloc.state_space |
| several passes, the stop rule and the count | `run_one` of `readable_filters.py` |
| `damped` | its cost, SciPy's least_squares, the twin |
| what a stop promises | the gradient at the end, by an orthogonal factorisation |
| lanes and threads | the same starts in another order, alone, on one thread: to the last bit |

Whole runs are compared only where they are no more sensitive than their result: from near the source. A Gauss-Newton
iteration far from an optimum can be chaotic: a start moved by 1e-15 of itself then ends elsewhere or after another
number of passes, in the square-root filter just as here. What has to agree from any start is a single pass. An estimate
agrees if the difference is small in units of its own standard deviations, ``√(dᵀ P⁻¹ d)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from math import sqrt
from typing import cast

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.convergence.ends import FilterEnds, ScaledDifferences
from magloc.convergence.filters import DampedFilter, IekfFilter, RepeatedFilter, field_weights
from magloc.measurement.differences import DifferenceMeasurement
from magloc.state_space import predict, update
from tests.arrays.test_differences import random_array
from tests.magloc.convergence.readable_filters import run_one

Array = NDArray[np.float64]
Filter = IekfFilter | RepeatedFilter | DampedFilter
EPS = float(np.finfo(np.float64).eps)
SOURCE = np.array([5.0, 0.0, 0.306, 100.0, 0.0, 0.0])
TETRAHEDRON = tetrahedron(1.5, noise_T=1e-9)
FILTERS = [IekfFilter(), RepeatedFilter(), DampedFilter()]
RELINEARISED = RepeatedFilter(relinearise_every_scalar=True, noise_inflation=4.0)
# A difference that no user of a fix could see: a billionth of its standard deviation.
ROUNDING = 1e-9
all_instruction_sets = pytest.mark.usefixtures("instruction_set")
any_array = cast(Callable[..., SensorArray], random_array)
each_filter = pytest.mark.parametrize("method", FILTERS, ids=lambda method: method.name)


def unequal(seed: int, n: int) -> SensorArray:
    """Sensors anywhere whose noise differs from sensor to sensor, but not between the axes of one."""
    rng = np.random.default_rng([seed, n])
    noise = 1e-9 * rng.uniform(0.3, 3.0, n)
    positions = [tuple(position) for position in rng.normal(size=(n, 3)).tolist()]
    return SensorArray(tuple(Sensor(f"s{i}", "vector", positions[i], noise[i]) for i in range(n)))


def problem(array: SensorArray, seed: int = 0) -> tuple[DifferenceMeasurement, Array]:
    """Measurement model, and noisy differences of the source."""
    measurement = DifferenceMeasurement.of(array)
    z = measurement.predicted(SOURCE[:3], SOURCE[3:])
    return measurement, z + np.random.default_rng(seed).normal(size=z.size) * np.sqrt(measurement.variance)


def directions(rng: np.random.Generator, n: int) -> Array:
    u = rng.normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def starts_of(kind: str, n: int, array: SensorArray = TETRAHEDRON) -> Array:
    """Starts (n, 6): over the cube without or with a moment, at the source, near or at a sensor, far away."""
    rng = np.random.default_rng([n, *kind.encode()])
    starts = np.zeros((n, 6))
    if kind != "cube":
        starts[:, 3:] = 100.0 * rng.normal(size=(n, 3))
    if kind in ("cube", "cube with moment"):
        starts[:, :3] = rng.uniform(-20.0, 20.0, (n, 3))
    elif kind == "source":
        starts[:, :3] = SOURCE[:3] + rng.uniform(-0.7, 0.7, (n, 3))
        starts[:, 3:] = SOURCE[3:] + rng.uniform(-20.0, 20.0, (n, 3))
    elif kind in ("near a sensor", "at a sensor"):
        sensors = array.positions[rng.integers(array.n_sensors, size=n)]
        exponent = rng.uniform(-1.0, 0.0, (n, 1)) if kind == "near a sensor" else rng.uniform(-6.0, -0.5, (n, 1))
        starts[:, :3] = sensors + directions(rng, n) * 10.0**exponent
    else:
        starts[:, :3] = directions(rng, n) * 10.0 ** rng.uniform(1.5, 4.0, (n, 1))
    return starts


def in_sigmas(difference: Array, S: Array) -> float:
    return float(np.linalg.norm(np.linalg.solve(S, difference)))


def solve_exactly(matrix: list[list[Fraction]], right: list[Fraction]) -> list[Fraction]:
    rows = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for k in range(len(rows)):
        for i in range(len(rows)):
            if i != k and rows[i][k]:
                factor = rows[i][k] / rows[k][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[-1] / row[i] for i, row in enumerate(rows)]


class TestSettings:
    def test_graphics_processors_are_gone(self) -> None:
        with pytest.raises(
            ValueError, match="Input device must be cpu: filters run on no other; instead received 'cuda'"
        ):
            IekfFilter(device="cuda")

    @each_filter
    @pytest.mark.parametrize("setting", [{"max_iterations": 0}, {"tolerance_T": -1.0}, {"tolerance_T": np.nan}])
    def test_no_pass_at_all_is_no_filter(self, method: Filter, setting: dict[str, float]) -> None:
        """It would return memory that nothing wrote."""
        name = next(iter(setting))
        with pytest.raises(ValueError, match=f"Input {name} must be positive"):
            replace(method, **setting)  # type: ignore[arg-type]


@all_instruction_sets
class TestOnePassIsTheExactUpdate:
    """The update of a linear model has one right answer: that of the Jacobian and the innovations in doubles.

    Both forms of the update start from these. A backward stable solution of equations of condition κ is off by about κ
    roundings, so nothing is claimed beyond κ = 1e15, where a double has no digits left.
    """

    @pytest.mark.parametrize("kind", ["cube", "cube with moment", "far", "near a sensor"])
    @pytest.mark.parametrize(
        ("method", "s"),
        [(IekfFilter(max_iterations=1), (3.0, 300.0)), (RepeatedFilter(max_iterations=1), (0.1, 100.0))],
        ids=["iekf", "repeated"],
    )
    def test_from_anywhere(self, method: IekfFilter | RepeatedFilter, s: tuple[float, float], kind: str) -> None:
        measurement, z = problem(TETRAHEDRON)
        variance = measurement.variance
        S = np.diag(np.repeat(s, 3))
        if isinstance(method, RepeatedFilter):
            S = predict(S, np.eye(6), S)
        starts = starts_of(kind, 10)
        ends = method.run(measurement, z, starts)
        compared = 0
        for start, end in zip(starts, ends.states, strict=True):
            H = measurement.jacobian(start[:3], start[3:])
            innovation = z - measurement.predicted(start[:3], start[3:])
            condition = 1.0 + np.linalg.norm(H @ S / np.sqrt(variance)[:, None], 2) ** 2
            if condition > 1e15:
                continue
            compared += 1
            step, information = self.exact_step(H, innovation, variance, np.diagonal(S))
            sigma = np.sqrt(variance)
            by_kalman = update(start, S, H / sigma[:, None], innovation / sigma)[0]
            for result in (end, by_kalman):
                e = [Fraction(result[i]) - Fraction(start[i]) - step[i] for i in range(6)]
                square = sum(e[i] * information[i][j] * e[j] for i in range(6) for j in range(6))
                assert sqrt(square) < ROUNDING + EPS * condition
        assert compared >= 5

    @staticmethod
    def exact_step(
        H: Array, innovation: Array, variance: Array, s: Array
    ) -> tuple[list[Fraction], list[list[Fraction]]]:
        rows = [[Fraction(h) for h in row] for row in H]
        r, zero = [Fraction(v) for v in variance], Fraction(0)
        information = [
            [sum((h[i] * h[j] / v for h, v in zip(rows, r, strict=True)), zero) for j in range(6)] for i in range(6)
        ]
        for i in range(6):
            information[i][i] += 1 / Fraction(s[i]) ** 2
        weighted = [Fraction(e) / v for e, v in zip(innovation, r, strict=True)]
        right = [sum((h[i] * e for h, e in zip(rows, weighted, strict=True)), zero) for i in range(6)]
        return solve_exactly(information, right), information


@all_instruction_sets
class TestReadableTwins:
    @pytest.mark.parametrize(
        "method",
        [*FILTERS, RepeatedFilter(noise_inflation=100.0), RELINEARISED],
        ids=["iekf", "repeated", "damped", "inflated", "relinearised"],
    )
    @pytest.mark.parametrize("kind", ["cube", "cube with moment", "far"])
    def test_one_pass(self, method: Filter, kind: str) -> None:
        measurement, z = problem(TETRAHEDRON)
        self.compare(replace(method, max_iterations=1), measurement, z, starts_of(kind, 25), ROUNDING)

    def test_the_covariance_of_the_repeated_filter_goes_along(self) -> None:
        """Steps of 0.1 m do not amplify much, so its first passes can be compared one by one."""
        measurement, z = problem(TETRAHEDRON)
        for passes in range(2, 6):
            self.compare(RepeatedFilter(max_iterations=passes), measurement, z, starts_of("cube", 25), 1e-8)

    @pytest.mark.parametrize("method", [*FILTERS, RELINEARISED], ids=["iekf", "repeated", "damped", "relinearised"])
    @pytest.mark.parametrize("tolerance_T", [1e-9, 1e-10, 1e-12])
    def test_whole_runs_from_near_the_source(self, method: Filter, tolerance_T: float) -> None:
        measurement, z = problem(TETRAHEDRON)
        ends = self.compare(
            replace(method, tolerance_T=tolerance_T), measurement, z, starts_of("source", 8), 1e-6, counts=True
        )
        assert ends.stopped.all()

    @each_filter
    def test_the_last_iteration_that_is_allowed_may_stop(self, method: Filter) -> None:
        """At every limit up to where all have stopped, one too."""
        measurement, z = problem(TETRAHEDRON)
        starts, stopped = starts_of("source", 3), 0
        for limit in range(1, 200):
            limited = replace(method, tolerance_T=1e-10, max_iterations=limit)
            ends = self.compare(limited, measurement, z, starts, 1e-6, counts=True)
            stopped = int(ends.stopped.sum())
            if stopped == len(starts):
                return
        pytest.fail(f"only {stopped} of {len(starts)} stopped")

    @each_filter
    @pytest.mark.parametrize(
        "array",
        [
            *(pytest.param(any_array(n, n, equal=True), id=f"{n} equal") for n in (2, 3, 5, 30)),
            *(pytest.param(unequal(1, n), id=f"{n} unequal") for n in (2, 3, 5, 30)),
            *(pytest.param(any_array(n, n), id=f"{n} with unequal axes") for n in (3, 5, 12)),
            pytest.param(any_array(3, 5, common_field_T=1e-8), id="common field bounded"),
        ],
    )
    def test_any_array(self, method: Filter, array: SensorArray) -> None:
        measurement, z = problem(array)
        self.compare(replace(method, max_iterations=1), measurement, z, starts_of("cube with moment", 8), ROUNDING)
        self.compare(replace(method, tolerance_T=1e-11), measurement, z, starts_of("source", 3), 1e-6, counts=True)

    @staticmethod
    def compare(
        method: Filter,
        measurement: DifferenceMeasurement,
        z: Array,
        starts: Array,
        tolerance: float,
        counts: bool = False,
    ) -> FilterEnds:
        ends = method.run(measurement, z, starts)
        for i, start in enumerate(starts):
            twin = run_one(method, measurement, z, start)
            near = tolerance
            if isinstance(method, DampedFilter):
                # A step that lowers the cost by less than the cost's rounding may be taken by one and not by the other.
                near += sqrt(8.0 * EPS * ends.chi2[i])
            assert in_sigmas(ends.states[i] - twin.x, twin.S) < near
            residual = z - measurement.predicted(ends.states[i, :3], ends.states[i, 3:])
            assert_allclose(ends.chi2[i], np.sum(residual**2 / measurement.variance), rtol=1e-6, atol=1e-6)
            if counts:
                assert (ends.iterations[i], ends.stopped[i]) == (twin.iterations, twin.converged)
        return ends


class TestTwoFormsOfTheDifferences:
    """Recursive contrasts and the matrix form are the same likelihood."""

    @each_filter
    @pytest.mark.parametrize("array", [TETRAHEDRON, unequal(2, 7)], ids=["equal", "unequal"])
    def test_scaled_differences_change_nothing(self, method: Filter, array: SensorArray) -> None:
        """A difference in other units is not one of the paper's, and takes the matrix form."""
        measurement, z = problem(array)
        factor = np.random.default_rng(0).uniform(0.5, 2.0, z.size)
        scaled = replace(
            measurement,
            differences=replace(
                measurement.differences,
                transform=factor[:, None] * measurement.differences.transform,
                variance=factor**2 * measurement.variance,
            ),
        )
        assert self.form(measurement, z) == "recursive"
        assert self.form(scaled, factor * z) == "matrix"
        once = replace(method, max_iterations=1)
        starts = starts_of("cube with moment", 40)
        contrasts, rows = once.run(measurement, z, starts), once.run(scaled, factor * z, starts)
        for i, start in enumerate(starts):
            S = run_one(once, measurement, z, start).S
            assert in_sigmas(contrasts.states[i] - rows.states[i], S) < ROUNDING
        assert_allclose(contrasts.chi2, rows.chi2, rtol=1e-6)

    @staticmethod
    def form(measurement: DifferenceMeasurement, z: Array) -> str:
        weights = field_weights(measurement)
        scaled = ScaledDifferences.of(z, measurement.variance, measurement.array.positions, weights, 1.0, 1.0)
        return "recursive" if scaled.blend.size else "matrix"


class TestDamped:
    measurement, z = problem(TETRAHEDRON)
    starts = starts_of("cube", 300)

    def cost(self, states: Array) -> Array:
        """χ² plus that of the prior, by magloc.measurement.differences."""
        residual = self.z - self.measurement.predicted(states[:, :3], states[:, 3:])
        prior = (states - self.starts) / np.repeat([3.0, 300.0], 3)
        return np.sum(residual**2 / self.measurement.variance, axis=1) + np.sum(prior**2, axis=1)

    def test_the_cost_never_rises(self) -> None:
        costs = [self.cost(self.starts)]
        for n in range(1, 60):
            costs.append(self.cost(DampedFilter(max_iterations=n).run(self.measurement, self.z, self.starts).states))
        assert np.all(np.diff(costs, axis=0) <= 1e-9 * np.array(costs[:-1]))
        assert np.all(costs[-1] < costs[0])

    def test_every_start_stops(self) -> None:
        assert DampedFilter().run(self.measurement, self.z, self.starts).stopped.all()

    def test_no_minimiser_finds_less_from_where_it_stops(self) -> None:
        ends = DampedFilter(max_iterations=500).run(self.measurement, self.z, self.starts)
        sigma = np.sqrt(self.measurement.variance)
        scale = np.repeat([3.0, 300.0], 3)
        for start, end, cost in list(zip(self.starts, ends.states, self.cost(ends.states), strict=True))[:20]:

            def residuals(x: Array, start: Array = start) -> Array:
                readings = (self.z - self.measurement.predicted(*np.split(x * scale, 2))) / sigma
                return np.concatenate([readings, x - start / scale])

            best = scipy.optimize.least_squares(residuals, end / scale, method="lm", xtol=1e-12, ftol=1e-12)
            assert cost < 2.0 * best.cost + 1e-4

    def test_same_optimum_as_the_iterated_filter_from_near_the_source(self) -> None:
        starts = starts_of("source", 50)
        damped = DampedFilter().run(self.measurement, self.z, starts)
        iterated = IekfFilter().run(self.measurement, self.z, starts)
        assert_allclose(damped.states, iterated.states, atol=1e-2, rtol=1e-3)


class TestNoWrongFix:
    """What is flagged as stopped, and by the repeated filter as the optimum, is one; lost arithmetic is not."""

    measurement, z = problem(TETRAHEDRON)

    @each_filter
    def test_on_a_sensor(self, method: Filter) -> None:
        starts = starts_of("cube", 40)
        alone = method.run(self.measurement, self.z, starts)
        starts[7, :3] = TETRAHEDRON.positions[2]
        ends = method.run(self.measurement, self.z, starts)
        assert np.isnan(ends.chi2[7])
        assert not ends.stopped[7]
        assert ends.iterations[7] == 1
        others = np.arange(40) != 7
        assert_array_equal(ends.states[others], alone.states[others])

    @each_filter
    @pytest.mark.parametrize("moment", [0.0, 1.0], ids=["no moment", "moment"])
    def test_close_to_a_sensor(self, method: Filter, moment: float) -> None:
        starts = starts_of("at a sensor", 2000) * np.repeat([1.0, moment], 3)
        ends = method.run(self.measurement, self.z, starts)
        lost = ~np.isfinite(ends.chi2)
        assert not ends.stopped[lost].any()
        self.assert_optima(method, starts, ends)

    @each_filter
    @pytest.mark.parametrize("kind", ["cube", "cube with moment"])
    def test_over_the_cube(self, method: Filter, kind: str) -> None:
        starts = starts_of(kind, 1000)
        ends = method.run(self.measurement, self.z, starts)
        assert np.isfinite(ends.chi2).all()
        self.assert_optima(method, starts, ends)

    @each_filter
    def test_a_micrometre_from_a_sensor(self, method: Filter) -> None:
        """One sensor tells 10²⁰ times as much as the others: nothing of theirs is left in the normal matrix."""
        rng = np.random.default_rng(0)
        starts = np.concatenate(
            [TETRAHEDRON.positions[0] + 1e-6 * directions(rng, 40), np.full((40, 3), 100.0)], axis=1
        )
        ends = method.run(self.measurement, self.z, starts)
        if isinstance(method, DampedFilter):
            assert np.isfinite(ends.chi2).all()
        else:
            assert np.isnan(ends.chi2).all()
            assert not ends.stopped.any()

    def assert_optima(self, method: Filter, starts: Array, ends: FilterEnds) -> None:
        """The next Gauss-Newton step, by an orthogonal factorisation, is less than a tenth of a standard deviation.

        The repeated filter is at the optimum when its χ² is, within 0.05: that is 0.22 standard deviations.
        """
        optimum = RepeatedFilter().run(self.measurement, self.z, SOURCE[None])
        stopped = ends.stopped
        scale, tolerance = np.full(6, 1e6), 0.25
        if isinstance(method, RepeatedFilter):
            stopped = method.reached(ends, optimum.chi2[0], optimum.states[0, :3])
        else:
            scale, tolerance = np.repeat([method.position_sigma_m, method.moment_sigma_Am2], 3), 0.1
        assert stopped.any()
        sigma = np.sqrt(self.measurement.variance)
        for start, end in zip(starts[stopped], ends.states[stopped], strict=True):
            residual = (self.z - self.measurement.predicted(end[:3], end[3:])) / sigma
            jacobian = self.measurement.jacobian(end[:3], end[3:]) / sigma[:, None]
            prior = np.zeros(6) if isinstance(method, RepeatedFilter) else (start - end) / scale
            Q, _ = np.linalg.qr(np.concatenate([jacobian * scale, np.eye(6)]))
            assert np.linalg.norm(Q.T @ np.concatenate([residual, prior])) < tolerance


@all_instruction_sets
class TestLanes:
    """Lanes, and blocks of 8 starts."""

    measurement, z = problem(TETRAHEDRON)
    each_filter = pytest.mark.parametrize(
        "method", [*FILTERS, RELINEARISED], ids=["iekf", "repeated", "damped", "each"]
    )
    arrays = pytest.mark.parametrize("array", [TETRAHEDRON, any_array(3, 5)], ids=["contrasts", "rows"])

    @pytest.fixture(autouse=True)
    def small_blocks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("magloc.convergence.ends._BLOCK_S", 0.0)

    @staticmethod
    def assert_same(a: FilterEnds, b: FilterEnds) -> None:
        assert_array_equal(a.states, b.states)
        assert_array_equal(a.chi2, b.chi2)
        assert_array_equal(a.iterations, b.iterations)
        assert_array_equal(a.stopped, b.stopped)

    @each_filter
    @arrays
    def test_permuted_starts_give_permuted_ends(self, method: Filter, array: SensorArray) -> None:
        measurement, z = problem(array)
        starts = np.concatenate([starts_of("cube", 150), starts_of("at a sensor", 50, array)])
        order = np.random.default_rng(0).permutation(len(starts))
        ends = method.run(measurement, z, starts)
        permuted = FilterEnds(ends.states[order], ends.chi2[order], ends.iterations[order], ends.stopped[order])
        self.assert_same(method.run(measurement, z, starts[order]), permuted)

    @each_filter
    @arrays
    def test_threads_change_nothing(self, method: Filter, array: SensorArray, threads: Callable[[int], None]) -> None:
        measurement, z = problem(array)
        starts = starts_of("cube", 200)
        threads(1)
        one = method.run(measurement, z, starts)
        for number in range(2, 5):
            threads(number)
            self.assert_same(method.run(measurement, z, starts), one)

    @each_filter
    @pytest.mark.parametrize("n", [0, 1, 7, 8, 9, 35])
    def test_any_number_of_starts(self, method: Filter, n: int) -> None:
        starts = starts_of("cube", 100)
        ends = method.run(self.measurement, self.z, starts)
        first = FilterEnds(ends.states[:n], ends.chi2[:n], ends.iterations[:n], ends.stopped[:n])
        self.assert_same(method.run(self.measurement, self.z, starts[:n]), first)

    @each_filter
    def test_a_start_that_does_not_stop_uses_all_its_passes(self, method: Filter) -> None:
        ends = replace(method, tolerance_T=0.0, max_iterations=17).run(self.measurement, self.z, starts_of("cube", 70))
        assert not ends.stopped.any()
        assert np.all(ends.iterations == 17)

    @each_filter
    def test_starts_are_left_as_they_were(self, method: Filter) -> None:
        starts = starts_of("cube", 40)
        before = starts.copy()
        method.run(self.measurement, self.z, starts)
        assert_array_equal(starts, before)
