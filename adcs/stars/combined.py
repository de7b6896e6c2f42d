"""Combination of fixes of several star cameras into readings of one star tracker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from adcs.stars.identification import NoFix, StarFix
from arrays.typing import FloatArray


class StarReadings(NamedTuple):
    """Attitudes of a body from its star cameras.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Ascending times.
    rotation : Rotation of n
        Attitudes, catalogue from body.
    covariance_rad2 : ndarray, shape (n, 3, 3)
        Covariance of a small rotation about the body's axes.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite").telemetry
    >>> log.star_covariance_rad2.shape == (len(log.time_s), 3, 3)
    True
    """

    time_s: FloatArray
    rotation: Rotation
    covariance_rad2: FloatArray


def combined_star_fixes(
    time_s: ArrayLike, fixes: Sequence[StarFix | NoFix], body_from_frame: Rotation | Sequence[Rotation]
) -> StarReadings:
    r"""Combine fixes of star cameras into the attitude of their body at each instant with a fix.

    A camera measures the rotation about its line of sight about ten times worse than rotations across it. Two cameras
    with different lines of sight measure all three well. Fixes of one instant are averaged by their information,
    :math:`\delta\theta = (\sum C_k^{-1})^{-1} \sum C_k^{-1} \delta\theta_k`, all about the body's axes.

    Parameters
    ----------
    time_s : array_like, shape (m,)
        Times of the fixes, in any order.
    fixes : sequence of StarFix or NoFix
        Results of :func:`adcs.identify_stars`; NoFix is ignored.
    body_from_frame : Rotation or sequence of Rotation
        Mounting of the camera, common to all fixes or one for each. The camera frame has x to the right, y up, z out of
        the sky.

    Returns
    -------
    StarReadings
        Readings for ``adcs.Telemetry(time_s, star=rotation, star_covariance_rad2=covariance_rad2)``.

    Raises
    ------
    ValueError
        There is no fix, or the numbers of times, fixes and mountings differ.

    Examples
    --------
    >>> import adcs
    >>> from scipy.spatial.transform import Rotation
    >>> fixes = adcs.identify_stars(catalogue, camera, images)  # doctest: +SKIP
    >>> adcs.combined_star_fixes(time_s, fixes, Rotation.identity())  # doctest: +SKIP
    """
    times = np.asarray(time_s, dtype=np.float64)
    mounted = [body_from_frame] * len(fixes) if isinstance(body_from_frame, Rotation) else list(body_from_frame)
    if times.shape != (len(fixes),) or len(mounted) != len(fixes):
        raise ValueError(
            f"Inputs time_s and body_from_frame must have one for each of the {len(fixes)} fixes; instead received "
            f"{times.size} and {len(mounted)}."
        )
    solved = [
        (t, fix, R.as_matrix()) for t, fix, R in zip(times, fixes, mounted, strict=True) if isinstance(fix, StarFix)
    ]
    if not solved:
        raise ValueError("Input fixes must have a fix; instead received none.")
    instants = np.unique([t for t, *_ in solved])
    rotations, covariances = [], []
    for instant in instants:
        there = [(fix.pose, R) for t, fix, R in solved if t == instant]
        attitudes = [pose.R_catalogue_from_frame @ R.T for pose, R in there]
        information = [np.linalg.inv(R @ pose.covariance[:3, :3] @ R.T) for pose, R in there]
        turns = [Rotation.from_matrix(attitudes[0].T @ attitude).as_rotvec() for attitude in attitudes]
        covariance = np.linalg.inv(np.sum(information, axis=0))
        mean = covariance @ np.sum([one @ turn for one, turn in zip(information, turns, strict=True)], axis=0)
        rotations.append(attitudes[0] @ Rotation.from_rotvec(mean).as_matrix())
        covariances.append(covariance)
    return StarReadings(instants, Rotation.from_matrix(np.array(rotations)), np.array(covariances))
