"""The field of a body: against sums of dipoles, and derivatives against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from magloc.bodies.body import Magnet, MagnetBody
from magloc.bodies.field import body_fields, magnet_errors, magnet_fields, pose_jacobian
from magloc.fields import dipole
from magloc.fields.shapes import Shape

BODY = MagnetBody(
    (
        Magnet("m1", (0.006, 0.0, 0.0), (0.0, 0.0, 0.05), moment_sigma_Am2=0.002),
        Magnet("m2", (-0.003, 0.005, 0.001), (0.03, 0.0, 0.04)),
        Magnet("m3", (-0.003, -0.005, 0.0), (0.0, -0.05, 0.01), moment_sigma_Am2=0.001),
    ),
    temperature_sigma_K=10.0,
)
SHAPED = MagnetBody(
    (
        replace(BODY.magnets[0], shape=Shape("cylinder", (0.004, 0.005))),
        replace(BODY.magnets[1], shape=Shape("cuboid", (0.004, 0.003, 0.005)), rotation_xyzw=(0.6, 0.0, 0.0, 0.8)),
        replace(BODY.magnets[2], shape=Shape("ring", (0.002, 0.005, 0.004))),
    )
)
SENSORS = np.array([[0.01, 0.0, 0.0], [-0.005, 0.0087, 0.0], [-0.005, -0.0087, 0.0]])


@pytest.fixture
def poses() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(60_1)
    return rng.normal((0.0, 0.0, 0.015), 0.002, (7, 3)), Rotation.random(7, rng=rng).as_matrix()


def test_field_is_the_sum_of_the_magnets_in_the_array_frame(poses: tuple[np.ndarray, np.ndarray]) -> None:
    position_m, R = poses
    for x, turn, field in zip(position_m, R, body_fields(BODY, SENSORS, position_m, R), strict=True):
        sources = [x + turn @ np.array(magnet.position_m) for magnet in BODY.magnets]
        moments = [turn @ np.array(magnet.moment_Am2) for magnet in BODY.magnets]
        np.testing.assert_allclose(field, dipole.total_field(SENSORS, sources, moments), rtol=1e-12)


@pytest.mark.parametrize("body", [BODY, SHAPED])
def test_jacobian_agrees_with_central_differences(body: MagnetBody, poses: tuple[np.ndarray, np.ndarray]) -> None:
    position_m, R = poses
    jacobian = pose_jacobian(body, magnet_fields(body, SENSORS, position_m, R), R)
    for axis in range(6):
        h = 1e-7 if axis < 3 else 1e-5
        step = h * np.eye(3)[axis % 3]

        def moved(sign: float, step: np.ndarray = step, axis: int = axis) -> np.ndarray:
            if axis < 3:
                return body_fields(body, SENSORS, position_m + sign * step, R)
            return body_fields(body, SENSORS, position_m, R @ Rotation.from_rotvec(sign * step).as_matrix())

        difference = (moved(1.0) - moved(-1.0)) / (2.0 * h)
        np.testing.assert_allclose(jacobian[..., axis], difference, rtol=1e-6, atol=1e-7 * np.abs(difference).max())


def test_errors_of_the_moments_scale_the_fields_of_single_magnets_and_of_all(
    poses: tuple[np.ndarray, np.ndarray],
) -> None:
    position_m, R = poses
    fields = magnet_fields(BODY, SENSORS, position_m, R)
    errors = magnet_errors(BODY, fields, R)
    assert errors.shape == (7, 3, 3, 3)
    np.testing.assert_allclose(errors[..., 0], 0.04 * fields.field_T[:, 0], rtol=1e-12)
    np.testing.assert_allclose(errors[..., 2], 0.011 * fields.field_T.sum(axis=1), rtol=1e-12)


def test_errors_of_places_and_directions_are_differences_of_bodies(poses: tuple[np.ndarray, np.ndarray]) -> None:
    position_m, R = poses
    sigma = 1e-8
    first = replace(BODY.magnets[1], position_sigma_m=sigma, direction_sigma_rad=sigma)
    body = MagnetBody((BODY.magnets[0], first))
    plain = MagnetBody((replace(BODY.magnets[0], moment_sigma_Am2=0.0), first))
    errors = magnet_errors(plain, magnet_fields(plain, SENSORS, position_m, R), R)
    assert errors.shape == (7, 3, 3, 5)
    assert magnet_errors(body, magnet_fields(body, SENSORS, position_m, R), R).shape[-1] == 6
    # The covariance of the errors does not depend on the axes in which they are drawn.
    drawn = []
    for step in sigma * np.eye(3):
        other = replace(first, position_m=tuple(np.array(first.position_m) + step))
        drawn.append(other)
    for step in sigma * null_space(np.array([first.moment_Am2])).T:
        moment = Rotation.from_rotvec(step).apply(first.moment_Am2)
        drawn.append(replace(first, moment_Am2=tuple(moment)))
    nominal = body_fields(plain, SENSORS, position_m, R)
    columns = np.stack(
        [body_fields(MagnetBody((body.magnets[0], other)), SENSORS, position_m, R) - nominal for other in drawn],
        axis=-1,
    ).reshape(7, 9, 5)
    of_errors = errors.reshape(7, 9, 5)
    np.testing.assert_allclose(
        of_errors @ of_errors.mT, columns @ columns.mT, rtol=1e-4, atol=1e-4 * np.max(columns**2)
    )


def test_shapes_stand_and_turn_as_in_magpylib(poses: tuple[np.ndarray, np.ndarray]) -> None:
    magpylib = pytest.importorskip("magpylib")
    for x, turn, field in zip(*poses, body_fields(SHAPED, SENSORS, *poses), strict=True):
        expected = np.zeros((3, 3))
        for magnet, kind in zip(SHAPED.magnets, ("Cylinder", "Cuboid", "CylinderSegment"), strict=True):
            assert magnet.shape is not None
            size = magnet.shape.size_m
            dimension = (size[0] / 2, size[1] / 2, size[2], 0, 360) if kind == "CylinderSegment" else size
            axes = magnet.R_body_from_shape
            source = getattr(magpylib.magnet, kind)(
                magnetization=axes.T @ np.array(magnet.moment_Am2) / magnet.shape.volume_m3,
                dimension=dimension,
                position=x + turn @ np.array(magnet.position_m),
                orientation=Rotation.from_matrix(turn @ axes),
            )
            expected += source.getB(SENSORS)
        np.testing.assert_allclose(field, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())
