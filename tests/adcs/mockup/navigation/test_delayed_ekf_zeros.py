"""The delayed filter where the accelerometer's zeros drift steadily, as those of a warming sensor do.

The oracle is the truth of simulated drives, whose errors are not of the filter's own model: zeros that drift at a
constant rate, spikes of the valves, a camera somewhat better than assumed. An error squared over its variance is then
not quite a χ² of one number, but should be no larger than one by more than chance.

Seeds are fixed, not chosen. A filter whose errors are normal, and as large as it says or smaller, fails the upper
bounds of a case with the probability FALSE_ALARM at most.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

from adcs.mockup.navigation.delayed_ekf import STATES, DelayedFilter, DelayedFilterSettings, StartSigma
from adcs.mockup.navigation.fixes import fuse
from sims.mockup.table_run import ImuErrors, TableScenario, table_run

FALSE_ALARM = 1e-4
RUNS, DURATION_S = 24, 60.0
DRIFT_M_S3 = np.array([0.002, -0.0015]) / 180.0
ZEROS = slice(5, 7)


@lru_cache(maxsize=1)
def drives(factor, runs):
    """Runs whose zeros drift so many times as fast as usual."""
    x, y = (factor * DURATION_S * DRIFT_M_S3).tolist()
    scenario = TableScenario(duration_s=DURATION_S, imu=ImuErrors(drift_m_s2=(x, y)))
    return [table_run(scenario, seed) for seed in range(runs)]


def squares(factor, settings=DelayedFilterSettings(), sigma=StartSigma(), runs=RUNS):  # noqa: B008 - frozen
    """Error squared over variance at the end of each run, summed over the runs, in the order of STATES."""
    squared = []
    for run in drives(factor, runs):
        late = DelayedFilter(run.start, 0.0, settings, sigma)
        fuse(late, run.imu, run.fixes)
        end, zeros = run.truth.state(-1), run.zero_m_s2[-1]
        moving = [*end.position_m, *end.velocity_m_s, end.heading_rad]
        true = [*moving, *zeros, run.zero_rad_s, *(factor * DRIFT_M_S3)]
        squared.append((late.x - true) ** 2 / np.diagonal(late.P))
    return np.sum(squared, axis=0)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(("factor", "runs"), [(3.0, RUNS // 2), (3.0, RUNS), (1.0, RUNS)])
def test_errors_are_no_larger_than_stated(factor: float, runs: int) -> None:
    total = squares(factor, runs=runs)
    # Of the sum of a state's squares over all runs; every state may fail (Bonferroni).
    upper = stats.chi2.isf(FALSE_ALARM / len(STATES), runs)
    for state, one in zip(STATES, total, strict=True):
        assert one < upper, state
    # Nor are they much smaller: the σ of the zeros is at most twice what it should be.
    assert total[ZEROS].min() > 0.25 * stats.chi2.ppf(FALSE_ALARM / 2, runs)


@pytest.mark.slow
def test_a_walk_alone_would_not_be_honest() -> None:
    """The bounds are narrow enough to tell: without drifts the zeros lag."""
    total = squares(1.0, DelayedFilterSettings(drift_walk_m_s3_rs=1e-15), StartSigma(drift_m_s3=1e-15))
    assert total[ZEROS].sum() > stats.chi2.isf(FALSE_ALARM, 2 * RUNS)
