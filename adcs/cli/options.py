"""What all commands share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

import adcs
from adcs.kalman.names import Filter, Noise, StartKind, is_measured
from arrays.io.outputs import refuse_file, write_files
from magloc.cli import framework
from magloc.cli.framework import Count, Flag, QuietOptions  # noqa: F401 - of an inherited option


@Parameter(name="*", group="Common options")
@dataclass(frozen=True)
class ReportOptions(QuietOptions):
    """Where a result goes.

    Parameters
    ----------
    out : Path, optional
        Folder for figures and the data behind them; made if it is not there.
    json : bool
        Print one JSON object.
    threads : int
        Threads at most; by default all cores. Results do not depend on it.
    quiet : bool
        No progress and no summary on stderr, only errors.
    """

    out: Path | None = None
    json: Flag = False

    def check(self) -> None:
        """Refuse, before long work, what cannot become a folder."""
        refuse_file(self.out, "--out")

    def write(self, files: Iterable[tuple[str, Any]]) -> None:
        """Write files by their names, as :func:`arrays.io.outputs.write_files`, if there is a folder for them."""
        write_files(self.out, files)

    def print(self, result: Mapping[str, Any], lines: Sequence[str]) -> None:
        """Print a result as JSON or as text."""
        framework.print_result(result, lines, as_json=self.json)


@Parameter(name="*")
@dataclass(frozen=True)
class EstimateOptions:
    """What replaces keys of the scenario file; by default nothing does.

    Parameters
    ----------
    sensors : str
        Sensors in use: any of st, gyro, mag and sun that observe attitude, in any order.
    states : str
        What is estimated besides attitude and rate: any of gyro-bias, field-bias, field-gain, magnetometer (both),
        disturbance, field-model and dipole with commas, or none.
        With other sensors the scenario's own states stay, but for the bias of a sensor that is not in use.
    filter : str
        As of `adcs run tabletsat`.
    allow_old_elements : bool
        Take two-line elements 30 days or more from their epoch too.
    """

    sensors: str | None = None
    states: str | None = None
    filter: Filter | None = None
    allow_old_elements: Flag = False

    def estimate(self, own: Sequence[str]) -> dict[str, Any]:
        """Keys of the table ``estimate``, and what replaces them; of its own states those stay that sensors measure."""
        given = {"sensors": self.sensors, "states": _names(self.states), "filter": self.filter}
        if self.sensors is not None and self.states is None:
            given["states"] = [state for state in own if is_measured(state, self.sensors)]
        return {key: value for key, value in given.items() if value is not None}


@Parameter(name="*")
@dataclass(frozen=True)
class ScenarioOptions(EstimateOptions):
    """What replaces keys of the scenario file; by default nothing does.

    Parameters
    ----------
    sensors : str
        Sensors in use: any of st, gyro, mag and sun that observe attitude, in any order, as in st+gyro+mag+sun.
    states : str
        What is estimated besides attitude and rate: any of gyro-bias, field-bias, field-gain, magnetometer (both),
        disturbance, field-model and dipole with commas, or none.
        With other sensors the scenario's own states stay, but for the bias of a sensor that is not in use.
    filter : str
        Error-state Kalman filter ("mekf"); with its converged gain ("constant-gain"); with a filter of the disturbance
        beside it ("parallel-disturbance"); of attitude and gyro bias alone ("reduced"); with a smoother of the whole
        run after it ("smoother"); a bank that finds how large the disturbance is ("self-tuning").
    process_noise : str
        Found by us ("tuned"), or as printed ("paper").
    star_noise : str
        The star tracker's 0.001° are the noise of its angle ("angle"), or of its quaternion's components ("paper").
    field_error_nT : float
        True field minus its model.
    share : float
        Share of the readings of every sensor that are wild, 0 to 1.
    eclipse : bool
        The satellite enters the Earth's shadow at 600 s.
    start : str
        The filter starts near the truth ("near"), from the first readings of two sensors ("vectors"), or from nowhere
        ("any").
    start_error_deg : float
        Error per axis of what the filter starts from.
    allow_old_elements : bool
        Take two-line elements 30 days or more from their epoch too.
    closed_loop_F : bool
        The Jacobian as printed by Ivanov et al., which takes the feedback of the control for dynamics.
    """

    process_noise: Noise | None = None
    star_noise: Literal["angle", "paper"] | None = None
    field_error_nT: Annotated[float | None, Parameter(name="--field-error-nT")] = None
    share: float | None = None
    eclipse: Flag = False
    start: StartKind | None = None
    start_error_deg: float | None = None
    closed_loop_F: Annotated[Flag, Parameter(name="--closed-loop-F")] = False

    def changes(self, duration_s: float | None, own: Sequence[str]) -> dict[str, Any]:
        """Keys of the scenario file with states of its own, and what replaces them."""
        estimate = {
            "process_noise": self.process_noise,
            "start": self.start,
            "start_error_deg": self.start_error_deg,
            "closed_loop_F": self.closed_loop_F or None,
        }
        changes: dict[str, Any] = {
            "estimate": self.estimate(own) | {key: value for key, value in estimate.items() if value is not None}
        }
        given = {"field_error_nT": self.field_error_nT, "wild_share": self.share}
        if disturbance := {key: value for key, value in given.items() if value is not None}:
            changes["disturbance"] = disturbance
        if self.eclipse:
            eclipse = adcs.read_scenario("eclipse").tables
            changes |= {key: eclipse[key] for key in ("start", "duration_s")}
            # The noise of that file is too small without the torque in the state.
            if self.process_noise is None and "disturbance" in (_names(self.states) or []):
                changes["estimate"]["process_noise"] = eclipse["estimate"]["process_noise"]
        if duration_s is not None:
            changes["duration_s"] = duration_s
        return changes


def _names(text: str | None) -> list[str] | None:
    if text is None:
        return None
    names = [name.strip() for name in text.replace("+", ",").split(",")]
    return [name for name in names if name and name != "none"]
