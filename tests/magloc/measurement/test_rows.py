"""What double precision can square, and what not: both sides of every bound."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np
import pytest

from arrays.array import SensorArray
from arrays.geometries import grid, tetrahedron
from arrays.typing import FloatArray
from magloc.measurement.rows import WhitenedRows, check_magnitudes, whitened_rows

ARRAY = tetrahedron(1.0)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda by: tetrahedron(1.0, noise_T=1e-20 / by), "noise between"),
        (lambda by: tetrahedron(1.0, noise_T=1e3 * by), "noise between"),
        (lambda by: replace(ARRAY, common_field_T=1e3 * by), "common field of at most 1e12 nT"),
        (lambda by: replace(ARRAY, ambient_T=np.array([0.0, -1e3 * by, 0.0])), "ambient field of at most 1e12 nT"),
        (lambda by: replace(ARRAY, noise_fraction=10.0 * by), "noise_fraction of at most 10"),
    ],
)
@pytest.mark.parametrize("by", [1.0 - 1e-6, 1.0 + 1e-6])
def test_magnitudes(change, name: str, by: float) -> None:
    expected: AbstractContextManager[object] = nullcontext() if by < 1.0 else pytest.raises(ValueError, match=name)
    with expected:
        check_magnitudes(change(by))


class TestModelOfOneRow:
    """Readings that come one by one have one model, which differs from no other."""

    ARRAY = replace(tetrahedron(1.5, noise_T=1e-9), common_field_T=1e-6)

    @staticmethod
    def rows(array: SensorArray, readings_T: FloatArray, ambient_T: FloatArray | None = None) -> WhitenedRows:
        (rows,) = whitened_rows(array, readings_T, ambient_T, 100)
        return rows

    def test_rows_share_it(self) -> None:
        readings = np.random.default_rng(1).normal(scale=1e-7, size=(2, 12))
        first, second = (self.rows(self.ARRAY, row[None]) for row in readings)
        assert first.model.channels is second.model.channels

    def test_other_channels_array_or_noise_have_another(self) -> None:
        readings = np.random.default_rng(1).normal(scale=1e-7, size=(1, 12))
        missing = np.where(np.arange(12) == 4, np.nan, readings)
        larger, louder = tetrahedron(3.0, noise_T=1e-9), replace(self.ARRAY, noise_fraction=0.1)
        cases = [(self.ARRAY, readings), (self.ARRAY, missing), (larger, readings)]
        cases += [(louder, readings), (louder, 2.0 * readings)]
        models = [self.rows(*case).model for case in cases]
        assert len({id(model) for model in models}) == len(cases)
        assert not np.allclose(models[0].channels.kept["gain"], models[1].channels.kept["gain"])
        assert not np.allclose(models[3].channels.kept["gain"], models[4].channels.kept["gain"])

    @pytest.mark.parametrize("ambient_T", [None, np.array([[2e-5, -1e-6, 4e-5]])])
    def test_as_a_row_of_many(self, ambient_T: FloatArray | None) -> None:
        readings = np.random.default_rng(1).normal(scale=1e-7, size=(3, 12))
        several = None if ambient_T is None else np.tile(ambient_T, (3, 1))
        alone, many = self.rows(self.ARRAY, readings[:1], ambient_T), self.rows(self.ARRAY, readings, several)
        np.testing.assert_allclose(alone.y[0], many.y[0], rtol=1e-12)
        np.testing.assert_allclose(alone.signals[0], many.signals[0], rtol=1e-12)
        np.testing.assert_allclose(alone.model.ambient[0], many.model.ambient[0])
        np.testing.assert_array_equal(*(rows.model.channels.kept["common"] for rows in (alone, many)))


class TestMarginalised:
    """Errors that count as noise: the squares of what is left are those of a regression on errors of unit variance."""

    @staticmethod
    def squares(common_field_T: float | None, columns: FloatArray) -> tuple[list[float], list[float]]:
        """Squares of three rows of noise without what counts as noise, and those that LAPACK's regression leaves."""
        array = replace(grid(4, 3, 0.1, noise_T=1e-9), common_field_T=common_field_T)
        readings = np.random.default_rng(2).normal(scale=1e-9, size=(3, 36))
        (rows,) = whitened_rows(array, readings, None, 3)
        common = np.tile(np.eye(3), (12, 1)) * (1.0 if common_field_T is None else common_field_T / 1e-9)
        left = []
        for raw, of_row in zip(rows.raw, columns, strict=True):
            every = np.hstack([common, of_row])
            # What is known of an error is a reading of it.
            known = np.eye(every.shape[1])[3 if common_field_T is None else 0 :]
            whole, y = np.vstack([every, known]), np.concatenate([raw, np.zeros(len(known))])
            left.append(float(np.sum((y - whole @ np.linalg.lstsq(whole, y)[0]) ** 2)))
        return np.sum(rows.marginalise(columns).y ** 2, axis=1).tolist(), left

    @pytest.mark.parametrize("common_field_T", [None, 2e-9])
    @pytest.mark.parametrize("size", [1e-3, 1.0, 1e3, 1e5])
    def test_squares_are_those_of_a_regression(self, size: float, common_field_T: float | None) -> None:
        columns = size * np.random.default_rng(3).normal(size=(3, 36, 14))
        np.testing.assert_allclose(*self.squares(common_field_T, columns), rtol=1e-9)

    @pytest.mark.parametrize("common_field_T", [None, 2e-9])
    def test_columns_that_repeat_others_or_are_none(self, common_field_T: float | None) -> None:
        columns = np.random.default_rng(4).normal(size=(3, 36, 14)) * np.geomspace(1e-2, 1e3, 14)
        columns[0, :, 7:], columns[1] = 0.5 * columns[0, :, :7], 0.0
        np.testing.assert_allclose(*self.squares(common_field_T, columns), rtol=1e-9)

    def test_more_columns_than_channels(self) -> None:
        columns = np.random.default_rng(5).normal(size=(3, 36, 50))
        np.testing.assert_allclose(*self.squares(2e-9, columns), rtol=1e-9)
