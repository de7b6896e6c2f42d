"""``magloc compensate``: from files to a corrected log that a survey reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from magloc.readings import write_readings
from tests.command_line import Run, assert_refused
from tests.magloc.compensation.flights import Flight, Platform, array_of


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Folder with a log, its array and a column of currents; moduli of the truth."""
    folder, rng, array = tmp_path_factory.mktemp("flown"), np.random.default_rng(563), array_of()
    platforms = {sensor.id: Platform.draw(rng, sensor) for sensor in array.sensors}
    flight = Flight.cloverleaf(rng)
    write_readings(folder / "plain.csv", flight.readings(array, platforms, rng), array)
    header, *rows = (folder / "plain.csv").read_text().splitlines()
    lines = [f"{header},motor_A", *(f"{row},{x:.6f}" for row, x in zip(rows, flight.current_A, strict=True))]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    arrays.write_array(folder / "array.toml", array)
    return folder, np.linalg.norm(flight.ambient(), axis=1)


def test_the_log_is_written_with_corrected_columns(flown: tuple[Path, np.ndarray], run: Run, tmp_path: Path) -> None:
    folder, truth = flown
    line = (folder / "log.csv", "--array", folder / "array.toml", "--currents", "motor_A", "--current-sigma-nT", "20")
    outcome = run("compensate", *line, "--out", tmp_path / "out.csv", "--json")
    assert outcome.status == 0, outcome.err
    report = json.loads(outcome.out)
    assert {"coefficients", "figure_of_merit_before_nT", "figure_of_merit_after_nT", "flags"} <= set(report)
    assert {"name", "value", "sigma", "determined"} <= set(report["coefficients"][0])
    assert report["figure_of_merit_before_nT"] > 10.0 * report["figure_of_merit_after_nT"]
    # The array file names the corrected columns, and the log is one of them from then on.
    corrected = {"mag": "mag_compensated_nT", "flux": tuple(f"flux_{axis}_compensated_nT" for axis in "xyz")}
    array = arrays.read_array(folder / "array.toml")
    from dataclasses import replace

    again = replace(array, columns=arrays.LogColumns(sensors=corrected))
    read = magloc.read_readings(tmp_path / "out.csv", again)
    error = read.values_T[:, 0] - truth
    assert np.std(error) < 0.04e-9


def test_table_and_calibration(flown: tuple[Path, np.ndarray], run: Run) -> None:
    folder, _ = flown
    log = folder / "plain.csv"
    outcome = run("compensate", log, "--array", folder / "array.toml", "--calibration", log)
    assert outcome.status == 0, outcome.err
    assert "mag permanent x" in outcome.out
    assert "not determined" in outcome.out
    assert "figure of merit of mag" in outcome.out


def test_refusals(flown: tuple[Path, np.ndarray], run: Run, tmp_path: Path) -> None:
    folder, _ = flown
    log, array = folder / "log.csv", folder / "array.toml"
    assert_refused(run("compensate", log, "--array", array), "motor_A", "unknown column")
    assert_refused(run("compensate", log, "--array", array, "--currents", "motor_B"), "motor_B", "motor_A")
    assert_refused(run("compensate", log, "--array", array, "--currents", "motor_A", "--out", log), "--out")
    assert_refused(
        run("compensate", log, "--array", array, "--currents", "motor_A", "--current-sigma-nT", "0"),
        "--current-sigma-nT",
    )
    short = tmp_path / "short.csv"
    short.write_text("\n".join((folder / "plain.csv").read_text().splitlines()[:31]) + "\n")
    assert_refused(run("compensate", short, "--array", array), str(short), "60 rows or more; instead received 30")
