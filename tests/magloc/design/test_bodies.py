"""Design of a body: its criterion, the descent, and the errors of rows of the designed body.

=======================  =========================================================================================
what                     who checks it
=======================  =========================================================================================
σ of a pose              central differences of readings, and a plain inverse of their covariance
slope of the criterion   differences of the criterion along random directions, with another step
descent                  a table of all positions of two magnets on a rod
gain                     fits of simulated rows: NEES, and a sign test of their errors
=======================  =========================================================================================
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from magloc.bodies.body import Magnet, MagnetBody, PoseLimits
from magloc.bodies.field import body_fields
from magloc.bodies.fit import stepped
from magloc.bodies.locator import locate_body
from magloc.bodies.search import spread_poses
from magloc.bounds.bodies import body_bounds
from magloc.design.bodies import BodyProblem, design_body, turned_magnet
from magloc.design.body_task import BodyTask, DesignVolume
from magloc.design.regions import Quantile
from magloc.design.task import DesignSearch
from magloc.design.volumes import BoxVolume, Cylinder
from magloc.fields.shapes import Shape
from tests.magloc.bodies.devices import hall_ring, knob, random_poses, readings_of

DISC = DesignVolume(Cylinder((0.0, 0.0, 0.0), 0.008, 0.0), 0.004)
QUICK = DesignSearch(2, 1, 6, 7, 10, 20)
TASK = BodyTask("knob", DISC, True, 0.008, Quantile(0.95), None, QUICK)
PLATE = DesignVolume(BoxVolume((0.0, 0.0, 0.0), (0.03, 0.03, 0.0)), 0.004)
SHAPED = replace(
    knob(moment_sigma_Am2=0.0005),
    magnets=(
        replace(knob().magnets[0], shape=Shape("cuboid", (0.005, 0.004, 0.003))),
        *knob(moment_sigma_Am2=0.0005).magnets[1:],
    ),
)


def problem(task: BodyTask, body: MagnetBody, n: int) -> BodyProblem:
    return BodyProblem(task, hall_ring(4), body, *spread_poses(body, hall_ring(4), n))


def test_deviations_are_those_of_differences() -> None:
    array, body, lever_m = hall_ring(4, noise_T=2e-6), knob(), 0.02
    of_task = replace(TASK, lever_m=lever_m)
    x, R = spread_poses(body, array, 6)
    found = BodyProblem(of_task, array, body, x, R)
    columns = []
    for k in range(6):
        step = (1e-7 if k < 3 else 1e-5) * np.eye(6)[k]
        ends = [body_fields(body, array.positions, *stepped(x, R, sign * step)).reshape(6, -1) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * step[k]))
    jacobian = np.stack(columns, axis=-1)
    covariance_T2 = 4e-12 * np.eye(12) + 50e-6**2 * np.kron(np.ones((4, 4)), np.eye(3))
    covariance = np.linalg.inv(jacobian.mT @ np.linalg.inv(covariance_T2) @ jacobian)
    largest = [np.linalg.eigvalsh(covariance[:, a:b, a:b])[:, -1] for a, b in ((0, 3), (3, 6))]
    expected = np.sqrt(largest[0] + lever_m**2 * largest[1])
    np.testing.assert_allclose(found.deviations(found.points_of(array, body)), expected, rtol=1e-5)


@pytest.mark.parametrize("sensors", [None, PLATE])
@pytest.mark.parametrize("body", [knob(), SHAPED])
def test_slope_is_the_derivative(body: MagnetBody, sensors: DesignVolume | None) -> None:
    found = problem(replace(TASK, sensors=sensors), body, 128)
    points = found.points_of(hall_ring(4), body)
    value, slope = found.log_value_and_slope(points)
    assert value == pytest.approx(np.log(found.value(points)), rel=1e-12)
    rng = np.random.default_rng(60_70)
    for _ in range(4):
        step = 3e-5 * rng.normal(size=points.shape)
        rise = np.log(found.value(points + step)) - np.log(found.value(points - step))
        assert rise == pytest.approx(2.0 * np.sum(slope * step), rel=2e-3, abs=1e-3 * np.abs(slope * step).sum())


def test_two_magnets_on_a_rod_are_the_best_of_a_table() -> None:
    """The table has steps of 0.5 mm; its best value is above that of the descent, or within 1 % below."""
    moments = ((0.05, 0.0, 0.0), (0.0, 0.03, -0.04))
    magnets = tuple(
        Magnet(f"m{i}", (x, 0.0, 0.0), m) for i, (x, m) in enumerate(zip((-0.002, 0.002), moments, strict=True))
    )
    body = MagnetBody(magnets, limits=PoseLimits((-0.002, -0.002, 0.013), (0.002, 0.002, 0.017), 0.3))
    rod = DesignVolume(BoxVolume((0.0, 0.0, 0.0), (0.02, 0.0, 0.0)), 0.003)
    task = replace(TASK, magnets=rod, directions_are_free=False, search=DesignSearch(4, 2, 6, 7, 20, 40))
    result = design_body(task, hall_ring(4), body, rng=1)
    found = problem(task, body, 1000 + 128)
    found = replace(found, position_m=found.position_m[1000:], R=found.R[1000:])
    steps = np.linspace(-1.0, 1.0, 41)
    table = [
        found.value(np.array([[a, 0.0, 0.0], [b, 0.0, 0.0]]))
        for a in steps
        for b in steps
        if abs(a - b) * 0.01 >= 0.003
    ]
    assert found.value(found.points_of(result.array, result.body)) < 1.01 * min(table)
    assert np.ptp(table) > 0.5 * min(table)
    assert np.abs(result.body.positions_m[:, 1:]).max() < 1e-12
    np.testing.assert_array_equal(result.body.moments_Am2, body.moments_Am2)


def test_rows_of_the_design_have_smaller_errors() -> None:
    """Limits of a mean of χ² and of a sign test, with a false-alarm rate of 1e-4 each, over 400 rows."""
    array, n = hall_ring(4), 400
    result = design_body(TASK, array, knob(), rng=2)
    rng = np.random.default_rng(60_71)
    squares = []
    for body in (knob(), result.body):
        x, R = random_poses(knob(), n, np.random.default_rng(60_72))
        poses = locate_body(array, body, readings_of(array, body, x, R, rng))
        turn = (Rotation.from_matrix(poses.R[:, 0]).inv() * Rotation.from_matrix(R)).as_rotvec()
        error = np.concatenate([x - poses.position_m[:, 0], turn], axis=1)
        nees = np.vecdot(error, np.linalg.solve(poses.covariance[:, 0], error[..., None])[..., 0])
        low, high = chi2.ppf([0.5e-4, 1.0 - 0.5e-4], 6 * n)
        assert low < nees.sum() < high
        squares.append(np.vecdot(error[:, :3], error[:, :3]) + 0.008**2 * np.vecdot(error[:, 3:], error[:, 3:]))
    assert np.sum(squares[1] < squares[0]) > binom.ppf(1.0 - 1e-4, n, 0.5)
    before_m, after_m = result.criterion_m
    assert after_m < before_m


def test_design_keeps_its_constraints() -> None:
    array = replace(hall_ring(4), sensors=tuple(replace(s, offset_uncertainty_T=1e-6) for s in hall_ring(4).sensors))
    steps: list[int] = []
    better: list[MagnetBody] = []
    task = replace(TASK, sensors=PLATE, search=replace(QUICK, large_iterations=2, small_iterations=2))
    result = design_body(task, array, SHAPED, progress=steps.append, better=lambda _, body: better.append(body))
    assert sum(steps) == task.search.n_steps
    assert better[-1] == result.body
    assert DISC.volume.nearest(result.body.positions_m) == pytest.approx(result.body.positions_m, abs=1e-12)
    for points in (result.body.positions_m, result.array.positions):
        apart = np.linalg.norm(points[:, None] - points, axis=-1) + np.eye(len(points))
        assert apart.min() >= 0.004 * (1.0 - 1e-6)
    assert [sensor.offset_uncertainty_T for sensor in result.array.sensors] == [1e-6] * 4
    moduli = [np.linalg.norm(body.moments_Am2, axis=1) for body in (SHAPED, result.body)]
    np.testing.assert_allclose(*moduli, rtol=1e-12)
    np.testing.assert_array_equal(result.before.covariance, body_bounds(array, SHAPED).covariance)


@pytest.mark.parametrize("direction", [[0.0, 0.0, 2.0], [1.0, -2.0, 0.5], [0.0, 0.0, -1.0]])
@pytest.mark.parametrize("kind", ["cuboid", "cylinder"])
def test_shapes_turn_with_their_moment(kind: str, direction: list[float]) -> None:
    shape = Shape(kind, (0.004, 0.003, 0.002) if kind == "cuboid" else (0.004, 0.003))
    magnet = Magnet("m", (0.0, 0.0, 0.0), (0.0, 0.0, 0.02), shape=shape)
    turned = turned_magnet(magnet, np.array(direction))
    assert np.cross(turned.moment_Am2, direction) == pytest.approx([0.0] * 3, abs=1e-12)
    assert np.dot(turned.moment_Am2, direction) > 0.0
    in_shape = [each.R_body_from_shape.T @ each.moment_Am2 for each in (magnet, turned)]
    np.testing.assert_allclose(*in_shape, atol=1e-12)


def test_bodies_without_limits_or_room_are_refused() -> None:
    with pytest.raises(ValueError, match="limits of its position"):
        design_body(TASK, hall_ring(4), replace(knob(), limits=PoseLimits()))
    with pytest.raises(ValueError, match="no start has such magnets"):
        design_body(replace(TASK, magnets=replace(DISC, least_spacing_m=0.02)), hall_ring(4), knob())
