"""Terms of a platform: their basis, and their fields in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.compensation.terms import CURRENT_T, EDDY_S, INDUCED, MATRICES, PERMANENT_T, PlatformTerms
from tests.magloc.compensation.flights import Platform, array_of

MAG = array_of().sensors[0]


def test_the_basis_is_orthonormal() -> None:
    basis = np.stack([matrix.ravel() for matrix in MATRICES.values()])
    np.testing.assert_allclose(basis @ basis.T, np.eye(9), atol=1e-15)


def test_fields_are_those_of_the_matrices() -> None:
    """p + A b + E db/dt + c I, from matrices that are drawn element by element."""
    rng = np.random.default_rng(1)
    platform = Platform.draw(rng, MAG)
    b, rate, current = 5e-5 * rng.standard_normal((20, 3)), 1e-5 * rng.standard_normal((20, 3)), rng.random(20)
    terms = PlatformTerms.of(MAG, ["motor_A"], 2e-8)
    found = terms.fields(b, rate, current[:, None]) @ (platform.coefficients(0.0) / terms.sigma)
    np.testing.assert_allclose(found, platform.field(b, rate, current), rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(
        terms.matrices(platform.coefficients(0.0) / terms.sigma), [platform.induced, platform.eddy], rtol=1e-12
    )


def test_a_turn_is_antisymmetric_and_a_stretch_has_no_trace() -> None:
    terms = PlatformTerms.of(MAG, (), CURRENT_T)
    for which, sign in ((terms.turns, -1.0), (terms.stretches, 1.0)):
        for index in which:
            matrix = terms.matrices(np.eye(21)[index])[0]
            np.testing.assert_allclose(matrix, sign * matrix.T)
            assert np.trace(matrix) == pytest.approx(0.0, abs=1e-18)
    assert np.trace(terms.matrices(np.eye(21)[terms.gain])[0]) > 0.0


def test_priors_are_those_of_the_sensor_or_wide() -> None:
    stated = PlatformTerms.of(MAG, ["i"], 3e-8).sigma
    np.testing.assert_allclose(stated, np.repeat([200e-9, 2e-3, 2e-3, 3e-8], [3, 9, 9, 3]))
    from dataclasses import replace

    bare = replace(MAG, offset_uncertainty_T=0.0, induced_uncertainty=0.0, eddy_uncertainty_s=0.0)
    wide = PlatformTerms.of(bare, (), CURRENT_T).sigma
    np.testing.assert_allclose(wide, np.repeat([PERMANENT_T, INDUCED, EDDY_S], [3, 9, 9]))
