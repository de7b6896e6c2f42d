"""What surveys of a built-in scenario find: ``python -m docs.studies.survey_figures survey-drone --seeds 12``.

Prints every field, and of all of them: recall of visible targets (whose χ² at the true place is twice the threshold),
false targets, errors, how often the 95 % ellipsoids and depth intervals hold the truth, and the error over the joint
Cramér-Rao bound; the same by classes of χ².
"""

from __future__ import annotations

import argparse
import math
import resource
from dataclasses import replace

import numpy as np

import sims
from sims.magnetics.paths import Lawnmower
from sims.magnetics.scenario import MagneticScenario
from tests.survey_figures import Pair, holds, judged

CLASSES = ((0.0, 200.0), (200.0, 2000.0), (2000.0, np.inf))


def enlarged(scenario: MagneticScenario, edge_m: float) -> MagneticScenario:
    """A built-in survey over a square of another size, as dense in lines and in targets."""
    path, targets = scenario.carrier.path, scenario.targets
    assert isinstance(path, Lawnmower)
    assert targets is not None
    half, lines = 0.5 * edge_m, round(edge_m / path.spacing_m) + 1
    number = round(targets.number * (edge_m / path.length_m) ** 2)
    targets = replace(targets, number=number, x_m=(-half, half), y_m=(-half, half))
    path = replace(path, start_m=(-half, half, path.start_m[2]), length_m=edge_m, lines=lines)
    way = lines * edge_m + 0.5 * math.pi * path.spacing_m * (lines - 1)
    carrier = replace(scenario.carrier, path=path)
    return replace(scenario, carrier=carrier, targets=targets, duration_s=way / path.speed_m_s)


def summary(pairs: list[Pair]) -> str:
    """Errors of targets that were found, in a line."""
    across = [float(np.hypot(*pair.error_m[:2])) for pair in pairs]
    depth = [abs(float(pair.error_m[2])) / pair.depth_m for pair in pairs]
    inside = [pair.interval_m[0] <= pair.depth_m <= pair.interval_m[1] for pair in pairs]
    ratio = np.sqrt(np.mean([float(pair.error_m @ pair.error_m) / pair.bound_m**2 for pair in pairs]))
    return (
        f"{len(pairs)} targets: {100.0 * np.median(across):.1f} cm across, {100.0 * np.median(depth):.1f} % of depth"
        f" (medians); ellipsoids hold {np.mean([holds(pair) for pair in pairs]):.3f}, depth intervals"
        f" {np.mean(inside):.3f}; rms over bound {ratio:.2f}; merged is said of"
        f" {np.mean([pair.merged for pair in pairs]):.3f}"
    )


def main() -> None:
    """Survey some fields."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--first", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--edge-m", type=float, help="of the square, instead of the scenario's")
    parser.add_argument("--targets", type=int, help="instead of the scenario's")
    parser.add_argument("--within-m", type=float, help="edge of the square in the middle with all targets")
    parser.add_argument("--gap-m", type=float, help="least gap between targets")
    parser.add_argument("--false-per-hectare", type=float, default=0.1)
    given = parser.parse_args()
    scenario = sims.read_scenario(given.scenario)
    assert isinstance(scenario, MagneticScenario)
    assert scenario.targets is not None
    if given.edge_m:
        scenario = enlarged(scenario, given.edge_m)
        assert scenario.targets is not None
    targets, half = scenario.targets, 0.5 * (given.within_m or 0.0)
    if given.within_m:
        targets = replace(targets, x_m=(-half, half), y_m=(-half, half))
    if given.gap_m:
        targets = replace(targets, gap_m=given.gap_m)
    if given.targets:
        targets = replace(targets, number=given.targets)
    scenario = replace(scenario, targets=None if given.targets == 0 else targets)
    fields = []
    for seed in range(given.first, given.first + given.seeds):
        fields.append(judged(sims.simulate(scenario, rng=seed), given.false_per_hectare))
        last = fields[-1]
        print(
            f"seed {seed}: found {len(last.pairs)}, missed {[round(chi2) for chi2 in last.missed_chi2]} (χ²),"
            f" false {last.n_false}, χ²/dof {last.chi2_per_dof:.3f}, {last.seconds:.0f} s, {last.processors_s:.0f} s of"
            f" processors, {last.rows} rows",
            flush=True,
        )
    most = [resource.getrusage(who).ru_maxrss >> 10 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(f"memory: {most[0]} MB, and {most[1]} MB in another process")
    pairs = [pair for field in fields for pair in field.pairs]
    visible = sum(pair.visible_chi2 > 2.0 * fields[0].threshold for pair in pairs)
    lost = sum(chi2 > 2.0 * fields[0].threshold for field in fields for chi2 in field.missed_chi2)
    n_false = sum(field.n_false for field in fields)
    print(f"found {visible} of {visible + lost} visible, {n_false} false in {len(fields)} fields")
    all_visible = [field for field in fields if min(field.all_chi2, default=0.0) > 2.0 * field.threshold]
    whole = sum(not field.missed_chi2 for field in all_visible)
    print(f"all targets are visible in {len(all_visible)} fields, and found in {whole} of these")
    if not pairs:
        return
    print(summary(pairs))
    for low, high in CLASSES:
        some = [pair for pair in pairs if low <= pair.significance < high]
        if some:
            print(f"χ² from {low:g} to {high:g}: {summary(some)}")


if __name__ == "__main__":
    main()
