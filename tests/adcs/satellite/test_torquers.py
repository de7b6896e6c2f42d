"""What torquers are commanded is an input that the filter is told: its torque m×B takes nothing along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import adcs
from adcs.io.log_layout import STANDARD
from adcs.io.telemetry_files import telemetry_columns
from adcs.kalman.mekf import run_filter
from adcs.satellite.telemetry import Telemetry
from arrays.io.csv import write_columns
from sims.attitude.simulation import AttitudeRuns, prepare, simulate_motion
from sims.experiments import accuracy
from tests.adcs.filter_runs import ANY_START, assert_as_readable, settings, start_of, tabletsat

SETTINGS = settings("st", ["disturbance"])


@pytest.fixture(scope="module")
def commanded() -> AttitudeRuns:
    """0.2 A·m² along ±x, changed every 50 s: 8e-6 N·m, ten times the disturbing torque."""
    scenario = replace(tabletsat(900.0), conditions=ANY_START)
    prepared = prepare(scenario, range(4))
    sign = np.where(np.arange(scenario.n_instants) // 50 % 2, 1.0, -1.0)
    return simulate_motion(replace(prepared, torquers_Am2=np.tile(0.2 * sign[:, None] * [1.0, 0.0, 0.0], (4, 1, 1))))


def rms_deg(runs: AttitudeRuns) -> float:
    tracks = run_filter(runs, SETTINGS, start_of(runs))
    return float(np.sqrt(np.mean(accuracy.error_norm_deg(runs, tracks)[:, 300:] ** 2)))


class TestKnownInput:
    def test_it_is_as_if_there_were_none(self, commanded: AttitudeRuns) -> None:
        none = np.zeros_like(commanded.torquers_Am2)
        quiet = simulate_motion(replace(commanded.prepared, torquers_Am2=none))
        assert rms_deg(commanded) < 1.1 * rms_deg(quiet)
        assert rms_deg(replace(commanded, torquers_Am2=none)) > 3.0 * rms_deg(quiet)

    def test_compiled_as_readable(self, commanded: AttitudeRuns) -> None:
        scenario = replace(commanded.scenario, duration_s=60.0)
        runs = simulate_motion(replace(prepare(scenario, range(2)), torquers_Am2=commanded.torquers_Am2[:2, 20:81]))
        start, used = start_of(runs), settings("mag+sun", ["disturbance", "dipole"])
        assert_as_readable(runs, used, start)


class TestLog:
    def test_file_and_record(self, commanded: AttitudeRuns, tmp_path) -> None:
        satellite = commanded.satellite
        log = Telemetry.of(commanded, satellite.start)
        write_columns(telemetry_columns(log), tmp_path / "log.csv")
        read = adcs.read_telemetry(tmp_path / "log.csv")
        np.testing.assert_allclose(read.record(satellite).torquers_Am2, commanded.torquers_Am2[:1], rtol=1e-15)

    def test_a_command_holds_until_the_next(self) -> None:
        given = np.array([[np.nan] * 3, [0.1, 0.0, 0.0], [np.nan] * 3, [0.0, 0.2, 0.0]])
        satellite = tabletsat().satellite
        held = Telemetry([0.0, 1.0, 2.0, 4.0], torquers_Am2=given).record(satellite).torquers_Am2[0]
        assert held.tolist() == [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]

    def test_units(self) -> None:
        columns = replace_unit("mAm2")
        np.testing.assert_allclose(columns.of(np.array([[100.0, 0.0, -50.0]])), [[0.1, 0.0, -0.05]])


def replace_unit(unit: str):
    """The standard columns in another unit."""
    return type(STANDARD["torquers_Am2"])(unit=unit)
