"""The course over ground as the attitude of an array."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from arrays.typing import FloatArray
from magloc.navigation.course import chords

ANTENNA = (0.3, -0.2, 1.0)


def read(folder: Path, place_m: FloatArray, **columns: object) -> magloc.Readings:
    rows = "".join(f"{0.1 * k:.1f},1,{','.join(map(repr, row))}\n" for k, row in enumerate(place_m.tolist()))
    (folder / "log.csv").write_text("time_s,F,E,N,H\n" + rows, encoding="utf-8")
    said = arrays.LogColumns(sensors={"m": "F"}, position=("E", "N", "H"), course=True, **columns)  # type: ignore[arg-type]
    array = arrays.SensorArray((arrays.Sensor("m", "scalar", (0.0, 0.0, 0.0), 1e-10),), columns=said)
    return magloc.read_readings(folder / "log.csv", array)


class TestCourse:
    @pytest.mark.parametrize("course_deg", [0.0, 90.0, 200.0])
    def test_of_a_straight_way(self, course_deg: float, tmp_path: Path) -> None:
        ahead = np.array([np.cos(np.radians(course_deg)), np.sin(np.radians(course_deg)), 0.0])
        readings = read(tmp_path, np.outer(0.1 * np.arange(50), ahead))
        assert readings.array_rotation is not None
        np.testing.assert_allclose(readings.array_rotation.apply([1.0, 0.0, 0.0]), np.tile(ahead, (50, 1)), atol=1e-9)
        np.testing.assert_allclose(readings.array_rotation.apply([0.0, 0.0, 1.0]), np.tile([0.0, 0.0, 1.0], (50, 1)))

    def test_a_circle(self, tmp_path: Path) -> None:
        """On a circle of 20 m the tangent is met within the turn on a chord, except near the ends."""
        angle = np.linspace(0.0, np.pi, 600)
        place = 20.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        readings = read(tmp_path, place)
        assert readings.array_rotation is not None
        tangent = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
        found = readings.array_rotation.apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(found[30:-30], tangent[30:-30], atol=1e-3)

    def test_an_antenna(self, tmp_path: Path) -> None:
        """The antenna leads on a way to the north: 0.3 m ahead, 0.2 m to the right, 1 m above."""
        place = np.outer(0.1 * np.arange(50), [0.0, 1.0, 0.0])
        readings = read(tmp_path, place + np.array([0.2, 0.3, 1.0]), antenna_m=ANTENNA)
        assert readings.array_position_m is not None
        np.testing.assert_allclose(readings.array_position_m, place, atol=1e-9)

    def test_a_carrier_at_rest_keeps_the_axes_of_the_world(self, tmp_path: Path) -> None:
        readings = read(tmp_path, np.ones((5, 3)))
        assert readings.array_rotation is not None
        np.testing.assert_array_equal(readings.array_rotation.as_quat(), np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))

    def test_not_beside_an_attitude(self) -> None:
        with pytest.raises(ValueError, match="Input course must not come together"):
            arrays.LogColumns(position=("E", "N", "H"), course=True, angles=("yaw",))


def test_chords_end_and_begin_at_each_row() -> None:
    way, back, forth, chord = chords(np.stack([np.arange(101.0), np.zeros(101)], axis=1))
    assert (way[-1], chord) == (pytest.approx(100.0), 2.0)
    np.testing.assert_allclose(back[2:-2], np.tile([2.0, 0.0], (97, 1)), atol=1e-6)
    np.testing.assert_allclose(forth[2:-2], np.tile([2.0, 0.0], (97, 1)), atol=1e-6)

    @pytest.mark.parametrize("course", [False, True])
    def test_sensors_apart_without_an_attitude(
        self, *, course: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Two sensors 1.5 m apart, of which nobody says which way they point."""
        (tmp_path / "log.csv").write_text("time_s,a,b,E,N,H\n" + "".join(f"{k},1,1,{k},0,0\n" for k in range(9)))
        columns = arrays.LogColumns(sensors={"a": "a", "b": "b"}, position=("E", "N", "H"), course=course)
        pair = [arrays.Sensor(name, "scalar", (0.0, y, 0.0), 1e-10) for name, y in (("a", 0.75), ("b", -0.75))]
        magloc.read_readings(tmp_path / "log.csv", arrays.SensorArray(pair, columns=columns))
        assert ("no attitude for sensors that are up to 1.5 m apart" in caplog.text) != course
