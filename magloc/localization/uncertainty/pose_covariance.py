"""Covariance of fixes in the world frame by errors of the array's pose."""

from __future__ import annotations

import numpy as np

from arrays.pose import PoseUncertainty
from arrays.typing import FloatArray
from magloc.localization.fit.columns import Solutions
from magloc.measurement.pose import ArrayPose, PoseErrors, rates_of
from magloc.readings import Readings


def pose_covariances(uncertainty: PoseUncertainty, rows: Readings, solutions: Solutions) -> FloatArray:
    """Return covariances (F, n, n) by pose errors, to add to solutions moved to the world.

    All sources of a row share the row's errors. For a source at a known position only the moment rotates.
    """
    added = np.zeros_like(solutions.covariance)
    if rows.pose is None:
        return added
    errors, lever_arm_m = PoseErrors.of(uncertainty), np.array(uncertainty.lever_arm_m)
    position_m, R = rows.pose[0], rows.pose[1].as_matrix()
    velocity_m_s, rate_rad_s = rates_of(rows.time_s, position_m, R)
    in_array = np.concatenate([solutions.position_m, solutions.moment_Am2], axis=2)
    moment_alone = added.shape[1] < in_array.shape[1] * in_array.shape[2]
    for f, i in enumerate(solutions.of_row.tolist()):
        pose = ArrayPose(position_m[i], R[i], velocity_m_s[i], rate_rad_s[i], lever_arm_m)
        E = errors.effect(pose, None if rows.pose_sigma is None else rows.pose_sigma[i])
        J = np.concatenate([pose.world_jacobian(source)[3 if moment_alone else 0 :] @ E for source in in_array[f]])
        added[f] = J @ J.T
    return added
