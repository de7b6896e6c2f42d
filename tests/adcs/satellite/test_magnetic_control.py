"""Magnetic control: B-dot and the equation of its mean torque, hysteresis rods, and runs of satellites with them.

What is checked          by what
rods' energy of a turn   the area of the loop: in closed form, by its limits, and what a satellite that turns loses
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from adcs import quaternion
from adcs.kalman.mekf import run_filter
from adcs.satellite import dynamics
from adcs.satellite.magnetic_control import BDot, HysteresisRods, b_dot_gain, detumbled
from sims.attitude.simulation import advance, prepare, simulate_control
from sims.experiments import accuracy
from sims.experiments.b_dot import INERTIA_KGM2, Damping, Detumbling, detumbling
from tests.adcs.filter_runs import settings, start_of

Array = NDArray[np.float64]
MU0 = 4e-7 * np.pi


class TestLaw:
    def test_it_brakes_what_turns_across_the_field(self) -> None:
        """Torque m×B of -k (ω - its part along the field), for a turn of half a degree from reading to reading."""
        rng = np.random.default_rng(0)
        b, w = 30e-6 * np.array([0.6, 0.0, 0.8]), 1e-3 * rng.standard_normal(3)
        step, law = 0.01, BDot(gain_Nms=2e-4, largest_Am2=10.0)
        moment = law.moment_Am2(b, b - step * np.cross(w, b), step)
        n = b / np.linalg.norm(b)
        np.testing.assert_allclose(np.cross(moment, b), -2e-4 * (w - n * (n @ w)), rtol=1e-4, atol=1e-10)

    def test_each_torquer_has_its_limit(self) -> None:
        moment = BDot(gain_Nms=1.0, largest_Am2=0.2).moment_Am2([0.0, 0.0, 30e-6], [1e-6, -1e-9, 30e-6], 1.0)
        np.testing.assert_allclose(moment, [-0.2, 0.2, 0.0], atol=1e-15)

    def test_by_the_rate_it_is_the_same(self) -> None:
        b, w, law = 30e-6 * np.array([0.6, 0.0, 0.8]), np.array([1e-3, -2e-3, 5e-4]), BDot(gain_Nms=2e-4)
        by_readings = law.moment_Am2(b - 1e-4 * np.cross(b, w), b, 1e-4)
        np.testing.assert_allclose(law.moment_by_rate_Am2(b, w), by_readings, rtol=1e-4)

    def test_without_a_reading_nothing_is_set(self) -> None:
        assert BDot(gain_Nms=1.0).moment_Am2(np.full(3, np.nan), [1e-6, 0.0, 0.0], 1.0).tolist() == [0.0, 0.0, 0.0]

    def test_a_duty_above_one_is_refused(self) -> None:
        with pytest.raises(ValueError, match="duty must be at most 1"):
            BDot(gain_Nms=1.0, duty=1.2)


class TestMeanTorque:
    def test_across_a_field_that_stays(self) -> None:
        """Saturated: H falls by 1.2 m d |B| a second; then by k d / I of itself."""
        law, J = BDot(gain_Nms=2e-4, largest_Am2=0.1, duty=0.5), np.diag([0.04, 0.04, 0.01])
        b = np.tile([0.0, 0.0, 30e-6], (3000, 1))
        H = detumbled(law, [0.0, 5e-3, 0.0], b, J, 1.0)
        assert H[0] - H[100] == pytest.approx(100.0 * 1.2 * 0.1 * 0.5 * 30e-6)
        assert H[2500] / H[2400] == pytest.approx((1.0 - 2e-4 * 0.5 / 0.04) ** 100)

    def test_what_is_along_the_field_stays(self) -> None:
        b = np.tile([0.0, 0.0, 30e-6], (50, 1))
        assert detumbled(BDot(gain_Nms=1e-3), [0.0, 0.0, 1e-3], b, INERTIA_KGM2, 1.0)[-1] == 1e-3

    def test_the_gain_is_that_of_the_largest_moment(self) -> None:
        assert b_dot_gain(INERTIA_KGM2, 1e-3) == pytest.approx(4e-3 * 0.041)


def path(rods: HysteresisRods, fields_A_m: Array) -> Array:
    """Flux density (n,) [T] in the first rod along fields H (n,) that begin at nothing."""
    state, flux = rods.demagnetised(), []
    for H in fields_A_m:
        state = rods.followed(state, [MU0 * H, 0.0, 0.0])
        flux.append(rods.moment_Am2(state)[0] * MU0 / rods.volume_m3)
    return np.array(flux)


def loss_of_loop(rods: HysteresisRods, amplitude_A_m: float) -> float:
    """∮ H dB of the second loop of a field that goes to and fro [J/m³]."""
    H = amplitude_A_m * np.sin(np.linspace(0.0, 4.5 * np.pi, 3601))
    flux = path(rods, H)
    loop = slice(2000, 3601)
    return float(np.sum(0.5 * (H[loop][1:] + H[loop][:-1]) * np.diff(flux[loop])))


def linear_loss(rods: HysteresisRods, amplitude_A_m: float) -> float:
    """The same in closed form far from saturation: dz/dH = s², integrated by hand over a loop that closes."""
    Hc, slope = rods.coercivity_A_m, 2.0 / np.pi * rods.saturation_T * rods.steepness_m_A
    t = math.tanh(amplitude_A_m / Hc)
    first = (t - 2.0 + math.sqrt(4.0 - 3.0 * t * t)) / (2.0 * t)
    a = math.atanh(first)
    grown = math.log(math.cosh(a + amplitude_A_m / Hc) / math.cosh(a))
    return 4.0 * slope * Hc * (2.0 * Hc * grown - amplitude_A_m)


class TestRods:
    @pytest.mark.parametrize("amplitude_A_m", [0.5, 5.0, 20.0, 60.0])
    def test_a_loop_costs_its_area(self, amplitude_A_m: float) -> None:
        rods = HysteresisRods(remanence_T=1e-6, saturation_T=1.0)
        found = loss_of_loop(rods, amplitude_A_m)
        assert found == pytest.approx(linear_loss(rods, amplitude_A_m), rel=1e-2)

    def test_a_saturated_loop_costs_four_times_coercivity_and_saturation(self) -> None:
        rods = HysteresisRods(remanence_T=0.0265)
        assert loss_of_loop(rods, 200.0) == pytest.approx(4.0 * 12.0 * 0.027, rel=1e-2)

    def test_the_largest_loop_has_remanence_and_coercivity(self) -> None:
        H = np.linspace(5_000.0, -100.0, 5_101)
        flux = path(HysteresisRods(), H)
        assert np.interp(0.0, -H, flux) == pytest.approx(0.004, rel=1e-3)
        assert np.interp(0.0, -flux, H) == pytest.approx(-12.0, rel=1e-3)

    def test_small_steps_lead_where_one_does(self) -> None:
        rods = HysteresisRods()
        assert path(rods, np.linspace(0.0, 30.0, 100))[-1] == pytest.approx(path(rods, np.array([30.0]))[0], rel=1e-12)

    def test_a_satellite_that_turns_loses_it(self) -> None:
        """Two rods across a field that stays: five turns lose ten loops."""
        J, rods, b = 0.04 * np.eye(3), HysteresisRods(), np.array([30e-6, 0.0, 0.0])
        body, q, w, state = dynamics.RigidBody(J), quaternion.IDENTITY, np.array([0.0, 0.0, 0.05]), rods.demagnetised()
        none, angle, energies = np.zeros(3), 0.0, []
        while angle < 12.6 * np.pi:
            inside = quaternion.rotate_back(q, b)
            state = rods.followed(state, inside + 0.5 * np.cross(inside, w))
            energies.append((angle, 0.5 * w @ J @ w))
            q, w, _ = dynamics.step(body, q, w, none, none, none, 0.0, 0.0, b, 1.0, rods.moment_Am2(state))
            angle += w[2]
        angles, joules = np.array(energies).T
        first, last = np.interp([2.5 * np.pi, 12.5 * np.pi], angles, joules)
        loop_J = rods.volume_m3 * loss_of_loop(rods, 30e-6 / MU0)
        assert (first - last) / 10.0 == pytest.approx(loop_J, rel=5e-3)

    def test_compiled_runs_agree(self) -> None:
        """Of a satellite with a magnet that tumbles, with rods that are not along its axes."""
        rods = HysteresisRods(axes=np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.1], [0.3, 0.0, 1.0]]), volume_m3=2e-5)
        runs = detumbling(range(2), damping="rods", rate_deg_s=3.0, magnet_Am2=0.3, rods=rods, duration_s=100.0).runs
        prepared, iron = runs.prepared, np.zeros((2, 2, 3))
        state = prepared.q, prepared.w, prepared.momentum_Nms
        for row in range(100):
            b = quaternion.rotate_back(state[0], prepared.true_field_orbital_T[:, row])
            iron = rods.followed(iron, b + 0.5 * np.cross(b, state[1]))
            prepared.dipole_Am2[:, row] = rods.moment_Am2(iron)
            state = advance(prepared, state, np.zeros((2, 3)), row)
        np.testing.assert_allclose(runs.q[:, 100], state[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(runs.w[:, 100], state[1], rtol=0, atol=1e-10)
        assert np.abs(prepared.dipole_Am2[:, 50:100]).max() > 0.02

    @pytest.mark.parametrize(
        ("bad", "what"),
        [
            ({"axes": np.zeros((1, 3))}, "axes must be directions"),
            ({"volume_m3": 0.0}, "volume_m3 must be positive"),
            ({"remanence_T": 0.03}, "remanence_T must be below saturation_T, 0.027; instead received 0.03"),
        ],
    )
    def test_no_rods(self, bad: dict[str, Any], what: str) -> None:
        with pytest.raises(ValueError, match=what):
            HysteresisRods(**bad)


@pytest.fixture(scope="module")
def few() -> Detumbling:
    return detumbling(range(4), rate_deg_s=1.5, duration_s=1500.0)


class TestRuns:
    @pytest.mark.slow
    def test_they_end_slow(self, few: Detumbling) -> None:
        rate = np.linalg.norm(few.runs.w, axis=-1)
        assert (few.time_s < 1500.0).all()
        assert np.degrees(rate[:, -60:]).max() < 0.5 < np.degrees(rate[:, 0]).min()

    @pytest.mark.slow
    def test_a_filter_that_is_told_follows(self, few: Detumbling) -> None:
        """The commands are in the record: without a gyro the attitude stays known while torquers brake."""
        used = settings("mag+sun", ["disturbance"])
        told, none = few.runs, replace(few.runs, torquers_Am2=np.zeros_like(few.runs.torquers_Am2))
        # In the median: runs that begin in eclipse, 5° an axis off, find the attitude when the Sun rises.
        errors = [
            np.median(accuracy.error_norm_deg(runs, run_filter(runs, used, start_of(runs)))[:, 300:])
            for runs in (told, none)
        ]
        assert errors[0] < 0.2
        assert errors[1] > 3.0 * errors[0]

    @pytest.mark.slow
    def test_a_rate_that_is_estimated(self) -> None:
        """Told nothing but readings: where the Sun is seen it does not take their noise for a turn; else it waits."""
        by = {
            one: detumbling(range(3), damping=one, rate_deg_s=0.3, duration_s=300.0) for one in ("readings", "estimate")
        }
        lit = np.isfinite(by["estimate"].runs.readings.sun[..., 0]).any(axis=1)
        assert lit.any()
        assert not lit.all()
        moments = {one: np.abs(found.runs.torquers_Am2[:, 200:]).mean(axis=(1, 2)) for one, found in by.items()}
        assert (moments["estimate"][lit] < 0.1 * moments["readings"][lit]).all()
        np.testing.assert_array_equal(moments["estimate"][~lit], moments["readings"][~lit])

    def test_rods_take_energy_out(self) -> None:
        """Of a satellite with a magnet: without them the field gives back what it takes."""
        with_rods, without = (
            detumbling(range(3), damping="rods", rate_deg_s=2.0, magnet_Am2=0.3, rods=rods, duration_s=20_000.0)
            for rods in (HysteresisRods(volume_m3=5e-6), HysteresisRods(volume_m3=1e-12))
        )
        assert (with_rods.last_rate_deg_s < without.last_rate_deg_s).all()
        assert np.median(with_rods.last_rate_deg_s) < 0.8 * np.median(without.last_rate_deg_s)

    @pytest.mark.parametrize("damping", ["readings", "rods"])
    def test_every_step_is_counted(self, damping: Damping) -> None:
        steps: list[int] = []
        detumbling([0], damping=damping, duration_s=60.0, advanced=steps.append)
        assert sum(steps) == 61

    def test_no_commands_beside_rods(self, few: Detumbling) -> None:
        with_rods = prepare(replace(few.runs.scenario, rods=HysteresisRods()), [0])
        with pytest.raises(ValueError, match=r"Input prepared must have no rods .*; instead received"):
            simulate_control(with_rods, lambda record, row: np.zeros((1, 3)))

    @pytest.mark.slow
    def test_of_forty_starts_at_ten_degrees_a_second(self) -> None:
        """Median within 10 % of the equation, 80 % within 20 %, 2,500 s at most with 0.2 A·m²."""
        found = detumbling(range(40), duration_s=5000.0)
        ratio = found.time_s / found.theory_s
        assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
        assert np.mean(np.abs(ratio - 1.0) <= 0.2) >= 0.8
        assert np.median(found.time_s) <= 2500.0
        assert math.isfinite(found.time_s.max())
