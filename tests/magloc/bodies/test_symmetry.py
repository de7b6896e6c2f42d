"""Symmetry of bodies: groups that are known, and equal fields in all poses of an orbit."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from magloc.bodies.body import Magnet, MagnetBody
from magloc.bodies.field import body_fields
from magloc.bodies.symmetry import body_symmetry
from tests.magloc.bodies.devices import knob


def ring_of(n: int, moment: tuple[float, float, float] = (0.0, 0.0, 0.05), *, radial: bool = False) -> MagnetBody:
    magnets = []
    for k in range(n):
        turn = Rotation.from_euler("z", 2.0 * math.pi * k / n)
        own = turn.apply((0.05, 0.0, 0.0)) if radial else moment
        magnets.append(Magnet(f"m{k}", tuple(turn.apply((0.006, 0.0, 0.002))), tuple(own)))
    return MagnetBody(tuple(magnets))


def test_groups_that_are_known() -> None:
    assert body_symmetry(knob()).order == 1
    assert body_symmetry(ring_of(3)).order == 3
    assert body_symmetry(ring_of(4, radial=True)).order == 8  # half turns about axes in the plane, too
    assert body_symmetry(ring_of(4)).order == 4
    along = MagnetBody((Magnet("a", (0, 0, 0), (0, 0, 0.05)), Magnet("b", (0, 0, 0.01), (0, 0, 0.05))))
    assert body_symmetry(along).axis is not None
    assert body_symmetry(along).order == 1
    against = MagnetBody((Magnet("a", (0, 0, 0), (0, 0, 0.05)), Magnet("b", (0, 0, 0.01), (0, 0, -0.05))))
    assert body_symmetry(against).order == 2


def test_poses_of_an_orbit_have_one_field() -> None:
    rng = np.random.default_rng(60_5)
    points = rng.normal(0.0, 0.01, (6, 3)) - [0.0, 0.0, 0.03]
    for body in (ring_of(3), ring_of(4, radial=True), ring_of(2)):
        symmetry = body_symmetry(body)
        assert symmetry.order > 1
        R = Rotation.random(rng=rng).as_matrix()
        places, turned = symmetry.orbit(np.array([0.001, 0.002, 0.01]), R)
        fields = body_fields(body, points, places, turned)
        np.testing.assert_allclose(fields, np.broadcast_to(fields[0], fields.shape), rtol=1e-9, atol=1e-15)


def test_the_pose_nearest_to_rest_is_chosen() -> None:
    body = ring_of(4, radial=True)
    symmetry = body_symmetry(body)
    R = Rotation.from_euler("zx", [100.0, 5.0], degrees=True).as_matrix()
    place, turn, lead = symmetry.nearest_to_rest(np.zeros(3), R)
    np.testing.assert_allclose(turn, R @ lead)
    assert Rotation.from_matrix(turn).magnitude() < math.radians(12.0)
    np.testing.assert_allclose(
        body_fields(body, np.array([[0.0, 0.02, 0.0]]), place, turn),
        body_fields(body, np.array([[0.0, 0.02, 0.0]]), np.zeros(3), R),
    )
