"""The consistency of a track: χ² bounds by scipy, NEES by hand, and the posterior bound by its information form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import chi2

from arrays import geometries
from arrays.array import SensorArray
from arrays.differences import contrasts
from magloc.chi_square import mean_bounds
from magloc.readings import Readings
from magloc.state_space import symmetric_square_root
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.consistency import consistency, nees_of
from magloc.tracking.coordinates import Chart
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import OrnsteinUhlenbeck, RandomWalk
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from tests.oracles import derivative, magpylib_field

FloatArray = NDArray[np.float64]
ARRAY = geometries.tetrahedron(1.5, "vector", 2e-10)


def point_of(
    position_m: FloatArray, moment_Am2: FloatArray, covariance: FloatArray, nis: float = 9.0, status: str = "tracked"
) -> TrackPoint:
    return TrackPoint(0.0, position_m, moment_Am2, covariance, np.ones(6), 2, nis, 9, status)


def blank_rows(n: int) -> list[Row]:
    """Rows without readings: they give no coordinates, and NEES is that of position and moment."""
    return list(rows_of(Readings(np.full((n, 12), np.nan))))


TRACKER = Tracker(ARRAY, RandomWalk(0.1, 0.1))


class TestMeanBounds:
    @pytest.mark.parametrize("dof", [1, 9, 600, 36_000])
    @pytest.mark.parametrize("level", [0.95, 0.99])
    def test_are_the_quantiles_of_chi_square(self, dof: int, level: float) -> None:
        expected = chi2.ppf([0.5 - 0.5 * level, 0.5 + 0.5 * level], dof) / dof
        np.testing.assert_allclose(mean_bounds(dof, level), expected, rtol=1e-9)

    def test_of_nothing(self) -> None:
        assert np.isnan(mean_bounds(0)).all()


class TestNees:
    @pytest.fixture
    def covariance(self) -> FloatArray:
        """Correlated, and of mixed units."""
        root = np.random.default_rng(0).normal(size=(6, 6)) * np.repeat([0.05, 20.0], 3)[:, None]
        return np.asarray(root @ root.T)

    def test_of_position_and_moment(self, covariance: FloatArray) -> None:
        error = np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance)
        points = [point_of(error[:3], error[3:], covariance)]
        result = consistency(points, TRACKER, blank_rows(1), np.zeros((1, 3)), np.zeros((1, 3)))
        assert result.nees_per_dimension == pytest.approx(error @ np.linalg.inv(covariance) @ error / 6.0, rel=1e-6)
        assert result.nees_bounds == pytest.approx(mean_bounds(6))
        assert result.position_rms_m == pytest.approx(float(np.linalg.norm(error[:3])))

    @pytest.mark.parametrize("moment", [True, False])
    def test_of_a_truth_without_a_height(self, covariance: FloatArray, moment: bool) -> None:
        """z missing: the marginal of the other coordinates, and of the moment where it is known."""
        error = np.array([0.04, -0.05, 7.0, 10.0, -8.0, 3.0])
        truth = np.array([[0.0, 0.0, np.nan]])
        points = [point_of(error[:3], error[3:], covariance)]
        result = consistency(points, TRACKER, blank_rows(1), truth, np.zeros((1, 3)) if moment else None)
        kept = [0, 1, 3, 4, 5] if moment else [0, 1]
        expected = error[kept] @ np.linalg.inv(covariance[np.ix_(kept, kept)]) @ error[kept] / len(kept)
        assert result.nees_per_dimension == pytest.approx(expected, rel=1e-6)
        assert result.position_rms_m == pytest.approx(math.hypot(0.04, 0.05))

    @pytest.mark.parametrize("moment", [True, False])
    def test_of_an_uncertain_truth(self, covariance: FloatArray, moment: bool) -> None:
        error = np.random.default_rng(2).multivariate_normal(np.zeros(6), covariance)
        points = [point_of(error[:3], error[3:], covariance)]
        true = np.zeros((1, 3))
        result = consistency(points, TRACKER, blank_rows(1), true, true if moment else None, None, np.array([0.2]))
        n = 6 if moment else 3
        total = (covariance + np.diag([0.04] * 3 + [0.0] * 3))[:n, :n]
        assert result.nees_per_dimension == pytest.approx(error[:n] @ np.linalg.inv(total) @ error[:n] / n, rel=1e-6)

    def test_bounds_are_printed_of_what_is_independent(self) -> None:
        """Innovations are, errors of a track's rows are not."""
        points = [point_of(np.ones(3), np.ones(3), np.eye(6), 9.0)] * 4
        lines = consistency(points, TRACKER, blank_rows(4), np.zeros((4, 3)), np.zeros((4, 3))).lines()
        assert ["bounds" in line for line in lines if "per dimension" in line] == [False, True]


class TestNeesOfACurvedEstimate:
    """Six differences of a weak source: their noise is χ² of six numbers, and so is NEES in their coordinates."""

    THREE = ARRAY.subset(["s1", "s2", "s3"])
    TRUTH = np.array([3.0, 1.5, 0.8, 120.0, -150.0, 160.0])
    UNIT = np.repeat([1.0, 100.0], 3)

    def test_is_the_square_of_the_noise(self) -> None:
        """To 1 %, for 200 draws of a noise that leaves the range known to 5 %; the Cartesian one is far off."""
        rng = np.random.default_rng(3)
        array = replace(self.THREE, sensors=tuple(replace(s, noise_T=6e-9) for s in self.THREE.sensors))
        tracker = Tracker(array, RandomWalk(0.1, 0.1))
        measurement = tracker.measurements.of(Row(0.0, np.zeros(9)))
        expected, found, cartesian = [], [], []
        for _ in range(200):
            noise = rng.normal(size=6)
            estimate = self.solve(measurement, measurement.predict_source(self.TRUTH) + noise)
            if estimate is None:
                continue
            H = measurement.directional_derivative(estimate, np.eye(6))
            point = self.point(array, estimate, np.linalg.inv(H.T @ H))
            expected.append(noise @ noise)
            found.append(nees_of(point, self.TRUTH, measurement)[0])
            cartesian.append((H @ (self.TRUTH - estimate)) @ (H @ (self.TRUTH - estimate)))
        assert len(found) > 190
        np.testing.assert_allclose(found, expected, rtol=1e-2)
        assert np.max(np.abs(np.array(cartesian) / expected - 1.0)) > 0.1

    def point(self, array: SensorArray, estimate: FloatArray, covariance: FloatArray) -> TrackPoint:
        """Of a single component."""
        chart = Chart.at(estimate[None], array.centroid, array.circumradius)
        S = chart.inverse_jacobian() @ symmetric_square_root(covariance)
        mixture = Mixture(estimate[None], S, np.zeros(1), 6, array.centroid, array.circumradius)
        return replace(point_of(estimate[:3], estimate[3:], covariance), mixture=mixture)

    def solve(self, measurement: RowMeasurement, z: FloatArray) -> FloatArray | None:
        """The source whose six differences are z, if scipy finds it."""
        fit = least_squares(
            lambda y: measurement.predict_source(y * self.UNIT) - z,
            self.TRUTH / self.UNIT,
            lambda y: measurement.directional_derivative(y * self.UNIT, np.diag(self.UNIT)),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        return np.asarray(fit.x * self.UNIT) if np.abs(fit.fun).max() < 1e-7 else None

    def test_what_is_known_in_part_is_counted_in_cartesian_coordinates(self) -> None:
        measurement = Tracker(ARRAY, RandomWalk(0.1, 0.1)).measurements.of(Row(0.0, np.zeros(12)))
        truth = self.TRUTH.copy()
        truth[2] = np.nan
        off = self.TRUTH + 0.1 * self.UNIT
        square, dof = nees_of(point_of(off[:3], off[3:], np.diag(self.UNIT**2)), truth, measurement)
        assert (square, dof) == (pytest.approx(5 * 0.01), 5)
        # A moment that is known in part is not known.
        truth[3] = np.nan
        assert nees_of(point_of(off[:3], off[3:], np.diag(self.UNIT**2)), truth, measurement)[1] == 2

    def test_without_a_moment_it_is_that_of_the_place(self) -> None:
        """Of a known direction and a log-range that is off by 1.5 σ."""
        covariance = np.diag(np.repeat([0.01, 1.0], 3)) ** 2
        point = self.point(ARRAY, self.TRUTH, covariance)
        assert point.mixture is not None
        away = np.concatenate([ARRAY.centroid + 1.002 * (self.TRUTH[:3] - ARRAY.centroid), np.full(3, np.nan)])
        measurement = Tracker(ARRAY, RandomWalk(0.1, 0.1)).measurements.of(Row(0.0, np.zeros(12)))
        square, dof = nees_of(point, away, measurement)
        sigma = 0.01 / np.linalg.norm(self.TRUTH[:3] - ARRAY.centroid)
        assert (square, dof) == (pytest.approx((math.log(1.002) / sigma) ** 2, rel=1e-6), 3)


class TestCounting:
    def test_rows_without_track_or_truth(self) -> None:
        zero, P = np.zeros(3), np.eye(6)
        points = [
            TrackPoint(0.0, status="not acquired: no signal"),
            point_of(zero, zero, P, math.nan, "acquired"),
            point_of(zero + 1.0, zero, P, 4.5),
            point_of(zero + 5.0, zero, P, 18.0),
            point_of(zero, zero, P, 500.0, "outlier"),
        ]
        truth = np.zeros((5, 3))
        truth[3] = np.nan
        result = consistency(points, TRACKER, blank_rows(5), truth, None, np.array([np.inf, 1.0, 2.0, 7.0, 2.0]))
        assert (result.rows, result.tracked_rows) == (4, 3)
        assert result.position_rms_m == pytest.approx(math.sqrt(3.0 / 3.0))
        assert result.position_bound_m == pytest.approx(math.sqrt(9.0 / 3.0))
        assert result.nees_per_dimension == pytest.approx(3.0 / 9.0)
        # The innovations of an outlier are not those of the filter.
        assert result.nis_per_dimension == pytest.approx(22.5 / 18.0)
        assert result.nis_bounds == mean_bounds(18)

    def test_nothing_tracked(self) -> None:
        points = [TrackPoint(0.0, status="not acquired: no signal")]
        result = consistency(points, TRACKER, blank_rows(1), np.zeros((1, 3)), None)
        assert (result.rows, result.tracked_rows) == (1, 0)
        assert math.isnan(result.position_rms_m)
        assert math.isnan(result.nees_per_dimension)
        assert math.isnan(result.nis_per_dimension)
        assert np.isnan([*result.nees_bounds, *result.nis_bounds]).all()


def information_of(state: FloatArray, rotation: FloatArray, origin: FloatArray) -> FloatArray:
    """Information of one row of the tetrahedron: (6, 6)."""
    H = jacobian_of(state, rotation, origin)
    R = np.kron(2e-10**2 * (np.eye(3) + 1.0), np.eye(3))
    return np.asarray(H.T @ np.linalg.solve(R, H))


def jacobian_of(state: FloatArray, rotation: FloatArray, origin: FloatArray) -> FloatArray:
    """Jacobian of the differences of one row, from magpylib's field by numerical derivatives: (9, 6)."""
    D = np.kron(contrasts(4), np.eye(3))
    scale = np.repeat([1.0, 100.0], 3)

    def differences(states: FloatArray) -> FloatArray:
        def one(x: FloatArray) -> FloatArray:
            p, m = rotation.T @ (x[:3] - origin), rotation.T @ (x * scale)[3:]
            return np.asarray(D @ magpylib_field(ARRAY.positions, p, m).ravel()) * 1e9

        return np.apply_along_axis(one, -1, states)

    return derivative(differences, state / scale, step=1e-2, atol=1e-9) * 1e-9 / scale


def shown(n: int) -> FloatArray:
    """Readings (n, 12) that stand out of noise."""
    return np.tile(1e-6 * np.arange(12.0), (n, 1))


class MovingArray:
    """A source that moves, and an array that moves and turns."""

    N_ROWS = 6

    def truth(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        t = np.array([0.0, 0.5, 1.0, 2.5, 3.0, 3.2])
        p = np.array([3.0, 1.5, 0.8]) + np.outer(t, [-0.2, 0.1, 0.0])
        return t, p, np.tile([120.0, -150.0, 160.0], (self.N_ROWS, 1))

    def rows(self, t: FloatArray) -> tuple[list[Row], FloatArray, FloatArray]:
        """Of an array that moves and turns; their readings play no part, only that they show a source."""
        from scipy.spatial.transform import Rotation

        origin = np.outer(t, [0.1, -0.1, 0.0])
        rotation = Rotation.from_rotvec(np.outer(t, [0.1, 0.0, -0.2]))
        rows = list(rows_of(Readings(shown(self.N_ROWS), time_s=t, array_position_m=origin, array_rotation=rotation)))
        return rows, rotation.as_matrix(), origin


class TestPosteriorBound(MovingArray):
    def test_is_tichavskys_recursion_in_information_form(self) -> None:
        """J' = D22 - D21 (J + D11)⁻¹ D12 with D11 = F⊤Q⁻¹F, D12 = -F⊤Q⁻¹, D22 = Q⁻¹ + H⊤R⁻¹H."""
        t, p, m = self.truth()
        rows, rotations, origin = self.rows(t)
        motion = RandomWalk(0.2, 0.05)
        bounds = posterior_bound(Tracker(ARRAY, motion), rows, p, m)
        expected = []
        J = np.zeros((6, 6))
        for i in range(self.N_ROWS):
            seen = information_of(np.concatenate([p[i], m[i]]), rotations[i], origin[i])
            if i == 0:
                J = seen
            else:
                dt_s = t[i] - t[i - 1]
                strength = float(np.linalg.norm(m[i]))
                Q = np.diag(np.repeat([0.2 * dt_s, 0.05 * strength * dt_s], 3) ** 2)
                Q_inverse = np.linalg.inv(Q)
                J = Q_inverse + seen - Q_inverse @ np.linalg.inv(J + Q_inverse) @ Q_inverse
            expected.append(math.sqrt(float(np.trace(np.linalg.inv(J)[:3, :3]))))
        np.testing.assert_allclose(bounds, expected, rtol=1e-5)

    def test_first_row_is_the_cramer_rao_bound(self) -> None:
        """Spec 1, section 4: edge 1.5 m, 1 nT, source (5, 0, 0.306) m, moment along z: (0.289, 0.082, 0.076) m."""
        array = geometries.tetrahedron(1.5, "vector", 1e-9)
        row = Row(0.0, shown(1)[0])
        p, m = np.array([[5.0, 0.0, 0.306]]), np.array([[0.0, 0.0, 100.0]])
        (bound,) = posterior_bound(Tracker(array, RandomWalk(0.1, 0.1)), [row], p, m)
        assert bound == pytest.approx(math.sqrt(0.289**2 + 0.082**2 + 0.076**2), rel=0.01)

    def test_counts_lasting_errors_as_unknowns_of_their_own(self) -> None:
        """Rest, and fields fixed to the array: the inverse of the information of source and fields from all rows."""
        t, p, m = self.truth()
        fields = replace(ARRAY, sensors=tuple(replace(s, offset_uncertainty_T=5e-10) for s in ARRAY.sensors))
        rows, rotations, origin = self.rows(t)
        still_p = np.tile(p[0], (self.N_ROWS, 1))
        bounds = posterior_bound(Tracker(fields, RandomWalk(1e-9, 1e-9)), rows, still_p, m)
        D, R = np.kron(contrasts(4), np.eye(3)), np.kron(2e-10**2 * (np.eye(3) + 1.0), np.eye(3))
        J = np.diag(np.repeat([0.0, 1.0 / 5e-10**2], [6, 12]))
        expected = []
        for rotation, place in zip(rotations, origin, strict=True):
            H = np.concatenate([jacobian_of(np.concatenate([p[0], m[0]]), rotation, place), D], axis=1)
            J = J + H.T @ np.linalg.solve(R, H)
            expected.append(math.sqrt(float(np.trace(np.linalg.inv(J)[:3, :3]))))
        np.testing.assert_allclose(bounds, expected, rtol=1e-3)

    def test_is_infinite_until_a_row_shows_the_source(self) -> None:
        t, p, m = self.truth()
        readings = shown(self.N_ROWS)
        readings[0] = np.nan
        readings[1] = 0.0
        readings[4] = np.nan
        bounds = posterior_bound(
            Tracker(ARRAY, OrnsteinUhlenbeck(0.2, 0.05)), list(rows_of(Readings(readings, time_s=t))), p, m
        )
        assert np.isinf(bounds[:2]).all()
        assert np.isfinite(bounds[2:]).all()
        assert bounds[4] > bounds[3]


class TestSmoothingBound(MovingArray):
    """Against the information of all states at once, inverted: block-tridiagonal, one block for every row."""

    def test_of_unknown_motion(self) -> None:
        t, p, m = self.truth()
        rows, rotations, origin = self.rows(t)
        bounds = posterior_bound(Tracker(ARRAY, RandomWalk(0.2, 0.05)), rows, p, m, smooth=True)
        unit = np.repeat([1.0, 100.0], 3)
        J = np.zeros((6 * self.N_ROWS,) * 2)
        for i in range(self.N_ROWS):
            here = slice(6 * i, 6 * i + 6)
            J[here, here] += information_of(np.concatenate([p[i], m[i]]), rotations[i], origin[i])
            if i:
                dt_s = t[i] - t[i - 1]
                sigma = np.repeat([0.2 * dt_s, 0.05 * float(np.linalg.norm(m[i])) * dt_s], 3)
                self.add_step(J, i, np.eye(6), np.diag(sigma**2))
        np.testing.assert_allclose(bounds, self.of_information(J, unit), rtol=1e-5)

    def test_of_wandering_motion_with_a_gap(self) -> None:
        """Velocity and turn rate are known from the start by their standard deviations alone."""
        t, p, m = self.truth()
        readings = shown(self.N_ROWS)
        readings[3] = np.nan
        rows = list(rows_of(Readings(readings, time_s=t)))
        motion = OrnsteinUhlenbeck(0.2, 0.05)
        tracker = Tracker(ARRAY, motion)
        bounds = posterior_bound(tracker, rows, p, m, smooth=True)
        velocity, rest = np.array([-0.2, 0.1, 0.0]), np.zeros(3)
        states = [motion.state_of(np.concatenate([place, m[0]]), velocity, rest) for place in p]
        J = np.zeros((12 * self.N_ROWS,) * 2)
        J[6:12, 6:12] = np.diag(np.repeat([0.2, 0.05], 3) ** -2)
        for i, (row, state) in enumerate(zip(rows, states, strict=True)):
            H = tracker.measurements.of(row).jacobian(state)
            here = slice(12 * i, 12 * i + 12)
            J[here, here] += H.T @ H
            if i:
                _, F, root = motion.step(states[i - 1], t[i] - t[i - 1])
                self.add_step(J, i, F, root @ root.T)
        np.testing.assert_allclose(bounds, self.of_information(J, np.repeat([1.0, 100.0, 0.2, 0.05], 3)), rtol=1e-5)

    def add_step(self, J: FloatArray, i: int, F: FloatArray, Q: FloatArray) -> None:
        """Information that a step gives of the states before and after it, in place."""
        n = len(F)
        scale = np.sqrt(np.diagonal(Q))
        inverse = np.linalg.inv(Q / np.outer(scale, scale)) / np.outer(scale, scale)
        both = np.concatenate([-F, np.eye(n)], axis=1)
        here = slice(n * (i - 1), n * (i + 1))
        J[here, here] += both.T @ inverse @ both

    def of_information(self, J: FloatArray, unit: FloatArray) -> FloatArray:
        """Bounds of the positions [m]; inverted in units that are alike in size."""
        units = np.tile(unit, self.N_ROWS)
        P = np.linalg.inv(J * np.outer(units, units)) * np.outer(units, units)
        return np.sqrt(np.diagonal(P).reshape(self.N_ROWS, -1)[:, :3].sum(axis=1))
