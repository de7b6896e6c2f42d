"""Whether one dipole fitted to a pair is called ``merged``: ``python -m docs.studies.survey_pairs survey-drone``.

Plots of 8 m with one target, or two within 1.4 m: how often it is said of single ones, and of pairs where the fit is
off the middle of the moments by more than its 95 % ellipsoid, and where it is not.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import chdtri

import magloc
import sims
from docs.studies.survey_figures import enlarged
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import Ground
from magloc.surveying.preparation import whole_rows
from magloc.surveying.rounds import AT_LAST
from magloc.surveying.targets import targets_of
from magloc.surveying.tiled import TiledSurvey
from sims.magnetics.scenario import MagneticScenario

HALF_M, GAP_M, THRESHOLD = 0.7, 0.3, 26.0


def fitted_as_one(scenario: MagneticScenario, seed: int) -> tuple[bool, bool] | None:
    """Whether it is called merged, and whether it is off; None where it is not significant."""
    field = sims.simulate(scenario, rng=seed)
    ground = Ground(magloc.SourcePrior(), magloc.Terrain(), 15.0, THRESHOLD)
    tiled = TiledSurvey.of(*whole_rows(field.array, field.readings), ground)
    places, moments = field.target_position_m, field.target_moment_Am2
    size = np.linalg.norm(moments, axis=1)
    start = Sources((size @ places / size.sum())[None], moments.sum(axis=0)[None])
    piece = replace(tiled, sources=start).piece(0)
    model = piece.model()
    fit, background = model.fit(start, piece.groups(model.record, AT_LAST * model.nearest_m), 1e-3)
    if not len(fit.sources):
        return None
    # A dipole has its own middle: that of the moments' components along it.
    along = moments @ fit.sources.moment_Am2[0]
    error = fit.sources.position_m[0] - along @ places / along.sum()
    off = error @ np.linalg.solve(fit.covariance[:3, :3], error) > chdtri(3, 0.05)
    groups, every = partial(piece.groups, model.record), np.ones(len(fit.sources), np.bool_)
    return "merged" in str(targets_of(model, fit, background, groups, every)["flags"][0]).split(), bool(off)


def main() -> None:
    """Single ones, then pairs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--first", type=int, default=8200)
    parser.add_argument("--seeds", type=int, default=24)
    given = parser.parse_args()
    scenario = sims.read_scenario(given.scenario)
    assert isinstance(scenario, MagneticScenario)
    scenario = enlarged(scenario, 8.0)
    targets = scenario.targets
    assert targets is not None
    for number in (1, 2):
        middle = replace(targets, number=number, x_m=(-HALF_M, HALF_M), y_m=(-HALF_M, HALF_M), gap_m=GAP_M)
        plots = [
            fitted_as_one(replace(scenario, targets=middle), seed)
            for seed in range(given.first, given.first + given.seeds)
        ]
        for off in (False, True):
            some = [plot[0] for plot in plots if plot is not None and plot[1] is off]
            print(f"{number} together, {'off' if off else 'not off'}: merged is said of {sum(some)} of {len(some)}")


if __name__ == "__main__":
    main()
