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
    return switching_loads(rng=3, duration_s=900.0)


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

        assert (found["lag_rows"], found["lag_s"], found["lag_bounds_rows"]) == (0.0, 0.0, [0, 0])
        assert 0.8 < found["chi2_per_dof"] < 1.2
        assert found["warnings"] == []

    def test_states_of_another_clock(self, adcs, files, flight):
        """The states two rows early: said, corrected, and in the JSON."""
        early = {name: np.append(flight.states[name][2:], [flight.states[name][-1]] * 2) for name in LOADS}
        write_columns(flight.columns | early, files[1])
        outcome = adcs(*files, "--json")
        found = json.loads(outcome.out)
        assert (found["lag_rows"], found["lag_s"]) == (2.0, 2.0)
        assert "do not have the same clock: the field changes 2 rows (2 s) later" in outcome.err
        assert found["warnings"][0] in outcome.err
        for entry, fields in zip(found["results"], flight.fields_T, strict=True):
            np.testing.assert_allclose(entry["field_nT"]["m1"], 1e9 * fields[0], atol=1e9 * NOISE_T)

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
