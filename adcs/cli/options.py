"""Options that several commands share."""

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
    """Outputs of a command.

    Parameters
    ----------
    out : Path, optional
        Folder for figures and their data; it is created if it does not exist.
    json : bool
        Print one JSON object, instead of the text.
    threads : int
        Largest number of threads; by default all cores. Results do not depend on it.
    quiet : bool
        Print errors only: no progress and no summary on stderr.
    """

    out: Path | None = None
    json: Flag = False

    def check(self) -> None:
        """Refuse, before long work, a path that cannot become a folder."""
        refuse_file(self.out, "--out")

    def write(self, files: Iterable[tuple[str, Any]]) -> None:
        """Write files by their names into the folder, if there is one."""
        write_files(self.out, files)

    def print(self, result: Mapping[str, Any], lines: Sequence[str]) -> None:
        """Print a result as JSON or as text."""
        framework.print_result(result, lines, as_json=self.json)


@Parameter(name="*")
@dataclass(frozen=True)
class EstimateOptions:
    """Options that replace keys of the scenario file.

    Parameters
    ----------
    sensors : str
        Sensors to use: st, gyro, mag and sun, in any order, joined by +; together they must observe attitude.
    states : str
        States to estimate besides attitude and rate: gyro-bias, field-bias, field-gain, magnetometer (both),
        disturbance, field-model and dipole, separated by commas, or none. By default those of the scenario, without
        the biases of sensors that are not used.
    filter : str
        Filter, as in `adcs run tabletsat`; by default that of the scenario.
    allow_old_elements : bool
        Also accept two-line elements 30 days or more from their epoch.
    """

    sensors: str | None = None
    states: str | None = None
    filter: Filter | None = None
    allow_old_elements: Flag = False

    def estimate(self, own: Sequence[str]) -> dict[str, Any]:
        """Return the values that replace keys of the table ``estimate``."""
        given = {"sensors": self.sensors, "states": _names(self.states), "filter": self.filter}
        if self.sensors is not None and self.states is None:
            given["states"] = [state for state in own if is_measured(state, self.sensors)]
        return {key: value for key, value in given.items() if value is not None}


@Parameter(name="*")
@dataclass(frozen=True)
class ScenarioOptions(EstimateOptions):
    """Options that replace keys of the scenario file.

    Parameters
    ----------
    sensors : str
        Sensors to use: st, gyro, mag and sun, in any order, as in st+gyro+mag+sun; together they must observe attitude.
    states : str
        States to estimate besides attitude and rate: gyro-bias, field-bias, field-gain, magnetometer (both),
        disturbance, field-model and dipole, separated by commas, or none. By default those of the scenario, without
        the biases of sensors that are not used.
    filter : str
        Error-state Kalman filter ("mekf"); with its converged gain ("constant-gain"); with a parallel filter of the
        disturbance ("parallel-disturbance"); of attitude and gyro bias only ("reduced"); followed by a smoother
        ("smoother"); a bank of filters that estimates the size of the disturbance ("self-tuning").
    process_noise : str
        Process noise: tuned for this simulation ("tuned"), or as printed in the paper ("paper").
    star_noise : str
        Meaning of the star tracker's 0.001°: noise of its angle ("angle"), or of the components of its quaternion
        ("paper").
    field_error_nT : float
        Size of the true field minus its model [nT].
    share : float
        Share of wild readings of every sensor, 0 to less than 1.
    eclipse : bool
        The satellite enters the Earth's shadow at 600 s.
    start : str
        Start of the filter: near the truth ("near"), from the first readings of two sensors ("vectors"), or without any
        knowledge ("any").
    start_error_deg : float
        Standard deviation of the attitude at the start of the filter, per axis [°].
    allow_old_elements : bool
        Also accept two-line elements 30 days or more from their epoch.
    closed_loop_F : bool
        Use the Jacobian as printed by Ivanov et al., which treats the feedback of the control as dynamics.
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
        """Return the values that replace keys of a scenario file with its own states."""
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
            # Without the torque in the state the process noise of that file is too small.
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
