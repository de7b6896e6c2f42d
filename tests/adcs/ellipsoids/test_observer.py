"""Tests of adcs.ellipsoids.observer: containment, contradictions, and the compiled batch against its readable twin."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adcs.ellipsoids.ellipsoid import Ellipsoid
from adcs.ellipsoids.names import STEP_RULES
from adcs.ellipsoids.observer import BoundedSystem, EllipsoidObserver
from tests.adcs.bounded_noise import containment, random_system, satellite, three_states
from tests.adcs.ellipsoids.readable import correct, predict
from tests.calls import calls_of

SYSTEMS = {"satellite": (satellite(), 200), "three states": (three_states(), 120)}


class TestContainment:
    """The true state never leaves the set, and no reading contradicts it, whatever the noise does within its bounds."""

    @pytest.mark.parametrize("rule", STEP_RULES)
    @pytest.mark.parametrize("name", SYSTEMS)
    def test_noise_of_all_kinds(self, name, rule):
        system, n_steps = SYSTEMS[name]
        found = containment(system, rule, 250, n_steps, seed=1)
        assert (found.violations, found.false_contradictions) == (0, 0)
        assert 0.9 < found.largest_form <= 1.0 + 1e-9  # the noise does go to the limit

    @pytest.mark.slow
    @pytest.mark.parametrize("rule", STEP_RULES)
    @pytest.mark.parametrize("name", SYSTEMS)
    def test_a_million_steps(self, name, rule):
        system, n_steps = SYSTEMS[name]
        found = containment(system, rule, 10_000, n_steps, seed=2)
        assert found.steps >= 1_000_000
        assert (found.violations, found.false_contradictions) == (0, 0)

    # Without disturbances the set shrinks to the size of rounding, and below it were it not covered.
    @settings(deadline=None, max_examples=60)
    @example(2, 1, "tightened", 8)
    @example(3, 3, "tightened", 19)
    @given(st.integers(1, 12), st.integers(1, 4), st.sampled_from(STEP_RULES), st.integers(0, 2**32 - 1))
    def test_random_systems_of_up_to_twelve_states(self, n, m, rule, seed):
        found = containment(random_system(n, m, np.random.default_rng(seed)), rule, 20, 40, seed)
        assert (found.violations, found.false_contradictions) == (0, 0)

    def test_tightening_gives_the_smallest_satellite_sets(self):
        traces = {rule: containment(satellite(), rule, 500, 200, seed=3).mean_trace for rule in STEP_RULES}
        assert traces["tightened"] < traces["optimal"] < traces["lemma"]

    def test_runs_are_compiled(self):
        """A hundred times the runs make not one interpreted call more."""
        few, many = (calls_of(lambda n=n: containment(satellite(), "tightened", n, 50, seed=4)) for n in (10, 1000))
        assert many == few


class TestTwins:
    """The batch is predict() and correct() for every run."""

    @pytest.mark.usefixtures("instruction_set")
    @pytest.mark.parametrize("rule", STEP_RULES)
    @pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (3, 2), (7, 3), (12, 2)])
    def test_sets_bounds_and_contradictions(self, n, m, rule):
        rng = np.random.default_rng(10 * n + m)
        system = random_system(n, m, rng)
        start = Ellipsoid(rng.standard_normal(n), np.diag(rng.uniform(0.5, 2.0, n)))
        reinflation = 0.3 * np.eye(n)
        n_runs = 6
        batch = EllipsoidObserver(system, start, n_runs, rule=rule, reinflation=reinflation)
        sets, bounds = [start] * n_runs, [system.bounds] * n_runs
        resets = np.zeros(n_runs, dtype=np.int64)
        x = start.centre + 0.1 * rng.standard_normal((n_runs, n))
        for _ in range(25):
            inputs = 0.1 * rng.standard_normal((n_runs, n))
            x = x @ system.A.T + inputs
            # Half of the runs have readings far more wrong than their bound, and some are missing.
            worse = np.where(np.arange(n_runs) % 2, 20.0, 1.0)[:, None]
            readings = x @ system.directions.T + worse * system.bounds * rng.uniform(-1.0, 1.0, (n_runs, m))
            readings[rng.random((n_runs, m)) < 0.1] = np.nan
            batch.predict(inputs)
            batch.correct(readings)
            for run in range(n_runs):
                predicted = predict(system, sets[run], inputs[run])
                found = correct(system, predicted, readings[run], bounds[run], rule=rule, reinflation=reinflation)
                sets[run], bounds[run] = found.ellipsoid, found.bounds
                resets[run] += found.resets
        np.testing.assert_array_equal(batch.resets, resets)
        assert resets[1::2].sum() > 0
        np.testing.assert_allclose(batch.bounds, np.array(bounds), rtol=1e-9)
        for run in range(n_runs):
            scale = sets[run].trace
            np.testing.assert_allclose(batch.shapes[run], sets[run].shape, rtol=0, atol=1e-8 * scale)
            np.testing.assert_allclose(batch.centres[run], sets[run].centre, rtol=0, atol=1e-8 * np.sqrt(scale))

    def test_result_does_not_depend_on_the_other_runs(self):
        system = satellite()
        readings = np.random.default_rng(5).uniform(-1.0, 1.0, (8000, 1))
        start = Ellipsoid(np.zeros(2), 9.0 * np.eye(2))
        together, alone = EllipsoidObserver(system, start, 8000), EllipsoidObserver(system, start, 1)
        for batch, values in ((together, readings), (alone, readings[777:778])):
            batch.predict()
            batch.correct(values)
        np.testing.assert_array_equal(together.shapes[777], alone.shapes[0])
        np.testing.assert_array_equal(together.centres[777], alone.centres[0])


class TestContradiction:
    system = satellite()
    start = Ellipsoid(np.zeros(2), np.eye(2))

    def test_bound_grows_by_half_at_least(self):
        """Roll is within ±1 and the reading of 2.1 is wrong by at most 1: the bound becomes the largest of 2.1, 1.5."""
        found = correct(self.system, self.start, [2.1], self.system.bounds)
        assert found.resets == 1
        assert found.bounds == pytest.approx([2.1])
        small = Ellipsoid(np.zeros(2), 1e-4 * np.eye(2))
        assert correct(self.system, small, [1.2], self.system.bounds).bounds == pytest.approx([1.5])

    def test_consistent_to_the_last_digit(self):
        """A strip that only touches the set is none."""
        found = correct(self.system, self.start, [2.0], self.system.bounds)
        assert found.resets == 0
        np.testing.assert_array_equal(found.bounds, self.system.bounds)
        assert found.ellipsoid.contains([1.0, 0.0])

    def test_a_point_that_a_reading_misses(self):
        """A set of no size and a direction in which it has none."""
        point = Ellipsoid(np.zeros(2), np.zeros((2, 2)))
        assert correct(self.system, point, [0.5], self.system.bounds).resets == 0
        assert correct(self.system, point, [1.5], self.system.bounds).bounds == pytest.approx([1.5])


class TestBadInput:
    @pytest.mark.parametrize(
        ("changed", "sentence"),
        [
            ({"A": np.ones((2, 3))}, "Input A must be a square matrix of finite numbers; instead received shape"),
            ({"disturbance": np.diag([1.0, -1.0])}, "Input disturbance must be positive semidefinite"),
            ({"disturbance": np.eye(3)}, "Input disturbance must be 2 by 2 finite numbers"),
            ({"directions": np.zeros((2, 2))}, "that are not all zero"),
            ({"directions": np.ones((2, 3))}, "Input direction must be 2 finite numbers"),
            ({"bounds": np.array([1.0, 0.0])}, "Input bounds must be positive and finite; instead received 0.0"),
            ({"bounds": np.array([1.0, -2.0])}, "Input bounds must be positive and finite; instead received -2.0"),
            ({"bounds": np.array([1.0, np.nan])}, "Input bounds must be positive and finite; instead received nan"),
            ({"bounds": np.ones(3)}, "Input bounds must be 2 numbers; instead received 3"),
        ],
    )
    def test_of_a_system(self, changed, sentence):
        good = {"A": np.eye(2), "disturbance": np.eye(2), "directions": np.eye(2), "bounds": np.ones(2)}
        with pytest.raises(ValueError, match=sentence):
            BoundedSystem(**{**good, **changed})

    def test_of_a_batch(self):
        start = Ellipsoid(np.zeros(2), np.eye(2))
        with pytest.raises(ValueError, match="Input start must have 2 dimensions"):
            EllipsoidObserver(satellite(), Ellipsoid(np.zeros(3), np.eye(3)), 1)
        with pytest.raises(ValueError, match="Input rule must be one of lemma, optimal, tightened"):
            EllipsoidObserver(satellite(), start, 1, rule="best")
        with pytest.raises(ValueError, match="Input reinflation must be positive semidefinite"):
            EllipsoidObserver(satellite(), start, 1, reinflation=-np.eye(2))
        with pytest.raises(ValueError, match="Input readings must have shape"):
            EllipsoidObserver(satellite(), start, 3).correct(np.zeros((2, 1)))
