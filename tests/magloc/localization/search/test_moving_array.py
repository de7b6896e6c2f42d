"""One source from several rows of an array that moves, with magpylib's field: exact, χ², and refused in time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arrays import geometries
from arrays.array import SensorArray
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.locator import fit_at_rest
from magloc.measurement.pose import ArrayPose, PosesOfRows
from tests.oracles import magpylib_field

FloatArray = NDArray[np.float64]
AMBIENT_T = np.array([2e-6, 20e-6, -43e-6])
SOURCE = np.array([1.0, 0.5, -1.0, 6.0, 3.0, -4.0])
SQUARE = geometries.square(1.5, "scalar", 1e-11)
N_ROWS = 12
Rows = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def passing(array: SensorArray, n: int = N_ROWS) -> Rows:
    """Readings (n, C) without noise on a line over the source, the poses, and ambient fields in the array's frame.

    The array rolls and pitches, and the ambient field changes by 100 nT from row to row.
    """
    t = np.linspace(-1.0, 1.0, n)
    origins = np.stack([4.0 * t, 0.3 * t, 2.5 + 0.2 * t], axis=-1)
    R = Rotation.from_euler("xyz", np.stack([0.1 * np.sin(5 * t), 0.1 * np.cos(4 * t), 0.3 * t], axis=-1)).as_matrix()
    ambient = AMBIENT_T + 1e-7 * np.random.default_rng(1).normal(size=(n, 3))
    fields = [
        (magpylib_field(origin + array.positions @ turn.T, SOURCE[:3], SOURCE[3:]) + field) @ turn
        for origin, turn, field in zip(origins, R, ambient, strict=True)
    ]
    return array.readings_of(np.stack(fields)), origins, R, np.einsum("nji,nj->ni", R, ambient)


class TestExact:
    def test_a_moving_array_of_scalar_sensors(self) -> None:
        """Three differences in a row do not determine a source, 36 do: to 1e-6 m and 1e-6 of the moment."""
        (best, *_) = fit_at_rest(SQUARE, *passing(SQUARE)).solutions
        np.testing.assert_allclose(best.position_m, SOURCE[:3], rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(best.moment_Am2, SOURCE[3:], rtol=0.0, atol=1e-6 * np.linalg.norm(SOURCE[3:]))
        assert best.dof == 3 * N_ROWS - 6
        assert best.range_observable

    def test_a_moving_pair_of_vector_sensors(self) -> None:
        pair = geometries.tetrahedron(1.5, "vector", 1e-11).subset(["s1", "s2"])
        (best, *_) = fit_at_rest(pair, *passing(pair)).solutions
        np.testing.assert_allclose(best.position_m, SOURCE[:3], rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(best.moment_Am2, SOURCE[3:], rtol=0.0, atol=1e-6 * np.linalg.norm(SOURCE[3:]))

    def test_missing_readings_leave_the_others(self) -> None:
        readings, *poses = passing(SQUARE)
        readings[3, 1], readings[7] = np.nan, np.nan
        (best, *_) = fit_at_rest(SQUARE, readings, *poses).solutions
        np.testing.assert_allclose(best.position_m, SOURCE[:3], rtol=0.0, atol=1e-6)
        assert best.dof == 3 * N_ROWS - 6 - 1 - 3

    def test_vector_sensors_need_no_ambient_field(self) -> None:
        """Whatever is common to the sensors of a row drops out."""
        pair = geometries.tetrahedron(1.5, "vector", 1e-11).subset(["s1", "s2"])
        readings, origins, R, _ = passing(pair)
        (best, *_) = fit_at_rest(pair, readings, origins, R).solutions
        np.testing.assert_allclose(best.position_m, SOURCE[:3], rtol=0.0, atol=1e-6)


class TestNoise:
    def test_misfit_and_error_are_chi_square(self) -> None:
        """Sums over 25 fits inside 99 % bounds: false-alarm rate 1 % for each of the two, seed not tuned.

        The noise is small enough that the optimum is linear in it.
        """
        readings, *poses = passing(SQUARE)
        rng = np.random.default_rng(2)
        misfit, error, dof = 0.0, 0.0, 0
        n_fits = 25
        for _ in range(n_fits):
            (best, *_) = fit_at_rest(SQUARE, readings + 1e-11 * rng.normal(size=readings.shape), *poses).solutions
            misfit, dof = misfit + best.chi2, dof + best.dof
            off = np.concatenate([best.position_m, best.moment_Am2]) - SOURCE
            error += float(off @ np.linalg.solve(best.covariance, off))
        assert dof == n_fits * (3 * N_ROWS - 6)
        assert chi2.ppf(0.005, dof) < misfit < chi2.ppf(0.995, dof)
        assert chi2.ppf(0.005, 6 * n_fits) < error < chi2.ppf(0.995, 6 * n_fits)


class TestRefusal:
    def test_too_few_rows(self) -> None:
        readings, *poses = passing(SQUARE)
        readings[5, 3] = np.nan
        fix = fit_at_rest(SQUARE, readings[4:6], *(pose[4:6] for pose in poses))
        assert fix.solutions == ()
        assert fix.reason == "2 rows give 5 independent differences, 6 are needed"

    def test_no_signal(self) -> None:
        _, origins, R, ambient = passing(SQUARE)
        readings = SQUARE.readings_of(np.repeat(ambient[:, None], 4, axis=1))
        fix = fit_at_rest(SQUARE, readings, origins, R, ambient)
        assert fix.solutions == ()
        assert fix.reason

    def test_what_is_known_bounds_the_source(self) -> None:
        """A half-space that the source is not in, and a moment that is too small for it."""
        readings, *poses = passing(SQUARE)
        fix = fit_at_rest(SQUARE, readings, *poses, prior=SourcePrior(low_m=(2.0, -math.inf, -math.inf)))
        assert all(solution.position_m[0] >= 2.0 for solution in fix.solutions)
        assert all(solution.chi2 > 1e3 for solution in fix.solutions)
        fix = fit_at_rest(SQUARE, readings, *poses, prior=SourcePrior(largest_moment_Am2=1.0))
        assert all(np.linalg.norm(solution.moment_Am2) <= 1.0 for solution in fix.solutions)
        assert all(solution.chi2 > 1e3 for solution in fix.solutions)

    def test_errors_of_poses_where_no_source_is_allowed(self) -> None:
        """No search has an optimum then that they could be linearised at."""
        readings, origins, R, ambient = passing(SQUARE)
        nowhere = SourcePrior(low_m=(1e6, -math.inf, -math.inf), largest_moment_Am2=1e-9)
        still = [
            ArrayPose(origin, turn, np.zeros(3), np.zeros(3), np.zeros(3))
            for origin, turn in zip(origins, R, strict=True)
        ]
        poses = PosesOfRows(SQUARE, still, [np.eye(9)[:, 3:6] * 0.02] * len(R))
        fix = fit_at_rest(SQUARE, readings, origins, R, ambient, prior=nowhere, poses=poses)
        assert fix.solutions == ()


@pytest.mark.parametrize("shift", [np.zeros(3), np.array([4e5, -3e5, 200.0])])
def test_the_fix_moves_with_the_world(shift: FloatArray) -> None:
    """Also in coordinates of hundreds of kilometres, as those of a map."""
    readings, origins, R, ambient = passing(SQUARE)
    (best, *_) = fit_at_rest(SQUARE, readings, origins + shift, R, ambient).solutions
    np.testing.assert_allclose(best.position_m - shift, SOURCE[:3], rtol=0.0, atol=1e-5)
