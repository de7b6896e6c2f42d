"""``adcs run detumbling``."""

from __future__ import annotations

import json

import pytest

from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant


@pytest.mark.slow
def test_numbers_and_text(adcs):
    arguments = ("run", "detumbling", "--seeds", "2", "--rate-deg-s", "0.7", "--duration", "500")
    outcome = adcs(*arguments, "--json")
    assert outcome.status == 0, outcome.err
    found = json.loads(outcome.out, parse_constant=refuse_constant)
    assert list(found) == [
        *("time_s", "theory_s", "ratio", "within_20_percent"),
        *("detumbled_runs", "runs", "last_rate_deg_s", "last_off_field_deg"),
    ]
    assert found["last_off_field_deg"] is None
    assert found["detumbled_runs"] == found["runs"] == 2
    assert f"after, median{found['time_s']:.0f} s" in adcs(*arguments).out.replace(" " * 8, "")


def test_too_short_is_null(adcs):
    outcome = adcs("run", "detumbling", "--seeds", "1", "--duration", "100", "--json")
    found = json.loads(outcome.out, parse_constant=refuse_constant)
    assert found["time_s"] is None
    assert found["detumbled_runs"] == 0


def test_a_magnet_and_rods(adcs):
    arguments = ("run", "detumbling", "--damping", "rods", "--magnet-Am2", "0.3", "--seeds", "2", "--duration", "300")
    found = json.loads(adcs(*arguments, "--json").out, parse_constant=refuse_constant)
    assert found["theory_s"] is None
    assert 0.0 < found["last_off_field_deg"] < 180.0
    assert f"magnet off the field, last orbit  {found['last_off_field_deg']:.2g}°" in adcs(*arguments).out


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--rate-deg-s", "0"),
        ("--duty", "1.5"),
        ("--moment-Am2", "-1"),
        ("--duration", "1e9"),
        ("--duration", "1e-9"),
        ("--magnet-Am2", "-1"),
    ],
)
def test_refused(adcs, option, value):
    assert_refused(adcs("run", "detumbling", option, value), option, "expected")
