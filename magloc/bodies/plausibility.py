"""Plausibility of a body and an array: lengths in another unit than metres, and readings that leave no check."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from arrays.array import SensorArray
from magloc.bodies.body import LARGEST_REMANENCE_T, Magnet, MagnetBody, PoseLimits
from magloc.bodies.field import placed_magnets
from magloc.bodies.poses import BodyPoses
from magloc.bodies.search import spread_poses
from magloc.fields.dipole import MU0_OVER_4PI

_LOG = logging.getLogger(__name__)
_N_POSES = 256
_UNSEEN = 30.0  # noise over the largest field of the sampled poses, beyond which no pose is seen
_MM = 1e-3
_STRONGEST_T = 4.0 * math.pi * MU0_OVER_4PI * 1.2e6  # remanence of the strongest magnets


def check_lengths(array: SensorArray, body: MagnetBody) -> None:
    """Raise ValueError for magnets that overlap, and for what :func:`check_reach` refuses."""
    for one, other in combinations(body.magnets, 2):
        apart_m = math.dist(one.position_m, other.position_m)
        if _inner_radius(one) + _inner_radius(other) > apart_m:
            raise ValueError(
                "Input body must have magnets that do not overlap; instead"
                f" {one.id} and {other.id} are {apart_m:.3g} m apart, {_needed(one)}, {_needed(other)}."
            )
    check_reach(array, body)


def check_reach(array: SensorArray, body: MagnetBody) -> None:
    """Raise ValueError for a body that no pose brings near the sensors, or that holds a sensor in every pose.

    The text names lengths that look like millimetres, if these explain it.
    """
    nearest_m, field_T = _reach(array, body)
    noise_T = float(array.channel_noise_T.min())
    if _UNSEEN * field_T < noise_T:
        causes = [name for name, others in _in_metres(array, body) if _UNSEEN * _reach(*others)[1] >= noise_T]
        hint = f": {causes[0]} looks like millimetres" if causes else ""
        raise ValueError(
            f"Input body must come near the sensors; instead all of its poses are {nearest_m:.3g} m away or more, where"
            f" its field of {field_T:.2g} T is below the noise of {noise_T:.2g} T{hint}."
        )
    if body.has_shapes and not nearest_m > 0.0:
        sizes = [list(magnet.shape.size_m) for magnet in body.magnets if magnet.shape is not None]
        raise ValueError(
            f"Input body must have a pose with all sensors outside its magnets; instead none has, with size_m {sizes}"
            " in metres."
        )


def warn_of_inside(array: SensorArray, body: MagnetBody, poses: BodyPoses) -> None:
    """Warn of poses in which a sensor is as near to a magnet as no magnet can come."""
    solved = poses.solved
    if not solved.any():
        return
    magnets, _ = placed_magnets(body, poses.position_m[solved, 0], poses.R[solved, 0])
    apart = np.linalg.norm(magnets[:, :, None] - array.positions, axis=-1)
    smallest_m = np.array([_ball_radius_m(magnet, _STRONGEST_T) for magnet in body.magnets])
    inside = apart < smallest_m[:, None]
    if inside.any():
        _, k, s = np.argwhere(inside)[0].tolist()
        _LOG.warning(
            f"in {int(inside.any(axis=(1, 2)).sum())} of {len(poses)} rows a sensor lies inside a magnet:"
            f" {array.ids[s]} in {body.ids[k]}; check the positions of magnets and sensors"
        )


def n_checks(array: SensorArray, n_unknowns: int) -> float:
    """Return how many readings of a row are left to check a pose, a known common field among them."""
    common_T = array.common_field_T
    noise_T = float(np.median(array.channel_noise_T))
    known = 0.0 if common_T is None else 3.0 / (1.0 + array.n_sensors * (common_T / noise_T) ** 2)
    return array.n_channels - 3 - n_unknowns + known


def warn_of_no_check(array: SensorArray, n_unknowns: int) -> None:
    """Warn of an array whose readings are as many as the unknowns of a pose, so that χ² shows no error."""
    common_T = array.common_field_T
    noise_T = float(np.median(array.channel_noise_T))
    if -0.5 < n_checks(array, n_unknowns) < 0.5:
        stated = "none is stated" if common_T is None else f"{1e9 * common_T:.3g} nT are stated"
        _LOG.warning(
            f"{array.n_channels} readings leave no check of a pose: six are its own, three those of the common field,"
            f" and χ² shows neither iron nearby nor a larger noise; add a sensor, or state a common_field_nT near the"
            f" noise of {1e9 * noise_T:.3g} nT ({stated})"
        )


def _ball_radius_m(magnet: Magnet, remanence_T: float) -> float:
    """Return the radius of the ball that has the moment of a magnet with a remanence [m]."""
    return math.cbrt(3.0 * MU0_OVER_4PI * magnet.modulus_Am2 / remanence_T)


def _inner_radius(magnet: Magnet) -> float:
    """Return the radius of the largest sphere within a magnet, or of the smallest that has a dipole's moment [m]."""
    if magnet.shape is None:
        return _ball_radius_m(magnet, LARGEST_REMANENCE_T)
    return 0.0 if magnet.shape.kind == "ring" else 0.5 * min(magnet.shape.size_m)


def _needed(magnet: Magnet) -> str:
    """Return the size of a magnet, with what it would be in another unit."""
    if magnet.shape is not None:
        size = ", ".join(f"{x:g}" for x in magnet.shape.size_m)
        in_mm = ", ".join(f"{_MM * x:g}" for x in magnet.shape.size_m)
        return f"with size_m {size} (millimetres are {in_mm})"
    return (
        f"with {magnet.modulus_Am2:.3g} A·m², which needs a ball of {2e3 * _inner_radius(magnet):.3g} mm at least"
        " (is moment_Am2 a remanence in T?)"
    )


def _in_metres(array: SensorArray, body: MagnetBody) -> Iterator[tuple[str, tuple[SensorArray, MagnetBody]]]:
    """Yield names of lengths, and array and body with these lengths taken for millimetres."""
    limits = body.limits
    if limits.is_bounded:
        low, high = (tuple((_MM * np.array(edge)).tolist()) for edge in (limits.low_m, limits.high_m))
        yield "position_m of the table range", (array, replace(body, limits=PoseLimits(low, high, limits.angle_rad)))
    magnets = tuple(replace(m, position_m=tuple((_MM * np.array(m.position_m)).tolist())) for m in body.magnets)
    yield "position_m of the magnets", (array, replace(body, magnets=magnets))
    sensors = tuple(replace(s, position_m=tuple((_MM * np.array(s.position_m)).tolist())) for s in array.sensors)
    yield "position_m of the sensors", (replace(array, sensors=sensors), body)


def _reach(array: SensorArray, body: MagnetBody) -> tuple[float, float]:
    """Return the least distance of a magnet from a sensor over poses [m], and the largest field of a magnet [T].

    The distance is that of poses with all sensors outside the magnets; zero without such a pose.
    """
    position_m, R = spread_poses(body, array, _N_POSES)
    magnets, _ = placed_magnets(body, position_m, R)
    distance_m = np.linalg.norm(magnets[:, :, None] - array.positions, axis=-1).min(axis=-1)
    inner_m = [_inner_radius(magnet) if magnet.shape is not None else 0.0 for magnet in body.magnets]
    outside = (distance_m > inner_m).all(axis=1)
    if not outside.any():
        return 0.0, math.inf
    moments = np.linalg.norm(body.moments_Am2, axis=1)
    field_T = 2.0 * MU0_OVER_4PI * moments / distance_m[outside] ** 3
    return float(distance_m[outside].min()), float(field_T.max())
