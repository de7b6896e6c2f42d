"""Manoeuvres that would determine what a log does not.

Each manoeuvre is a series of attitudes and currents. Its information about the parameters, with the attitude known up
to a common rotation, is added to that of the log; the first manoeuvre that makes a term small enough is named.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from adcs.log_calibration.fit import LogFit
from adcs.log_calibration.parameters import INCLINATION, MODULUS
from adcs.log_calibration.terms import Terms, is_throttle
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

_POINTS = 48
_NOISE_uT = 0.3
_COMMON_RAD = np.array([0.05, 0.05, 1.0])
_TILT_RAD = math.radians(45.0)
_CURRENT = "change {} by {:g} at a constant attitude"
_THROTTLE, _CURRENT_A = 0.5, 10.0
PLACE = "state place and date (--place, --date)"
_LAG = "turn quickly to and fro about the yaw axis"
_REST = "rest for ten seconds"
_SIDES = "rest on several sides"
_FAULT = "correct the faults that the warnings name"


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """Attitudes and currents of a manoeuvre.

    Attributes
    ----------
    words : str
        Instruction to the pilot.
    rotation : Rotation
        Attitudes (n), world from body.
    current : ndarray, shape (n, J)
    """

    words: str
    rotation: Rotation
    current: FloatArray


def manoeuvres(fit: LogFit) -> Iterator[Manoeuvre]:
    """Yield manoeuvres from the easiest to the most laborious one."""
    problem = fit.estimate.problem
    mean = np.array([np.mean(one.values) for one in problem.currents])
    size = [_THROTTLE if is_throttle(name) else _CURRENT_A for name in problem.layout.currents]
    steady = np.tile(mean, (_POINTS, 1))
    part = np.linspace(0.0, 1.0, _POINTS)
    swing = _TILT_RAD * np.sin(2.0 * np.pi * part)
    turns = {
        "turn once about the yaw axis, level": Rotation.from_rotvec(np.outer(2.0 * np.pi * part, [0.0, 0.0, 1.0])),
        "turn about the roll axis, 45° to each side": Rotation.from_rotvec(np.outer(swing, [1.0, 0.0, 0.0])),
        "turn about the pitch axis, 45° to each side": Rotation.from_rotvec(np.outer(swing, [0.0, 1.0, 0.0])),
    }
    yield from (Manoeuvre(words, rotation, steady) for words, rotation in turns.items())
    for k, name in enumerate(problem.layout.currents):
        change = steady.copy()
        change[:, k] += size[k] * (part - 0.5)
        yield Manoeuvre(_CURRENT.format(name, size[k]), Rotation.identity(_POINTS), change)
    four = [
        Rotation.from_rotvec([0.0, 0.0, heading]) * Rotation.from_rotvec(np.outer(swing, axis))
        for heading in 0.5 * np.pi * np.arange(4)
        for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    ]
    yield Manoeuvre("turn about the roll and the pitch axis on four headings", Rotation.concatenate(four), steady[:1])


def advice(fit: LogFit, terms: Terms) -> list[str]:
    """Return an instruction for each term, empty for terms that are determined."""
    determined = terms.determined
    words = ["" for _ in terms.names]
    fixed = {"lag": _LAG, "gyro": _REST, "accelerometer": _SIDES}
    if not fit.estimate.problem.field.is_known:
        fixed["scale"] = PLACE
    for i in np.flatnonzero(~determined):
        words[i] = fixed.get(terms.kinds[i], "") if terms.largest[i] > 0.0 else _FAULT
    if all(words[i] for i in np.flatnonzero(~determined)):
        return words
    last = ""
    for manoeuvre in manoeuvres(fit):
        information = fit.solution.information + _information(fit, manoeuvre)
        covariance = np.linalg.pinv(information, hermitian=True)
        sigma = np.sqrt(np.einsum("qi,ij,qj->q", terms.jacobian, covariance, terms.jacobian))
        now = terms.are_determined(sigma)
        for i in np.flatnonzero(~determined & now):
            words[i] = words[i] or manoeuvre.words
        last = manoeuvre.words
    return [word if word or known else last for word, known in zip(words, determined, strict=True)]


def _information(fit: LogFit, manoeuvre: Manoeuvre) -> FloatArray:
    """Return the information of a manoeuvre about the parameters."""
    at = fit.estimate
    layout, p = at.problem.layout, at.parameters
    b, by_inclination = at.field_uT
    R = manoeuvre.rotation.as_matrix()
    n = len(R)
    current = np.broadcast_to(manoeuvre.current, (n, len(layout.currents)))
    J = np.zeros((len(layout.magnetometers), n, 3, 3 + layout.size))
    for m in range(len(layout.magnetometers)):
        turned = p[layout.matrix(m)].reshape(3, 3) @ R.transpose(0, 2, 1)
        body = R.transpose(0, 2, 1) @ b
        J[m, :, :, :3] = turned @ cross_matrix(b)
        J[m, :, :, 3 + MODULUS] = turned @ b
        J[m, :, :, 3 + INCLINATION] = turned @ by_inclination
        for i in range(3):
            J[m, :, i, 3 + layout.matrix(m).start + 3 * i : 3 + layout.matrix(m).start + 3 * i + 3] = body
            J[m, :, i, 3 + layout.offset(m).start + i] = 1.0
            J[m, :, i, 3 + layout.current(m).start + i : 3 + layout.current(m).stop : 3] = current
    flat = J.reshape(-1, 3 + layout.size) / _NOISE_uT
    whole = flat.T @ flat
    whole[:3, :3] += np.diag(_COMMON_RAD**-2.0)
    return np.asarray(whole[3:, 3:] - whole[3:, :3] @ np.linalg.solve(whole[:3, :3], whole[:3, 3:]))
