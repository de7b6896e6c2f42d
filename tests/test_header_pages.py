"""The page of the C++ headers: every public type and call, and no private one."""

from __future__ import annotations

import pytest

from docs.header_pages import HEADERS, end_of_block, header_text, public_part
from magloc import core


def test_types_and_calls_are_there() -> None:
    page = "\n".join(header_text(core.include_dir(), name) for name in HEADERS)
    for heading in ("AttitudeFilter", "SatelliteFilter", "SatelliteConfig", "Status", "Tracker", "TrackerStatus"):
        assert f"### `{heading}`" in page
    assert "Status update(double time_s, const SatelliteReadings<Real> &given, const OrbitPoint<Real> &at);" in page
    assert "TrackerStatus update(double time_s, const double (&readings_T)[n][3]);" in page
    for hidden in ("private", "return", "static_assert", "memory_[", "model_."):
        assert hidden not in page


def test_bodies_are_left_out() -> None:
    text = """class A {
  int hidden_;

 public:
  A() noexcept : hidden_(f(1)) { if (x) { y(); } }
  int get() const { return hidden_; }

 private:
  void h();
}"""
    assert public_part(text) == "class A {\n public:\n  A() noexcept;\n  int get() const;\n};"


def test_a_brace_that_is_missing() -> None:
    with pytest.raises(ValueError, match="closing brace"):
        end_of_block("struct A { int x;", 9)
