"""The public names of ``adcs``, used as a user types them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import adcs
import sims
from adcs.complementary.adaptive import AdaptiveTuning
from adcs.satellite.telemetry import Telemetry

T0 = np.datetime64("2014-09-01T12:00:00", "us")


@pytest.fixture(scope="module")
def flight():
    """A satellite of our own, simulated: its scenario, its run, and its log as plain arrays."""
    scenario = replace(sims.read_scenario("tabletsat"), duration_s=120.0, gyro_bias_rad_s=math.radians(0.02))
    runs = sims.simulate(scenario, 7)
    return scenario, runs, Telemetry.of(runs, scenario.satellite.start)


def satellite_of(scenario):
    orbit = scenario.satellite.orbit
    return adcs.Satellite(
        inertia_kgm2=scenario.satellite.body.inertia_kgm2,
        orbit=adcs.circular_orbit(
            altitude_m=orbit.altitude_m,
            inclination_deg=math.degrees(orbit.inclination_rad),
            node_deg=math.degrees(orbit.node_rad),
            epoch=orbit.epoch,
        ),
    )


class TestEstimate:
    def test_from_nowhere_to_the_truth_without_a_file(self, flight):
        """Axis by axis the error at the end stays below 6 σ, which noise exceeds once in 10⁸."""
        scenario, runs, log = flight
        telemetry = adcs.Telemetry(
            time_s=log.time_s,
            star=Rotation.from_quat(log.star),
            gyro_rad_s=log.gyro_rad_s,
            field_T=log.field_T,
            sun=log.sun,
            wheels_Nms=log.wheels_Nms,
        )
        attitude = adcs.estimate(telemetry, satellite_of(scenario), sensors="mag+sun+gyro", states=("gyro-bias",))
        assert len(attitude) == len(runs.time_s)
        error_deg = runs.error_deg(attitude)
        assert error_deg[-1] < 6.0 * np.linalg.norm(attitude.sigma_deg[-1])
        star = Rotation.from_quat(log.star)
        assert np.degrees((star.inv() * attitude.rotation).magnitude())[-1] < 0.3
        bias = attitude.states["gyro-bias"][-1] - runs.prepared.gyro_bias_rad_s[0, -1]
        assert np.all(np.abs(bias) < 6.0 * attitude.sigma["gyro-bias"][-1])

    def test_readings_of_other_sensors_are_not_used(self, flight):
        scenario, _, log = flight
        attitude = adcs.estimate(log, satellite_of(scenario), sensors="mag+sun")
        assert attitude.rejected["st"].all()
        assert attitude.rejected["gyro"].all()
        assert not attitude.rejected["mag"].any()
        assert not attitude.rejected["sun"].any()

    def test_the_figure_has_a_row_for_every_state(self, flight):
        scenario, _, log = flight
        figure = adcs.estimate(log, satellite_of(scenario), sensors="st+gyro", states=["gyro-bias"]).plot()
        assert len(figure.axes) == 3 * 3

    def test_prints_what_the_command_prints_and_its_warnings(self, flight):
        scenario, _, log = flight
        track = adcs.estimate(log, satellite_of(scenario), sensors="st+gyro", states=("gyro-bias",))
        lines = repr(replace(track, warnings=("too good",))).splitlines()
        assert lines[0].endswith("st+gyro, estimating gyro-bias; filter mekf")
        assert lines[1].startswith("attitude at the end, orbital from body")
        assert lines[-1] == "warning: too good"
        assert len(lines) < 12

    def test_settings_are_those_of_the_names(self, flight):
        scenario, _, log = flight
        satellite = satellite_of(scenario)
        by_name = adcs.estimate(log, satellite, sensors="st+gyro", filter="reduced")
        chosen = adcs.EstimatorSettings.of("st+gyro", filter="reduced")
        np.testing.assert_array_equal(by_name.q, adcs.estimate(log, satellite, sensors=chosen).q)
        assert "gyro-bias" in by_name.states

    def test_rows_that_are_missing_are_estimated_too(self, flight):
        scenario, _, log = flight
        kept = np.delete(np.arange(len(log.time_s)), range(60, 80))
        parts = {name: getattr(log, name)[kept] for name in ("star", "gyro_rad_s", "wheels_Nms")}
        attitude = adcs.estimate(adcs.Telemetry(log.time_s[kept], **parts), satellite_of(scenario), sensors="st+gyro")
        assert len(attitude) == len(log.time_s)
        np.testing.assert_array_equal(attitude.rows, kept)
        assert attitude.sigma_deg[79, 0] > attitude.sigma_deg[59, 0]

    @pytest.mark.parametrize(
        ("sensors", "what"), [("sun+gyro", "observe attitude"), ("mag+sun", "must have readings of the Sun sensor")]
    )
    def test_misuse(self, flight, sensors, what):
        scenario, _, log = flight
        telemetry = adcs.Telemetry(log.time_s, gyro_rad_s=log.gyro_rad_s, field_T=log.field_T)
        with pytest.raises(ValueError, match=what):
            adcs.estimate(telemetry, satellite_of(scenario), sensors=sensors)

    def test_an_unknown_filter(self, flight):
        scenario, _, log = flight
        with pytest.raises(ValueError, match="Input filter must be one of mekf"):
            adcs.estimate(log, satellite_of(scenario), sensors="st", filter="ukf")


class TestTelemetry:
    @pytest.mark.parametrize(
        ("given", "what"),
        [
            ({"time_s": [0.0, 1.0, 1.0]}, "time_s must ascend; instead received 1"),
            ({"time_s": [0.0, 1.0], "step_s": 0.0}, "step_s must be positive"),
            ({"time_s": [0.0, np.nan]}, "finite"),
            ({"time_s": [0.0, 1e9], "step_s": 1.0}, "fewer than"),
            ({"time_s": [0.0, 1.0], "field_T": np.zeros((3, 3))}, r"field_T must have shape \(2, 3\)"),
            ({"time_s": [0.0, 1.0], "sun": np.zeros((2, 3))}, "sun must have a direction"),
        ],
    )
    def test_misuse(self, given, what):
        with pytest.raises(ValueError, match=f"Input .*{what}"):
            adcs.Telemetry(**given)

    def test_instants(self):
        """On a grid if the times are on one, else at the times; steps as long as the usual one fill gaps."""
        on_grid = adcs.Telemetry([0.0, 0.5, 2.0])
        assert (on_grid.step_s, on_grid.instants_s.tolist()) == (0.5, [0.0, 0.5, 1.0, 1.5, 2.0])
        free = adcs.Telemetry([0.0, 0.9, 2.0, 5.2, 6.2], step_s=1.0)
        np.testing.assert_allclose(free.instants_s, [0.0, 0.9, 2.0, 2.0 + 3.2 / 3.0, 2.0 + 6.4 / 3.0, 5.2, 6.2])
        assert free.rows.tolist() == [0, 1, 2, 5, 6]
        assert adcs.Telemetry([0.0, 0.9, 2.0]).step_s == 1.0

    def test_a_number_that_is_missing_makes_the_reading_missing(self):
        field = np.array([[1.0, 2.0, np.nan], [1.0, 2.0, 3.0]])
        assert np.isnan(adcs.Telemetry([0.0, 1.0], field_T=field).field_T[0]).all()

    def test_time_counts_from_the_epoch_of_the_orbit(self):
        orbit = adcs.circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch=T0)
        satellite = adcs.Satellite(inertia_kgm2=np.diag([1.0, 1.1, 1.2]), orbit=orbit)
        record = adcs.Telemetry([30.0, 31.0], field_T=np.ones((2, 3))).record(satellite)
        assert record.environment.utc[0, 0] == T0 + np.timedelta64(30, "s")

    def test_a_node_is_given_once(self):
        with pytest.raises(ValueError, match="must not both be given"):
            adcs.circular_orbit(altitude_m=5e5, inclination_deg=0.0, epoch=T0, node_deg=1.0, local_time_h=2.0)


@pytest.fixture(scope="module")
def imu():
    """An IMU that turns steadily, with a biased gyro, noise-free vectors, up and a dipping field."""
    time_s = 0.02 * np.arange(3000)
    rate = np.array([0.2, -0.1, 0.3])
    truth = Rotation.from_rotvec(rate * time_s[:, None])
    up, field = np.array([0.0, 0.0, 9.81]), np.array([0.0, 20e-6, -40e-6])
    body = [truth.inv().apply(up), truth.inv().apply(field)]
    return time_s, np.tile(rate + 1e-3, (len(time_s), 1)), body, [up, field], truth


class TestComplementaryFilter:
    @pytest.mark.parametrize("method", ["explicit", "gauss-newton"])
    def test_follows_the_vectors(self, imu, method):
        time_s, gyro, body, frame, truth = imu
        attitude = adcs.complementary_filter(time_s, gyro, body, frame, method=method)
        off = np.degrees((truth.inv() * attitude.rotation).magnitude())
        # The bias over the gain is where it settles at first, 1e-3·√3/0.02 rad: 5° if both vectors were one.
        assert off[0] < 1e-6
        assert off.max() < 5.0
        assert np.isnan(attitude.sigma_deg).all()
        assert "reference from body" in repr(attitude)

    @pytest.mark.slow
    def test_adaptive_finds_the_bias_of_the_gyro(self, imu):
        """Its first vector is to be the field, in tesla."""
        time_s, gyro, body, frame, truth = imu
        attitude = adcs.complementary_filter(time_s, gyro, body[::-1], frame[::-1], method="adaptive")
        assert np.degrees((truth.inv() * attitude.rotation).magnitude())[-1] < 0.05
        np.testing.assert_allclose(attitude.states["gyro-bias"][-1], 1e-3, rtol=0.05)
        assert np.isfinite(attitude.sigma_deg).all()
        assert len(attitude.plot().axes) == 3 * 3

    def test_misuse(self, imu):
        time_s, gyro, body, frame, _ = imu
        with pytest.raises(ValueError, match="time_s must ascend"):
            adcs.complementary_filter(np.append(time_s[:-1], 0.0), gyro, body, frame)
        with pytest.raises(ValueError, match="two vectors"):
            adcs.complementary_filter(time_s, gyro, body[:1], frame)
        with pytest.raises(ValueError, match="method must be one of"):
            adcs.complementary_filter(time_s, gyro, body, frame, method="mekf")
        with pytest.raises(ValueError, match="settings must be Gains"):
            adcs.complementary_filter(time_s, gyro, body, frame, settings=AdaptiveTuning())


class TestIdentifyStars:
    def test_a_frame_of_a_made_up_sky(self):
        """Stars at the places of a catalogue, seen by a camera of known attitude."""
        from adcs.stars.camera import StarCamera
        from adcs.stars.catalogue import StarCatalogue
        from adcs.stars.identification import StarFix

        rng = np.random.default_rng(5)
        z = rng.uniform(-1.0, 1.0, 3000)
        catalogue = StarCatalogue.of(
            np.arange(3000), rng.uniform(0, 2 * np.pi, 3000), np.arcsin(z), np.linspace(0, 6, 3000)
        )
        camera = StarCamera(1024, 1024, np.radians(12.0) / 1024)
        turn = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix()
        seen = catalogue.directions @ turn
        x, y = (-seen[:, i] / seen[:, 2] / np.tan(camera.rad_per_px) for i in (0, 1))
        there = (seen[:, 2] < 0) & (np.abs(x) < 512) & (np.abs(y) < 512)
        points = np.stack([x[there] + 512, y[there] + 512], axis=1)
        (fix,) = adcs.identify_stars(catalogue, camera, [(points, catalogue.magnitudes[there])])
        assert isinstance(fix, StarFix)
        np.testing.assert_allclose(fix.R_catalogue_from_frame, turn, atol=1e-4)


class TestEllipsoids:
    def test_one_observer_by_default(self):
        from adcs.ellipsoids.observer import BoundedSystem

        system = BoundedSystem(np.eye(2), np.zeros((2, 2)), np.eye(2), np.ones(2))
        observer = adcs.EllipsoidObserver(system, adcs.Ellipsoid(np.zeros(2), 4.0 * np.eye(2)))
        observer.correct([[1.0, -1.0]])
        assert len(observer) == 1
        assert observer.centres[0, 0] > 0.0 > observer.centres[0, 1]
