"""``magloc live --calibrate``: sensors calibrated while they are turned, with what turn is missing."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import arrays
from arrays.array import SensorArray
from magloc.ambient import Place, modulus_at
from magloc.cli.calibration.by_turning import check_gains
from magloc.cli.framework import note, print_json
from magloc.cli.live import PageOptions, TurningOptions
from magloc.live.tally import Tally
from magloc.live.turning import TurningCalibrator, TurningProgress, refuse_unfinished, turn


def calibrate_live(
    array: SensorArray,
    path: Path,
    source: str,
    replay_speed: float,
    options: TurningOptions,
    place: Place | None,
    page: PageOptions,
) -> None:
    """Calibrate until it is enough, with a JSON line for every fit; write the array file."""
    modulus_T = None if options.modulus_nT is None else 1e-9 * options.modulus_nT
    if modulus_T is None and place is not None:
        modulus_T = modulus_at(place)
    goal_T = None if options.goal_nT is None else 1e-9 * options.goal_nT
    calibrator, tally = TurningCalibrator(array, modulus_T, goal_T), Tally()
    progress: TurningProgress | None = None
    with ExitStack() as stack:
        view = None
        if page.view:
            from magloc.viewer.turning_view import TurningView

            view = stack.enter_context(TurningView(calibrator, port=page.port, open=page.open))
            note(f"open {view.address} in a browser; Ctrl-C ends the page")
        for rows, fitted in turn(source, calibrator, tally, replay_speed=replay_speed):
            if view is not None:
                view.update(rows)
            if fitted is not None:
                progress = fitted
                print_json(_entry(fitted))
                sys.stdout.flush()
                if fitted.enough:
                    break
        refuse_unfinished(progress, source)
        assert options.out_array is not None
        assert calibrator.progress is not None
        calibrated = calibrator.array()
        check_gains(array, calibrated, calibrator.progress.modulus_T, path, options.out_array)
        arrays.write_array(options.out_array, calibrated)
        if modulus_T is None:
            note("the modulus of the field is not known: the mean gain of the sensors stays as in the array file")
        note(f"enough: wrote {options.out_array}")
        if view is not None:
            view.wait()


def _entry(progress: TurningProgress) -> dict[str, Any]:
    """Return the JSON line of a fit."""
    return {
        "time_s": progress.time_s,
        "rows": progress.rows,
        "modulus_nT": 1e9 * progress.modulus_T,
        "goal_nT": 1e9 * progress.goal_T,
        "sensors": [
            {
                "id": sensor.id,
                "coverage": sensor.coverage,
                "missing_direction": sensor.missing,
                "offset_nT": 1e9 * sensor.fit.offset_T,
                "offset_sigma_nT": 1e9 * sensor.offset_sigma_T,
                "gain_sigma": sensor.gain_sigma,
                "disturbed": float(np.mean(sensor.disturbed)),
            }
            for sensor in progress.sensors
        ],
        "turn": progress.advice,
        "flags": list(progress.flags),
        "enough": progress.enough,
    }
