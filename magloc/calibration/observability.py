"""Directions in which the unknowns of an array change without effect on the readings.

Without a known path the array may move and turn as a whole. With an unknown moment the size of the array or all of its
gains may change. A common offset of all sensors is a common field. These directions are the gauges. A path in a plane
or along a line, trusted sensors and unknowns that are not estimated change the list. Therefore it is derived from the
null space of the information matrix, which is described by the gauges where they span it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.calibration.model import CalibrationProblem, CalibrationState
from magloc.calibration.sensors import (
    AXES,
    AXIS_PAIRS,
    GAINS,
    OFFSET,
    PER_SENSOR,
    POSITION,
    SensorProblem,
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
    """A direction in which the sensors' unknowns do not affect the readings.

    Attributes
    ----------
    name : str
        Description of the change: one gauge, a combination of gauges, or the unknowns that change most.
    information : float
        Information of the readings, relative to the prior; 0 if they do not depend on it.
    prior : float
        Standard deviation that the prior allows: of a gauge in its own unit (m, rad, T, or a fraction), 1 for a
        direction that mixes unknowns.
    """

    name: str
    information: float
    prior: float = 1.0


def gauge_vectors(problem: SensorProblem[State], state: State) -> dict[str, FloatArray]:
    """Return the sensors' unknowns along every gauge, (N, 15) in prior standard deviations."""
    array, n = problem.array, problem.array.n_sensors
    relative = array.positions + state.sensors[:, POSITION]
    relative = relative - relative.mean(axis=0)
    response = responses(array, state.sensors)
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


def unobservable_of_source(
    problem: CalibrationProblem, state: CalibrationState, information: FloatArray
) -> tuple[Unobservable, ...]:
    """Return the directions of the sensors' unknowns without information in (F, F), the gauges first."""
    gauges = {name: vector.ravel() for name, vector in gauge_vectors(problem, state).items()}
    free = problem.free.ravel()
    found = unobservable_directions(information, gauges, free, lambda index: unknown_name(problem.array, index))
    if _mirror_cost(problem, state) < _MIRRORED_WITHIN:
        found += (Unobservable("mirror image: every position inverted through one point", 0.0),)
    return found


def unobservable_directions(
    information: FloatArray, gauges: dict[str, FloatArray], free: BoolArray, name_of: Callable[[int], str]
) -> tuple[Unobservable, ...]:
    """Return the directions without information in (p, p), the gauges first.

    Parameters
    ----------
    information : ndarray, shape (p, p)
        Information of the readings, in units of the prior's.
    gauges : dict
        Changes of all P unknowns along every gauge, (P,) in prior standard deviations.
    free : ndarray of bool, shape (P,)
        True for the p unknowns that are estimated.
    name_of : callable
        Name of one of the P unknowns.
    """
    if not len(information):
        return ()
    value, vector = np.linalg.eigh(information)
    limit = max(UNSEEN, _ROUNDING * len(value) * float(value[-1]))
    null = vector[:, value < limit]
    found, units, seen = [], [], {}
    for name, full in gauges.items():
        length = float(np.linalg.norm(full))
        whole = full / length
        unit = whole[free]
        told = float(unit @ information @ unit)
        held = np.linalg.norm(unit) < 1.0 - 1e-6  # a part of it is trusted or not estimated
        if held or told >= limit:
            seen[name] = whole
        else:
            found.append(Unobservable(name, max(0.0, told), 1.0 / length))
            units.append(unit)
    if units:
        basis, _ = np.linalg.qr(np.stack(units, axis=1))
        null = null - basis @ (basis.T @ null)
    left, size, _ = np.linalg.svd(null, full_matrices=False)
    for direction in left[:, size > 0.5].T:
        told = float(direction @ information @ direction)
        whole = np.zeros(len(free))
        whole[free] = direction
        found.append(Unobservable(_describe(whole, seen, name_of), max(0.0, told)))
    return tuple(found)


def _describe(whole: FloatArray, gauges: dict[str, FloatArray], name_of: Callable[[int], str]) -> str:
    """Describe a direction (P,) by gauges, else by the unknowns that change most."""
    if gauges:
        columns = np.stack(list(gauges.values()), axis=1)
        share, *_ = np.linalg.lstsq(columns, whole, rcond=None)
        if np.linalg.norm(columns @ share - whole) < _UNEXPLAINED:
            taking_part = np.flatnonzero(np.abs(share) > 0.1 * np.abs(share).max())
            return "combination of " + ", ".join(list(gauges)[k] for k in taking_part)
    return "mostly " + ", ".join(name_of(int(k)) for k in np.argsort(-np.abs(whole))[:3])


def unknown_name(array: SensorArray, index: int) -> str:
    """Return the name of one of the sensors' 15 N unknowns, as ``s1 position x``."""
    sensor, k = divmod(index, PER_SENSOR)
    name = array.ids[sensor]
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
