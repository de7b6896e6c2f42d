"""Known paths: between their rows, outside them, along their course, and in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from arrays.io.errors import InputError
from magloc.signature.path import write_object_path

TIMES = np.array([0.0, 2.0, 4.0, 20.0])
PLACES = np.array([[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [4.0, 6.0, 5.0], [4.0, 6.0, 5.0]])


class TestBetweenRows:
    def test_straight_and_evenly(self) -> None:
        rotation = Rotation.from_euler("z", [[0.0], [0.4], [0.6], [0.6]])
        position, R = magloc.ObjectPath(TIMES, PLACES, rotation).at(np.array([1.0, 3.5]))
        np.testing.assert_allclose(position, [[2.0, 0.0, 5.0], [4.0, 4.5, 5.0]])
        assert R is not None
        np.testing.assert_allclose(Rotation.from_matrix(R).as_euler("zyx")[:, 0], [0.2, 0.55])

    def test_neither_in_gaps_nor_outside(self) -> None:
        position, _ = magloc.ObjectPath(TIMES, PLACES).at(np.array([-0.1, 2.0, 10.0, 20.0, 20.1]))
        np.testing.assert_array_equal(np.isfinite(position[:, 0]), [False, True, False, True, False])

    def test_rows_in_any_order(self) -> None:
        order = np.array([2, 0, 3, 1])
        rotation = Rotation.from_euler("z", [[0.0], [0.4], [0.6], [0.6]])
        t = np.array([0.5, 3.0])
        one, two = (
            magloc.ObjectPath(TIMES, PLACES, rotation),
            magloc.ObjectPath(TIMES[order], PLACES[order], rotation[order]),
        )
        for a, b in zip(one.at(t), two.at(t), strict=True):
            np.testing.assert_allclose(a, b)

    def test_another_time(self) -> None:
        with pytest.raises(InputError, match="path: found none of the times of the readings"):
            magloc.ObjectPath(TIMES, PLACES).at(np.array([100.0]))


class TestAlongCourse:
    def test_forward_is_along_the_velocity_and_stays_at_rest(self) -> None:
        t = np.arange(6.0)
        north = np.stack([0.0 * t, np.minimum(t, 3.0), 0.0 * t], axis=-1)
        rotation = magloc.ObjectPath(t, north).along_course().rotation
        assert rotation is not None
        np.testing.assert_allclose(rotation.apply([1.0, 0.0, 0.0]), np.tile([0.0, 1.0, 0.0], (6, 1)), atol=1e-12)
        np.testing.assert_allclose(rotation.apply([0.0, 0.0, 1.0]), np.tile([0.0, 0.0, 1.0], (6, 1)), atol=1e-12)

    def test_a_known_attitude_is_kept(self) -> None:
        path = magloc.ObjectPath(TIMES, PLACES, Rotation.identity(4))
        assert path.along_course() is path

    def test_at_rest_there_is_no_course(self) -> None:
        with pytest.raises(InputError, match="neither an attitude nor a horizontal velocity"):
            magloc.ObjectPath(TIMES, np.zeros((4, 3))).along_course()


class TestFiles:
    @pytest.mark.parametrize("rotation", [None, Rotation.random(4, rng=1)])
    def test_what_is_written_is_read(self, tmp_path: Path, rotation: Rotation | None) -> None:
        write_object_path(tmp_path / "path.csv", magloc.ObjectPath(TIMES, PLACES, rotation))
        read = magloc.read_object_path(tmp_path / "path.csv")
        np.testing.assert_array_equal(read.time_s, TIMES)
        np.testing.assert_array_equal(read.position_m, PLACES)
        assert (read.rotation is None) == (rotation is None)
        if rotation is not None and read.rotation is not None:
            np.testing.assert_allclose(read.rotation.as_matrix(), rotation.as_matrix(), atol=1e-15)

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("time_s,x_m,y_m\n0,1,2\n", "column z_m: found no such column"),
            ("time_s,x_m,y_m,z_m,heading_deg\n0,1,2,3,4\n", "column heading_deg: found an unknown column"),
            ("time_s,x_m,y_m,z_m\n0,1,,3\n", "line 2, column y_m: found no value"),
            ("time_s,x_m,y_m,z_m\n0,1,2,3\n0,1,2,3\n", "column time_s: found 0 as on line 2"),
            ("time_s,x_m,y_m,z_m,qx,qy,qz\n0,1,2,3,0,0,1\n", "column qw: found qx, qy, qz without it"),
            ("time_s,x_m,y_m,z_m,qx,qy,qz,qw\n0,1,2,3,0,0,1,1\n", "columns qx to qw: found a quaternion of norm"),
        ],
    )
    def test_what_is_no_path(self, tmp_path: Path, text: str, expected: str) -> None:
        (tmp_path / "path.csv").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=expected):
            magloc.read_object_path(tmp_path / "path.csv")
