"""``adcs loads`` on the log of a simulated satellite."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

import arrays
from arrays.io.csv import write_columns
from sims.experiments.loads import LOADS, NOISE_T, switching_loads
from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant


@pytest.fixture(scope="module")
def flight():
    return switching_loads(seed=3, duration_s=900.0)


@pytest.fixture
def files(flight, tmp_path):
    write_columns(flight.columns, tmp_path / "loads.csv")
    arrays.write_array(tmp_path / "array.toml", flight.array)
    return "loads", tmp_path / "loads.csv", "--array", tmp_path / "array.toml"


class TestResult:
    def test_fields_places_and_the_log_without_them(self, adcs, files, flight, tmp_path):
        outcome = adcs(*files, "--json", "--out", tmp_path / "quiet.csv")
        assert outcome.status == 0, outcome.err
        found = json.loads(outcome.out, parse_constant=refuse_constant)
        assert [one["load"] for one in found["results"]] == ["heater", "radio"]
        for entry, fields in zip(found["results"], flight.fields_T, strict=True):
            np.testing.assert_allclose(entry["field_nT"]["m1"], 1e9 * fields[0], atol=1e9 * NOISE_T)
            assert np.linalg.norm(np.array(entry["position_m"]) - LOADS[entry["load"]][0]) < 0.015
        with (tmp_path / "quiet.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0]) == list(flight.columns)
        quiet = np.array([[float(row[f"{name}_nT"]) for name in flight.array.channel_names] for row in rows])
        assert np.abs(quiet - 1e9 * flight.quiet_T).max() < 2e9 * NOISE_T

    def test_text_of_one_load(self, adcs, files):
        out = adcs(*files, "--loads", "radio").out
        assert "radio: " in out
        assert "moment [A·m²]" in out
        assert "heater" not in out


class TestRefusals:
    def test_a_load_that_is_not_there(self, adcs, files):
        assert_refused(adcs(*files, "--loads", "fan"), "column fan", "found no such column")

    def test_no_load(self, adcs, files, flight):
        columns = {name: values for name, values in flight.columns.items() if name not in LOADS}
        write_columns(columns, files[1])
        assert_refused(adcs(*files), "found no column of a load")

    def test_a_window_of_nothing(self, adcs, files):
        assert_refused(adcs(*files, "--window-s", "0"), "window_s")
