"""Containment to the last digit: rounding must not lose a point that was in the set and in the strip.

Points are where both are touched, at the edge of the strip and on the boundary of the set, in rational numbers. Each
enlargement that the code makes for rounding is needed by some of them.
"""

from __future__ import annotations

import math
import os
from fractions import Fraction

import numpy as np
import pytest

from adcs.ellipsoids.ellipsoid import Ellipsoid
from adcs.ellipsoids.names import STEP_RULES
from adcs.ellipsoids.observer import BoundedSystem, EllipsoidObserver

N_CASES = 300 if os.environ.get("HYPOTHESIS_PROFILE") == "random" else 100  # all by `make test-full`


def exact(values):
    return np.array([Fraction(float(value)) for value in np.ravel(values)])


def exact_form(ellipsoid, point):
    """The quadratic form of a point, in one dimension or two, without any rounding."""
    offset, H = point - exact(ellipsoid.centre), exact(ellipsoid.shape)
    if ellipsoid.n == 1:
        return offset[0] ** 2 / H[0]
    a, b, _, d = H
    return (d * offset[0] ** 2 - 2 * b * offset[0] * offset[1] + a * offset[1] ** 2) / (a * d - b * b)


def on_boundary(ellipsoid, direction):
    """A rational point in a direction from the centre, on the boundary but for 2⁻⁵⁰, and inside."""
    centre, offset = exact(ellipsoid.centre), exact(direction)
    length = Fraction(math.sqrt(exact_form(ellipsoid, centre + offset))) * (1 + Fraction(1, 2**50))
    point = centre + offset / length
    assert 1 - Fraction(1, 2**47) < exact_form(ellipsoid, point) <= 1
    return point


def cases(n, size, seed):
    """Sets round or flat about centres of some size, a direction, a point of the boundary, a reading and its bound."""
    rng = np.random.default_rng(seed)
    while True:
        is_flat = bool(rng.integers(2))
        flatness = 10.0 ** rng.uniform(0.0, 5.5) if is_flat else 1.0 + rng.random()
        turn = linear_turn(rng.uniform(0.0, math.pi)) if n == 2 else np.eye(1)
        root = turn * np.array([1.0, 1.0 / flatness])[:n] * math.exp(rng.uniform(-2.0, 2.0))
        ellipsoid = Ellipsoid(size * rng.normal(size=n), root @ root.T)
        # Across the flat side, or anywhere; the point near the pole of the direction, or anywhere.
        tilt = rng.integers(2) * 10.0 ** rng.uniform(-6.0, 0.0)
        h = turn[:, -1] + (n - 1) * tilt * turn[:, 0] if is_flat else rng.normal(size=n)
        pole = root.T @ h / np.linalg.norm(root.T @ h)
        away = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-8.0, 0.5)
        u = math.cos(away) * pole + (math.sin(away) * pole[::-1] * [1.0, -1.0] if n == 2 else 0.0)
        point = on_boundary(ellipsoid, root @ u)
        bound = float(np.linalg.norm(root.T @ h) * 10.0 ** rng.uniform(-8.0 if n == 2 else -1.0, 0.3))
        seen = exact(h) @ point
        # The point is at the edge of the strip, and at times within.
        share = 1.0 if rng.random() < 0.6 else rng.random()
        value = float(seen + int(rng.choice([-1, 1])) * Fraction(share) * Fraction(bound))
        for _ in range(3):
            if abs(Fraction(value) - seen) <= Fraction(bound):
                yield ellipsoid, h, point, value, bound
                break
            value = math.nextafter(value, float(seen))


def linear_turn(angle):
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def some(*arguments):
    return (case for case, _ in zip(cases(*arguments), range(N_CASES), strict=False))


@pytest.mark.parametrize("size", [0.0, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("rule", STEP_RULES)
def test_a_strip_keeps_every_point_that_it_has_in_common(rule, n, size):
    reduced = 0
    for ellipsoid, h, point, value, bound in some(n, size, 2):
        system = BoundedSystem(np.eye(n), np.zeros((n, n)), h[None], np.array([bound]))
        observer = EllipsoidObserver(system, ellipsoid, rule=rule)
        observer.correct([[value]])
        after = Ellipsoid(observer.centres[0], observer.shapes[0])
        assert observer.resets[0] == 0
        assert exact_form(after, point) <= 1
        reduced += after.trace < ellipsoid.trace
    assert reduced > N_CASES // 2


@pytest.mark.parametrize("size", [0.0, 1.0, 1e6])
@pytest.mark.parametrize("n", [1, 2])
def test_a_map_keeps_every_point(n, size):
    rng = np.random.default_rng(3)
    for ellipsoid, _, point, _, _ in some(n, size, 3):
        A, offset = rng.normal(size=(n, n)), size * rng.normal(size=n)
        observer = EllipsoidObserver(BoundedSystem(A, np.zeros((n, n)), np.eye(n), np.ones(n)), ellipsoid)
        observer.predict(offset)
        mapped = Ellipsoid(observer.centres[0], observer.shapes[0])
        assert exact_form(mapped, exact(A).reshape(n, n) @ point + exact(offset)) <= 1
