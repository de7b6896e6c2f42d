"""The moment of an object on a known path.

====================================  ==================================================================================
what                                  who checks it
====================================  ==================================================================================
a moment that does not change         least squares of plain differences with their covariance (13), fields by magpylib
a moment that changes                 filterpy's Kalman filter and its smoother
a turning object                      the moment that made the readings, turned
an uncertain path                     NEES over many draws of its error
a wrong path, clock, second source    that it is said
====================================  ==================================================================================
"""

from __future__ import annotations

from dataclasses import replace

import filterpy.kalman
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

import arrays
import magloc
from magloc.chi_square import mean_bounds, normalised_square
from tests.passing_ship import (
    ARRAY,
    PERMANENT_AM2,
    FloatArray,
    Pass,
    least_squares,
    moments,
    readings_of,
    shifted,
    straight_pass,
)

PASS = straight_pass(70.0)
CONSTANT = np.tile(PERMANENT_AM2, (len(PASS.time_s), 1))
UNTURNED = magloc.ObjectPath(PASS.time_s, PASS.position_m)


class TestLeastSquares:
    """Without noise of the motion the filter's last row, and every row of the smoother, is least squares of all."""

    READINGS = readings_of(PASS, CONSTANT, seed=3)

    @pytest.mark.parametrize("smooth", [False, True])
    def test_on_a_path(self, smooth: bool) -> None:
        expected, covariance = least_squares(self.READINGS, PASS.position_m, np.tile(np.eye(3), (len(CONSTANT), 1, 1)))
        track = magloc.track_moment(ARRAY, self.READINGS, UNTURNED, turn_rad_s=0.0, smooth=smooth)
        np.testing.assert_allclose(track.moment_Am2[-1], expected, rtol=1e-6)
        np.testing.assert_allclose(track.covariance[-1, 3:, 3:], covariance, rtol=1e-4, atol=1e-6 * covariance.max())
        if smooth:
            np.testing.assert_allclose(track.moment_Am2, np.tile(expected, (len(CONSTANT), 1)), rtol=1e-6)
            np.testing.assert_allclose(track.covariance[0, 3:, 3:], track.covariance[-1, 3:, 3:], rtol=1e-4)

    def test_at_rest_in_the_array(self) -> None:
        place = np.array([4.0, 3.0, 9.0])
        at_rest = Pass(PASS.time_s, np.tile(place, (len(CONSTANT), 1)), PASS.rotation)
        readings = readings_of(at_rest, CONSTANT, seed=4)
        expected, _ = least_squares(readings, at_rest.position_m, np.tile(np.eye(3), (len(CONSTANT), 1, 1)))
        track = magloc.track_moment(ARRAY, readings, place, turn_rad_s=0.0)
        np.testing.assert_allclose(track.moment_Am2[-1], expected, rtol=1e-6)
        np.testing.assert_array_equal(track.position_m, at_rest.position_m)

    def test_chi_square_of_the_record(self) -> None:
        """Within the bounds that one record in a hundred leaves."""
        track = magloc.track_moment(ARRAY, self.READINGS, UNTURNED, turn_rad_s=0.0)
        assert track.dof == 9 * len(CONSTANT) - 3
        low, high = mean_bounds(track.dof)
        assert low < track.chi2 / track.dof < high
        assert not track.misfit


class TestKalmanFilter:
    def test_filter_and_smoother_are_filterpys(self) -> None:
        """A moment that changes, by a filter that we did not write: same S_q, same start, same differences."""
        rng = np.random.default_rng(5)
        turned = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, CONSTANT.shape), axis=0)).apply(CONSTANT)
        track = magloc.track_moment(ARRAY, readings_of(PASS, turned, seed=6), UNTURNED, turn_rad_s=0.02)
        smooth = magloc.track_moment(ARRAY, track.readings, UNTURNED, turn_rad_s=0.02, smooth=True)
        peer = filterpy.kalman.KalmanFilter(dim_x=3, dim_z=9)
        x, S = track.model.start()
        peer.x, peer.P, peer.R = x, S @ S.T, np.eye(9)
        means, covariances, noises = [], [], []
        for i, row in enumerate(track.model.rows):
            change = (0.02 * np.linalg.norm(peer.x)) ** 2 * np.eye(3) if i else np.zeros((3, 3))
            peer.predict(Q=change)
            H = row.moment_columns(PASS.position_m[i])
            peer.update(row.z, H=H)
            means.append(peer.x.copy())
            covariances.append(peer.P.copy())
            noises.append(change)
        np.testing.assert_allclose(track.moment_Am2[5:], means[5:], rtol=1e-5, atol=1e-3)
        peer.F = np.eye(3)
        smoothed, P, *_ = peer.rts_smoother(np.array(means), np.array(covariances), Qs=np.array(noises))
        np.testing.assert_allclose(smooth.moment_Am2[10:], smoothed[10:], rtol=1e-5, atol=1e-2)
        np.testing.assert_allclose(smooth.covariance[10:, 3:, 3:], P[10:], rtol=1e-3, atol=1e-3)

    def test_bound_and_nees(self) -> None:
        """Of 30 moments that change as the model says; NEES of the middle rows: one false alarm in 100 each."""
        errors = {False: [], True: []}
        ratios = []
        for seed in range(30):
            rng = np.random.default_rng(1000 + seed)
            true = CONSTANT.copy()
            for i in range(1, len(true)):
                true[i] = true[i - 1] + 0.02 * np.linalg.norm(true[i - 1]) * rng.normal(size=3)
            readings, truth = readings_of(PASS, true, seed=seed), magloc.Truth(PASS.time_s, PASS.position_m, true)
            for smooth in (False, True):
                track = magloc.track_moment(ARRAY, readings, UNTURNED, turn_rad_s=0.02, smooth=smooth)
                middle = len(true) // 2
                error = track.moment_Am2[middle] - true[middle]
                errors[smooth].append(float(normalised_square(error, track.covariance[middle, 3:, 3:])))
                result = track.consistency(truth)
                ratios.append(result.moment_rms_Am2 / result.moment_bound_Am2)
        low, high = mean_bounds(90)
        assert low < np.sum(errors[False]) / 90 < high
        assert low < np.sum(errors[True]) / 90 < high
        assert 0.9 < np.mean(ratios) < 1.1


class TestKnownAttitude:
    def test_the_moment_turns_with_the_object(self) -> None:
        """Equation (29) with a known rate: nothing is left to be noise."""
        rotation = Rotation.from_euler("z", 0.05 * PASS.time_s[:, None])
        turning = Pass(PASS.time_s, PASS.position_m, rotation)
        true = rotation.apply(PERMANENT_AM2)
        track = magloc.track_moment(ARRAY, readings_of(turning, true), turning.path, turn_rad_s=0.0)
        np.testing.assert_allclose(track.moment_Am2[3:], true[3:], rtol=1e-5, atol=0.1)

    def test_of_an_array_that_turns(self) -> None:
        """The same in the frame of a world in which the array's pose is known."""
        R = Rotation.from_euler("z", 0.03 * PASS.time_s[:, None])
        fields = magloc.dipole.field(
            ARRAY.positions, R.inv().apply(PASS.position_m)[:, None], R.inv().apply(CONSTANT)[:, None]
        )
        readings = magloc.Readings(
            ARRAY.readings_of(fields), time_s=PASS.time_s, array_position_m=np.zeros((len(R), 3)), array_rotation=R
        )
        track = magloc.track_moment(ARRAY, readings, UNTURNED, turn_rad_s=0.0)
        assert track.frame == "world"
        np.testing.assert_allclose(track.moment_Am2[3:], CONSTANT[3:], rtol=1e-5, atol=0.1)


class TestUncertainPath:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(("correlation_s", "n_runs"), [(20.0, 10), (20.0, 30), (0.0, 30), (np.inf, 30)])
    def test_nees(self, correlation_s: float, n_runs: int) -> None:
        """Of the last moment over draws of the path's error: one false alarm in 100."""
        error = magloc.PathError(position_m=1.0, position_correlation_s=correlation_s)
        kept = error.kept(1.0)
        squares = []
        for seed in range(n_runs):
            rng = np.random.default_rng(2000 + seed)
            walk = np.zeros_like(CONSTANT)
            walk[0] = rng.normal(size=3)
            for i in range(1, len(walk)):
                walk[i] = kept * walk[i - 1] + np.sqrt(1.0 - kept**2) * rng.normal(size=3)
            path = magloc.ObjectPath(PASS.time_s, PASS.position_m + walk)
            track = magloc.track_moment(
                ARRAY, readings_of(PASS, CONSTANT, seed), path, turn_rad_s=0.0, path_error=error, smooth=True
            )
            squares.append(float(normalised_square(track.moment_Am2[-1] - CONSTANT[-1], track.covariance[-1, 3:, 3:])))
        low, high = mean_bounds(3 * n_runs)
        assert low < np.sum(squares) / (3 * n_runs) < high

    def test_the_paths_error_is_found(self) -> None:
        """A lasting offset of metres, within 5 σ of each number."""
        offset = np.array([2.0, -1.5, 1.0])
        readings = readings_of(PASS, CONSTANT, seed=7)
        track = magloc.track_moment(
            ARRAY, readings, shifted(UNTURNED, offset), turn_rad_s=0.0, path_error=magloc.PathError(3.0), smooth=True
        )
        sigma = np.sqrt(np.diagonal(track.covariance, axis1=1, axis2=2))
        assert np.abs((track.position_m - PASS.position_m) / sigma[:, :3]).max() < 5.0
        assert not track.misfit


class TestHostileWorld:
    """What no exact path explains is said: χ² beyond noise by one in a million."""

    def misfit(self, path: magloc.ObjectPath, readings: magloc.Readings, **kwargs: object) -> bool:
        return magloc.track_moment(ARRAY, readings, path, turn_rad_s=1e-4, **kwargs).misfit  # type: ignore[arg-type]

    def test_a_path_that_is_wrong_by_metres(self) -> None:
        assert self.misfit(shifted(UNTURNED, np.array([0.0, 2.0, 0.0])), readings_of(PASS, CONSTANT, 1))

    def test_a_clock_that_lags(self) -> None:
        late = replace(UNTURNED, time_s=UNTURNED.time_s + 0.5)
        readings = readings_of(PASS, CONSTANT, 1)
        assert self.misfit(late, readings)
        # Half a second is 1.5 m along the track, which a stated σ of the path covers.
        assert not self.misfit(late, readings, path_error=magloc.PathError(2.0), smooth=True)

    def test_a_second_source(self) -> None:
        readings = readings_of(PASS, CONSTANT, 1)
        other = magloc.dipole.field(ARRAY.positions, PASS.position_m[:, None] + [25.0, 10.0, 0.0], CONSTANT[:, None])
        both = replace(readings, values_T=readings.values_T + ARRAY.readings_of(other))
        assert self.misfit(UNTURNED, both)

    def test_a_moment_that_changes_at_once_is_found_anew(self) -> None:
        jumped = CONSTANT.copy()
        jumped[15:] = [-4000.0, 8000.0, 3000.0]
        track = magloc.track_moment(ARRAY, readings_of(PASS, jumped, 2), UNTURNED, turn_rad_s=1e-4)
        assert track.status[15:18] == ["outlier", "outlier", "acquired"]
        np.testing.assert_allclose(track.moment_Am2[-1], jumped[-1], rtol=0.01)


class TestSensors:
    def test_two_vector_sensors_are_enough(self) -> None:
        pair = arrays.axial(4.0, "vector", noise_T=1e-11)
        track = magloc.track_moment(pair, readings_of(PASS, CONSTANT, array=pair), UNTURNED, turn_rad_s=0.0)
        np.testing.assert_allclose(track.moment_Am2[-1], PERMANENT_AM2, rtol=1e-4, atol=1.0)

    def test_scalar_sensors_in_an_ambient_field(self) -> None:
        scalar = arrays.tetrahedron(6.0, "scalar", noise_T=1e-10)
        readings = readings_of(PASS, CONSTANT, seed=8, array=scalar)
        track = magloc.track_moment(scalar, readings, UNTURNED, turn_rad_s=0.0, smooth=True)
        error = track.moment_Am2[-1] - PERMANENT_AM2
        assert normalised_square(error, track.covariance[-1, 3:, 3:]) < 27.9  # χ² of 3, one in 260,000
        assert not track.misfit

    def test_moduli_alone_leave_the_sign_open(self) -> None:
        scalar = arrays.tetrahedron(6.0, "scalar", noise_T=1e-10)
        readings = replace(readings_of(PASS, CONSTANT, array=scalar), ambient_T=None)
        with pytest.raises(ValueError, match="leave the sign of the moment open"):
            magloc.track_moment(scalar, readings, UNTURNED)

    def test_missing_readings(self) -> None:
        readings = readings_of(PASS, CONSTANT, seed=9)
        values = readings.values_T.copy()
        values[4], values[10, :3] = np.nan, np.nan
        track = magloc.track_moment(ARRAY, replace(readings, values_T=values), UNTURNED)
        assert track.status[4] == "predicted"
        assert track[10].nis_dof == 6
        assert track.tracked.all()


class TestEstimability:
    def test_it_grows_from_what_is_known_without_any_row(self) -> None:
        """MeasureS: 1 - σ over that of the covariance which is propagated from the start without any measurement."""
        track = magloc.track_moment(ARRAY, readings_of(PASS, CONSTANT, 1), UNTURNED, turn_rad_s=0.0)
        learned = np.array([point.estimability for point in track])
        assert (np.diff(learned[:, 3:], axis=0) >= -1e-12).all()
        assert (learned[-1, 3:] > 0.99).all()
        np.testing.assert_array_equal(learned[:, :3], 0.0)


class TestBadInput:
    READINGS = readings_of(PASS, CONSTANT)

    def test_a_path_of_another_length(self) -> None:
        with pytest.raises(ValueError, match=r"Input path must have finite positions \(3,\) or \(n, 3\)"):
            magloc.track_moment(ARRAY, self.READINGS, np.zeros((4, 3)))

    def test_time_that_goes_back(self) -> None:
        back = replace(self.READINGS, time_s=self.READINGS.time_s[::-1])
        with pytest.raises(ValueError, match="Input time_s must increase from row to row"):
            magloc.track_moment(ARRAY, back, UNTURNED)

    def test_a_truth_without_moments(self) -> None:
        track = magloc.track_moment(ARRAY, self.READINGS, UNTURNED)
        with pytest.raises(arrays.InputError, match="found no moment"):
            track.consistency(magloc.Truth(PASS.time_s, PASS.position_m))


def test_rows_outside_the_path_are_left_out() -> None:
    readings = readings_of(PASS, CONSTANT)
    part: FloatArray = PASS.time_s[5:12]
    track = magloc.track_moment(ARRAY, readings, magloc.ObjectPath(part, PASS.position_m[5:12]))
    np.testing.assert_array_equal(track.time_s, part)


def test_induced_moments_are_not_constant() -> None:
    """The readings of a ship that rolls: its moment in its own axes changes, and is followed."""
    rolling = straight_pass(70.0, roll_deg=5.0)
    true = moments(rolling)
    track = magloc.track_moment(ARRAY, readings_of(rolling, true, 3), rolling.path, turn_rad_s=0.02, smooth=True)
    result = track.consistency(magloc.Truth(rolling.time_s, rolling.position_m, true))
    assert result.moment_rms_Am2 < 2.0 * result.moment_bound_Am2 < 0.02 * np.linalg.norm(PERMANENT_AM2)


def test_it_is_drawn_and_exported_as_any_track() -> None:
    track = magloc.track_moment(ARRAY, readings_of(PASS, CONSTANT), UNTURNED)
    dataset = track.to_xarray()
    np.testing.assert_array_equal(dataset.moment_Am2, track.moment_Am2)
    assert dataset.sizes["row"] == len(track)
    assert track.to_geojson((54.4, 10.2, 0.0))["features"][0]["geometry"]["type"] == "LineString"
    assert len(track.plot().axes) > 1
    assert repr(track).splitlines()[0].split()[0] == "time_s"


class TestSeveralSources:
    """Sources at known places together: the last row is least squares of all rows where nothing changes."""

    PLACES_M = np.array([[0.0, 0.0, 0.1], [0.1, 0.05, 0.12]])
    MOMENTS_AM2 = np.array([[0.1, 0.2, -0.3], [0.3, 0.1, 0.2]])

    def readings(self, array: arrays.SensorArray, seed: int) -> FloatArray:
        pairs = zip(self.PLACES_M, self.MOMENTS_AM2, strict=True)
        fields_T = array.ambient_fields + sum(magloc.dipole.field(array.positions, p, m) for p, m in pairs)
        noise_T = np.random.default_rng(seed).normal(size=(8, array.n_channels)) * array.channel_noise_T
        return np.asarray(array.readings_of(fields_T) + noise_T)

    def test_is_the_fix_of_the_mean(self) -> None:
        array = arrays.grid(3, 3, 0.1, noise_T=1e-6)
        readings_T = self.readings(array, 1)
        tracks = magloc.track_moments(array, readings_T, self.PLACES_M, turn_rad_s=1e-12)
        mean = magloc.locate(array, magloc.Readings(readings_T), position_m=self.PLACES_M, average=True)[0].best
        for track, source in zip(tracks, mean.sources, strict=True):
            np.testing.assert_allclose(track.moment_Am2[-1], source.moment_Am2, rtol=1e-4)
            np.testing.assert_allclose(track.covariance[-1][3:, 3:], source.covariance, rtol=1e-3, atol=1e-9)
            np.testing.assert_array_equal(track.position_m[-1], source.position_m)

    def test_moduli(self) -> None:
        """NEES of 6 × 12 within 99.9 %."""
        array = replace(arrays.grid(4, 3, 0.1, "scalar", 1e-8), ambient_T=(2e-5, 0.0, 4e-5))
        total = 0.0
        for seed in range(12):
            tracks = magloc.track_moments(array, self.readings(array, seed), self.PLACES_M, turn_rad_s=1e-12)
            for track, moment in zip(tracks, self.MOMENTS_AM2, strict=True):
                error = track.moment_Am2[-1] - moment
                total += float(normalised_square(error, track.covariance[-1][3:, 3:]))
        low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 72)
        assert low < total < high

    def test_one_at_rest_is_that_of_one(self) -> None:
        array = arrays.grid(3, 3, 0.1, noise_T=1e-6)
        readings_T = self.readings(array, 3)
        (of_several,) = magloc.track_moments(array, readings_T, self.PLACES_M[:1])
        alone = magloc.track_moment(array, readings_T, self.PLACES_M[0])
        np.testing.assert_array_equal(of_several.moment_Am2, alone.moment_Am2)

    @pytest.mark.parametrize(
        ("places_m", "text"),
        [([1.0, 2.0, 3.0], r"of shape \(K, 3\)"), ([[0.0, 0.0, 1.0]] * 2, "different places")],
    )
    def test_refused(self, places_m: object, text: str) -> None:
        array = arrays.grid(3, 3, 0.1)
        with pytest.raises(ValueError, match=text):
            magloc.track_moments(array, np.zeros((2, 27)), places_m)  # type: ignore[arg-type]
