"""``adcs run complementary``: complementary filters of field, Sun and gyro."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from adcs.cli.options import ReportOptions
from adcs.complementary.names import Method, Rule
from arrays.io.errors import LARGEST, InputError
from arrays.io.outputs import refuse_file, write_files
from magloc.cli.framework import ABOVE_ZERO, Seed, progress, refuse_outside, warn  # noqa: F401 - Seed of an inherited option
from sims.cli.run_tabletsat import RunOptions, Runs, run_in_batches

if TYPE_CHECKING:
    from adcs.complementary.explicit import Gains
    from arrays.typing import FloatArray
    from sims.attitude.complementary import SatelliteRuns, SatelliteScenario

STEP_ORBITS, OUTAGE_STEP_ORBITS, OUTAGE_ORBITS = 1.7, 0.3, 1.5
ORBITS, ORBITS_WITH_OUTAGE = 3.5, 4.0
_ALONE_KP_PER_S, _OUTAGE_KP_PER_S = 0.02, 0.005
_LONGEST_ORBITS = 20.0
_RUNS_AT_ONCE = 20  # 250 MB of the adaptive filter


@Parameter(name="*")
@dataclass(frozen=True)
class ComplementaryOptions(RunOptions):
    """Filter, gains and disturbances.

    Parameters
    ----------
    filter : str
        Gain on vector products ("explicit"), on the angle to a quaternion measured from both vectors
        ("gauss-newton"), or an error-state filter that detects steps of the bias ("adaptive", without gains).
    kp : float, optional
        Gain K_P [1/s]; by default 0.02, 0.005 with an outage.
    ki : float, optional
        Gain K_I [1/s²]; by default kp²/4, at least 2e-6. It is 0 during an outage.
    sigma_nT : float
        Noise of the magnetometer per axis [nT].
    outage : str, optional
        The Sun sensor fails. Its replacement is the field of 500 s ago as measured ("raw"), the same turned by the gyro
        ("transported"), or nothing ("magnetometer-only"); the adaptive filter always uses nothing.
    amplitude_deg : float
        Amplitude of roll, pitch and yaw against the orbital frame [°].
    seeds : int
        Number of runs.
    seed : int
        Seed of the first run; the next runs take the next seeds.
    duration : float, optional
        Duration of a run [s]; by default 3.5 orbits of 5881 s, 4 with an outage.
    """

    filter: Method = "explicit"
    kp: float | None = None
    ki: float | None = None
    sigma_nT: Annotated[float, Parameter(name="--sigma-nT")] = 1000.0
    outage: Rule | None = None
    amplitude_deg: float = 5.0
    seeds: Runs = field(default=1, kw_only=True)

    def check(self) -> None:
        """Refuse options that are out of range."""
        refuse_outside(0.0, LARGEST, "0 or more", kp=self.kp, ki=self.ki)
        for name, value in (("--kp", self.kp), ("--ki", self.ki)):
            if value is not None and self.filter == "adaptive":
                raise InputError(f"{name}: found {value:g}, expected no gain: --filter adaptive has none.")
        refuse_outside(ABOVE_ZERO, LARGEST, "a positive number", sigma_nT=self.sigma_nT)
        if not 0.0 <= self.amplitude_deg < 90.0:
            raise InputError(f"--amplitude-deg: found {self.amplitude_deg:g}, expected 0 to less than 90.")
        from sims.attitude.complementary import ORBIT
        from sims.experiments.complementary import OUTAGE_MAX_FROM_ORBITS, RMS_ORBITS

        least = (RMS_ORBITS[0] if self.outage is None else OUTAGE_MAX_FROM_ORBITS) * ORBIT.period_s
        most = _LONGEST_ORBITS * ORBIT.period_s
        expected = f"{math.ceil(least + 1.0)} to {int(most)} s"
        refuse_outside(least + 1.0, most, expected, unit=" s", duration=self.duration_s)
        try:
            self.gains.check(1.0)
        except ValueError:
            raise InputError(
                f"--kp: found {self.gains.kp_per_s:g} 1/s, expected 1 1/s at most: with steps of 1 s the filter "
                "becomes unstable where kp·h·2 exceeds 2."
            ) from None

    @property
    def duration_s(self) -> float:
        """Duration of a run [s]."""
        from sims.attitude.complementary import ORBIT

        orbits = ORBITS if self.outage is None else ORBITS_WITH_OUTAGE
        return orbits * ORBIT.period_s if self.duration is None else self.duration

    @property
    def gains(self) -> Gains:
        """Gains, with defaults for those that are not given."""
        from adcs.complementary.explicit import Gains

        kp = (_ALONE_KP_PER_S if self.outage is None else _OUTAGE_KP_PER_S) if self.kp is None else self.kp
        ki = max(kp * kp / 4.0, 2e-6) if self.ki is None else self.ki
        return Gains(kp, ki)

    @property
    def scenario(self) -> SatelliteScenario:
        """Scenario of the simulation."""
        from sims.attitude.complementary import SatelliteScenario

        return SatelliteScenario(
            sigma_T=1e-9 * self.sigma_nT,
            amplitude_rad=math.radians(self.amplitude_deg),
            step_orbits=STEP_ORBITS if self.outage is None else OUTAGE_STEP_ORBITS,
            outage_orbits=None if self.outage is None else OUTAGE_ORBITS,
            duration_s=self.duration_s,
        )

    @property
    def surroundings(self) -> str:
        """Scenario of the simulation, as text."""
        outage = "" if self.outage is None else f"; Sun sensor out from {OUTAGE_ORBITS} orbits: {self.outage}"
        return (
            f"magnetometer {self.sigma_nT:g} nT; angles of {self.amplitude_deg:g}°; bias step 0.02 °/s at "
            f"{self.scenario.step_orbits} orbits{outage}"
        )

    @property
    def gains_text(self) -> str:
        """K_P and K_I as time constants; a gain of 0 has none."""
        K_P, K_I = self.gains.kp_per_s, self.gains.ki_per_s2
        first = f"K_P 1/({1.0 / K_P:.4g} s)" if K_P else "K_P 0"
        return f"{first}, K_I " + (f"1/({1.0 / math.sqrt(K_I):.4g} s)²" if K_I else "0")


def run_complementary(
    options: ComplementaryOptions, out: Path | None = None, progress: Callable[[int], None] | None = None
) -> dict[str, Any]:
    """Run the scenario, and write its figures and data.

    ``out``: folder for ``complementary.png`` (the first run), ``complementary.csv`` (the first run through time, both
    complementary filters and the adaptive one) and ``complementary-runs.csv`` (all runs); made if it is not there.
    ``progress``: called with the number of runs finished since the last call. Returns: ``rms_deg``, root mean square of
    the three axes' errors from 0.5 to 3 orbits, ``steady_rms_deg``, the same before the step (with an outage from the
    time that the step is gone, 1 orbit, until it begins), ``peak_deg``, the largest error of an axis after the step
    (before the outage), None in a run that ends before it; and ``outage_max_deg``, the largest errors of roll, pitch
    and yaw from 2 orbits on, or None. Means over the runs; the last one is their median.
    """
    import numpy as np

    from sims.attitude.complementary import satellite_runs
    from sims.experiments.complementary import OUTAGE_COLUMNS, errors_deg, run_columns

    options.check()
    refuse_file(out, "--out")
    table, files = run_in_batches(
        options,
        _RUNS_AT_ONCE,
        lambda seeds: satellite_runs(options.scenario, seeds),
        lambda runs: run_columns(runs.scenario, errors_deg(runs, options.filter, options.gains, options.outage)),
        None if out is None else partial(_files_of_first, options),
        progress,
    )
    write_files(out, [*files, ("complementary-runs.csv", table)])
    means = {name: float(table[name].mean()) for name in ("rms_deg", "steady_rms_deg", "peak_deg")}
    largest = [float(np.median(table[name])) for name in OUTAGE_COLUMNS]
    return {
        **{name: None if math.isnan(mean) else mean for name, mean in means.items()},
        "outage_max_deg": None if options.outage is None else largest,
    }


def _files_of_first(options: ComplementaryOptions, runs: SatelliteRuns) -> Iterator[tuple[str, Any]]:
    """Yield the figure and the errors of the first run, for all filters."""
    from adcs.plots.complementary import ComplementaryPicture, complementary_figure
    from sims.experiments.complementary import errors_deg

    names: tuple[Method, ...] = ("gauss-newton", "explicit", "adaptive")
    errors: dict[str, FloatArray] = {name: errors_deg(runs, name, options.gains, options.outage)[0] for name in names}
    scenario = runs.scenario
    title = f"{options.gains_text}; {options.surroundings}"
    yield (
        "complementary.png",
        complementary_figure(
            ComplementaryPicture(title, scenario.orbits, errors, scenario.step_orbits, scenario.outage_orbits)
        ),
    )
    columns = {"time_s": scenario.time_s, "orbits": scenario.orbits}
    for name, of_filter in errors.items():
        columns |= dict(
            zip((f"{name.replace('-', '_')}_{axis}_deg" for axis in ("roll", "pitch", "yaw")), of_filter.T, strict=True)
        )
    yield "complementary.csv", columns


def summary_lines(options: ComplementaryOptions, result: dict[str, Any]) -> list[str]:
    """Return the settings and the result as text."""
    peak = result["peak_deg"]
    lines = [
        f"{options.filter} filter" + ("" if options.filter == "adaptive" else f", {options.gains_text}"),
        options.surroundings,
        f"{options.seeds} run{'' if options.seeds == 1 else 's'} of {options.duration_s:.0f} s, errors of all axes:",
        f"rms from 0.5 to 3 orbits [°]             {result['rms_deg']:.3f}",
        f"rms while steady [°]                     {result['steady_rms_deg']:.3f}",
        f"largest after the step [°]               {'none' if peak is None else f'{peak:.3f}'}",
    ]
    if result["outage_max_deg"] is not None:
        largest = " / ".join(f"{value:.3f}" for value in result["outage_max_deg"])
        lines.append(f"largest in the outage, roll / pitch / yaw [°]  {largest}")
    return lines


def complementary(
    *,
    options: ComplementaryOptions = ComplementaryOptions(),
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Run complementary filters of magnetometer, Sun sensor and gyro on a satellite.

    The bias of the gyro steps, or the Sun sensor fails. --out writes the figure and its data.

    Parameters
    ----------
    options : ComplementaryOptions
        Filter, gains and disturbances.
    report : ReportOptions
        Outputs.
    """
    options.check()
    if options.filter != "adaptive":
        warn(options.gains.warnings(1.0))
    with progress(options.seeds, "runs") as advance:
        result = run_complementary(options, report.out, advance)
    report.print(result, summary_lines(options, result))
