"""Results as data frames: the columns of the CSV files, with units."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import adcs
import magloc
from arrays.io.results import Result
from arrays.io.units import unit_of_column


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    board = magloc.datasets.load("board")
    diver = magloc.datasets.load("diver")
    ship = magloc.datasets.load("ship")
    log = adcs.datasets.load("satellite")
    path = magloc.ObjectPath(ship.truth.time_s, ship.truth.position_m)
    return {
        "fixes": magloc.locate(board.array, board.readings[:5]),
        "track": magloc.track(diver.array, diver.readings[100:]),
        "several": magloc.track_sources(board.array, board.readings[:5], sources=1),
        "signature": magloc.fit_signature(ship.array, ship.readings, path),
        "attitude": adcs.estimate(log.telemetry, log.satellite, sensors="st+gyro"),
    }


def test_columns_are_those_of_the_result(results: dict[str, Result]) -> None:
    fixes, track = results["fixes"], results["track"]
    assert isinstance(fixes, magloc.Fixes)
    assert isinstance(track, magloc.Track)
    for found in (fixes, track):
        frame = found.to_dataframe()
        np.testing.assert_array_equal(frame[["x_m", "y_m", "z_m"]], found.position_m)
        np.testing.assert_array_equal(frame["s_y_m"], np.sqrt(found.covariance[:, 1, 1]))
        assert frame.attrs["frame"] == found.frame


def test_units_are_known_without_the_name(results: dict[str, Result]) -> None:
    units = {name: unit for found in results.values() for name, unit in found.to_dataframe().attrs["units"].items()}
    wanted = {"time_s": "s", "s_z_m": "m", "my_Am2": "A m2", "rate_x_deg_s": "deg/s", "nis": "1"}
    wanted |= {"sigma_attitude_x_deg": "deg", "status": "1", "dropped_sensors": "1", "chi2_low99": "1"}
    assert {name: units.get(name) for name in wanted} == wanted
    assert unit_of_column("acceleration_x_m_s2") == "m/s2"
    json.dumps(results["fixes"].to_dataframe().attrs)  # pandas writes them into Parquet as JSON


@pytest.mark.parametrize("name", ["fixes", "track", "several", "signature", "attitude"])
def test_dataset_has_units_and_as_many_rows(results: dict[str, Result], name: str) -> None:
    found = results[name]
    dataset = found.to_xarray()
    assert all({"units", "long_name"} <= set(variable.attrs) for variable in dataset.data_vars.values())
    rows = len({*found.columns()["time_s"]}) if name in ("fixes", "track") else len(found.to_dataframe())
    assert dataset.sizes[found.dimension] == rows
    assert f"<pre>{repr(found)[:20]}" in found._repr_html_()


def test_parquet_keeps_the_units(results: dict[str, Result], tmp_path: Path) -> None:
    results["fixes"].to_dataframe().to_parquet(tmp_path / "fixes.parquet")
    again = pd.read_parquet(tmp_path / "fixes.parquet")
    assert again.attrs["units"]["x_m"] == "m"
