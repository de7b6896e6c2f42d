"""Readings from which a background was subtracted: the key of the array file, and the hint at it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from magloc.localization.subtracted_background import background_is_subtracted
from tests.command_line import Run
from tests.conftest import REPOSITORY

HINT = 'background = "subtracted"'


@pytest.fixture
def recording(data_folder: Path) -> Path:
    """Folder of a magnet before sixteen sensors, with optical truth."""
    folder = data_folder / "magnet-mocap"
    if not folder.is_dir():
        pytest.skip("needs the recording magnet-mocap")
    return folder


def rows(common_T: float) -> tuple[arrays.SensorArray, np.ndarray]:
    """Readings of a near magnet, whose common field has a standard deviation."""
    rng = np.random.default_rng(5)
    array = arrays.grid(4, 4, 0.012, noise_T=3e-7)
    place = np.column_stack([rng.uniform(-0.02, 0.02, (40, 2)), rng.uniform(0.05, 0.08, 40)])
    field = magloc.dipole.field(array.positions, place[:, None], np.array([0.3, 0.2, 0.8]))
    field = field + common_T * rng.standard_normal((40, 1, 3))
    readings = array.readings_of(field)
    return array, readings + 3e-7 * rng.standard_normal(readings.shape)


class TestHint:
    def test_small_common_field(self) -> None:
        assert background_is_subtracted(*rows(2e-7))

    def test_earth_field(self) -> None:
        assert not background_is_subtracted(*rows(3e-5))

    def test_wandering_field(self) -> None:
        assert not background_is_subtracted(*rows(3e-6))

    def test_stated_already(self) -> None:
        array, readings = rows(2e-7)
        assert not background_is_subtracted(replace(array, common_field_T=1e-6), readings)

    def test_no_gain(self) -> None:
        """Sensors far quieter than the change of the field learn nothing from the prior."""
        array, readings = rows(0.0)
        sensors = tuple(replace(sensor, noise_T=3e-9) for sensor in array.sensors)
        field = array.readings_of(array.calibrated_field(readings))
        assert not background_is_subtracted(replace(array, sensors=sensors), field)

    def test_by_the_command(self, run: Run) -> None:
        folder = REPOSITORY / "magloc" / "datasets"
        outcome = run("locate", folder / "board.csv", "--array", folder / "board-array.toml")
        assert HINT not in outcome.err


class TestRecording:
    """63 poses of a magnet 22 to 79 mm away; the source's offsets contain the background."""

    @pytest.mark.parametrize(("number", "largest_mm"), [(1, 0.22), (2, 0.21), (3, 0.22)])
    def test_errors(self, recording: Path, tmp_path: Path, run: Run, number: int, largest_mm: float) -> None:
        text = (recording / f"array-run{number}.toml").read_text(encoding="utf-8")
        stated = tmp_path / "array.toml"
        stated.write_text(f"{HINT}\n{text}", encoding="utf-8")
        array = arrays.read_array(stated)
        fixes = magloc.locate(array, magloc.read_readings(recording / f"run{number}.csv", array))
        truth = magloc.read_truth(recording / f"run{number}-truth.csv").position_m
        assert 1e3 * np.median(np.linalg.norm(fixes.position_m - truth, axis=1)) <= largest_mm
        covariance = fixes.solutions.covariance[fixes.best][:, :3, :3] + 0.15e-3**2 * np.eye(3)
        error = fixes.position_m - truth
        assert np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)) / 3.0 <= 1.5

    def test_hint(self, recording: Path, run: Run) -> None:
        arguments = ("locate", recording / "run2.csv", "--array")
        assert HINT in run(*arguments, recording / "array-run2.toml").err
        # Without a calibration the model is too wrong to say.
        assert HINT not in run(*arguments, recording / "array-nominal.toml").err
