"""Tests of adcs.ellipsoids.ellipsoid and of the readable operations: one class per operation.

Against numerically minimal ellipses that we did not derive.

Who checks whom
---------------

====================  =======================================================================================
operation             oracle
====================  =======================================================================================
sum                   linear programme over all ellipses in the plane (a set contains another where its support
                      function is larger in every direction, which is linear in the shape); Minkowski sum of
                      segments in one dimension; points of both sets
intersection          the ellipse of least trace around points of the intersection's boundary, by SLSQP; an
                      interval in one dimension; the slice of an ellipsoid by a plane from a null space
form, support         scipy.linalg, points of the boundary
====================  =======================================================================================
"""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import linalg, optimize

from adcs.ellipsoids.ellipsoid import Ellipsoid, quadratic_form, segment_shape
from adcs.ellipsoids.names import STEP_RULES
from tests.adcs.ellipsoids.readable import (
    Outcome,
    intersect_strip,
    minimum_trace_sum,
    sum_with_ellipsoid,
    sum_with_segment,
    transformed,
)

seeds = st.integers(0, 2**32 - 1)
dimensions = st.integers(1, 12)
rules = st.sampled_from(STEP_RULES)


def random_root(n, rng, rank=None):
    """A matrix R, shape (n, rank), with semi-axes between 0.03 and 3: R u with |u| ≤ 1 fill the ellipsoid R Rᵀ."""
    rank = n if rank is None else rank
    axes = np.exp(rng.uniform(math.log(0.03), math.log(3.0), rank))
    return linalg.qr(rng.standard_normal((n, n)))[0][:, :rank] * axes


def random_shape(n, rng, rank=None):
    root = random_root(n, rng, rank)
    return root @ root.T


def support(ellipsoid, direction):
    """Largest lᵀx of its points, for directions l of shape (..., n)."""
    direction = np.asarray(direction)
    squared = np.einsum("...i,ij,...j->...", direction, ellipsoid.shape, direction)
    return direction @ ellipsoid.centre + np.sqrt(np.maximum(squared, 0.0))


def points_of(root, rng, n_points, *, boundary=False):
    """Points of the ellipsoid R Rᵀ around zero; half of them on the boundary, or all."""
    u = rng.standard_normal((n_points, root.shape[1]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    if not boundary:
        u[::2] *= rng.random((len(u[::2]), 1)) ** (1.0 / root.shape[1])
    return u @ root.T


def form_rtol(ellipsoid, size, box=0.0):
    """Largest error of the form 1 of a point that is a sum of terms up to size (n,).

    A shape H that is off by D changes the form by |D| / λ_min(H) at most, where these are above 1e-13 tr H.
    D is 16 n eps max(tr H, box) of rounding, where H is a sum of terms up to box, and 16 n eps |size| √tr H, which
    covers a rounded centre; rounding of the point itself counts for less than that.
    """
    eps, trace = np.finfo(np.float64).eps, ellipsoid.trace
    rounding = 16.0 * ellipsoid.n * eps * (max(trace, box) + np.linalg.norm(size) * math.sqrt(trace))
    return rounding / np.linalg.eigvalsh(ellipsoid.shape)[0]


class TestEllipsoid:
    def test_axes_widths_and_support(self):
        ellipsoid = Ellipsoid(np.array([1.0, 2.0]), np.diag([4.0, 9.0]))
        assert ellipsoid.trace == 13.0
        np.testing.assert_allclose(ellipsoid.semi_axes, [3.0, 2.0])
        np.testing.assert_allclose(ellipsoid.half_widths, [2.0, 3.0])
        np.testing.assert_allclose(support(ellipsoid, [[1.0, 0.0], [0.0, -1.0]]), [3.0, 1.0])

    @settings(deadline=None)
    @given(dimensions, seeds)
    def test_boundary_has_the_form_one(self, n, seed):
        rng = np.random.default_rng(seed)
        centre, root = rng.standard_normal(n), random_root(n, rng)
        points = centre + points_of(root, rng, 20, boundary=True)
        ellipsoid = Ellipsoid(centre, root @ root.T)
        np.testing.assert_allclose(ellipsoid.form(points), 1.0, rtol=form_rtol(ellipsoid, np.abs(points).max(axis=0)))

    @settings(deadline=None)
    @given(st.integers(2, 12), seeds)
    def test_flat_sets_contain_what_their_supports_allow(self, n, seed):
        rng = np.random.default_rng(seed)
        root = random_root(n, rng, rank=n - 1)
        ellipsoid = Ellipsoid(np.zeros(n), root @ root.T)
        assert ellipsoid.contains(points_of(root, rng, 20)).all()
        across = linalg.null_space(root.T)[:, 0]
        assert not ellipsoid.contains(1e-3 * across)
        assert support(ellipsoid, across) == pytest.approx(0.0, abs=1e-7)

    def test_form_of_a_thin_one(self):
        """Ratio of the squared semi-axes 1e-8: known to rounding, 1e8 eps."""
        rng = np.random.default_rng(0)
        for _ in range(50):
            axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            root = axes * np.sqrt([1.0, 1e-4, 1e-8])
            ellipsoid = Ellipsoid(np.zeros(3), root @ root.T)
            np.testing.assert_allclose(ellipsoid.form(root.T), 1.0, rtol=2e-7)

    def test_a_point(self):
        point = Ellipsoid(np.ones(2), np.zeros((2, 2)))
        assert point.contains([1.0, 1.0])
        assert point.form([1.0, 1.1]) == math.inf

    def test_batches(self):
        forms = quadratic_form(np.zeros((4, 1, 3)), np.tile(np.eye(3), (4, 5, 1, 1)), np.full((5, 3), 0.5))
        assert forms.shape == (4, 5)
        np.testing.assert_allclose(forms, 0.75)


class TestMap:
    @settings(deadline=None)
    @given(dimensions, seeds)
    def test_boundary_stays_boundary(self, n, seed):
        rng = np.random.default_rng(seed)
        centre, root = rng.standard_normal(n), random_root(n, rng)
        A, u = rng.standard_normal((n, n)) + 3.0 * np.eye(n), rng.standard_normal(n)
        points = centre + points_of(root, rng, 10, boundary=True)
        ellipsoid = Ellipsoid(centre, root @ root.T)
        mapped = transformed(ellipsoid, A, u)
        size = np.abs(A) @ np.abs(points).max(axis=0) + np.abs(u)
        rtol = form_rtol(mapped, size, np.sum((np.abs(A) @ ellipsoid.half_widths) ** 2))
        assume(rtol < 1e-2)  # of the first order
        np.testing.assert_allclose(mapped.form(points @ A.T + u), 1.0, rtol=rtol)


class TestSum:
    @pytest.mark.parametrize("seed", range(40))
    def test_no_ellipse_around_the_sum_has_a_smaller_trace(self, seed):
        """At most 1e-5 above a linear programme over all ellipses, of which every other one is around a segment."""
        rng = np.random.default_rng(seed)
        H, Q = random_shape(2, rng), random_shape(2, rng, rank=1 + seed % 2)
        angle = np.linspace(0.0, math.pi, 4001)
        l0, l1 = np.cos(angle), np.sin(angle)

        def support(S):
            return np.sqrt(np.maximum(S[0, 0] * l0**2 + 2 * S[0, 1] * l0 * l1 + S[1, 1] * l1**2, 0.0))

        best = optimize.linprog(
            [1.0, 1.0, 0.0],
            A_ub=-np.stack([l0**2, l1**2, 2.0 * l0 * l1], axis=1),
            b_ub=-((support(H) + support(Q)) ** 2),
            bounds=[(None, None)] * 3,
        )
        assert best.success
        assert np.trace(minimum_trace_sum(H, Q)) / best.fun - 1.0 <= 1e-5

    @settings(deadline=None)
    @given(dimensions, seeds)
    def test_contains_every_sum(self, n, seed):
        rng = np.random.default_rng(seed)
        centre, root, added = (
            rng.standard_normal(n),
            random_root(n, rng),
            random_root(n, rng, int(rng.integers(1, n + 1))),
        )
        first, points = Ellipsoid(centre, root @ root.T), centre + points_of(root, rng, 30)
        assert sum_with_ellipsoid(first, added @ added.T).contains(points + points_of(added, rng, 30)).all()
        f = rng.standard_normal(n)
        along = rng.choice([-0.7, 0.0, 0.7], (30, 1)) * f / np.linalg.norm(f)
        assert sum_with_segment(first, f, 0.7).contains(points + along).all()

    @settings(deadline=None)
    @given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0))
    def test_intervals(self, a, b):
        both = sum_with_segment(Ellipsoid(np.zeros(1), np.array([[a * a]])), [-2.0], b)
        assert both.half_widths[0] == pytest.approx(a + b, rel=1e-12)

    def test_nothing_added(self):
        H = np.diag([1.0, 2.0])
        np.testing.assert_array_equal(minimum_trace_sum(H, np.zeros((2, 2))), H)
        np.testing.assert_array_equal(minimum_trace_sum(np.zeros((2, 2)), H), H)


def intersection_boundary(H, h, y, c, n_points=400):
    """Points on the boundary of {xᵀ H⁻¹ x ≤ 1} within a strip: its arcs and its chords' ends."""
    root = linalg.cholesky(H, lower=True)
    # On the unit circle u the strip is |y - kᵀu| ≤ c.
    k = root.T @ h
    size, direction = np.linalg.norm(k), math.atan2(k[1], k[0])
    angle = [np.linspace(0.0, 2.0 * math.pi, n_points)]
    for edge in ((y - c) / size, (y + c) / size):
        if abs(edge) <= 1.0:
            angle.append(direction + np.array([1.0, -1.0]) * math.acos(edge))
    angle = np.concatenate(angle)
    u = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return u[np.abs(y - u @ k) <= c * (1.0 + 1e-12)] @ root.T


def least_trace_around(points, start):
    """Trace of the ellipse of least trace around points, found by SLSQP over B, b of |B x - b| ≤ 1."""

    def unpack(p):
        return np.array([[p[0], p[1]], [p[1], p[2]]]), p[3:]

    def trace(p):
        # tr (BᵀB)⁻¹ of a symmetric 2 by 2 matrix
        return (p[0] ** 2 + 2.0 * p[1] ** 2 + p[2] ** 2) / (p[0] * p[2] - p[1] ** 2) ** 2

    def trace_slope(p):
        top, det = p[0] ** 2 + 2.0 * p[1] ** 2 + p[2] ** 2, p[0] * p[2] - p[1] ** 2
        of_det = np.array([p[2], -2.0 * p[1], p[0]])
        return np.append(np.array([2.0 * p[0], 4.0 * p[1], 2.0 * p[2]]) / det**2 - 2.0 * top / det**3 * of_det, [0, 0])

    def slack(p):
        B, b = unpack(p)
        return 1.0 - np.sum((points @ B - b) ** 2, axis=1)

    def slack_slope(p):
        B, b = unpack(p)
        r, (x, y) = points @ B - b, points.T
        return -2.0 * np.stack([r[:, 0] * x, r[:, 0] * y + r[:, 1] * x, r[:, 1] * y, -r[:, 0], -r[:, 1]], axis=1)

    B = linalg.inv(linalg.sqrtm(start.shape).real)
    found = optimize.minimize(
        trace,
        [B[0, 0], B[0, 1], B[1, 1], *(B @ start.centre)],
        jac=trace_slope,
        constraints={"type": "ineq", "fun": slack, "jac": slack_slope},
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    # What SLSQP leaves of a violation is repaired by blowing the ellipse up.
    return found.fun * (1.0 - min(slack(found.x).min(), 0.0))


class TestIntersection:
    def test_trace_against_the_smallest_ellipse(self):
        """Eighty random strips that cut: the mean and the largest ratio to the true minimum (seed 1, not chosen)."""
        rng = np.random.default_rng(1)
        ratios = {rule: [] for rule in STEP_RULES}
        while len(ratios["lemma"]) < 80:
            H, angle = random_shape(2, rng), rng.uniform(0.0, math.pi)
            h = np.array([math.cos(angle), math.sin(angle)])
            e = math.sqrt(h @ H @ h)
            c = e * rng.uniform(0.1, 1.0)
            y = (e + c) * rng.uniform(-0.9, 0.9)
            before = Ellipsoid(np.zeros(2), H)
            updates = {rule: intersect_strip(before, h, y, c, rule) for rule in STEP_RULES}
            if any(update.outcome is not Outcome.REDUCED for update in updates.values()):
                continue
            points = intersection_boundary(H, h, y, c)
            least = least_trace_around(points, updates["tightened"].ellipsoid)
            for rule, update in updates.items():
                assert update.ellipsoid.contains(points).all()
                ratios[rule].append(update.ellipsoid.trace / least)
        assert min(map(min, ratios.values())) > 1.0 - 1e-4  # the oracle is the smallest
        mean = {rule: np.mean(ratio) for rule, ratio in ratios.items()}
        assert mean["optimal"] <= 1.35
        assert mean["tightened"] <= 1.05
        assert max(ratios["tightened"]) <= 1.3
        assert mean["lemma"] > mean["optimal"]

    @settings(deadline=None)
    @given(dimensions, seeds, rules)
    def test_contains_every_point_of_both(self, n, seed, rule):
        rng = np.random.default_rng(seed)
        root = random_root(n, rng, rank=int(rng.integers(1, n + 1)))
        before = Ellipsoid(rng.standard_normal(n), root @ root.T)
        points = before.centre + points_of(root, rng, 50)
        h = rng.standard_normal(n) * 10.0 ** rng.uniform(-3.0, 3.0)
        e = math.sqrt(h @ before.shape @ h)
        c = e * 10.0 ** rng.uniform(-3.0, 0.5) + 1e-9
        y = float(points[1] @ h + c * rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)]))
        update = intersect_strip(before, h, y, c, rule)
        assert update.outcome is not Outcome.INCONSISTENT
        assert update.ellipsoid.trace <= before.trace * (1.0 + 1e-12)
        inside = np.abs(y - points @ h) <= c
        assert update.ellipsoid.contains(points[inside]).all()
        assert update.ellipsoid.contains(points[1])

    @settings(deadline=None)
    @given(st.floats(-5.0, 5.0), st.floats(0.1, 3.0), st.floats(-1.0, 1.0), st.floats(0.01, 3.0), rules)
    def test_intervals(self, centre, radius, fraction, c, rule):
        """In one dimension it is the intersection of two intervals, with a floor of 1/1000 of the first."""
        y = centre + (radius + c) * fraction
        low, high = max(centre - radius, y - c), min(centre + radius, y + c)
        found = intersect_strip(Ellipsoid(np.array([centre]), np.array([[radius**2]])), [2.0], 2 * y, 2 * c, rule)
        assert found.ellipsoid.half_widths[0] == pytest.approx(max(0.5 * (high - low), 1e-3 * radius), rel=1e-9)
        assert found.ellipsoid.centre[0] == pytest.approx(0.5 * (low + high), abs=1e-9)

    def test_a_strip_that_contains_the_ellipsoid_changes_nothing(self):
        before = Ellipsoid(np.zeros(2), np.eye(2))
        for rule in STEP_RULES:
            update = intersect_strip(before, [1.0, 0.0], 0.4, 1.5, rule)
            assert update.outcome is Outcome.UNINFORMATIVE
            assert update.ellipsoid is before

    def test_what_a_direction_does_not_see(self):
        """The ellipsoid is flat along h: nothing to learn, but a contradiction shows."""
        flat = Ellipsoid(np.zeros(2), np.diag([1.0, 0.0]))
        assert intersect_strip(flat, [0.0, 1.0], 0.5, 1.0).outcome is Outcome.UNINFORMATIVE
        assert intersect_strip(flat, [0.0, 1.0], 1.5, 1.0).outcome is Outcome.INCONSISTENT

    def test_contradiction(self):
        before = Ellipsoid(np.zeros(2), np.eye(2))
        update = intersect_strip(before, [1.0, 0.0], 1.6, 0.5)
        assert update.outcome is Outcome.INCONSISTENT
        assert update.ellipsoid is before


class TestBadInput:
    @pytest.mark.parametrize(
        ("centre", "shape", "sentence"),
        [
            (
                [0, 0],
                [[1, 0], [0, -1e-3]],
                "must be positive semidefinite; instead received one with the eigenvalue -0.001",
            ),
            ([0, 0], [[1, 2], [2, 1]], "positive semidefinite"),
            ([0, 0], [[1, 0.5], [0, 1]], "must be symmetric"),
            ([0, 0], np.eye(3), "must be 2 by 2 finite numbers; instead received shape"),
            ([0, 0], [[1, 0], [0, np.nan]], "finite"),
            ([0, np.inf], np.eye(2), "Input centre must be a vector of finite numbers"),
            (0.0, np.eye(1), "Input centre must be a vector"),
        ],
    )
    def test_of_an_ellipsoid(self, centre, shape, sentence):
        with pytest.raises(ValueError, match=sentence):
            Ellipsoid(centre, shape)

    @pytest.mark.parametrize("direction", [[0.0, 0.0], [1.0, math.nan], [1.0, 0.0, 0.0]])
    def test_directions(self, direction):
        with pytest.raises(ValueError, match="Input direction must be 2 finite numbers that are not all zero"):
            segment_shape(direction, 1.0, 2)
