"""What double precision can square, and what not: both sides of every bound."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np
import pytest

from arrays.geometries import tetrahedron
from magloc.measurement.rows import check_magnitudes

ARRAY = tetrahedron(1.0)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda by: tetrahedron(1.0, noise_T=1e-20 / by), "noise between"),
        (lambda by: tetrahedron(1.0, noise_T=1e3 * by), "noise between"),
        (lambda by: replace(ARRAY, common_field_T=1e3 * by), "common field of 1e12 nT"),
        (lambda by: replace(ARRAY, ambient_T=np.array([0.0, -1e3 * by, 0.0])), "ambient field of 1e12 nT"),
        (lambda by: replace(ARRAY, noise_fraction=10.0 * by), "noise_fraction of 10"),
    ],
)
@pytest.mark.parametrize("by", [1.0 - 1e-6, 1.0 + 1e-6])
def test_magnitudes(change, name: str, by: float) -> None:
    expected: AbstractContextManager[object] = nullcontext() if by < 1.0 else pytest.raises(ValueError, match=name)
    with expected:
        check_magnitudes(change(by))
