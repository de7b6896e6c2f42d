"""The ambient field of readings: what is wrong with a place is said in one sentence that names it."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.geometries import tetrahedron
from arrays.io.errors import InputError
from magloc.ambient import Place, with_ambient_field
from magloc.readings import Readings


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
