"""``adcs run ellipsoid``: yaw from roll alone, in guaranteed ellipsoids."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

from adcs.cli.options import ReportOptions
from adcs.ellipsoids.names import StepRule
from arrays.io.errors import LARGEST, InputError
from arrays.io.outputs import refuse_file, write_files
from magloc.cli.framework import Flag, Seed, progress, refuse_outside  # noqa: F401 - Seed of an inherited option
from sims.cli.run_tabletsat import RunOptions, Runs, run_in_batches

if TYPE_CHECKING:
    from arrays.typing import FloatArray
    from sims.experiments.ellipsoid import EllipsoidRuns, EllipsoidSettings

JUMP_S = 2000.0
_LEAST_DEG = 1e-9
_RUNS_AT_ONCE = 500  # 90 MB of an orbit


@Parameter(name="*")
@dataclass(frozen=True)
class EllipsoidOptions(RunOptions):
    """Bounds of the errors, and settings of the observer.

    Parameters
    ----------
    noise_deg : float
        Largest error of the horizon sensor [°]: 1 for a compensated sensor, 4 for a raw one.
    drift_deg_s : float
        Bias of the yaw gyro, and its bound [°/s]: 0.02, or 0.0001 for a better gyro.
    step : str
        Update of a set by a reading: least trace with a narrowed strip ("tightened"), with the strip as it
        is ("optimal"), or the update of Pankratova and Sholokhov ("lemma").
    jump : bool
        After 2000 s the errors of the readings are four times their bound.
    closed_loop : bool
        Simulate the satellite in its attitude loop, instead of the error dynamics alone.
    seeds : int
        Number of runs.
    seed : int
        Seed of the first run; the next runs take the next seeds.
    duration : float
        Duration of a run [s]; by default one orbit.
    """

    noise_deg: float = 1.0
    drift_deg_s: float = 0.02
    step: StepRule = "tightened"
    jump: Flag = False
    closed_loop: Flag = False
    seeds: Runs = field(default=300, kw_only=True)
    duration: float = field(default=5678.0, kw_only=True)

    def check(self) -> None:
        """Refuse options that are out of range."""
        from adcs.ellipsoids.roll_yaw import STEP_S

        least = f"{_LEAST_DEG:g} or more"
        refuse_outside(_LEAST_DEG, LARGEST, least, noise_deg=self.noise_deg, drift_deg_s=self.drift_deg_s)
        refuse_outside(STEP_S, 1e7, f"{STEP_S:g} to 1e7 s", unit=" s", duration=self.duration)
        if self.jump and self.duration <= JUMP_S:
            raise InputError(f"--duration: found {self.duration:g} s, expected more than the {JUMP_S:g} s of --jump.")

    @property
    def n_steps(self) -> int:
        """Number of steps of 2 s."""
        from adcs.ellipsoids.roll_yaw import STEP_S

        return int(self.duration / STEP_S)

    @property
    def settings(self) -> EllipsoidSettings:
        """Settings of the simulation and of the observer."""
        from sims.experiments.ellipsoid import EllipsoidSettings

        return EllipsoidSettings(
            math.radians(self.noise_deg),
            math.radians(self.drift_deg_s),
            self.n_steps,
            self.step,
            JUMP_S if self.jump else None,
            self.closed_loop,
        )


def run_ellipsoid(
    options: EllipsoidOptions, out: Path | None = None, progress: Callable[[int], None] | None = None
) -> dict[str, Any]:
    """Run the scenario, and write its figures and data.

    ``out``: folder for ``ellipsoid.png`` (the first 500 runs at most), ``ellipsoid.csv`` (the first run through time)
    and ``ellipsoid-runs.csv`` (all runs); made if it is not there. ``progress``: called with the number of runs
    finished since the last call. Returns: ``final_error_mean_deg``, ``final_error_p95_deg`` and ``final_error_max_deg``
    of the estimated yaw, ``half_width_mean_deg``, the guaranteed half-width of yaw at the end,
    ``containment_violations`` of all ``steps``, and ``resets_mean``, contradictions in a run.
    """
    import numpy as np

    from sims.experiments.ellipsoid import ellipsoid_runs, run_columns

    options.check()
    refuse_file(out, "--out")
    table, files = run_in_batches(
        options,
        _RUNS_AT_ONCE,
        lambda seeds: ellipsoid_runs(options.settings, seeds),
        run_columns,
        None if out is None else partial(_files_of_first, options),
        progress,
    )
    write_files(out, [*files, ("ellipsoid-runs.csv", table)])
    error = table["final_error_deg"]
    return {
        "final_error_mean_deg": float(error.mean()),
        "final_error_p95_deg": float(np.percentile(error, 95.0)),
        "final_error_max_deg": float(error.max()),
        "half_width_mean_deg": float(table["half_width_deg"].mean()),
        "containment_violations": int(table["violations"].sum()),
        "steps": options.seeds * options.n_steps,
        "resets_mean": float(table["resets"].mean()),
    }


def _files_of_first(options: EllipsoidOptions, runs: EllipsoidRuns) -> Iterator[tuple[str, Any]]:
    """Yield the figure, and the first run through time."""
    import numpy as np

    from adcs.ellipsoids.roll_yaw import STEP_S, kalman_track, roll_yaw_system
    from adcs.plots.ellipsoids import RollYawPicture, roll_yaw_figure
    from magloc.plots import style

    system = roll_yaw_system(math.radians(options.noise_deg), math.radians(options.drift_deg_s))
    increments = None if runs.increments_rad is None else runs.increments_rad[0]
    kalman = kalman_track(system, runs.roll_readings_rad[0], increments)
    time_s = STEP_S * np.arange(options.n_steps + 1, dtype=np.float64)
    parts = [
        "Attitude loop" if options.closed_loop else "Error dynamics",
        f"horizon sensor ±{options.noise_deg:g}°"
        + (f", ±{4.0 * options.noise_deg:g}° from {JUMP_S:g} s" if options.jump else ""),
        f"gyro {options.drift_deg_s:g} °/s",
        f"step '{options.step}'",
    ]
    jump_s = JUMP_S if options.jump else None
    picture = RollYawPicture("; ".join(parts), time_s, runs.states_rad, runs.track, kalman, options.closed_loop, jump_s)
    yield "ellipsoid.png", partial(style.save, roll_yaw_figure(picture), dpi=130)
    track, H, P = runs.track, runs.track.shapes[0], kalman.covariances
    columns = {
        "time_s": time_s,
        **_of_axes("true_", runs.states_rad[0]),
        **_of_axes("", track.centres[0]),
        **_of_matrix("shape_", H),
        "bound_deg": np.degrees(track.bounds[0]),
        "resets": track.resets[0],
        **_of_axes("kalman_", kalman.means),
        **_of_matrix("kalman_", P),
    }
    yield "ellipsoid.csv", columns


def _of_axes(name: str, angles_rad: FloatArray) -> dict[str, FloatArray]:
    return {f"{name}{axis}_deg": math.degrees(1.0) * angles_rad[:, i] for i, axis in enumerate(("roll", "yaw"))}


def _of_matrix(name: str, matrix_rad2: FloatArray) -> dict[str, FloatArray]:
    places = {"roll_roll": (0, 0), "roll_yaw": (0, 1), "yaw_yaw": (1, 1)}
    return {f"{name}{key}_deg2": math.degrees(1.0) ** 2 * matrix_rad2[:, i, j] for key, (i, j) in places.items()}


def summary_lines(options: EllipsoidOptions, result: dict[str, Any]) -> list[str]:
    """Return the result as text, one line for each number."""
    from adcs.ellipsoids.roll_yaw import STEP_S

    return [
        f"{options.seeds} runs of {options.n_steps * STEP_S:g} s",
        f"error of yaw at the end, mean / 95 % / largest [°]  {result['final_error_mean_deg']:.3f} /"
        f" {result['final_error_p95_deg']:.3f} / {result['final_error_max_deg']:.3f}",
        f"guaranteed half-width of yaw at the end, mean [°]   {result['half_width_mean_deg']:.3f}",
        f"truth outside of the set                            {result['containment_violations']} of"
        f" {result['steps']} steps",
        f"readings that contradicted the set, in a run        {result['resets_mean']:.2f}",
    ]


def ellipsoid(
    *,
    options: EllipsoidOptions = EllipsoidOptions(),
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Estimate the yaw of a satellite from a horizon sensor and gyros, in guaranteed ellipsoids.

    No sensor measures yaw; along the orbit it turns into roll and back. Only bounds of the errors are known, and the
    sets are certain to contain the true attitude. --out writes the figure and its data.

    Parameters
    ----------
    options : EllipsoidOptions
        Bounds of the errors, and settings of the observer.
    report : ReportOptions
        Outputs.
    """
    with progress(options.seeds, "runs") as advance:
        result = run_ellipsoid(options, report.out, advance)
    report.print(result, summary_lines(options, result))
