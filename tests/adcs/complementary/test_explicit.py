"""Tests of the complementary filters: low pass, error angle, compiled twin, the source's figures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adcs import quaternion
from adcs.complementary import explicit
from adcs.complementary.explicit import Gains, complementary_track
from adcs.complementary.names import RULES
from adcs.complementary.outage import Substitution
from adcs.satellite.vector_record import VectorRecord
from magloc import core
from sims.attitude.complementary import ORBIT, SatelliteScenario, attitude, satellite_runs
from tests.adcs.attitudes import random_attitudes
from tests.adcs.complementary.readable import MeasuredQuaternion, explicit_error, gauss_newton_track, steps
from tests.calls import calls_of

TRACKS = [complementary_track, gauss_newton_track]


def errors_deg(track, runs):
    return np.degrees(2.0 * quaternion.error_vector(track.q, runs.q))


def rms(values):
    return math.sqrt(np.mean(np.square(values)))


def short_record(n=60, seed=0, runs=2, missing=()):
    """Anything: the two implementations must agree on it."""
    rng = np.random.default_rng(seed)
    second = rng.standard_normal((runs, n, 3))
    first = rng.standard_normal((runs, n, 3))
    for name, begin, end in missing:
        {"first": first, "second": second}[name][:, begin:end] = np.nan
    return VectorRecord(
        dt_s=np.full(n, 0.5),
        rate_rad_s=0.3 * rng.standard_normal((runs, n, 3)),
        first_body=first,
        second_body=second,
        first_reference=rng.standard_normal((1, n, 3)),
        second_reference=rng.standard_normal((1, n, 3)),
        frame_rate_rad_s=0.1 * rng.standard_normal((1, n, 3)),
    )


class TestPrinciple:
    @pytest.mark.parametrize("track", TRACKS)
    def test_low_pass_in_three_axes(self, track):
        """A small turn of both measured vectors, across both, comes through as k/(s+k): 1 - exp(-k t)."""
        n, k, angle = 400, 0.02, 1e-3
        q = quaternion.exp([0.0, 0.0, angle])
        vectors = [np.tile(v, (n, 1)) for v in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])]
        record = VectorRecord(
            np.full(n, 0.1),
            np.zeros((n, 3)),
            *(quaternion.rotate_back(q, v) for v in vectors),
            *vectors,
            np.zeros((n, 3)),
        )
        found = quaternion.log(track(record, Gains(k, 0.0)).q[0])[:, 2]
        # The eigenvalue of e is 2 about the axis across both vectors; the measured quaternion makes it 1.
        eigenvalue = 2.0 if track is complementary_track else 1.0
        expected = angle * (1.0 - (1.0 - k * eigenvalue * 0.1) ** np.arange(1, n + 1))
        np.testing.assert_allclose(found, expected, atol=1e-5 * angle)


class TestError:
    @pytest.mark.parametrize("seed", range(5))
    def test_small_error(self, seed):
        """e = Σ(E - vvᵀ)δθ, with the eigenvalues 1 ± |cos| and 2."""
        rng = np.random.default_rng(seed)
        q = random_attitudes(1, rng)[0]
        body = rng.standard_normal((2, 3))
        body /= np.linalg.norm(body, axis=1, keepdims=True)
        delta = 1e-6 * rng.standard_normal(3)
        q_true = quaternion.multiply(q, quaternion.exp(delta))
        e = explicit_error(q, [(v, quaternion.rotate(q_true, v)) for v in body])
        M = sum(np.eye(3) - np.outer(v, v) for v in body)
        np.testing.assert_allclose(e, M @ delta, atol=1e-11)
        cosine = abs(body[0] @ body[1])
        np.testing.assert_allclose(np.linalg.eigvalsh(M), [1.0 - cosine, 1.0 + cosine, 2.0], atol=1e-12)


class TestTwins:
    @pytest.mark.parametrize(
        ("rule", "missing", "method"),
        [
            # In `make test` each two of these come together.
            pytest.param(rule, missing, method, marks=[pytest.mark.slow] if (i + j + k) % 2 else [])
            for i, rule in enumerate(RULES)
            for j, missing in enumerate([(), [("second", 25, 45)], [("second", 0, 60)], [("first", 10, 20)]])
            for k, method in enumerate(["explicit", "gauss-newton"])
        ],
    )
    def test_agree(self, method, missing, rule, instruction_sets):
        record = short_record(missing=missing)
        gains = Gains(0.1, 1e-3, 0.05, 1e-4, boost=3.0, boost_level_rad=0.4, boost_memory=0.8)
        substitution = Substitution(rule, 5.0)
        track_of = complementary_track if method == "explicit" else gauss_newton_track
        tracks = [track_of(record, gains, substitution=substitution) for _ in instruction_sets]

        def readable(rounded, run):
            correction = explicit_error if method == "explicit" else MeasuredQuaternion()
            q, integral = zip(*steps(rounded, correction, gains, substitution=substitution, run=run), strict=True)
            return np.array(q), np.array(integral)

        rng, rate = np.random.default_rng(0), record.rate_rad_s
        others = [replace(record, rate_rad_s=np.nextafter(rate, rng.choice([-9.0, 9.0], rate.shape))) for _ in range(3)]
        for run in range(2):
            q, integral = readable(record, run)
            # By one vector alone the least rounding of a rate moves the readable one itself by 1e-8.
            rounding = max(np.abs(readable(other, run)[0] - q).max() for other in others)
            for track in tracks:
                np.testing.assert_allclose(track.q[run], q, atol=1e-9 + 10.0 * rounding)
                np.testing.assert_allclose(track.integral_rad_s[run], integral, atol=1e-9 + 10.0 * rounding)

    def test_integral_against_scipy(self):
        """Without vectors both only integrate the gyro."""
        record = short_record(missing=[("first", 0, 60), ("second", 0, 60)])
        expected = Rotation.identity()
        for rate, frame in zip(record.rate_rad_s[0, 1:], record.frame_rate_rad_s[0, 1:], strict=True):
            expected = Rotation.from_rotvec(-0.5 * frame) * expected * Rotation.from_rotvec(0.5 * rate)
        track = complementary_track(record, Gains(0.1))
        assert quaternion.angle_between(track.q[0, -1], quaternion.from_rotation(expected)) < 1e-7

    def test_blocks_and_threads_change_nothing(self, monkeypatch):
        """A filter goes on where the call before ended, with its delayed vectors; long turns, too."""
        record = short_record(runs=5, missing=[("second", 25, 45)])
        record = replace(record, rate_rad_s=8.0 * record.rate_rad_s)
        found, before = [], core.threads()
        for block, threads in ((1000, 1), (7, 1), (13, 3)):
            monkeypatch.setattr(explicit, "BLOCK", block)
            core.set_threads(threads)
            found.append(complementary_track(record, substitution=Substitution("transported", 5.0)))
        core.set_threads(before)
        for other in found[1:]:
            np.testing.assert_array_equal(other.q, found[0].q)

    def test_nothing_to_do(self):
        assert complementary_track(short_record(n=0)).q.shape == (2, 0, 4)


class TestSatellite:
    def test_gyro_against_euler_kinematics(self):
        """Body rate of 3-2-1 angles, textbook, plus that of the orbital frame, in the middle of a step."""
        scenario = SatelliteScenario(duration_s=100.0, sigma_T=1e-15)
        runs = satellite_runs(scenario, [3])
        t, h = scenario.time_s - 0.5 * scenario.dt_s, 1e-2
        middle, *around = self.around(scenario, t, (0.0, -h, h))
        angles = [Rotation.from_quat(q, scalar_first=True).as_euler("ZYX") for q in (middle, *around)]
        (yaw, pitch, roll), rates = angles[0].T, ((angles[2] - angles[1]) / (2.0 * h)).T
        relative = np.stack(
            [
                rates[2] - rates[0] * np.sin(pitch),
                rates[1] * np.cos(roll) + rates[0] * np.cos(pitch) * np.sin(roll),
                -rates[1] * np.sin(roll) + rates[0] * np.cos(pitch) * np.cos(roll),
            ],
            axis=-1,
        )
        orbital = quaternion.rotate_back(middle, [0.0, ORBIT.rate_rad_s, 0.0])
        np.testing.assert_allclose(runs.record.rate_rad_s[0], relative + orbital, atol=1e-10)
        assert yaw.shape == t.shape

    def around(self, scenario, t, apart):
        from sims.noise import stream

        phases = stream(3, "attitude").uniform(0.0, 2.0 * math.pi, (1, 3))
        return [attitude(phases, scenario.amplitude_rad, t + d)[0] for d in apart]

    def test_noise_and_step(self):
        scenario = SatelliteScenario(duration_s=6000.0, step_orbits=0.5, outage_orbits=0.8, outage_end_orbits=0.9)
        runs = satellite_runs(scenario, [0, 1])
        clean = quaternion.rotate_back(runs.q, runs.record.first_reference)
        # 36,000 numbers: 4 standard errors of a standard deviation.
        assert np.std(runs.record.first_body - clean) == pytest.approx(1e-6, rel=4.0 / math.sqrt(2 * 36_000))
        out = np.isnan(runs.record.second_body).any(axis=(0, 2))
        np.testing.assert_array_equal(out, (scenario.orbits >= 0.8) & (scenario.orbits < 0.9))
        assert runs.bias_rad_s[scenario.orbits < 0.5].max() == 0.0
        assert runs.bias_rad_s[-1] == pytest.approx(math.radians(0.02))
        again = satellite_runs(scenario, [1])
        np.testing.assert_array_equal(again.record.first_body[0], runs.record.first_body[1])


@pytest.fixture(scope="module")
def paper():
    """The source's set-up; seeds 0 and 1."""
    return satellite_runs(SatelliteScenario(), range(2))


def window(runs, begin, end):
    orbits = runs.scenario.orbits
    return (orbits >= begin) & (orbits < end)


class TestFigures:
    """Section 10 of the specification; seeds from 0 on."""

    @pytest.mark.parametrize("track", TRACKS)
    def test_converges_without_noise(self, track):
        scenario = SatelliteScenario(sigma_T=0.0, duration_s=0.06 * ORBIT.period_s)
        runs = satellite_runs(scenario, range(5))
        errors = errors_deg(track(runs.record, Gains(0.1, 1e-3)), runs)
        assert np.abs(errors[:, window(runs, 0.05, 1.0)]).max() < 0.05

    @pytest.mark.parametrize("track", TRACKS)
    @pytest.mark.parametrize(
        ("sigma_nT", "kp", "ki", "most_rms", "most_peak"),
        [(1000.0, 0.02, 1e-4, 0.25, 1.6), (250.0, 0.05, 1.3e-4, 0.10, 0.65)],
    )
    def test_best_gains(self, track, sigma_nT, kp, ki, most_rms, most_peak):
        runs = satellite_runs(SatelliteScenario(sigma_T=1e-9 * sigma_nT), range(3))
        for errors in errors_deg(track(runs.record, Gains(kp, ki)), runs):
            assert rms(errors[window(runs, 0.5, 3.0)]) <= most_rms
            assert np.abs(errors[window(runs, 1.7, 3.5)]).max() <= most_peak
            assert rms(errors[window(runs, 2.4, 3.5)]) <= most_rms
            smoothed = [rms(part) for part in np.array_split(errors[window(runs, 1.7, 2.4)], 14)]
            assert smoothed[-1] < 0.5

    @pytest.mark.parametrize(
        ("kp", "ki"), [(0.01, 2.5e-5), (0.02, 1e-4), (0.05, 1.25e-4), (0.1, 2.5e-3), (0.3, 4.5e-3)]
    )
    def test_equal_gains_equal_filters(self, paper, kp, ki):
        """No factor of three at sensible gains."""
        explicit, measured = (
            rms(errors_deg(track(paper.record, Gains(kp, ki)), paper)[:, window(paper, 0.5, 3.0)]) for track in TRACKS
        )
        assert 0.7 <= measured / explicit <= 1.4

    def test_the_pair_of_the_source(self, paper):
        """1.05° of a slow filter and 2.82° of one near its stability limit: a matter of gains."""

        def pooled(track, kp, ki):
            errors = errors_deg(track(paper.record, Gains(kp, ki)), paper)
            return [rms(one) for one in errors[:, window(paper, 0.5, 3.0)]]

        for value in pooled(gauss_newton_track, 0.005, 2.5e-6):
            assert 0.8 <= value <= 1.3
        for value in pooled(complementary_track, 0.9, 8.1e-4):
            assert 1.5 <= value <= 2.8
        assert min(pooled(complementary_track, 1.0, 0.0)) > 3.0

    def test_equal_gains_that_show_the_factor(self):
        """K_P = 0.97 at 850 nT, which hides the drift step in noise: ratio 2.69 of the source."""
        runs = satellite_runs(SatelliteScenario(sigma_T=850e-9), range(2))
        explicit, measured = (
            rms(errors_deg(track(runs.record, Gains(0.97, 1e-3 * 0.97**2)), runs)[:, window(runs, 0.5, 3.0)])
            for track in TRACKS
        )
        assert 2.0 <= explicit / measured <= 3.5

    def test_boosted_integral(self, paper):
        """A larger K_I while the smoothed error stands out: the step is gone sooner, for a third more noise."""
        slow = Gains(0.01, 2.5e-6)
        boosted = Gains(0.01, 2.5e-6, boost=10.0, boost_level_rad=math.radians(1.5))
        peaks, steady = [], []
        for gains in (slow, boosted):
            errors = errors_deg(complementary_track(paper.record, gains), paper)
            peaks.append(rms(errors[:, window(paper, 1.7, 2.4)]))
            steady.append(rms(errors[:, window(paper, 0.8, 1.7)]))
        assert peaks[1] < 0.7 * peaks[0]
        assert steady[1] < 1.5 * steady[0]


class TestSpeed:
    def test_steps_are_compiled(self):
        """Fifty times the steps make not one interpreted call more."""
        short, long = (satellite_runs(SatelliteScenario(duration_s=s), [0]).record for s in (100.0, 5000.0))
        assert calls_of(lambda: complementary_track(long)) == calls_of(lambda: complementary_track(short))


class TestInput:
    @pytest.mark.parametrize(("dt", "kp"), [(1.0, 1.01), (0.5, 2.01)])
    def test_beyond_the_stability_limit(self, dt, kp):
        with pytest.raises(ValueError, match=rf"kp_per_s must be {1.0 / dt:g} 1/s at most.*unstable"):
            Gains(kp).check(dt)
        with pytest.raises(ValueError, match="at most"):
            Gains(0.1, outage_kp_per_s=kp).check(dt)

    def test_at_the_limit_a_warning(self):
        Gains(1.0).check(1.0)
        assert "close to 1 1/s" in Gains(1.0).warnings(1.0)[0]
        assert "unstable" in Gains(0.9).warnings(1.0)[0]
        assert Gains(0.89).warnings(1.0) == ()

    def test_the_limit_is_one(self):
        """Errors decay below it, and stay as they are on it."""
        n = 300
        vectors = [np.tile(v, (n, 1)) for v in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])]
        record = VectorRecord(np.ones(n), np.zeros((n, 3)), *vectors, *vectors, np.zeros((n, 3)))
        start = quaternion.exp([0.0, 0.0, 1e-6])
        track = complementary_track(record, Gains(0.99, 0.0), q_start=start)
        assert quaternion.angle_between(track.q[0, -1], quaternion.IDENTITY) < 1e-7
        # At the limit itself the sign changes and the error stays.
        marginal = complementary_track(record, Gains(1.0, 0.0), q_start=start)
        assert quaternion.angle_between(marginal.q[0, -1], quaternion.IDENTITY) == pytest.approx(1e-6, rel=1e-3)

    @pytest.mark.parametrize("name", ["first_body", "second_body", "first_reference", "second_reference"])
    def test_zero_vector(self, name):
        values = {
            name_: np.ones((1, 5, 3)) for name_ in ("first_body", "second_body", "first_reference", "second_reference")
        }
        values[name][0, 3] = 0.0
        with pytest.raises(ValueError, match=f"Input {name} must have a length.*zero vector at instant 3"):
            VectorRecord(np.ones(5), np.zeros((1, 5, 3)), frame_rate_rad_s=np.zeros((1, 5, 3)), **values)

    def test_shapes_and_numbers(self):
        good = dict.fromkeys(
            ("rate_rad_s", "first_body", "second_body", "first_reference", "second_reference", "frame_rate_rad_s"),
            np.ones((4, 3)),
        )
        with pytest.raises(ValueError, match="first_reference must have shape"):
            VectorRecord(np.ones(4), **{**good, "first_reference": np.ones((5, 3))})
        with pytest.raises(ValueError, match="rate_rad_s must be finite"):
            VectorRecord(np.ones(4), **{**good, "rate_rad_s": np.full((4, 3), np.nan)})
        with pytest.raises(ValueError, match="dt_s must be positive"):
            VectorRecord(np.zeros(4), **good)
        with pytest.raises(ValueError, match=r"second_body must have shape \(R, n, 3\)"):
            VectorRecord(np.ones(4), **{**good, "second_body": np.ones(3)})
        with pytest.raises(ValueError, match="q_start must be quaternions with a length"):
            complementary_track(VectorRecord(np.ones(4), **good), q_start=np.zeros(4))

    @pytest.mark.parametrize("value", [-0.1, math.nan])
    def test_gains(self, value):
        with pytest.raises(ValueError, match="ki_per_s2 must be 0 or more"):
            Gains(0.1, value)
