"""The live page of a calibration by turning without a browser: directions, the turn that is missing, and advice."""

from __future__ import annotations

import numpy as np

from magloc.live.turning import SPREAD, TurningCalibrator, covered_directions
from magloc.viewer.turning_view import TurningView
from tests.magloc.live.test_turning import FIELD_T, board, turned
from tests.magloc.viewer.conftest import node
from tests.waiting import wait_for


def test_what_is_missing_is_shown_until_it_is_enough() -> None:
    calibrator = TurningCalibrator(board(), FIELD_T)
    with TurningView(calibrator, port=0, open=False) as view:
        sphere = view._sphere
        flat, whole = turned(200, tilt=0.3), turned(begin_s=20.0)
        for rows, is_enough in ((flat, False), (whole, True)):
            progress = calibrator.add(rows)
            assert progress is not None
            assert progress.enough is is_enough
            view.update(rows)
            wait_for(
                lambda: sphere._drawn is calibrator.progress and calibrator.progress.advice in sphere._panel.content
            )
            least = progress.least_covered
            is_green = node(sphere._server, "/directions").colors[:, 1] == 158
            np.testing.assert_array_equal(is_green, covered_directions(least.directions))
            assert len(is_green) == len(SPREAD)
            assert f"{100.0 * least.coverage:.0f} % covered" in sphere._panel.content
            missing = node(sphere._server, "/next")
            assert missing.visible is not is_enough
            if not is_enough:
                np.testing.assert_allclose(missing.points[0, 1], least.missing, atol=1e-6)
            now = calibrator.newest_directions(rows.values_T[-1])[least.id]
            np.testing.assert_allclose(node(sphere._server, "/now").points[0, 1], now, atol=1e-6)
