"""Attitudes for the tests."""

import numpy as np
from numpy.typing import NDArray


def random_attitudes(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Quaternions (n, 4), uniform over all rotations."""
    q = rng.standard_normal((n, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
