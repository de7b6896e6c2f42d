"""What the first row says of a source. The seeds are not chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag

import magloc
from arrays import geometries
from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from magloc.ambient import in_world_field
from magloc.localization.fit.prior import NOTHING_KNOWN
from magloc.tracking import row_filter
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.start import NO_AMBIENT, NO_DIPOLE, TrackStarter, with_errors
from magloc.tracking.chart.update import update_states
from magloc.tracking.row_filter import Gaussians
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.tracker import Tracker
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import simulate
from tests.magloc.tracking.test_ambient_uncertainty import REST, SCENARIO


class TestErrorsOfSensors:
    def test_they_are_what_a_joint_update_finds(self) -> None:
        """A diver's fluxgates, near the source: components found alone, and with sixty errors as states throughout."""
        simulation = simulate(read_scenario("diver"), 0)
        tracker, truth = Tracker(simulation.array, REST), simulation.truth
        row = tracker.measurements.of(list(rows_of(simulation.readings))[120])
        assert truth.moment_Am2 is not None
        x = np.concatenate([truth.position_m[120], truth.moment_Am2[120]]) * np.array([[1.0], [1.02], [0.99]])
        sigma = tracker.errors.sigma
        S = np.broadcast_to(
            np.diag([0.3, 0.2, 0.2, *np.full(3, np.linalg.norm(x[0, 3:]) / row.radius_m**4)]), (3, 6, 6)
        )
        alone = update_states(x, S, row.with_errors_as_noise(sigma))
        mixture = Mixture(alone.x, alone.S, np.zeros(3), 6, row.centroid_m, row.radius_m)
        found = with_errors(mixture, row, sigma)
        zero = np.zeros((3, sigma.size))
        S_joint = np.stack([block_diag(S[0], np.diag(sigma))] * 3)
        together = Gaussians(np.concatenate([x, zero], axis=1), S_joint, n_nuisances=sigma.size)
        joint = row_filter.update(together, row.kernel_rows)
        unit = np.maximum(np.linalg.norm(joint.S, axis=2), 1e-100)  # drift has not begun
        offset = np.concatenate([found.chart.coordinates(joint.x[:, :6]), (joint.x - found.x)[:, 6:]], axis=1)
        np.testing.assert_allclose(offset / unit, 0.0, atol=3e-3)  # both end within 1e-3 σ of the optimum
        P, P_joint = (root @ np.swapaxes(root, 1, 2) for root in (found.S, joint.S))
        units = unit[:, :, None] * unit[:, None, :]
        np.testing.assert_allclose((P - P_joint) / units, 0.0, atol=3e-3)
        assert np.abs(P_joint / units)[:, :6, 6:].max() > 0.1


class TestMisfit:
    def test_errors_of_sensors_count_as_noise(self) -> None:
        """In one row, offsets that are equally uncertain on all axes are noise: the misfit is as large."""
        array, times = geometries.cube(1.5, "vector", 1e-9), 10.0
        offsets = tuple(replace(one, offset_uncertainty_T=times * one.noise_T) for one in array.sensors)
        noisy = tuple(replace(one, noise_T=float(np.hypot(1.0, times)) * one.noise_T) for one in array.sensors)
        row = Row(0.0, 1e-6 * np.random.default_rng(3).normal(size=array.n_channels))
        found = []
        for sensors in (offsets, noisy):
            tracker = Tracker(replace(array, sensors=sensors), REST)
            starter = TrackStarter(tracker.array, tracker.errors, NOTHING_KNOWN)
            assert starter.mixture(tracker.measurements.of(row), REST) == (None, NO_DIPOLE)
            found.append(starter.misfit @ starter.misfit)
        assert found[0] == pytest.approx(found[1], rel=1e-3)


class TestValleyOfRangesThatBends:
    """Eight moduli of 0.1 nT, four metres from 54 A·m²."""

    @pytest.mark.parametrize("seed", range(5))
    def test_the_truth_is_in_one_of_its_parts(self, seed: int) -> None:
        """χ² of six numbers, once in 100,000 each; of the one Gaussian in its middle 106, 8,428 and 980 in three."""
        simulation = simulate(replace(SCENARIO, duration_s=1.0), seed)
        tracker, truth = Tracker(simulation.array, REST), simulation.truth
        row = next(iter(rows_of(in_world_field(simulation.readings, simulation.array))))
        mixture, _ = tracker.filter.start(tracker.measurements.of(row), REST)
        assert mixture is not None
        assert truth.moment_Am2 is not None
        true = np.concatenate([truth.position_m[0], truth.moment_Am2[0]])
        e = mixture.chart.coordinates(np.broadcast_to(true, (len(mixture), 6)))
        square = np.sum(np.linalg.solve(mixture.S, e[..., None])[..., 0] ** 2, axis=1)
        assert len(mixture) > 10
        assert square.min() < stats.chi2.ppf(1.0 - 1e-5, 6)


class TestModuliInNoAmbientField:
    """They are linear in no moment: fits alone start a track, with either sign of the moment."""

    @pytest.mark.parametrize("pose", [None, PoseUncertainty()], ids=["exact", "with its errors"])
    def test_seven_differences_follow_a_source(self, pose: PoseUncertainty | None) -> None:
        """Its place leaves χ² of three numbers with 1e-4; both signs of the moment stay as likely, to the last row."""
        simulation = simulate(replace(SCENARIO, ambient_T=None, duration_s=3.0, pose=pose), 0)
        found = magloc.track(simulation.array, simulation.readings, motion=REST)
        off = found.position_m[-1] - simulation.truth.position_m[-1]
        assert found.tracked.all()
        assert off @ np.linalg.solve(found.covariance[-1, :3, :3], off) < stats.chi2.ppf(1.0 - 1e-4, 3)
        size = np.sqrt(np.trace(found.covariance[-1, 3:, 3:]))
        # Which of equally likely components is divided or merged first is rounding.
        np.testing.assert_allclose(found.moment_Am2[-1] / size, 0.0, atol=1e-3)
        assert simulation.truth.moment_Am2 is not None
        assert size == pytest.approx(np.linalg.norm(simulation.truth.moment_Am2[-1]), rel=0.1)
        assert found.estimability[-1][3:].min() > 0.5
        assert found.table().splitlines()[len(found)].split()[7:9] == ["0", f"{size:.0f}"]

    def test_fewer_say_so(self) -> None:
        few = SensorArray(SCENARIO.array.sensors[:5])
        simulation = simulate(replace(SCENARIO, array=few, models=SCENARIO.models[:5], ambient_T=None), 0)
        assert set(magloc.track(few, simulation.readings[:3], motion=REST).status) == {NO_AMBIENT}


def test_a_single_component_has_the_set_of_two_that_are_alike() -> None:
    """Its quantiles are known, those of a mixture are searched for; near the array, where ranges begin at 0, too."""
    rng = np.random.default_rng(0)
    for distance in (0.1, 0.5, 3.0, 30.0):
        root = 0.2 * rng.normal(size=(6, 6))
        one = Mixture.of_gaussian(distance * rng.normal(size=6), root, np.zeros(3), 0.5)
        two = replace(one, x=one.x.repeat(2, 0), S=one.S.repeat(2, 0), log_weight=np.log([0.5, 0.5]))
        np.testing.assert_allclose(one.range_interval_m(), two.range_interval_m(), rtol=1e-9)
