"""The ambient field of readings: what is wrong with a place is said in one sentence that names it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from arrays.geometries import cube, tetrahedron
from arrays.io.errors import InputError
from magloc.ambient import Place, in_world_field, with_ambient_field
from magloc.fields import dipole
from magloc.readings import Readings


class TestFieldOfTheWorld:
    """A field that is stated in the world is that of every row, turned to the array's axes."""

    FIELD_T = np.array([1e-5, 2e-5, -4e-5])
    ARRAY = replace(cube(0.6, "scalar", 1e-11), ambient_world_T=tuple(FIELD_T.tolist()))

    def readings(self) -> tuple[Readings, np.ndarray]:
        """Of a source at rest in the world, and its position and moment."""
        rotation = Rotation.random(4, rng=np.random.default_rng(3))
        origin_m = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1], [1.0, 0.2, 0.0], [1.5, 0.0, 0.0]])
        source = np.array([1.0, 1.5, -1.0, 3.0, -2.0, 5.0])
        place, moment = rotation.inv().apply(source[:3] - origin_m), rotation.inv().apply(np.tile(source[3:], (4, 1)))
        field_T = dipole.field(self.ARRAY.positions, place[:, None], moment[:, None])
        values_T = self.ARRAY.readings_of(field_T + rotation.inv().apply(self.FIELD_T)[:, None])
        return Readings(values_T, array_position_m=origin_m, array_rotation=rotation), source

    def test_fixes_and_moments(self) -> None:
        readings, source = self.readings()
        np.testing.assert_allclose(
            magloc.locate(self.ARRAY, readings).position_m, np.tile(source[:3], (4, 1)), atol=1e-6
        )
        track = magloc.track_moment(self.ARRAY, readings, source[:3])
        np.testing.assert_allclose(track.moment_Am2[-1], source[3:], atol=1e-4)
        step = magloc.Tracker(self.ARRAY, magloc.RandomWalk(0.1, 0.1)).update(readings[0])
        assert step.position_m is not None or step.rivals

    def test_a_record_of_the_field_comes_first(self) -> None:
        readings, _ = self.readings()
        given = replace(readings, ambient_T=np.zeros((4, 3)))
        assert in_world_field(given, self.ARRAY) is given

    def test_needs_a_pose(self) -> None:
        with pytest.raises(InputError, match="key ambient_world_nT of the array file: found no pose"):
            magloc.locate(self.ARRAY, self.readings()[0].values_T)


class TestPlace:
    @pytest.mark.parametrize(
        ("latitude_deg", "date", "model", "sentence"),
        [
            (95.0, "2025-01-01", "IGRF-14", "Input place: latitude_deg"),
            (50.0, "1800-01-01", "IGRF-14", "Input date: "),
            (50.0, "someday", "IGRF-14", "Input date: found 'someday', expected a date"),
            (50.0, "2025-01-01", "XYZ", "Input geomagnetic_model: found 'XYZ', expected one of"),
        ],
    )
    def test_what_is_wrong_is_named(self, latitude_deg: float, date: str, model: str, sentence: str) -> None:
        array = tetrahedron(1.5, "scalar")
        readings = Readings(np.full((1, array.n_channels), 5e-5))
        with pytest.raises(InputError, match=sentence):
            with_ambient_field(array, readings, Place(latitude_deg, 10.0, 0.0, date, model), gradient=False)
