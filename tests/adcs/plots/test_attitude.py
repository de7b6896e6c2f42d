"""Figures of attitude filters: what of the values is within the axes, and what is hatched."""

from __future__ import annotations

import numpy as np
import pytest

import adcs
from adcs.plots.attitude import sensor_gaps, states_figure


def figure(are_errors):
    """A start of 90° that falls to 0.1° within the first tenth."""
    time_s = np.arange(200.0)
    values = np.full((200, 30), np.nan)
    values[:, :6] = (90.0 * np.exp(-time_s / 3.0) + 0.1)[:, None]
    return states_figure("", time_s, values, np.full((200, 30), 0.05), are_errors=are_errors)


class TestLimits:
    def test_an_estimate_is_never_cut(self):
        for ax in figure(are_errors=False).axes:
            low, high = ax.get_ylim()
            assert low < 0.1
            assert high > 90.1

    def test_an_error_may_leave_the_panel_at_the_start(self):
        for ax in figure(are_errors=True).axes:
            assert ax.get_ylim()[1] < 1.0


class TestGaps:
    def test_what_is_missing_and_what_is_of_little_use(self):
        seen = {"sun": np.array([True, False, True]), "mag": np.ones(3, dtype=bool)}
        degraded = {"on one line": np.array([False, False, True]), "never": np.zeros(3, dtype=bool)}
        gaps = sensor_gaps(seen, ("sun", "mag"), degraded)
        assert [words for words, _ in gaps] == ["no Sun sensor", "on one line"]
        assert [well.tolist() for _, well in gaps] == [[True, False, True], [True, True, False]]

    @pytest.mark.parametrize("sensors", ["mag+sun", "mag+sun+gyro"])
    def test_a_track_knows_where_sun_and_field_are_on_one_line(self, sensors):
        log = adcs.datasets.load("satellite")
        track = adcs.estimate(log.telemetry, log.satellite, sensors=sensors)
        told = any("on one line" in text for text in track.warnings)
        assert told == any(rows.any() for rows in track.degraded.values())
        labels = [text.get_text() for text in track.plot().legends[0].get_texts()]
        assert told == ("Sun and field on one line" in labels)
