"""The table of levels: thresholds that follow from a probability."""

from __future__ import annotations

import pytest
from scipy.stats import chi2, norm

from magloc import levels


def test_thresholds_of_an_interval() -> None:
    assert chi2.ppf(levels.INTERVAL, 1) == pytest.approx(levels.DELTA_CHI2_95, rel=1e-12)
    assert norm.ppf(0.5 + 0.5 * levels.INTERVAL) == pytest.approx(levels.SIGMAS_95, rel=1e-12)


def test_what_is_thrown_away_is_refused_less_often_than_what_is_looked_at() -> None:
    for costly in (levels.MISFIT, levels.CONTRADICTION):
        for cheap in (levels.SECOND_LOOK, levels.FALSE_ALARM, levels.DISAGREEMENT, levels.SENSOR_FALSE_ALARM):
            assert costly < cheap
    assert levels.SUSPICIOUS_FIT < levels.CREDIBLE_ROW < levels.CREDIBLE_FIT
