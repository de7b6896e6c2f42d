"""A simulation: fields, sensors' errors, missing readings, and streams of random numbers.

Statistical tests have fixed seeds, not chosen, and state the probability with which a right program fails them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from arrays.geometries import grid, tetrahedron
from arrays.sensor import Calibration, Sensor
from sims.magnetics import simulation as simulation_module
from sims.magnetics.paths import Attitude, Lawnmower, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Missing, Platform, Pulsation, Source
from sims.magnetics.sensors import SensorModel
from sims.magnetics.simulation import MU0, Simulation, simulate
from sims.noise import stream
from tests.oracles import magpylib_field

FloatArray = NDArray[np.float64]
FALSE_ALARM = 1e-4
SILENT = SensorModel("vector", noise_T_rtHz=1e-30)
AMBIENT_T = (2e-6, 20e-6, -43e-6)
MOVING = Carrier(
    Lawnmower((-8.0, 2.0, 3.0), 1.1, 12.0, 3.0, 2, 1.3),
    Attitude(True, (0.5, 0.5, -0.5, 0.5), (0.0, 0.0, 0.1), (0.1, 0.2, 0.3), (3.0, 4.0, 5.0)),
)
TARGET = Source(
    Carrier(Steered((0.0, -6.0, 0.0), 0.3, 0.2, turn_rad_s=0.05), Attitude(rate_rad_s=(0.1, -0.2, 0.05))),
    moment_Am2=(100.0, -50.0, 80.0),
    polarisability_m3=((1.0, 0.2, 0.0), (0.2, 2.0, -0.1), (0.0, -0.1, 0.5)),
)


def scenario(model: SensorModel = SILENT, array: SensorArray | None = None, **changes: object) -> MagneticScenario:
    array = tetrahedron(1.5) if array is None else array
    base = MagneticScenario(array, (model,) * array.n_sensors, duration_s=20.0, rate_Hz=10.0, sources=(TARGET,))
    return replace(base, **changes)  # type: ignore[arg-type]


def rotations(simulation: Simulation) -> Rotation:
    return simulation.readings.array_rotation


def bounds(dof: int) -> FloatArray:
    """Interval of χ², which a right program leaves with the probability FALSE_ALARM."""
    interval: FloatArray = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], dof)
    return interval


class TestField:
    def test_readings_are_magpylibs_field_of_the_moving_dipoles(self) -> None:
        other = replace(TARGET, carrier=Carrier(Steered((3.0, 4.0, -2.0))), polarisability_m3=((0.0,) * 3,) * 3)
        wanted = scenario(carrier=MOVING, sources=(TARGET, other), ambient_T=AMBIENT_T)
        result = simulate(wanted, 1)
        positions = np.array(wanted.array.positions)
        for row in range(0, 201, 20):
            turn, origin = rotations(result)[row], result.readings.array_position_m[row]
            field = np.tile(AMBIENT_T, (4, 1))
            for truth in result.truths:
                places = origin + turn.apply(positions)
                field = field + magpylib_field(places, truth.position_m[row], truth.moment_Am2[row])
            np.testing.assert_allclose(
                result.readings.values_T[row], turn.inv().apply(field).ravel(), rtol=1e-12, atol=1e-19
            )

    def test_scalar_sensors_read_the_modulus(self) -> None:
        model = replace(SILENT, reads="scalar")
        vector = simulate(scenario(carrier=MOVING, ambient_T=AMBIENT_T), 1).readings.values_T.reshape(-1, 4, 3)
        scalar = simulate(scenario(model, tetrahedron(1.5, "scalar"), carrier=MOVING, ambient_T=AMBIENT_T), 1)
        np.testing.assert_allclose(scalar.readings.values_T, np.linalg.norm(vector, axis=-1), rtol=1e-13)

    def test_sensors_read_in_their_own_axes_with_their_nominal_calibration(self) -> None:
        turn = Rotation.from_rotvec([0.4, -0.3, 0.9])
        calibration = Calibration.of("vector", [1.1, 0.9, 1.2], [1e-6, 2e-6, -1e-6])
        plain = tetrahedron(1.5)
        array = replace(
            plain,
            sensors=tuple(
                replace(s, rotation_xyzw=tuple(turn.as_quat()), calibration=calibration) for s in plain.sensors
            ),
        )
        field = simulate(scenario(), 1).readings.values_T.reshape(-1, 4, 3)
        found = simulate(scenario(array=array), 1).readings.values_T.reshape(-1, 4, 3)
        expected = turn.inv().apply(field.reshape(-1, 3)).reshape(field.shape) * [1.1, 0.9, 1.2] + [1e-6, 2e-6, -1e-6]
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-18)

    def test_ambient_field_is_given_in_the_array_frame(self) -> None:
        result = simulate(scenario(carrier=MOVING, ambient_T=AMBIENT_T), 1)
        np.testing.assert_allclose(
            rotations(result).apply(result.readings.ambient_T), np.tile(AMBIENT_T, (201, 1)), atol=1e-19
        )

    def test_an_array_at_rest_in_the_origin_has_no_pose(self) -> None:
        assert simulate(scenario(), 1).readings.array_position_m is None
        for carrier in (
            Carrier(Steered((1.0, 0.0, 0.0))),
            Carrier(Steered(speed_m_s=0.1)),
            Carrier(attitude=Attitude(mount_xyzw=(0.6, 0.0, 0.0, 0.8))),
            Carrier(attitude=Attitude(follows_course=True)),
        ):
            assert simulate(scenario(carrier=carrier), 1).readings.array_position_m is not None


class TestMoment:
    def test_permanent_moment_turns_with_the_body(self) -> None:
        body = Carrier(attitude=Attitude(rate_rad_s=(0.0, 0.0, 0.1)))
        source = Source(replace(body, path=Steered((5.0, 0.0, 0.0))), moment_Am2=(3.0, 0.0, 4.0))
        truth = simulate(scenario(sources=(source,)), 1).truth
        angle = 0.1 * truth.time_s
        expected = np.stack([3 * np.cos(angle), 3 * np.sin(angle), np.full_like(angle, 4.0)], axis=-1)
        np.testing.assert_allclose(truth.moment_Am2, expected, atol=1e-13)

    def test_induced_moment_of_a_turning_rod(self) -> None:
        # A rod that is magnetised along its own axis u alone has the moment α (u·B) u/µ0.
        rod = Source(
            Carrier(Steered((5.0, 0.0, 0.0)), Attitude(rate_rad_s=(0.0, 0.0, 0.1))),
            polarisability_m3=((2.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        )
        truth = simulate(scenario(sources=(rod,), ambient_T=AMBIENT_T), 1).truth
        axis = np.stack([np.cos(0.1 * truth.time_s), np.sin(0.1 * truth.time_s), np.zeros(201)], axis=-1)
        expected = 2.0 * (axis @ AMBIENT_T)[:, None] * axis / (4e-7 * math.pi)
        np.testing.assert_allclose(truth.moment_Am2, expected, rtol=1e-12, atol=1e-15)

    def test_a_sphere_of_iron_is_magnetised_along_the_field(self) -> None:
        sphere = Source(Carrier(Steered((5.0, 0.0, 0.0))), polarisability_m3=tuple(4 * math.pi * 0.001 * np.eye(3)))
        moment = simulate(scenario(sources=(sphere,), ambient_T=AMBIENT_T), 1).truth.moment_Am2
        np.testing.assert_allclose(moment[0], 4 * math.pi * 0.1**3 * np.array(AMBIENT_T) / MU0, rtol=1e-12)


class TestCommonFields:
    PULSATIONS = (Pulsation((50e-9, 20e-9, -5e-9), 7.0), Pulsation((0.0, 3e-9, 0.0), 2.0))

    def test_pulsations_are_the_same_at_all_sensors(self) -> None:
        quiet, loud = (simulate(scenario(pulsations=p), 1).readings.values_T for p in ((), self.PULSATIONS))
        added = (loud - quiet).reshape(-1, 4, 3)
        np.testing.assert_allclose(added, np.broadcast_to(added[:, :1], added.shape), atol=1e-20)
        assert np.abs(added[..., 0]).max() == pytest.approx(50e-9, rel=0.01)

    def test_they_are_sinusoids_of_their_period_and_direction(self) -> None:
        loud = simulate(scenario(pulsations=self.PULSATIONS[:1], sources=()), 1).readings
        wave = loud.values_T[:, :3] @ [50e-9, 20e-9, -5e-9] / (50**2 + 20**2 + 5**2) / 1e-18
        angle = 2 * math.pi * loud.time_s / 7.0
        design = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        coefficients, residual, *_ = np.linalg.lstsq(design, wave, rcond=None)
        assert residual[0] < 1e-20
        assert np.hypot(*coefficients) == pytest.approx(1.0)

    def test_differences_of_a_moving_array_do_not_see_them(self) -> None:
        quiet, loud = (
            simulate(scenario(carrier=MOVING, pulsations=p), 1).readings.values_T.reshape(-1, 4, 3)
            for p in ((), self.PULSATIONS)
        )
        np.testing.assert_allclose(np.diff(loud, axis=1), np.diff(quiet, axis=1), atol=1e-19)

    def test_noise_of_the_platform_is_common_and_white(self) -> None:
        noisy = simulate(scenario(platform=Platform(noise_T=3e-9), sources=(), duration_s=1000.0), 1)
        values = noisy.readings.values_T.reshape(-1, 4, 3)
        np.testing.assert_allclose(values, np.broadcast_to(values[:, :1], values.shape), atol=1e-20)
        low, high = bounds(values[:, 0].size)
        assert low < (values[:, 0] ** 2).sum() / 9e-18 < high

    def test_the_dipole_of_the_platform_moves_with_the_array(self) -> None:
        platform = Platform((0.0, 0.0, 3.0), (0.1, 0.2, -0.3))
        values = simulate(scenario(carrier=MOVING, platform=platform, sources=()), 1).readings.values_T
        expected = magpylib_field(tetrahedron(1.5).positions, np.array([0.0, 0.0, 3.0]), np.array([0.1, 0.2, -0.3]))
        np.testing.assert_allclose(values, np.tile(expected.ravel(), (201, 1)), rtol=1e-12)

    def test_what_the_ambient_field_induces(self) -> None:
        """Nine numbers of each sensor for the field in the array's axes, nine for its derivative, of a stated size."""
        ambient = (2e-6, 20e-6, -44e-6)
        quiet, induced, eddying = (
            simulate(scenario(carrier=MOVING, platform=Platform(**terms), sources=(), ambient_T=ambient), 1)
            for terms in ({}, {"induced": 1e-3}, {"eddy_s": 1e-3})
        )
        body = quiet.readings.ambient_T
        time_s = quiet.readings.time_s
        sizes = []
        for loud, cause in ((induced, body), (eddying, np.gradient(body, time_s, axis=0))):
            added = loud.readings.values_T - quiet.readings.values_T
            terms = np.linalg.lstsq(cause, added)[0]
            assert np.abs(added - cause @ terms).max() < 1e-6 * np.abs(added).max()
            sizes.append(terms.std())
        # Of 36 numbers: once in 10,000 times beyond.
        assert all(0.55e-3 < size < 1.5e-3 for size in sizes)
        assert {s.induced_uncertainty for s in induced.array.sensors} == {1e-3}
        assert {s.eddy_uncertainty_s for s in eddying.array.sensors} == {1e-3}

    def test_one_row_shows_no_change_of_the_ambient_field(self) -> None:
        """Which has no derivative, and no eddy currents."""
        one = {"carrier": MOVING, "duration_s": 0.01, "sources": ()}
        quiet, eddying = (simulate(scenario(platform=Platform(eddy_s=s), **one), 1) for s in (0.0, 1e-4))
        assert len(eddying.readings) == 1
        np.testing.assert_array_equal(eddying.readings.values_T, quiet.readings.values_T)

    def test_it_may_oscillate(self) -> None:
        platform = Platform((0.0, 0.0, 3.0), (0.0, 0.0, 1.0), frequency_Hz=0.5)
        values = simulate(scenario(platform=platform, sources=()), 1).readings.values_T[:, 2]
        np.testing.assert_allclose(values[10:], -values[:-10], atol=1e-18)  # half a period later
        assert values.std() > 0.1 * np.abs(values).max()


class TestSensorErrors:
    def test_white_noise_is_that_of_the_array(self) -> None:
        result = simulate(scenario(SILENT.with_sigma(2e-9, 10.0), sources=(), duration_s=2000.0), 1)
        assert [sensor.noise_T for sensor in result.array.sensors] == [2e-9] * 4
        low, high = bounds(20_001)
        for channel in result.readings.values_T.T:
            assert low < (channel**2).sum() / 4e-18 < high

    def test_readings_are_multiples_of_the_resolution(self) -> None:
        step = 5e-9
        rounded = simulate(scenario(replace(SILENT, resolution_T=step)), 1).readings.values_T
        exact = simulate(scenario(), 1).readings.values_T
        np.testing.assert_allclose(rounded / step, np.round(rounded / step), atol=1e-9)
        assert np.abs(rounded - exact).max() <= step / 2 * (1 + 1e-9)
        assert np.abs(rounded - exact).max() > 0.4 * step

    def test_rounding_counts_as_noise_of_the_array(self) -> None:
        model = replace(SILENT.with_sigma(2e-9, 10.0), resolution_T=3e-9)
        noise = scenario(model).nominal_array.sensors[0].noise_T
        assert noise == pytest.approx(math.sqrt(4e-18 + 9e-18 / 12), rel=1e-11)

    def test_a_reading_beyond_the_range_is_the_range(self) -> None:
        exact = simulate(scenario(), 1)
        limit = float(np.quantile(np.abs(exact.readings.values_T), 0.7))
        clipped = simulate(scenario(replace(SILENT, range_T=limit, resolution_T=1e-11)), 1)
        beyond = np.abs(exact.readings.values_T) > limit + 1e-11
        np.testing.assert_array_equal(np.abs(clipped.readings.values_T[beyond]), limit)
        assert np.abs(clipped.readings.values_T).max() == limit
        assert {sensor.saturation_T for sensor in clipped.array.sensors} == {limit}
        assert exact.array.sensors[0].saturation_T is None

    def test_misalignment_and_gain_have_their_rms(self) -> None:
        model = replace(SILENT, misalignment_rad=2e-3, gain_error=3e-4)
        sensors = tuple(Sensor(f"s{i}", "vector", (float(i), 0.0, 0.0), 1e-9) for i in range(1000))
        true = simulate(scenario(model, SensorArray(sensors), duration_s=0.1, sources=()), 1).true_array
        scale = np.array([sensor.calibration.scale for sensor in true.sensors])
        gains = np.linalg.norm(scale, axis=2) - 1.0  # a rotation keeps the length of a row
        turns = Rotation.from_matrix(scale / (1.0 + gains[:, :, None])).as_rotvec()
        low, high = bounds(3000)
        assert low < (turns**2).sum() / 4e-6 < high
        assert low < (gains**2).sum() / 9e-8 < high

    def test_they_stay_the_same_in_a_run(self) -> None:
        model = replace(SILENT, misalignment_rad=2e-3, gain_error=3e-4)
        result = simulate(scenario(model, carrier=MOVING, ambient_T=AMBIENT_T), 1)
        exact = simulate(scenario(carrier=MOVING, ambient_T=AMBIENT_T), 1)
        scale = np.array([sensor.calibration.scale for sensor in result.true_array.sensors])
        field = exact.readings.values_T.reshape(-1, 4, 3)
        expected = np.einsum("nij,tnj->tni", scale, field).reshape(201, 12)
        np.testing.assert_allclose(result.readings.values_T, expected, rtol=1e-10, atol=1e-18)
        assert result.array.sensors[0].misalignment_rad == 2e-3
        assert result.array.sensors[0].gain_uncertainty == 3e-4
        assert result.array.sensors[0].calibration == Calibration.of("vector")

    def test_a_field_fixed_to_the_array_stays_the_same_in_its_axes(self) -> None:
        model = replace(SILENT, offset_error_T=5e-9)
        stray = simulate(scenario(model, carrier=MOVING), 1).readings.values_T
        stray = stray - simulate(scenario(carrier=MOVING), 1).readings.values_T
        np.testing.assert_allclose(stray, np.broadcast_to(stray[0], stray.shape), atol=1e-19)
        assert len(np.unique(stray[0].round(12))) == 12

    def test_it_has_its_rms(self) -> None:
        sensors = tuple(Sensor(f"s{i}", "vector", (float(i), 0.0, 0.0), 1e-9) for i in range(1000))
        model = replace(SILENT, offset_error_T=5e-9)
        values = simulate(scenario(model, SensorArray(sensors), duration_s=0.1, sources=()), 1).readings.values_T
        low, high = bounds(3000)
        assert low < (values[0] ** 2).sum() / 25e-18 < high

    def test_a_scalar_sensor_reads_the_modulus_with_it(self) -> None:
        vector = SILENT
        scalar = replace(SILENT, reads="scalar", offset_error_T=5e-9)
        fields = simulate(scenario(replace(vector, offset_error_T=5e-9), ambient_T=AMBIENT_T), 1).readings.values_T
        moduli = simulate(scenario(scalar, tetrahedron(1.5, "scalar"), ambient_T=AMBIENT_T), 1).readings.values_T
        np.testing.assert_allclose(moduli, np.linalg.norm(fields.reshape(-1, 4, 3), axis=-1), rtol=1e-13)

    def test_the_array_states_all_that_lasts(self) -> None:
        """1/f noise of density N²·f_c/f has the variance N² f_c ln 10 in a decade."""
        model = SensorModel("vector", 2e-11, corner_Hz=0.5, drift_T_rth=3e-10, offset_error_T=1e-9)
        for sensor in scenario(model).nominal_array.sensors:
            assert (sensor.drift_T_rth, sensor.offset_uncertainty_T) == (3e-10, 1e-9)
            assert sensor.flicker_T**2 == pytest.approx(4e-22 * 0.5 * math.log(10.0))

    def test_drift_starts_at_zero_and_grows(self) -> None:
        sensors = tuple(Sensor(f"s{i}", "vector", (float(i), 0.0, 0.0), 1e-9) for i in range(500))
        model = replace(SILENT, drift_T_rth=6e-9)
        wanted = scenario(model, SensorArray(sensors), duration_s=100.0, rate_Hz=1.0, sources=())
        values = simulate(wanted, 1).readings.values_T
        assert np.abs(values[0]).max() < 1e-25
        low, high = bounds(1500)
        assert low < (values[-1] ** 2).sum() / (36e-18 * 100 / 3600) < high

    def test_a_narrow_band_delays_the_signal(self) -> None:
        wanted = scenario(replace(SILENT, bandwidth_Hz=0.5), sources=(), pulsations=(Pulsation((1e-9, 0.0, 0.0), 5.0),))
        slow = simulate(replace(wanted, duration_s=100.0), 1).readings.values_T[500:, 0]
        assert np.abs(slow).max() == pytest.approx(1e-9 / math.sqrt(1 + (0.2 / 0.5) ** 2), rel=5e-3)


class TestMissingReadings:
    def test_a_sensor_misses_all_its_axes_with_the_stated_probability(self) -> None:
        wanted = scenario(missing=Missing(dropout=0.1), duration_s=2000.0, sources=())
        missing = np.isnan(simulate(wanted, 1).readings.values_T).reshape(-1, 4, 3)
        np.testing.assert_array_equal(missing, np.broadcast_to(missing[..., :1], missing.shape))
        n = 4 * 20_001
        low, high = stats.binom.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], n, 0.1)
        assert low <= missing[..., 0].sum() <= high

    def test_a_gap_has_no_rows(self) -> None:
        whole = simulate(scenario(carrier=MOVING, ambient_T=AMBIENT_T), 1)
        result = simulate(scenario(carrier=MOVING, ambient_T=AMBIENT_T, missing=Missing(gaps_s=((3.05, 5.0),))), 1)
        kept = (whole.readings.time_s < 3.05) | (whole.readings.time_s > 5.0)
        assert kept.sum() == 201 - 20
        np.testing.assert_array_equal(result.readings.time_s, whole.readings.time_s[kept])
        np.testing.assert_array_equal(result.readings.values_T, whole.readings.values_T[kept])
        np.testing.assert_array_equal(result.readings.array_position_m, whole.readings.array_position_m[kept])
        np.testing.assert_array_equal(result.truth.position_m, whole.truth.position_m[kept])

    def test_nothing_but_gaps_is_refused(self) -> None:
        with pytest.raises(ValueError, match="leave some rows"):
            simulate(scenario(missing=Missing(gaps_s=((0.0, 20.0),))), 1)


class TestRandomNumbers:
    NOISY = SensorModel("vector", 1e-9, 1.0, 100.0, 1e-3, 1e-12, 1e-3, 1e-3, 1e-8)
    FULL = scenario(
        NOISY,
        carrier=MOVING,
        ambient_T=AMBIENT_T,
        pulsations=(Pulsation((1e-8, 0.0, 0.0), 9.0),),
        missing=Missing(0.01),
        platform=Platform(noise_T=1e-9),
    )

    def test_the_same_seed_gives_the_same_numbers(self) -> None:
        one, two, other = (simulate(self.FULL, seed).readings.values_T for seed in (5, 5, 6))
        np.testing.assert_array_equal(one, two)
        assert not np.array_equal(one, other, equal_nan=True)

    def test_no_two_features_share_a_stream(self, monkeypatch: pytest.MonkeyPatch) -> None:
        used = []

        def recorded(seed: int, *name: str) -> np.random.Generator:
            used.append(name)
            return stream(seed, *name)

        monkeypatch.setattr(simulation_module, "stream", recorded)
        platform = Platform((0.0, 0.0, 3.0), (0.0, 0.0, 1.0), 0.5, 1e-9)
        simulate(replace(self.FULL, sources=(TARGET, TARGET), platform=platform), 1)
        assert len(set(used)) == len(used) == 3 + 1 + 2 + 2 + 6 * 4

    def test_leaving_out_a_sensor_changes_no_other(self) -> None:
        part = replace(self.FULL, array=self.FULL.array.subset(["s1", "s3", "s4"]), models=(self.NOISY,) * 3)
        whole = simulate(self.FULL, 5).readings.values_T.reshape(-1, 4, 3)
        np.testing.assert_array_equal(
            simulate(part, 5).readings.values_T.reshape(-1, 3, 3), whole[:, [0, 2, 3]], strict=True
        )

    @pytest.mark.parametrize(
        "without",
        [{"pulsations": ()}, {"platform": Platform()}, {"missing": Missing()}, {"ambient_T": None}, {"sources": ()}],
        ids=lambda change: next(iter(change)),
    )
    def test_leaving_out_a_feature_leaves_the_noise(self, without: dict[str, object]) -> None:
        assert simulate(replace(self.FULL, **without), 5).true_array == simulate(self.FULL, 5).true_array
        # Noise and drift alone are simply added, and can be taken off again.
        full = replace(self.FULL, models=(SensorModel("vector", 1e-9, corner_Hz=1.0, drift_T_rth=1e-8),) * 4)
        noise = []
        for wanted in (full, replace(full, **without)):
            silent = replace(wanted, models=(SILENT,) * 4)
            noise.append(simulate(wanted, 5).readings.values_T - simulate(silent, 5).readings.values_T)
        present = np.isfinite(noise[0])
        np.testing.assert_allclose(noise[0][present], noise[1][present], atol=1e-17)
        assert noise[0][present].std() > 1e-9


class TestBar:
    LENGTH_M = 2.0

    def source(self, start_m: tuple[float, float, float], **changes: object) -> Source:
        attitude = Attitude(mount_xyzw=(0.5, 0.1, -0.7, 0.5), rate_rad_s=(0.1, 0.0, 0.05))
        bar = Source(Carrier(Steered(start_m, 0.3, 0.2), attitude), (100.0, -50.0, 80.0), body_length_m=self.LENGTH_M)
        return replace(bar, **changes)  # type: ignore[arg-type]

    def test_field_is_that_of_a_thin_cuboid(self) -> None:
        """magpylib's, exact: a thousandth as wide as long, it differs from a line by about a part in 10⁶."""
        simulation = simulate(scenario(sources=(self.source((3.0, 1.0, 0.5)),)), 1)
        width_m = 1e-3 * self.LENGTH_M
        magnetisation = np.array([100.0, -50.0, 80.0]) / (self.LENGTH_M * width_m**2)
        path = simulation.paths[0]
        expected = [
            magpylib.magnet.Cuboid(
                magnetization=magnetisation,
                dimension=(self.LENGTH_M, width_m, width_m),
                position=position,
                orientation=rotation,
            ).getB(simulation.true_array.positions)
            for position, rotation in zip(path.position_m, path.rotation, strict=True)
        ]
        found = simulation.readings.values_T.reshape(np.shape(expected))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=5e-6 * np.abs(expected).max())
        point = simulate(scenario(sources=(self.source((3.0, 1.0, 0.5), body_length_m=0.0),)), 1)
        assert np.abs(point.readings.values_T - simulation.readings.values_T).max() > 0.01 * np.abs(expected).max()

    def test_a_sensor_nearer_than_its_length_is_refused(self) -> None:
        with pytest.raises(ValueError, match="at least 2 m from source 1"):
            simulate(scenario(sources=(self.source((1.0, 1.0, 0.5)),)), 1)

    @pytest.mark.slow
    @pytest.mark.parametrize("stated", [True, False])
    @pytest.mark.parametrize("lengths", [2.0, 3.0, 4.5, 6.0])
    def test_fixes_are_as_good_as_they_say(self, lengths: float, stated: bool) -> None:
        """A bar's error is no draw of the prior of bodies: a mean NEES of 0.9 to 1.8 here, of a point 48 to 445.

        Nothing stated, a quarter of the distance is assumed where four sensors are near: the board is wide then.
        """
        length_m = 0.02
        board = grid(6, 5, 0.8 * length_m * (1.0 if stated else lengths))
        attitude = Attitude(rate_rad_s=(1.1, 0.7, 0.4))  # all directions of the bar in 40 s
        carrier = Carrier(Steered((0.003, -0.004, lengths * length_m)), attitude)
        bar = Source(carrier, moment_Am2=(0.1, 0.3, 0.2), body_length_m=length_m)
        model = SILENT.with_sigma(2e-11 * math.sqrt(0.14) / (lengths * length_m) ** 3, 1.0)  # 1e-4 of the field
        task = scenario(model, board, sources=(bar,), duration_s=40.0, rate_Hz=1.0)
        simulation = simulate(task, 1)
        fixes = magloc.locate(simulation.array, simulation.readings, body_length_m=length_m if stated else None)
        error = np.hstack([fixes.position_m, fixes.moment_Am2])
        error -= np.hstack([simulation.truth.position_m, simulation.truth.moment_Am2])
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fixes.covariance), error) / 6.0
        assert np.mean(nees) < 3.0


class TestContact:
    def test_a_sensor_within_the_source_is_refused(self) -> None:
        ghost = replace(TARGET, carrier=Carrier(Steered((-1.0, 0.0, 0.9), speed_m_s=0.2)), radius_m=0.4)
        with pytest.raises(ValueError, match=r"0\.4 m from source 2; instead received sensor s4 at 0\.01.* after 5"):
            simulate(scenario(sources=(TARGET, ghost)), 1)

    def test_a_source_on_a_sensor_is_refused_whatever_its_size(self) -> None:
        point = Source(Carrier(Steered(tuple(tetrahedron(1.5).positions[1]))), moment_Am2=(1.0, 0.0, 0.0))
        with pytest.raises(ValueError, match="sensor s2"):
            simulate(scenario(sources=(point,)), 1)

    def test_a_platform_on_a_sensor_is_refused(self) -> None:
        platform = Platform(tuple(tetrahedron(1.5).positions[2]), (1.0, 0.0, 0.0))
        with pytest.raises(ValueError, match="sensor s3"):
            simulate(scenario(platform=platform), 1)


class TestScenario:
    @pytest.mark.parametrize(
        ("change", "what"),
        [
            ({"duration_s": 0.0}, "duration_s"),
            ({"rate_Hz": -1.0}, "rate_Hz"),
            ({"rate_Hz": 1e9}, "rows"),
            ({"models": (SILENT,)}, "models"),
            ({"models": (replace(SILENT, reads="scalar"),) * 4}, "models"),
        ],
    )
    def test_what_is_none_is_refused(self, change: dict[str, object], what: str) -> None:
        with pytest.raises(ValueError, match=what):
            scenario(**change)

    @pytest.mark.parametrize(("duration_s", "rate_Hz", "rows"), [(0.1, 30.0, 4), (160.0, 2.0, 321), (1.05, 2.0, 3)])
    def test_rows_end_with_the_duration(self, duration_s: float, rate_Hz: float, rows: int) -> None:
        assert len(scenario(duration_s=duration_s, rate_Hz=rate_Hz).time_s) == rows

    def test_a_simulation_without_a_source_has_no_truth(self) -> None:
        with pytest.raises(ValueError, match="source"):
            _ = simulate(scenario(sources=()), 1).truth
