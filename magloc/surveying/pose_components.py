"""How wrong the pose of a survey is, as its own rows tell, where nothing is stated: variance components."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from arrays.pose import PoseUncertainty
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.rounds import Model

UNSTATED = PoseUncertainty(position_m=0.02, attitude_rad=math.radians(0.5))
"""What is assumed until targets tell more."""
_POSITIONS_M = (0.005, 0.01, 0.02, 0.04, 0.08)
_CORRELATIONS_S = (0.0, 2.0, 10.0, 40.0)


def with_likeliest_pose(model: Model, sources: Sources) -> Model:
    """The model whose errors of the pose have the largest likelihood where sources are: how lasting, and how large."""
    every = np.arange(len(model.record))

    def likeliest(poses: Iterable[PoseUncertainty]) -> PoseUncertainty:
        return min(poses, key=lambda pose: with_pose(model, pose).misfit(sources, every))

    lasting = likeliest(replace(UNSTATED, correlation_s=seconds) for seconds in _CORRELATIONS_S)
    large = likeliest(replace(lasting, position_m=metres) for metres in _POSITIONS_M)
    return with_pose(model, likeliest(replace(large, correlation_s=seconds) for seconds in _CORRELATIONS_S))


def with_pose(model: Model, pose: PoseUncertainty) -> Model:
    """The model where some uncertainty of the pose is stated."""
    return replace(model, record=model.record.with_pose(pose), errors=PoseErrors.of(pose))
