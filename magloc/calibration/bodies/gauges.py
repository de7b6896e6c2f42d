"""Directions in which the unknowns of sensors and magnets change without effect on the readings.

With unknown poses the array and the body may each move and rotate as a whole. All gains may change against the
strength of the magnets, and with unknown poses the size of both, too. Known poses without rotation leave a common
translation of sensors and magnets, and a single known pose leaves their common rotation too.
"""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.bodies.body import PoseLimits
from magloc.calibration.bodies.model import (
    DIRECTION,
    PER_MAGNET,
    STRENGTH,
    BodyProblem,
    BodyState,
    across,
    changed_body,
)
from magloc.calibration.observability import Unobservable, gauge_vectors, unknown_name, unobservable_directions
from magloc.calibration.sensors import POSITION
from magloc.navigation.rotations import turn_of_change

_FRAME_SIGMAS = 3.0


def body_gauges(problem: BodyProblem, state: BodyState) -> dict[str, FloatArray]:
    """Return the unknowns of sensors and magnets along every gauge, (15 N + 6 K,) in prior standard deviations."""
    of_array = gauge_vectors(problem, state)
    body = changed_body(problem.body, state.magnets)
    places, axes = body.positions_m - body.centre_m, across(problem.body)
    none, still, zero = np.zeros(problem.magnet_prior.shape), np.zeros(problem.prior.shape), np.zeros(3)
    rotations = np.einsum("kda,kd->ka", across(problem.body), state.magnets[:, DIRECTION])
    # A rotation of the body is one by two angles across each nominal moment, and one about the moment itself.
    along = body.moments_Am2 / np.linalg.norm(body.moments_Am2, axis=1, keepdims=True)
    frames = np.concatenate([turn_of_change(rotations) @ np.swapaxes(axes, -1, -2), along[..., None]], axis=-1)

    def magnets(place: FloatArray, turn: FloatArray, strength: float) -> FloatArray:
        strengths = strength * (1.0 + state.magnets[:, STRENGTH])
        angles = (np.linalg.inv(frames) @ turn)[:, :2]
        return np.concatenate([np.broadcast_to(place, places.shape), strengths, angles], axis=1) / problem.magnet_prior

    units = dict(zip("xyz", np.eye(3), strict=True))
    pairs = {f"array: translation along {name}": (of_array[f"translation along {name}"], none) for name in units}
    pairs |= {f"array: rotation about {name}": (of_array[f"rotation about {name}"], none) for name in units}
    pairs |= {f"body: translation along {name}": (still, magnets(unit, zero, 0.0)) for name, unit in units.items()}
    for name, unit in units.items():
        pairs[f"body: rotation about {name}"] = still, magnets(np.cross(unit, places), unit, 0.0)
    pairs |= {f"common offset along {name}": (of_array[f"common offset along {name}"], none) for name in units}
    size, gain = of_array["size of the array against the moment"], of_array["common gain against the moment"]
    shifts = np.stack([of_array[f"translation along {name}"] for name in units])
    known = np.flatnonzero(problem.has_pose)
    if known.size:
        # Known poses stay, so that array and body change together, about the array's origin.
        R, origin, centre = problem.pose_R[known[0]], problem.pose_m[known[0]], problem.array.positions.mean(axis=0)
        centre = centre + state.sensors[:, POSITION].mean(axis=0)
        in_array = origin + body.positions_m @ R.T
        size, places = size + np.tensordot(centre, shifts, 1), in_array @ R
        for name, unit in units.items():
            shift = of_array[f"translation along {name}"]
            pairs[f"array and body together: translation along {name}"] = shift, magnets(unit @ R, zero, 0.0)
            turn = of_array[f"rotation about {name}"] + np.tensordot(np.cross(unit, centre), shifts, 1)
            turned = magnets(np.cross(unit, in_array) @ R, unit @ R, 0.0)
            pairs[f"array and body together: rotation about {name}"] = turn, turned
    pairs["size of array and body against the strength of the magnets"] = size, magnets(places, zero, 3.0)
    pairs["common gain against the strength of the magnets"] = gain, magnets(zero, zero, -1.0)
    return {name: np.concatenate([one.ravel(), other.ravel()]) for name, (one, other) in pairs.items()}


def unobservable_of_body(problem: BodyProblem, state: BodyState, information: FloatArray) -> tuple[Unobservable, ...]:
    """Return the directions of sensors and magnets without information in (p, p), the gauges first."""
    free = np.concatenate([problem.free.ravel(), np.ones(problem.n_globals, dtype=np.bool_)])

    def name_of(index: int) -> str:
        return unknown_name(problem.array, index) if index < problem.free.size else _name_of_magnet(problem, index)

    return unobservable_directions(information, body_gauges(problem, state), free, name_of)


def wider_limits(problem: BodyProblem, unobservable: tuple[Unobservable, ...]) -> PoseLimits:
    """Return the body's limits in the frames of a calibration.

    Unknown poses leave open where array and body stand in their frames. In these frames the same motion reaches
    farther: by three standard deviations of the prior of their translations, rotations and size.
    """
    limits = problem.body.limits
    if problem.has_pose.any():
        return limits
    middle = np.mean([limits.low_m, limits.high_m], axis=0) if limits.is_bounded else problem.array.centroid
    of_array, of_body = (float(np.linalg.norm(x)) for x in (middle - problem.array.centroid, problem.body.centre_m))
    squares_m, squares_rad = [0.0], [0.0]
    for part in unobservable:
        if "translation along" in part.name:
            squares_m.append(part.prior**2)
        elif "rotation about" in part.name:
            squares_rad.append(part.prior**2)
            squares_m.append((part.prior * (of_body if part.name.startswith("body") else of_array)) ** 2)
        elif part.name.startswith("size"):
            squares_m.append((part.prior * of_array) ** 2)
    # Each axis has one of three translations and rotations.
    margin_m, margin_rad = (_FRAME_SIGMAS * math.sqrt(sum(squares) / 3.0) for squares in (squares_m, squares_rad))
    low, high = np.subtract(limits.low_m, margin_m), np.add(limits.high_m, margin_m)
    return PoseLimits(tuple(low.tolist()), tuple(high.tolist()), min(limits.angle_rad + margin_rad, math.pi))


def _name_of_magnet(problem: BodyProblem, index: int) -> str:
    magnet, k = divmod(index - problem.free.size, PER_MAGNET)
    quantity = f"position {'xyz'[k]}" if k < 3 else ("strength" if k == 3 else "direction")
    return f"magnet {problem.body.ids[magnet]} {quantity}"
