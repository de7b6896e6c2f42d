"""Calibration by a moving source: the truth comes back as exactly as is claimed, or is said to be unseen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arrays.array import SensorArray
from arrays.array_file import read_array
from arrays.geometries import tetrahedron
from arrays.sensor import Calibration, Sensor
from magloc.calibration import least_squares as source_fit
from magloc.calibration.array import CalibrationPrior, calibrate_on_path, self_calibrate
from magloc.calibration.continuation import apply_calibration
from magloc.calibration.model import CalibrationProblem, CalibrationState, MomentKind
from magloc.calibration.observability import gauge_vectors
from magloc.calibration.results import SourceCalibration
from magloc.calibration.sensors import AXES, GAINS, OFFSET, POSITION
from magloc.readings import read_readings
from magloc.truth import read_truth
from tests.oracles import magpylib_field
from tests.plain_locator import plain_locator

FloatArray = NDArray[np.float64]
COMMON_OFFSETS = {f"common offset along {axis}" for axis in "xyz"}
GAIN = {"common gain against the moment"}
SIZE = {"size of the array against the moment"}
TRANSLATIONS = {f"translation along {axis}" for axis in "xyz"}
ROTATIONS = {f"rotation about {axis}" for axis in "xyz"}
PRIOR = CalibrationPrior(position_m=2e-3, gain=0.05, axes_rad=0.02, offset_T=1e-6)
MOMENT = np.array([0.5, -0.3, 0.8])


@dataclass(frozen=True)
class Passage:
    """A nominal array, what is wrong with it, and a source that passes."""

    array: SensorArray
    change: FloatArray
    position_m: FloatArray
    readings_T: FloatArray
    world_from_array: FloatArray

    @property
    def true_array(self) -> SensorArray:
        return apply_calibration(self.array, self.change)


def nominal_array(noise_T: float, common_field_T: float | None, rng: np.random.Generator) -> SensorArray:
    """Six sensors, turned and calibrated each in its own way."""
    places = 0.1 * np.array([[1, 0, 0], [-1, 0, 0.2], [0, 1, -0.1], [0.1, -1, 0], [0, 0.2, 1], [0.2, 0.1, -1]])
    rotations = Rotation.random(len(places), rng=rng).as_quat()
    sensors = (
        Sensor(
            id=f"s{i}",
            kind="vector",
            position_m=tuple(place.tolist()),
            noise_T=noise_T,
            rotation_xyzw=tuple(rotation.tolist()),
            calibration=Calibration.of("vector", rng.uniform(0.8, 1.2, 3), rng.normal(0, 1e-5, 3)),
        )
        for i, (place, rotation) in enumerate(zip(places, rotations, strict=True), start=1)
    )
    return SensorArray(tuple(sensors), common_field_T=common_field_T)


def sphere_of_positions(n: int, rng: np.random.Generator) -> FloatArray:
    direction = rng.normal(size=(n, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(0.2, 0.35, (n, 1))


def passage(
    seed: int,
    *,
    noise_T: float = 1e-10,
    noisy: bool = False,
    n: int = 60,
    common_field_T: float | None = None,
    path: FloatArray | None = None,
    attitude: FloatArray | None = None,
    moment: FloatArray = MOMENT,
    prior: CalibrationPrior = PRIOR,
) -> Passage:
    """Readings by magpylib of an array whose errors are drawn from the prior."""
    rng = np.random.default_rng(seed)
    array = nominal_array(noise_T, common_field_T, rng)
    deviations = np.where(prior.free(array), prior.deviations(array.n_sensors), 0.0)
    change = deviations * rng.normal(size=deviations.shape)
    true = apply_calibration(array, change)
    position = sphere_of_positions(n, rng) if path is None else path
    world_from_array = np.broadcast_to(np.eye(3), (len(position), 3, 3)) if attitude is None else attitude
    sigma = 5e-5 if common_field_T is None else common_field_T
    common = rng.normal(0.0, sigma, (len(position), 1, 3))
    moments = np.broadcast_to(moment, position.shape)
    fields = np.stack(
        [
            magpylib_field(true.positions, p, R.T @ m)
            for p, R, m in zip(position, world_from_array, moments, strict=True)
        ]
    )
    readings = true.readings_of(fields + common)
    return Passage(
        array, change, position, readings + noisy * noise_T * rng.normal(size=readings.shape), world_from_array
    )


def unseen(result: SourceCalibration) -> set[str]:
    return {direction.name for direction in result.unobservable}


def assert_recovered(result: SourceCalibration, case: Passage, *, within: float) -> None:
    """Every unknown within a fraction of its prior standard deviation."""
    wrong = (result.change - case.change) / PRIOR.deviations(case.array.n_sensors)
    np.testing.assert_allclose(wrong, 0.0, rtol=0, atol=within)


def problem_of(
    case: Passage, *, unknown_position: bool, unknown_height: bool, moment: MomentKind
) -> CalibrationProblem:
    """With a moment of known direction the path is measured with errors too."""
    n = len(case.position_m)
    measured: dict[str, Any] = {
        "path_m": case.position_m,
        "path_sigma_m": np.full(n, 1e-4),
        "axis": np.tile(MOMENT / np.linalg.norm(MOMENT), (n, 1)),
    }
    return CalibrationProblem(
        array=case.array,
        readings_T=case.readings_T,
        noise_T=np.full(case.readings_T.shape, 1e-8),
        prior=PRIOR.deviations(case.array.n_sensors),
        free=CalibrationPrior(trusted_positions=("s2",), trusted_scales=("s3",)).free(case.array),
        world_from_array=case.world_from_array,
        unknown_position=unknown_position,
        unknown_height=unknown_height,
        moment=moment,
        **(measured if moment == "axis" else {}),
    )


def state_of(case: Passage) -> CalibrationState:
    rng = np.random.default_rng(99)
    shape = case.position_m.shape
    return CalibrationState(
        sensors=case.change,
        position_m=case.position_m + rng.normal(0, 1e-3, shape),
        height_m=2e-3,
        moment_Am2=np.broadcast_to(MOMENT, shape) + rng.normal(0, 1e-2, shape),
        common_T=rng.normal(0, 1e-6, shape),
    )


MODELS = pytest.mark.parametrize(
    ("unknown_position", "unknown_height", "moment"),
    [(True, False, "constant"), (True, False, "free"), (False, True, "constant"), (False, False, "free"),
     (False, False, "known"), (True, False, "axis")],
)  # fmt: skip


@pytest.fixture(scope="module")
def turning() -> Passage:
    attitude = Rotation.random(5, rng=np.random.default_rng(5)).as_matrix()
    return passage(1, n=5, attitude=attitude)


class TestDerivatives:
    """The Jacobian is that of the residuals, by central differences; eliminating the rows changes no information."""

    @MODELS
    def test_jacobian(self, turning, unknown_position, unknown_height, moment):
        problem = problem_of(turning, unknown_position=unknown_position, unknown_height=unknown_height, moment=moment)
        state = state_of(turning)
        estimated, g, k = problem.estimated_indices.tolist(), problem.n_globals, problem.n_row_unknowns
        n = problem.free.size
        linear = problem.linearise(state)
        n_rows, n_channels = linear.residual.shape

        def residual(step: FloatArray, rows: FloatArray) -> FloatArray:
            return problem.residuals(problem.prediction_T(problem.after_step(state, step, rows)))

        def slope(along: Callable[[float], FloatArray], h: float) -> FloatArray:
            return (along(h) - along(-h)) / (2.0 * h)

        nothing, still = np.zeros(len(estimated)), np.zeros((n_rows, k))
        by_sensor = linear.by_sensor
        np.testing.assert_array_equal(by_sensor.transpose(1, 3, 0, 2)[~problem.free], 0.0)
        assert len(estimated) == problem.free.sum() + g
        for which_one, index in enumerate(estimated):
            unit = np.eye(len(estimated))[which_one]
            numeric = slope(lambda h, unit=unit: residual(h * unit, still), 1e-4 if index < n else 1e-6)
            expected = np.zeros((n_rows, n_channels))
            if index < n:
                sensor, which = divmod(index, 15)
                expected.reshape(n_rows, -1, 3)[:, sensor] = by_sensor[:, sensor, :, which]
            else:
                expected = linear.by_source[..., index - n]
            scale = max(1.0, float(np.abs(expected).max()))
            np.testing.assert_allclose(numeric / scale, expected / scale, rtol=0, atol=1e-6, err_msg=str(index))
        for column in range(k):
            h = 1e-10 if column >= k - 3 else 1e-6
            rows = np.eye(k)[column] * np.ones((n_rows, 1))
            numeric = slope(lambda h, rows=rows: residual(nothing, h * rows), h)
            expected = linear.by_row[..., column]
            scale = np.abs(expected).max()
            np.testing.assert_allclose(numeric / scale, expected / scale, rtol=0, atol=1e-6, err_msg=f"row {column}")

    @MODELS
    @pytest.mark.parametrize("common_field_T", [None, 1e-6])
    def test_elimination(self, turning, unknown_position, unknown_height, moment, common_field_T):
        """The information about the sensors is the inverse of their block of the inverse of all information."""
        case = replace(turning, array=replace(turning.array, common_field_T=common_field_T))
        problem = problem_of(case, unknown_position=unknown_position, unknown_height=unknown_height, moment=moment)
        state = state_of(case)
        linear = problem.linearise(state)
        n_rows, n_channels, k = linear.by_row.shape
        n, g = problem.free.size, problem.n_globals
        dense = np.zeros((n_rows, n_channels, n + g + n_rows * k))
        for sensor in range(6):
            channels = slice(3 * sensor, 3 * sensor + 3)
            dense[:, channels, 15 * sensor : 15 * sensor + 15] = linear.by_sensor[:, sensor]
        dense[..., n : n + g] = linear.by_source
        for t in range(n_rows):
            dense[t, :, n + g + t * k : n + g + (t + 1) * k] = linear.by_row[t]
        dense = dense.reshape(n_rows * n_channels, -1)
        priors = np.zeros((3 * n_rows, dense.shape[1]))
        if common_field_T is not None:
            for t in range(n_rows):
                for axis in range(3):
                    priors[3 * t + axis, n + g + t * k + k - 3 + axis] = 1.0 / common_field_T
        if moment == "axis":
            places = [n + g + t * k + axis for t in range(n_rows) for axis in range(3)]
            priors = np.concatenate([priors, 1e4 * np.eye(dense.shape[1])[places]])
        all_rows = np.concatenate([dense, priors])
        others = all_rows[:, n:]
        q, _ = np.linalg.qr(others)
        sensors = all_rows[:, :n][:, problem.free.ravel()]
        rest = sensors - q @ (q.T @ sensors)
        expected = rest.T @ rest
        information = source_fit.information_of_sensors(problem, state)
        np.testing.assert_allclose(information, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


class TestKnownPath:
    """Without noise the array's errors come back exactly, but for what no reading can tell."""

    def test_all_is_told_if_moment_and_common_field_are_known(self):
        case = passage(2, common_field_T=1e-13)
        result = calibrate_on_path(
            case.array, case.readings_T, case.position_m, moment_Am2=np.tile(MOMENT, (60, 1)), prior=PRIOR
        )
        assert result.converged
        assert unseen(result) == set()
        assert_recovered(result, case, within=1e-6)
        assert result.chi2 < 1e-2
        assert result.chi2_before > 1e6

    @pytest.mark.parametrize("moment", ["constant", "free"])
    def test_an_unknown_moment_scales_all_gains(self, moment):
        case = passage(3, common_field_T=1e-13)
        result = calibrate_on_path(case.array, case.readings_T, case.position_m, moment=moment, prior=PRIOR)
        assert unseen(result) == GAIN
        np.testing.assert_allclose(result.change[:, POSITION], case.change[:, POSITION], rtol=0, atol=1e-8)
        np.testing.assert_allclose(result.change[:, OFFSET], case.change[:, OFFSET], rtol=0, atol=1e-11)
        estimated, true = result.array.channel_gain, case.true_array.channel_gain
        ratio = np.vdot(estimated, true) / np.vdot(true, true)
        assert 0.9 < ratio < 1.1
        np.testing.assert_allclose(estimated, ratio * true, rtol=0, atol=1e-6)
        np.testing.assert_allclose(result.moment_Am2 * ratio, np.tile(MOMENT, (60, 1)), rtol=0, atol=1e-6)

    def test_a_trusted_scale_fixes_the_gains(self):
        prior = replace(PRIOR, trusted_scales=("s4",))
        case = passage(4, common_field_T=1e-13, prior=prior)
        result = calibrate_on_path(case.array, case.readings_T, case.position_m, prior=prior)
        assert unseen(result) == set()
        assert_recovered(result, case, within=1e-5)
        np.testing.assert_array_equal(result.sigma[3, GAINS], 0.0)

    def test_an_unknown_common_field_hides_a_common_offset(self):
        case = passage(5)
        result = calibrate_on_path(
            case.array, case.readings_T, case.position_m, moment_Am2=np.tile(MOMENT, (60, 1)), prior=PRIOR
        )
        assert unseen(result) == COMMON_OFFSETS
        gain = case.true_array.channel_gain.reshape(-1, 3, 3)
        common = np.linalg.solve(gain, (result.change - case.change)[:, OFFSET, None])[..., 0]
        np.testing.assert_allclose(common, np.tile(common[0], (6, 1)), rtol=0, atol=1e-10)
        np.testing.assert_allclose(result.change[:, :12], case.change[:, :12], rtol=0, atol=1e-5)

    def test_an_unknown_height_is_found_up_to_that_of_the_array(self):
        case = passage(6, common_field_T=1e-13)
        flat = case.position_m - np.array([0.0, 0.0, 0.27])
        result = calibrate_on_path(case.array, case.readings_T, flat, unknown_height=True, prior=PRIOR)
        assert unseen(result) == GAIN | {"translation along z"}
        shift = (result.change - case.change)[:, POSITION]
        np.testing.assert_allclose(shift, np.tile([0.0, 0.0, shift[0, 2]], (6, 1)), rtol=0, atol=1e-7)
        height = np.tile([0.0, 0.0, shift[0, 2]], (60, 1))
        np.testing.assert_allclose(result.position_m, case.position_m + height, rtol=0, atol=1e-7)

    def test_only_what_is_asked_for_changes(self):
        prior = replace(PRIOR, estimate=("positions", "offsets"))
        case = passage(7, common_field_T=1e-13, prior=prior)
        result = calibrate_on_path(case.array, case.readings_T, case.position_m, prior=prior)
        assert_recovered(result, case, within=1e-5)
        np.testing.assert_array_equal(result.change[:, GAINS], 0.0)
        np.testing.assert_array_equal(result.change[:, AXES], 0.0)

    def test_a_line_leaves_every_sensor_free_to_turn_about_it(self):
        """On a line the field at a sensor is made of three functions of the distance along it.

        Nine factors of three channels take up whatever its place around the line (6 sensors) and the moment (3) change;
        a common gain is one of these.
        """
        line = np.linspace([-0.5, 0.25, 0.0], [0.5, 0.25, 0.0], 60)
        case = passage(8, path=line, common_field_T=1e-13, noise_T=1e-8)
        result = calibrate_on_path(case.array, case.readings_T, case.position_m, prior=PRIOR)
        assert len(result.unobservable) == 6 + 3
        assert unseen(result) > GAIN


class TestSelfCalibration:
    """Without a path, sensors and path come back together once the gauge is fixed."""

    TRUSTED = replace(PRIOR, trusted_positions=("s1", "s3", "s5"), trusted_scales=("s2",))

    @pytest.mark.parametrize("moment", ["constant", "free"])
    def test_trusted_sensors_fix_the_gauge(self, moment):
        case = passage(9, common_field_T=1e-13, prior=self.TRUSTED)
        result = self_calibrate(case.array, case.readings_T, moment=moment, prior=self.TRUSTED)
        assert result.converged
        assert unseen(result) == set()
        assert_recovered(result, case, within=1e-4)
        np.testing.assert_allclose(result.position_m, case.position_m, rtol=0, atol=1e-6)
        np.testing.assert_allclose(result.moment_Am2, np.tile(MOMENT, (60, 1)), rtol=0, atol=1e-5)

    def test_without_trust_every_gauge_is_named(self):
        case = passage(10)
        result = self_calibrate(case.array, case.readings_T, prior=PRIOR)
        assert result.converged
        assert unseen(result) == TRANSLATIONS | ROTATIONS | SIZE | GAIN | COMMON_OFFSETS
        assert result.chi2 < 1e-2

    def test_a_trusted_position_holds_the_array_there(self):
        """It may still be turned and scaled about that sensor: its middle moves, unless the axis is through both."""
        prior = replace(PRIOR, trusted_positions=("s1",))
        case = passage(11, common_field_T=1e-13, prior=prior)
        result = self_calibrate(case.array, case.readings_T, prior=prior)
        combinations = [name for name in unseen(result) if name.startswith("combination of")]
        assert len(result.unobservable) == 5
        assert unseen(result) == GAIN | set(combinations)
        assert sum("translation" in name for name in combinations) >= len(combinations) - 1

    def test_a_trusted_scale_and_two_positions_hold_all(self):
        prior = replace(PRIOR, trusted_positions=("s1", "s3"), trusted_scales=("s1",))
        case = passage(11, common_field_T=1e-13, prior=prior)
        assert unseen(self_calibrate(case.array, case.readings_T, prior=prior)) == set()

    def test_what_moves_along_the_gauges_fits_as_well(self):
        """A finite rotation, scaling and translation of everything changes no reading."""
        case = passage(12)
        problem = problem_of(case, unknown_position=True, unknown_height=False, moment="constant")
        state = CalibrationState(case.change, case.position_m, 0.0, np.tile(MOMENT, (60, 1)), np.zeros((60, 3)))
        turn, scale, shift = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), 1.1, np.array([0.02, 0.03, -0.01])
        true = case.true_array
        sensors = tuple(
            replace(
                sensor,
                position_m=tuple((scale * turn @ np.array(sensor.position_m) + shift).tolist()),
                rotation_xyzw=tuple((Rotation.from_matrix(turn) * Rotation.from_quat(sensor.rotation_xyzw)).as_quat()),
            )
            for sensor in true.sensors
        )
        moved = replace(problem, array=replace(true, sensors=sensors))
        other = CalibrationState(
            np.zeros_like(case.change),
            scale * case.position_m @ turn.T + shift,
            0.0,
            np.tile(scale**3 * turn @ MOMENT, (60, 1)),
            np.zeros((60, 3)),
        )
        np.testing.assert_allclose(moved.prediction_T(other), problem.prediction_T(state), rtol=1e-9, atol=1e-16)
        names = set(gauge_vectors(problem, state))
        assert names == TRANSLATIONS | ROTATIONS | SIZE | GAIN | COMMON_OFFSETS

    def test_a_nominal_array_that_is_hardly_known_may_be_its_mirror_image(self):
        vague = replace(PRIOR, position_m=0.5)
        case = passage(13)
        problem = problem_of(case, unknown_position=True, unknown_height=False, moment="constant")
        assert "mirror image: every position inverted through one point" in unseen(
            self_calibrate(case.array, case.readings_T, prior=vague)
        )
        # Its readings are the same: the field of a dipole is even.
        state = CalibrationState(case.change, case.position_m, 0.0, np.tile(MOMENT, (60, 1)), np.zeros((60, 3)))
        inverted = tuple(
            replace(sensor, position_m=tuple((-np.array(sensor.position_m)).tolist()))
            for sensor in case.true_array.sensors
        )
        mirrored = replace(problem, array=replace(case.true_array, sensors=inverted))
        np.testing.assert_allclose(
            mirrored.prediction_T(replace(state, sensors=0 * case.change, position_m=-case.position_m)),
            problem.prediction_T(state),
            rtol=1e-9,
            atol=1e-16,
        )

    def test_a_source_at_rest_tells_next_to_nothing(self):
        still = np.tile([0.2, 0.15, 0.1], (60, 1))
        case = passage(14, path=still, common_field_T=1e-13, noise_T=1e-9)
        result = calibrate_on_path(case.array, case.readings_T, case.position_m, prior=PRIOR)
        assert result.converged
        # Three numbers of every sensor are seen, less the three of the moment.
        assert len(result.unobservable) == 90 - (18 - 3)


class TestMovingArray:
    def test_a_turning_array_sees_a_moment_that_is_constant_in_the_world(self):
        attitude = Rotation.random(60, rng=np.random.default_rng(15)).as_matrix()
        case = passage(15, attitude=attitude, common_field_T=1e-13)
        result = calibrate_on_path(
            case.array, case.readings_T, case.position_m, prior=PRIOR, world_from_array=case.world_from_array
        )
        assert unseen(result) == GAIN
        np.testing.assert_allclose(result.change[:, POSITION], case.change[:, POSITION], rtol=0, atol=1e-8)
        np.testing.assert_allclose(result.moment_Am2[0] / np.linalg.norm(result.moment_Am2[0]),
                                   MOMENT / np.linalg.norm(MOMENT), rtol=0, atol=1e-7)  # fmt: skip
        ignored = calibrate_on_path(case.array, case.readings_T, case.position_m, prior=PRIOR)
        assert result.chi2 < 1e-2
        assert ignored.chi2 > 1e6


class TestUncertainty:
    """Errors of the estimates are distributed as their covariance says.

    Arrays are drawn from the prior, so that (estimate - truth) has the posterior covariance, unseen directions
    included. The sum over the runs is χ² with as many degrees of freedom as there are unknowns; each of its two
    bounds fails by chance once in 1,000 times. The seeds were not tuned.
    """

    RUNS = 12

    def check(self, run: Callable[[int], tuple[Passage, SourceCalibration]]) -> None:
        total, dof, fit, fit_dof = 0.0, 0, 0.0, 0.0
        for seed in range(self.RUNS):
            case, result = run(seed)
            assert result.converged
            error = (result.change - case.change)[result.estimated]
            scale = np.sqrt(np.diagonal(result.covariance))
            total += (error / scale) @ np.linalg.solve(result.covariance / np.outer(scale, scale), error / scale)
            dof += error.size
            fit += result.chi2
            fit_dof += result.dof
            np.testing.assert_allclose(result.sigma[result.estimated], scale)
        low, high = chi2.ppf([0.0005, 0.9995], dof)
        assert low < total < high, (total, dof)
        # The effective number of unknowns makes χ² of the readings their degrees of freedom on average.
        low, high = chi2.ppf([0.0005, 0.9995], fit_dof)
        assert low < fit < high, (fit, fit_dof)

    def test_known_path(self):
        def run(seed: int) -> tuple[Passage, SourceCalibration]:
            case = passage(100 + seed, noise_T=1e-8, noisy=True, n=30)
            return case, calibrate_on_path(case.array, case.readings_T, case.position_m, prior=PRIOR)

        self.check(run)

    @pytest.mark.slow
    def test_self_calibration(self):
        prior = replace(TestSelfCalibration.TRUSTED, position_m=5e-4, gain=0.01, axes_rad=5e-3)

        def run(seed: int) -> tuple[Passage, SourceCalibration]:
            case = passage(200 + seed, noise_T=1e-8, noisy=True, n=30, prior=prior, common_field_T=1e-6)
            return case, self_calibrate(case.array, case.readings_T, prior=prior)

        self.check(run)


class TestMissingReadings:
    def test_holes_change_nothing(self):
        case = passage(16, common_field_T=1e-13)
        rng = np.random.default_rng(16)
        holes = np.where(rng.random(case.readings_T.shape) < 0.2, np.nan, case.readings_T)
        holes[7, 2:] = np.nan
        result = calibrate_on_path(case.array, holes, case.position_m, moment_Am2=np.tile(MOMENT, (60, 1)), prior=PRIOR)
        assert not result.rows[7]
        assert result.rows.sum() == 59
        assert_recovered(result, case, within=1e-6)


class TestBadInput:
    @pytest.fixture
    def case(self) -> Passage:
        return passage(17)

    def test_fewer_readings_than_unknowns(self, case):
        with pytest.raises(ValueError, match=r"must have more readings than unknowns; instead 5 usable rows leave 75"):
            calibrate_on_path(case.array, case.readings_T[:5], case.position_m[:5])
        with pytest.raises(ValueError, match=r"7 usable rows leave 84 numbers for 93 unknowns"):
            self_calibrate(case.array, case.readings_T[:7])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"position_m": np.zeros((3, 3))}, r"position_m must be finite and have shape \(60, 3\)"),
            ({"position_m": np.full((60, 3), np.nan)}, r"position_m must be finite"),
            ({"readings_T": np.zeros((60, 4))}, r"readings_T must have shape \(n, 18\); instead received \(60, 4\)"),
            ({"world_from_array": np.zeros((2, 3, 3))}, r"world_from_array must have shape \(60, 3, 3\)"),
            ({"moment_Am2": np.zeros(3)}, r"moment_Am2 must be finite and have shape \(60, 3\)"),
            (
                {"prior": CalibrationPrior(trusted_scales=("s9",))},
                r"prior must trust ids of sensors of the array; .* 's9'",
            ),
            ({"array": tetrahedron(1.0, kind="scalar", noise_T=1e-9)}, "must have vector sensors only"),
        ],
    )
    def test_arguments(self, case, arguments: dict[str, Any], message: str):
        values: dict[str, Any] = {
            "array": case.array, "readings_T": case.readings_T, "position_m": case.position_m, **arguments
        }  # fmt: skip
        with pytest.raises(ValueError, match=message):
            calibrate_on_path(**values)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"gain": 0.0}, "gain must be positive and finite; instead received 0.0"),
            ({"offset_T": np.inf}, "offset_T must be positive and finite"),
            ({"estimate": ("colours",)}, "estimate must be some of positions, gains, axes, offsets; .* 'colours'"),
            ({"estimate": ()}, "instead received none"),
        ],
    )
    def test_prior(self, arguments: dict[str, Any], message: str):
        with pytest.raises(ValueError, match=message):
            CalibrationPrior(**arguments)

    def test_readings_without_a_source(self, case):
        with pytest.raises(ValueError, match="rows that can be located with the nominal array; instead none can"):
            self_calibrate(case.array, np.broadcast_to(case.array.channel_offset_T, (60, 18)))


@pytest.fixture(scope="module")
def recording(data_folder: Path) -> tuple[SensorArray, FloatArray, FloatArray]:
    """Array, readings and true x-y of the magnet."""
    folder = data_folder / "magnet-array"
    array = read_array(folder / "array.toml")
    readings = read_readings(folder / "readings.csv", array)
    return array, readings.values_T, read_truth(folder / "truth.csv").position_m[:, :2]


class TestRecording:
    """A robot-moved magnet over thirty sensors: calibrated on alternate blocks of 50 rows, judged on the others.

    ``every``: of so many rows one is taken.

    The nominal array is the file's with positions, gains and offsets off by 3 mm, 10 % and 100 µT, or with its
    positions off and its calibration removed. Held-out rows are fixed by a plain Locator; its error is in x-y.
    """

    @staticmethod
    def perturbed(array: SensorArray, seed: int, *, removed: bool, proportional: bool) -> SensorArray:
        rng = np.random.default_rng(seed)
        sensors = []
        for sensor in array.sensors:
            position = np.array(sensor.position_m) + rng.normal(0.0, 3e-3, 3)
            gain = sensor.calibration.scale[0][0] * (1.0 + 0.1 * rng.normal())
            offset = np.array(sensor.calibration.offset_T) + rng.normal(0.0, 1e-4, 3)
            calibration = Calibration.of("vector") if removed else Calibration.of("vector", gain, offset)
            noise_T = 2e-6 if proportional else sensor.noise_T
            sensors.append(replace(sensor, position_m=position, calibration=calibration, noise_T=noise_T))
        return SensorArray(tuple(sensors), noise_fraction=0.03 if proportional else 0.0)

    def check(self, recording, seed: int, *, removed: bool, proportional: bool, every: int = 1) -> None:
        array, readings, xy = recording
        nominal = self.perturbed(array, seed, removed=removed, proportional=proportional)
        held_out = np.arange(len(readings))[::every] // 50 % 2 == 1
        readings, xy = readings[::every], xy[::every]
        path = np.column_stack([xy, np.zeros(len(xy))])
        known = calibrate_on_path(nominal, readings[~held_out], path[~held_out])
        unknown = self_calibrate(nominal, readings[~held_out])
        assert known.converged
        assert unknown.converged
        at, chi2_known = self.fixes(known.array, readings[held_out])
        errors = np.linalg.norm(at - xy[held_out], axis=1)
        assert np.median(errors) <= 0.32e-3
        assert errors.max() <= 1.0e-3
        at, chi2_unknown = self.fixes(unknown.array, readings[held_out])
        # The similarity is fitted on the rows of the calibration, not on those that are judged.
        calibrated_at, _ = self.fixes(unknown.array, readings[~held_out])
        errors = np.abs(similarity(calibrated_at, xy[~held_out])(at) - xy[held_out] @ [1.0, 1j])
        assert np.median(errors) <= 0.5e-3
        assert chi2_unknown <= 1.1 * chi2_known

    @staticmethod
    def fixes(array: SensorArray, readings: FloatArray) -> tuple[FloatArray, float]:
        best = [fix.solutions[0] for fix in plain_locator(array).fit_rows(readings)]
        return np.array([solution.position_m[:2] for solution in best]), sum(solution.chi2 for solution in best)

    @pytest.mark.slow
    @pytest.mark.parametrize("every", [2, pytest.param(1, marks=pytest.mark.slow)])
    def test_perturbed(self, recording, every):
        self.check(recording, 0, removed=False, proportional=True, every=every)

    @pytest.mark.slow
    def test_removed(self, recording):
        self.check(recording, 0, removed=True, proportional=False)

    @pytest.mark.slow
    @pytest.mark.parametrize("removed", [False, True])
    @pytest.mark.parametrize("proportional", [False, True])
    @pytest.mark.parametrize("seed", range(1, 6))
    def test_other_seeds(self, recording, seed, removed, proportional):
        self.check(recording, seed, removed=removed, proportional=proportional)


def similarity(points: FloatArray, onto: FloatArray) -> Callable[[FloatArray], NDArray[np.complex128]]:
    """Least-squares shift, turn and scale of the plane, written with complex numbers."""
    a, b = points @ [1.0, 1j], onto @ [1.0, 1j]
    factor = np.vdot(a - a.mean(), b - b.mean()) / np.vdot(a - a.mean(), a - a.mean())
    return lambda others: (others @ [1.0, 1j] - a.mean()) * factor + b.mean()
