"""``adcs calibrate-log`` on the log of a simulated flight."""

import json
from dataclasses import replace

import numpy as np
import pytest

import arrays
from adcs.log_calibration.fit import fit_log
from sims.attitude.flights import FlightSettings, simulate_flight
from tests.adcs.log_calibration.flights import write_flight
from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant

PLACE = ("--place", "48", "11", "500", "--date", "2026-05-01")


@pytest.fixture(scope="module")
def flight():
    from magloc.fields.geomagnetic import field_enu

    east, north, up = field_enu(48.0, 11.0, 500.0, np.datetime64("2026-05-01"))
    field_T = (0.0, float(np.hypot(east, north)), float(up))
    return simulate_flight(31, FlightSettings(duration_s=60.0, inertial_Hz=50.0, magnetometer_Hz=25.0, field_T=field_T))


@pytest.fixture
def log(flight, tmp_path):
    write_flight(flight, tmp_path / "flight.csv")
    return tmp_path / "flight.csv"


def test_json_and_array_file(adcs, log, flight, tmp_path):
    outcome = adcs("calibrate-log", log, *PLACE, "--out", tmp_path / "mag.toml", "--json")
    assert outcome.status == 0, outcome.err
    found = json.loads(outcome.out, parse_constant=refuse_constant)
    entries = {entry["name"]: entry for entry in found["terms"]}
    assert set(entries["field offset x"]) == {"name", "value", "sigma", "unit", "determined", "manoeuvre"}
    for i, axis in enumerate("xyz"):
        entry = entries[f"field offset {axis}"]
        assert abs(entry["value"] - 1e9 * flight.offset_T[0, i]) < 4.0 * entry["sigma"] + 100.0
    # Rows of the file round the times of the magnetometer up to the next row.
    assert abs(entries["field lag"]["value"] - 30.0) < 20.0
    assert found["undetermined"] == [name for name, entry in entries.items() if not entry["determined"]]
    array = arrays.read_array(tmp_path / "mag.toml")
    np.testing.assert_allclose(array.sensors[0].calibration.scale, flight.scale[0], atol=0.02)


def test_table_and_parameters(adcs, log, tmp_path):
    outcome = adcs("calibrate-log", log, *PLACE, "--out", tmp_path / "mag.params")
    assert outcome.status == 0, outcome.err
    assert "field offset x" in outcome.out
    assert "found z upwards" in outcome.err
    assert "CAL_MAG0_XOFF" in (tmp_path / "mag.params").read_text()


def test_without_a_place_the_scale_is_listed(adcs, log, tmp_path):
    outcome = adcs("calibrate-log", log, "--out", tmp_path / "mag.parm")
    assert "not determined: field scale" in outcome.out
    assert "neither is the scale" in outcome.err
    assert "COMPASS_DIA_X" not in (tmp_path / "mag.parm").read_text()


def test_array_file_of_two_magnetometers_is_refused(adcs, tmp_path):
    flight = simulate_flight(31, FlightSettings(duration_s=20.0, inertial_Hz=50.0, magnetometers=2))
    write_flight(flight, tmp_path / "two.csv")
    assert_refused(
        adcs("calibrate-log", tmp_path / "two.csv", "--out", tmp_path / "mag.toml"), "2 magnetometers, whose"
    )
    assert not (tmp_path / "mag.toml").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--out", "mag.csv"), "expected a name that ends in"),
        (("--out", "mag.toml", "--place", "48", "11", "500"), "expected --date with it"),
        (("--out", "mag.toml", "--place", "48", "11", "500", "--date", "May"), "found 'May'"),
        (("--out", "mag.toml", "--place", "95", "11", "500", "--date", "2026-05-01"), "--place: latitude_deg must lie"),
        (("--out", "mag.toml", "--currents", "amps"), "column amps: found no such column"),
    ],
)
def test_refusals(adcs, log, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    assert_refused(adcs("calibrate-log", log, *options), words)
    assert not (tmp_path / "mag.toml").exists()


def test_fit_that_does_not_converge_writes_no_file(adcs, log, tmp_path, monkeypatch):
    monkeypatch.setattr("adcs.log_calibration.calibrate.fit_log", lambda *of: replace(fit_log(*of), converged=False))
    assert_refused(adcs("calibrate-log", log, "--out", tmp_path / "mag.params"), "found a fit that does not converge")
    assert not (tmp_path / "mag.params").exists()
