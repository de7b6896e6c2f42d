"""Properties of targets from fitted sources: covariance, interval of the depth, flags."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.fields.multipole import multipole_field_matrix
from magloc.surveying.fit.joint_fit import JointFit, SurveyBackground, jacobian_of, residual_of, with_free_sources
from magloc.surveying.rounds import NEAR, WHILE_SEARCHING, Groups, SurveyModel, residuals_above
from magloc.surveying.search import WINDOW, groups_near, likeliest_moments, normal_equations

TARGET_ENTRIES = ("position_m", "moment_Am2", "covariance", "depth_interval95_m", "significance", "flags")
_WEAK = 200.0
_MISFIT = 1.5  # χ² per reading
_LASTING = 3.72  # standard deviations, one-sided
_N_DEPTHS = 16
_SPAN = 3.0  # factor above and below the depth
_N_SECOND = 9  # degrees of freedom of a second source
_FALSE_MERGED = 0.01  # false alarms among single sources
_WITHIN, _N_BESIDE, _DEEPER, _N_BELOW = 1.0, 7, 1.6, 5  # places of a second source, over the distance
_SIGMAS, _STEPS = 3.0, 9  # places on the map, in standard deviations of the position


class Profile(NamedTuple):
    """95 % interval of the depth, and scatter (2, 2) on the map, from a profile of χ²."""

    depth_interval95_m: tuple[float, float]
    scatter_m2: FloatArray


def profile_of(model: SurveyModel, fit: JointFit, background: SurveyBackground, which: int) -> Profile:
    """Return the profile of a weak source over its place and moment.

    The other sources are linearised; places are weighted by their likelihood.
    """
    record, white = model.record, background.white
    source = fit.sources.some(np.array([which]))
    others = fit.sources.some(np.delete(np.arange(len(fit.sources)), which))
    position = source.position_m[0]
    # Twice the range of a search, because the far tail distinguishes a target from the ground.
    reach = 2.0 * WINDOW * float(record.height_above(position))
    used = groups_near(record, white, source.position_m, reach)
    near = np.linalg.norm(others.position_m[:, :2] - position[:2], axis=1) < reach
    Q = with_free_sources(record, background, others.some(near))
    # The source is weak, so its own part is added back to first order.
    own_field, fields = source.fields(record), fit.sources.fields(record)
    own = jacobian_of(record, background, source, own_field)[:, 3:] @ source.moment_Am2[0]
    left = residual_of(record, background, fields) + own
    left = left - Q @ (Q.T @ left)
    directions = record.directions(fields)
    terrain, bounds = record.terrain, model.bounds
    depth = float(terrain.depth_of(position))
    least, most = terrain.height_m - bounds.high_m[2], terrain.height_m - bounds.low_m[2]
    depths = np.geomspace(max(least, depth / _SPAN), min(most, depth * _SPAN), _N_DEPTHS)
    sigma = np.sqrt(np.diagonal(fit.covariance)[6 * which : 6 * which + 2])
    offset = np.linspace(-_SIGMAS, _SIGMAS, _STEPS)
    beside = np.stack(np.meshgrid(sigma[0] * offset, sigma[1] * offset, indexing="ij"), axis=-1).reshape(-1, 2)
    of_place = np.empty((_N_DEPTHS, len(beside)))
    for i, at in enumerate(depths):
        flat = np.column_stack([position[:2] + beside, np.full(len(beside), terrain.height_m - at)])
        places = terrain.drape(flat)
        _, projected, v = normal_equations(record, white, directions, places, used, Q, left)
        of_place[i] = np.sum(v * np.linalg.solve(projected, v[..., None])[..., 0], axis=1)
    weight = np.exp(0.5 * (of_place - of_place.max())).sum(axis=0)
    scatter = (beside.T * weight) @ beside / weight.sum()
    explained = of_place.max(axis=1)
    level = explained.max() - chdtri(1, 0.05)
    inside = np.flatnonzero(explained > level)
    low, high = (
        math.exp(np.interp(level, explained[[beyond, last]], np.log(depths[[beyond, last]])))
        for beyond, last in ((max(inside[0] - 1, 0), inside[0]), (min(inside[-1] + 1, _N_DEPTHS - 1), inside[-1]))
    )
    # The profile is linear in the other sources, so its peak may differ from the fit; include both.
    return Profile((min(low, depth), max(high, depth)), scatter)


def _with_scatter(covariance: FloatArray, scatter_m2: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a source with another scatter on the map."""
    on_map = covariance[:2, :2]
    follows = np.linalg.solve(on_map, covariance[:2]).T
    return np.asarray(covariance + follows @ (scatter_m2 - on_map) @ follows.T)


def second_source_chi2(
    model: SurveyModel,
    background: SurveyBackground,
    directions: FloatArray,
    Q: FloatArray,
    left: FloatArray,
    position: FloatArray,
) -> float:
    """Return χ² of a score test for a second source near a position.

    It is the χ² of the residuals that quadrupole and octupole at the position would explain. Two dipoles near each
    other equal one dipole, quadrupole and octupole at their middle, to third order of the gap. Q projects out
    everything else, including the source's position, so that 9 of 12 degrees of freedom remain.
    """
    record, white = model.record, background.white
    near = groups_near(record, white, position[None], WINDOW * float(record.height_above(position)))
    rows, of = np.flatnonzero(np.isin(white.group, near)), white.entries(near)
    fields = np.concatenate(
        [multipole_field_matrix(record.sensors_m[rows], position, order) for order in (2, 3)], axis=-1
    )
    seen = np.einsum("nci,ncij->ncj", directions[rows], fields[:, record.array.channel_sensor])
    A = white.of_some(seen, near)
    A = A / np.linalg.norm(A, axis=0)
    lost = Q[of].T @ A
    # 1 - QQᵀ is a weight, not a projector: apply it once; ``left`` already includes it.
    size, axes = np.linalg.eigh(A.T @ A - lost.T @ lost)
    return float(np.sum((axes.T @ (A.T @ left[of]))[-_N_SECOND:] ** 2 / size[-_N_SECOND:]))


def shift_by_second(
    model: SurveyModel, fit: JointFit, background: SurveyBackground, Q: FloatArray, left: FloatArray, which: int
) -> FloatArray:
    """Return the change of position and moment (6,) by the likeliest second source.

    The result is of first order. Q projects out all sources; ``left`` is the residual.
    """
    record, white = model.record, background.white
    fields = fit.sources.fields(record)
    directions = record.directions(fields)
    position = fit.sources.position_m[which]
    distance = float(record.height_above(position))
    used = groups_near(record, white, position[None], WINDOW * distance)
    beside = distance * np.linspace(-_WITHIN, _WITHIN, _N_BESIDE)
    below = record.height_m - distance * np.geomspace(1.0 / _DEEPER, _DEEPER, _N_BELOW)
    below = np.unique(np.clip(below, model.bounds.low_m[2], model.bounds.high_m[2]))
    box = np.stack(np.meshgrid(position[0] + beside, position[1] + beside, below, indexing="ij"), axis=-1)
    places = record.terrain.drape(box.reshape(-1, 3))
    moments, explained = likeliest_moments(*normal_equations(record, white, directions, places, used, Q, left))
    best = int(np.argmax(explained))
    of = white.entries(used)
    added = white.of_moments(record, directions, places[[best]], used) @ moments[best]
    J = jacobian_of(record, background, fit.sources, fields)
    gradient = J[of].T @ added - (background.Q.T @ J).T @ (background.Q[of].T @ added)
    return np.asarray(fit.covariance[6 * which : 6 * which + 6] @ gradient)


def targets_of(
    model: SurveyModel, fit: JointFit, background: SurveyBackground, groups: Groups, which: BoolArray
) -> dict[str, NDArray[Any]]:
    """Return the entries of targets for some sources (K,) of a fit."""
    sources, K = fit.sources, len(fit.sources)
    covariance = fit.covariance.reshape(K, 6, K, 6)[np.arange(K), :, np.arange(K)]
    significance = fit.significance
    record = model.record
    depth = record.terrain.depth_of(sources.position_m)
    rate = np.insert(
        record.terrain.slope_at(sources.position_m[:, :2]), 2, -1.0, axis=1
    )  # of the depth by the position
    sigma = np.sqrt(np.einsum("ki,kij,kj->k", rate, covariance[:, :3, :3], rate))
    interval = np.column_stack([depth - 1.96 * sigma, depth + 1.96 * sigma])
    weak = significance < _WEAK
    for j in np.flatnonzero(weak & which):
        distance = float(record.height_above(sources.position_m[j]))
        coarse = model.background(sources, groups(WHILE_SEARCHING * distance))
        interval[j], scatter = profile_of(model, fit, coarse, int(j))
        covariance[j] = _with_scatter(covariance[j], scatter)
    apart = np.linalg.norm(sources.position_m[:, None] - sources.position_m, axis=-1) + np.diag(np.full(K, np.inf))
    flat = record.terrain.flatten(sources.position_m)
    rim = np.minimum(flat - model.bounds.low_m, model.bounds.high_m - flat)
    left, above = residuals_above(record, fit, background)
    directions = record.directions(sources.fields(record))
    Q = with_free_sources(record, background, sources)
    free = fit.residual - Q @ (Q.T @ fit.residual)
    second = np.zeros(K)
    for j in np.flatnonzero(which):
        second[j] = second_source_chi2(model, background, directions, Q, free, sources.position_m[j])
    merged = second > chdtri(_N_SECOND, _FALSE_MERGED)
    for j in np.flatnonzero(merged):
        moved = shift_by_second(model, fit, background, Q, free, int(j))
        # The direction of the shift is hardly known, because the place of the second source is not.
        square = np.repeat(np.sum(moved.reshape(2, 3) ** 2, axis=1), 3)
        covariance[j] += np.diag(square)
        low, high = interval[j] - depth[j]
        interval[j] = depth[j] + np.hypot([low, high], 1.96 * math.sqrt(square[0])) * np.sign([low, high])
    # The error of the ground shifts depths, not places.
    half = np.hypot(interval - depth[:, None], 1.96 * record.terrain.sigma_m)
    interval = np.maximum(0.0, depth[:, None] + half * [-1.0, 1.0])
    flags = {
        "weak": weak,
        "near": apart.min(axis=1, initial=np.inf) < NEAR * depth + 0.5,
        "misfit": np.array([is_misfit(left, np.flatnonzero(near)) for near in above], np.bool_),
        "merged": merged,
        "edge": (rim[:, :2] < 0.3).any(axis=1) | (rim[:, 2] < 0.02),
    }
    words = np.array([" ".join(name for name, set_ in flags.items() if set_[j]) for j in range(K)], np.str_)
    parts = (sources.position_m, sources.moment_Am2, covariance, interval, significance, words)
    return {name: part[which] for name, part in zip(TARGET_ENTRIES, parts, strict=True)}


def is_misfit(left: FloatArray, at: IntArray) -> bool:
    """Return whether residuals of groups fit much worse than noise, or are correlated in time.

    First test: groups `at` of the residuals (g, k) fit worse than in one of 10,000 right models, and χ² is 50 % too
    large.

    Second test: residuals of successive groups are correlated, as if a target moves to and fro, more than in one of
    10,000 right models. The statistic is the sum of their products divided by its estimated standard deviation.
    """
    near, after = left[at], np.diff(at) == 1
    products = near[1:][after] * near[:-1][after]
    lasting = np.sum(products) > _LASTING * np.linalg.norm(products)
    return bool(lasting or np.sum(near**2) > max(float(chdtri(max(near.size, 1), 1e-4)), _MISFIT * near.size))
