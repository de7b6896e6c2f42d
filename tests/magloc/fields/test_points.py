"""Tests of magloc.fields.points: the kernels agree with magloc.fields.dipole to rounding, in all instruction sets.

Physics is tested on the reference (test_dipole.py). What is tested here is what compilation could spoil: the blocks
and their edges, the lanes, the threads, the rule on the source, and the layouts of the arrays that go in.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from magloc.fields import dipole
from magloc.fields import points as kernels
from tests import oracles

Array = NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)
# Each of the twins is within 64 eps of the exact value (test_dipole.py derives it; fused multiply-adds only lower it).
ROUNDING = 64 * EPS
BETWEEN_TWINS = 2 * ROUNDING
BLOCK = 256
# No point, one, the blocks' edges, and several blocks of which the last is not full
SIZES = [0, 1, 7, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5]
UPPER = np.triu_indices(3)


def jacobians_at(points: Array, source: Array, moment: Array) -> Array:
    """Jacobians (N, 3, 6) of one dipole's field by (p, m)."""
    by_moment = np.stack([kernels.field_at_points(points, source[None], m[None]) for m in np.eye(3)], axis=-1)
    return np.concatenate([-kernels.gradient_at_points(points, source[None], moment[None]), by_moment], axis=-1)


PAIRS = [
    pytest.param(kernels.field_at_points, dipole.total_field, dipole.field, id="field"),
    pytest.param(kernels.gradient_at_points, dipole.total_gradient_tensor, dipole.gradient_tensor, id="gradient"),
]


def points_and_dipoles(n_points: int, n_dipoles: int) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng([n_points, n_dipoles])
    return rng.uniform(-5, 5, (n_points, 3)), rng.uniform(-5, 5, (n_dipoles, 3)), rng.normal(size=(n_dipoles, 3))


pytestmark = pytest.mark.usefixtures("instruction_set")


class TestTwins:
    @pytest.mark.parametrize("n_dipoles", [0, 1, 3])
    @pytest.mark.parametrize("n_points", SIZES)
    @pytest.mark.parametrize(("kernel", "twin", "of_one"), PAIRS)
    def test_sums_over_dipoles(
        self,
        kernel: Callable[..., Array],
        twin: Callable[..., Array],
        of_one: Callable[..., Array],
        n_points: int,
        n_dipoles: int,
    ) -> None:
        points, sources, moments = points_and_dipoles(n_points, n_dipoles)
        actual, expected = kernel(points, sources, moments), twin(points, sources, moments)
        assert actual.shape == expected.shape
        # The terms of the sum may cancel, so an error is measured against the sum of their norms.
        axes = tuple(range(1, expected.ndim))
        size = np.zeros(n_points)
        for p, m in zip(sources, moments, strict=True):
            size += np.sqrt(np.sum(of_one(points, p, m) ** 2, axes))
        assert np.all(np.sqrt(np.sum((actual - expected) ** 2, axes)) <= BETWEEN_TWINS * size)

    @pytest.mark.parametrize("n_points", SIZES)
    def test_jacobian(self, n_points: int) -> None:
        points, sources, moments = points_and_dipoles(n_points, 1)
        actual = jacobians_at(points, sources[0], moments[0])
        expected = dipole.field_jacobian(points, sources[0], moments[0])
        assert actual.shape == expected.shape == (n_points, 3, 6)
        for columns in (slice(0, 3), slice(3, 6)):
            error = np.linalg.norm((actual - expected)[..., columns], axis=(1, 2))
            assert np.all(error <= BETWEEN_TWINS * np.linalg.norm(expected[..., columns], axis=(1, 2)))


class TestAccuracy:
    """Against 120-digit arithmetic, from near to far."""

    @pytest.mark.parametrize("distance_m", [1e-50, 1e50])
    def test_neither_overflows_nor_underflows(self, distance_m: float) -> None:
        point, origin, moment = distance_m * np.array([[0.48, -0.6, 0.64]]), np.zeros(3), np.array([3.0, -5.0, 8.0])
        # Norms are taken of numbers near one: the squares of these would leave the range themselves.
        unit = 1e-7 / distance_m / distance_m / distance_m
        field = kernels.field_at_points(point, [origin], [moment])[0] / unit
        gradient = kernels.gradient_at_points(point, [origin], [moment])[0] / unit * distance_m
        exact_field = oracles.decimal_field(point[0], origin, moment) / unit
        exact_gradient = oracles.decimal_gradient_tensor(point[0], origin, moment) / unit * distance_m
        assert np.linalg.norm(field - exact_field) <= ROUNDING * np.linalg.norm(exact_field)
        assert np.linalg.norm(gradient - exact_gradient) <= ROUNDING * np.linalg.norm(exact_gradient)


class TestThreads:
    def test_result_does_not_depend_on_their_number(
        self, threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(kernels, "_TERMS_A_BLOCK", BLOCK)
        points, sources, moments = points_and_dipoles(20 * BLOCK + 3, 4)
        results = []
        for number in range(1, 5):
            threads(number)
            results.append(kernels.field_at_points(points, sources, moments))
        for result in results[1:]:
            np.testing.assert_array_equal(result, results[0])


class TestSingularPoint:
    """On a source the result is NaN for that point only, wherever it lies in a block."""

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("index", [0, 5, BLOCK - 1, BLOCK, 2 * BLOCK + 2])
    def test_is_nan_there_only(self, index: int) -> None:
        points, sources, moments = points_and_dipoles(2 * BLOCK + 3, 2)
        points[index] = sources[1]
        for result in (
            kernels.field_at_points(points, sources, moments),
            kernels.gradient_at_points(points, sources, moments),
            jacobians_at(points, sources[1], moments[1]),
        ):
            is_nan = np.isnan(result.reshape(len(points), -1))
            expected = np.arange(len(points)) == index
            np.testing.assert_array_equal(is_nan, np.broadcast_to(expected[:, None], is_nan.shape))
            assert np.all(np.isfinite(result[~expected]))


class TestInputs:
    points, sources, moments = points_and_dipoles(BLOCK + 4, 2)

    def test_layout_does_not_matter(self) -> None:
        read_only = self.points.copy()
        read_only.setflags(write=False)
        doubled = np.repeat(self.points, 2, axis=0)
        expected = kernels.field_at_points(self.points, self.sources, self.moments)
        for points in (np.asfortranarray(self.points), doubled[::2], read_only, self.points.tolist()):
            np.testing.assert_array_equal(kernels.field_at_points(points, self.sources, self.moments), expected)

    def test_inputs_stay_as_they_were(self) -> None:
        points, sources, moments = self.points.copy(), self.sources.copy(), self.moments.copy()
        kernels.field_at_points(points, sources, moments)
        for now, before in [(points, self.points), (sources, self.sources), (moments, self.moments)]:
            np.testing.assert_array_equal(now, before)
            assert now.flags.writeable

    def test_misuse(self) -> None:
        kernel = kernels.field_at_points
        with pytest.raises(ValueError, match=r"Input points must have shape \(N, 3\); instead received shape \(3,\)\."):
            kernel(self.points[0], self.sources, self.moments)
        with pytest.raises(ValueError, match=r"Input sources must have shape \(K, 3\)"):
            kernel(self.points, self.sources[0], self.moments)
        with pytest.raises(ValueError, match=r"Input moments must have shape \(K, 3\)"):
            kernel(self.points, self.sources, self.moments[:, :2])
        with pytest.raises(ValueError, match="same length; instead received 2 and 1"):
            kernel(self.points, self.sources, self.moments[:1])
