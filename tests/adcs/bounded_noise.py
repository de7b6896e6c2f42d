"""Runs of linear systems with bounded noise of many kinds, for tests of containment."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from adcs.ellipsoids.ellipsoid import Ellipsoid, quadratic_form, segment_shape
from adcs.ellipsoids.observer import BoundedSystem, EllipsoidObserver


class Containment(NamedTuple):
    """What :func:`containment` found."""

    largest_form: float
    violations: int
    false_contradictions: int
    steps: int
    mean_trace: float


def satellite(noise=1.0, drift=0.02):
    """Roll and yaw in degrees and steps of 2 s, as section 5 of the specification has them."""
    angle = 2.0 * math.sqrt(3.986004418e14 / 6.878e6**3)
    return BoundedSystem(
        A=np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]),
        disturbance=segment_shape([0.0, 1.0], 2.0 * drift, 2),
        directions=np.array([[1.0, 0.0]]),
        bounds=np.array([noise]),
    )


def three_states():
    """An unstable system of three states with an ellipsoid of disturbances."""
    return BoundedSystem(
        A=np.array([[1.02, 0.3, 0.0], [-0.3, 1.0, 0.2], [0.1, 0.0, 0.9]]),
        disturbance=np.array([[0.02, 0.005, 0.0], [0.005, 0.01, 0.002], [0.0, 0.002, 0.03]]),
        directions=np.array([[0.6, 0.0, 0.8]]),
        bounds=np.array([0.3]),
    )


def random_system(n, m, rng):
    """A system with eigenvalues up to 1.05 in modulus, disturbances of any rank and channels of any direction."""
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.5, 1.05) / np.abs(np.linalg.eigvals(A)).max()
    root = rng.standard_normal((n, rng.integers(0, n + 1))) * 0.1
    return BoundedSystem(A, root @ root.T, rng.standard_normal((m, n)), rng.uniform(0.05, 1.0, m))


def containment(system, rule, n_runs, n_steps, seed):
    """Observers against noise of all kinds.

    The runs have in turn uniform noise, a random corner, a constant corner, a square wave, and an adversary, who hides
    the error in the reading and pushes the state along the error. Half of the initial states are on the boundary of the
    first set.
    """
    rng = np.random.default_rng(seed)
    n, m = system.n, system.m
    eigenvalue, eigenvector = np.linalg.eigh(system.disturbance)
    keep = eigenvalue > 1e-12 * max(eigenvalue.max(), 1e-300)
    root = eigenvector[:, keep] * np.sqrt(eigenvalue[keep])  # disturbances are root @ v, |v| <= 1
    radius = 3.0 * float(system.bounds.max())
    observer = EllipsoidObserver(system, Ellipsoid(np.zeros(n), radius**2 * np.eye(n)), n_runs, rule=rule)
    inner = np.where(np.arange(n_runs) % 2, 1.0, rng.random(n_runs) ** (1.0 / n))
    x = radius * inner[:, None] * _directions(rng, n_runs, n)
    kind = np.arange(n_runs) % 5
    half_period = rng.integers(2, 60, n_runs)
    corner, fixed = rng.choice([-1.0, 1.0], (n_runs, m)), _directions(rng, n_runs, root.shape[1])
    largest, violations = 0.0, 0
    for step in range(n_steps):
        wave = np.where((step // half_period) % 2, 1.0, -1.0)[:, None]
        random = _directions(rng, n_runs, root.shape[1])
        away = ((x - observer.centres) @ system.A.T) @ root
        length = np.linalg.norm(away, axis=1, keepdims=True)
        away = np.where(length > 0.0, away / np.where(length > 0.0, length, 1.0), random)
        v = _by_kind(kind, random * rng.random((n_runs, 1)), random, fixed, fixed * wave, away)
        x = x @ system.A.T + v @ root.T
        observer.predict()
        hidden = -np.sign((x - observer.centres) @ system.directions.T)
        signs = rng.choice([-1.0, 1.0], (n_runs, m))
        error = _by_kind(kind, rng.uniform(-1.0, 1.0, (n_runs, m)), signs, corner, corner * wave, hidden)
        observer.correct(x @ system.directions.T + error * system.bounds)
        form = quadratic_form(observer.centres, observer.shapes, x)
        largest, violations = max(largest, float(form.max())), violations + int(np.count_nonzero(form > 1.0 + 1e-9))
    trace = float(np.trace(observer.shapes, axis1=1, axis2=2).mean())
    return Containment(largest, violations, int(observer.resets.sum()), n_runs * n_steps, trace)


def _directions(rng, n_runs, n):
    vectors = rng.standard_normal((n_runs, n))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True) if n else vectors


def _by_kind(kind, *choices):
    return np.choose(kind[:, None], choices)
