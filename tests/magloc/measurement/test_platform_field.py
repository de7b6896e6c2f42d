"""The field of a platform's matrices in closed form."""

from __future__ import annotations

import numpy as np

from magloc.measurement.platform_field import matrix_effects


def test_elements_of_a_matrix() -> None:
    rng = np.random.default_rng(7)
    A, b, direction = rng.standard_normal((3, 3)), rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
    np.testing.assert_allclose(matrix_effects(direction, b) @ A.ravel(), np.einsum("ni,ij,nj->n", direction, A, b))
    fields = matrix_effects(np.eye(3), b[:, None]) @ A.ravel()
    np.testing.assert_allclose(fields, b @ A.T)
