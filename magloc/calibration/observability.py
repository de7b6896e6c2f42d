"""What readings of a moving source cannot tell about an array: directions in which its unknowns change unseen.

Without a known path the array may be moved and turned as a whole, and with the source's moment unknown it may be
scaled, or all of its gains may; a common offset of all sensors is a common field. These are the gauges. A path in a
plane or along a line, sensors that are trusted and unknowns that are not estimated change the list, so that it is found
from the information matrix: its null space, described by the gauges where they span it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc.calibration.model import (
    AXES,
    AXIS_PAIRS,
    GAINS,
    OFFSET,
    PER_SENSOR,
    POSITION,
    Problem,
    State,
    responses,
    unknowns,
)

UNSEEN = 1e-3
"""Information, in units of the prior's, below which a direction counts as unobservable."""
_ROUNDING = 1e-15
_UNEXPLAINED = 0.1
_MIRRORED_WITHIN = 20.0


@dataclass(frozen=True)
class Unobservable:
    """A direction in which the unknowns of the sensors may change without any effect on the readings.

    Attributes
    ----------
    name : str
        What changes: one gauge, a combination of gauges, or the unknowns that change most.
    information : float
        What the readings tell of it, relative to the prior; 0 is nothing.
    """

    name: str
    information: float


def gauge_vectors(problem: Problem, state: State) -> dict[str, FloatArray]:
    """How the sensors' unknowns change along every gauge at a state, each (N, 15) in prior standard deviations."""
    array, n = problem.array, problem.array.n_sensors
    relative = array.positions + state.sensors[:, POSITION]
    relative = relative - relative.mean(axis=0)
    response = responses(problem, state)
    nominal = array.channel_gain.reshape(-1, 3, 3)
    vectors = {}
    for axis, name in enumerate("xyz"):
        unit = np.eye(3)[axis]
        vectors[f"translation along {name}"] = unknowns(n, position=unit)
        turned = np.cross(unit, np.eye(3)).T
        vectors[f"rotation about {name}"] = unknowns(
            n, position=relative @ turned.T, response=-response @ turned @ np.linalg.inv(nominal)
        )
        vectors[f"common offset along {name}"] = unknowns(n, offset=response @ unit)
    vectors["size of the array against the moment"] = unknowns(n, position=relative)
    vectors["common gain against the moment"] = unknowns(n, response=response @ np.linalg.inv(nominal))
    return {name: vector / problem.prior for name, vector in vectors.items()}


def unobservable(problem: Problem, state: State, information: FloatArray) -> tuple[Unobservable, ...]:
    """Directions that the information (F, F) about the sensors' free unknowns does not tell, the gauges first."""
    if not len(information):
        return ()
    value, vector = np.linalg.eigh(information)
    limit = max(UNSEEN, _ROUNDING * len(value) * float(value[-1]))
    null = vector[:, value < limit]
    free = problem.free.ravel()
    found, seen = [], {}
    for name, full in gauge_vectors(problem, state).items():
        whole = full.ravel() / np.linalg.norm(full)
        unit = whole[free]
        told = float(unit @ information @ unit)
        held = np.linalg.norm(unit) < 1.0 - 1e-6  # a part of it is trusted or not estimated
        if held or told >= limit:
            seen[name] = whole
        else:
            found.append(Unobservable(name, max(0.0, told)))
            null = null - np.outer(unit, unit @ null)
    left, size, _ = np.linalg.svd(null, full_matrices=False)
    for direction in left[:, size > 0.5].T:
        told = float(direction @ information @ direction)
        found.append(Unobservable(_described(problem, direction, seen), max(0.0, told)))
    if _mirrored_cost(problem, state) < _MIRRORED_WITHIN:
        found.append(Unobservable("mirror image: every position inverted through one point", 0.0))
    return tuple(found)


def _described(problem: Problem, direction: FloatArray, gauges: dict[str, FloatArray]) -> str:
    """A direction as a combination of gauges that moves nothing that is held, or by the unknowns that change most."""
    whole = np.zeros(problem.free.size)
    whole[problem.free.ravel()] = direction
    if gauges:
        columns = np.stack(list(gauges.values()), axis=1)
        share, *_ = np.linalg.lstsq(columns, whole, rcond=None)
        if np.linalg.norm(columns @ share - whole) < _UNEXPLAINED:
            taking_part = np.flatnonzero(np.abs(share) > 0.1 * np.abs(share).max())
            return "combination of " + ", ".join(list(gauges)[k] for k in taking_part)
    where = np.flatnonzero(problem.free.ravel())
    largest = where[np.argsort(-np.abs(direction))[:3]]
    return "mostly " + ", ".join(unknown_name(problem, int(k)) for k in largest)


def unknown_name(problem: Problem, index: int) -> str:
    """Name of one of the 15 N unknowns of the sensors, as ``s1 position x``."""
    sensor, k = divmod(index, PER_SENSOR)
    name = problem.array.ids[sensor]
    if k < AXES.start:
        return f"{name} {'position' if k < GAINS.start else 'gain'} {'xyz'[k % 3]}"
    if k >= OFFSET.start:
        return f"{name} offset {'xyz'[k - OFFSET.start]}"
    channel, component = AXIS_PAIRS[k - AXES.start]
    return f"{name} axis {'xyz'[channel]} towards {'xyz'[component]}"


def _mirrored_cost(problem: Problem, state: State) -> float:
    """Rise of the priors' χ² when sensors and path are inverted through a point, which no reading shows."""
    if not (problem.unknown_position and problem.free[:, POSITION].all()):
        return np.inf
    nominal = problem.array.positions
    weight = problem.prior[:, POSITION] ** -2
    here = nominal + state.sensors[:, POSITION]
    # The best point of inversion q minimises the sum of ((2 q - here - nominal) / prior)².
    twice = np.sum(weight * (here + nominal), axis=0) / np.sum(weight, axis=0)
    mirrored = np.sum(weight * (twice - here - nominal) ** 2)
    return float(mirrored - np.sum(weight * state.sensors[:, POSITION] ** 2))
