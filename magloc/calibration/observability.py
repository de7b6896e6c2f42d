"""Directions in which the unknowns of an array change without effect on the readings.

Without a known path the array may move and turn as a whole. With an unknown moment the size of the array or all of its
gains may change. A common offset of all sensors is a common field. These directions are the gauges. A path in a plane
or along a line, trusted sensors and unknowns that are not estimated change the list. Therefore it is derived from the
null space of the information matrix, which is described by the gauges where they span it.
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
    CalibrationProblem,
    CalibrationState,
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
    """A direction in which the sensors' unknowns do not affect the readings.

    Attributes
    ----------
    name : str
        Description of the change: one gauge, a combination of gauges, or the unknowns that change most.
    information : float
        Information of the readings, relative to the prior; 0 if they do not depend on it.
    """

    name: str
    information: float


def gauge_vectors(problem: CalibrationProblem, state: CalibrationState) -> dict[str, FloatArray]:
    """Return the sensors' unknowns along every gauge, (N, 15) in prior standard deviations."""
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


def unobservable_directions(
    problem: CalibrationProblem, state: CalibrationState, information: FloatArray
) -> tuple[Unobservable, ...]:
    """Return the directions without information in (F, F), the gauges first."""
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
        found.append(Unobservable(_describe(problem, direction, seen), max(0.0, told)))
    if _mirror_cost(problem, state) < _MIRRORED_WITHIN:
        found.append(Unobservable("mirror image: every position inverted through one point", 0.0))
    return tuple(found)


def _describe(problem: CalibrationProblem, direction: FloatArray, gauges: dict[str, FloatArray]) -> str:
    """Describe a direction by gauges, else by the unknowns that change most."""
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


def unknown_name(problem: CalibrationProblem, index: int) -> str:
    """Return the name of one of the sensors' 15 N unknowns, as ``s1 position x``."""
    sensor, k = divmod(index, PER_SENSOR)
    name = problem.array.ids[sensor]
    if k < AXES.start:
        return f"{name} {'position' if k < GAINS.start else 'gain'} {'xyz'[k % 3]}"
    if k >= OFFSET.start:
        return f"{name} offset {'xyz'[k - OFFSET.start]}"
    channel, component = AXIS_PAIRS[k - AXES.start]
    return f"{name} axis {'xyz'[channel]} towards {'xyz'[component]}"


def _mirror_cost(problem: CalibrationProblem, state: CalibrationState) -> float:
    """Return how much the priors' χ² rises if sensors and path are inverted through a point.

    No reading shows such an inversion.
    """
    if problem.is_on_path or not problem.free[:, POSITION].all():
        return np.inf
    nominal = problem.array.positions
    weight = problem.prior[:, POSITION] ** -2
    here = nominal + state.sensors[:, POSITION]
    # The best point of inversion q minimises the sum of ((2 q - here - nominal) / prior)².
    twice = np.sum(weight * (here + nominal), axis=0) / np.sum(weight, axis=0)
    mirrored = np.sum(weight * (twice - here - nominal) ** 2)
    return float(mirrored - np.sum(weight * state.sensors[:, POSITION] ** 2))
