"""Fusion and accelerometer zeros of the mock-up: simulated runs, estimates and errors.

``adcs run mockup --part fusion`` and ``--part zeros`` print the summaries.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from adcs.mockup.navigation.strapdown import PlanarState, PlanarTrack, strapdown, wrapped
from sims.experiments.mockup_settings import METHODS, SETTLED_S, UNKNOWNS, Method, Unknowns

if TYPE_CHECKING:
    from adcs.mockup.navigation.delayed_ekf import StartSigma
    from adcs.mockup.navigation.fixes import Fused, Fusion
    from adcs.mockup.navigation.zeros import ZeroFit
    from sims.mockup.table_run import TableRun, TableScenario
from arrays.typing import FloatArray

SHORT_S = 20.0
"""Largest duration of a run with two firings [s]; longer ones drive around the table."""
ZERO_M_S2 = (0.005, -0.004)
_DRIFT_M_S3 = (0.002 / 180.0, -0.0015 / 180.0)


@dataclass(frozen=True)
class TrackErrors:
    """Errors of a track against the truth of the same instants; position errors are distances."""

    position_rms_mm: float
    position_p95_mm: float
    position_max_mm: float
    velocity_rms_mm_s: float
    heading_rms_deg: float


def track_errors(track: PlanarTrack, truth: PlanarTrack, after_s: float = SETTLED_S) -> TrackErrors:
    """Return the errors of a track from an instant on; truth and track have the same instants."""
    late = truth.time_s >= after_s
    distance = 1e3 * np.linalg.norm(track.position_m - truth.position_m, axis=1)[late]
    velocity = 1e3 * np.linalg.norm(track.velocity_m_s - truth.velocity_m_s, axis=1)[late]
    heading = np.degrees(wrapped(track.heading_rad - truth.heading_rad))[late]
    percentile, largest = float(np.percentile(distance, 95.0)), float(distance.max())
    return TrackErrors(_rms(distance), percentile, largest, _rms(velocity), _rms(heading))


@dataclass(frozen=True, eq=False)
class FusionResult:
    """One run of one method."""

    seed: int
    run: TableRun  # truth, samples and fixes
    fused: Fused  # the track is a :class:`adcs.mockup.navigation.delayed_ekf.FilterTrack` for the delayed filter
    errors: TrackErrors


@dataclass(frozen=True, eq=False)
class FusionRuns:
    """All runs of one method."""

    method: Method
    results: tuple[FusionResult, ...]

    def summary(self) -> dict[str, Any]:
        """Return the keys of ``--json``: means over the runs, the largest error, and counts of fixes.

        Fixes are the used and the unused ones; pending fixes would have arrived after the end.
        """
        from adcs.mockup.navigation.fixes import FixOutcome, unused_counts

        errors = [asdict(result.errors) for result in self.results]
        outcomes = [outcome for result in self.results for outcome in result.fused.outcomes]
        used = sum(int(result.fused.used.sum()) for result in self.results)
        delays_s = np.concatenate([result.run.fixes.arrival_s - result.run.exposure_s for result in self.results])
        return {
            **{name: float(np.mean([error[name] for error in errors])) for name in errors[0]},
            "position_max_mm": max(error["position_max_mm"] for error in errors),
            "delay_ms_median": None if not delays_s.size else 1e3 * float(np.median(delays_s)),
            "fixes": len(outcomes),
            "used_fixes": used,
            "rejected_fixes": outcomes.count(FixOutcome.REJECTED),
            "unused_fixes": unused_counts(outcomes),
            "pending_fixes": sum(len(result.run.fixes) for result in self.results) - len(outcomes),
            "false_fixes": int(sum(result.run.false[: len(result.fused.outcomes)].sum() for result in self.results)),
            "runs": len(errors),
        }


def fused_runs(
    method: Method,
    scenario: TableScenario,
    seeds: Sequence[int],
    progress: Callable[[int], None] | None = None,
    simulate: Callable[[TableScenario, int], TableRun] | None = None,
) -> FusionRuns:
    """Simulate drives around the table, and estimate each by one method.

    Parameters
    ----------
    method : {'paper', 'velocity-corrected', 'ekf', 'camera', 'imu'}
    scenario : TableScenario
        Longer than 10 s.
    seeds : sequence of int
        One for each run.
    progress : callable, optional
        Called with 1 after every run.
    simulate : callable, optional
        Function that makes a run of a scenario and a seed, such as
        :meth:`sims.experiments.mockup_camera.TableCamera.run`; by default :func:`sims.table_run`.

    Returns
    -------
    FusionRuns
        Errors of all runs; `summary` has their statistics.

    Raises
    ------
    ValueError
        An argument is out of range.

    Examples
    --------
    >>> import sims
    >>> from sims import experiments
    >>> scenario = sims.TableScenario(duration_s=12.0)
    >>> experiments.fused_runs("imu", scenario, seeds=[0]).summary()["runs"]
    1
    """
    from adcs.mockup.navigation.fixes import fuse

    _check("method", method, METHODS, seeds, scenario.duration_s)
    results = []
    for seed in seeds:
        run = (simulate or _table_run)(scenario, seed)
        fused = fuse(fusion_of(method, run.start, run.imu.begin_s), run.imu, run.fixes)
        results.append(FusionResult(seed, run, fused, track_errors(fused.track, run.truth)))
        if progress is not None:
            progress(1)
    return FusionRuns(method, tuple(results))


@lru_cache(maxsize=8)
def _table_run(scenario: TableScenario, seed: int) -> TableRun:
    """Simulate one run, which several methods share."""
    from sims.mockup.table_run import table_run

    return table_run(scenario, seed)


def fusion_of(method: Method, start: PlanarState, begin_s: float, sigma: StartSigma | None = None) -> Fusion:
    """Return the estimator of a method; ``sigma`` is the accuracy of an unusual start."""
    from adcs.mockup.navigation.delayed_ekf import DelayedFilter, StartSigma
    from adcs.mockup.navigation.reintegration import (
        CameraOnly,
        ImuOnly,
        Reintegration,
        corrected_velocity,
        finite_difference,
    )

    makers: dict[Method, Callable[[], Fusion]] = {
        "paper": lambda: Reintegration(start, begin_s, finite_difference),
        "velocity-corrected": lambda: Reintegration(start, begin_s, corrected_velocity),
        "ekf": lambda: DelayedFilter(start, begin_s, sigma=sigma or StartSigma()),
        "camera": lambda: CameraOnly(start),
        "imu": lambda: ImuOnly(start),
    }
    return makers[method]()


@dataclass(frozen=True, eq=False)
class ZerosResult:
    """One run, integrated with and without the estimated zeros.

    ``before``, ``after``: integrated samples, raw from a line through two fixes, and without the zeros.
    ``position_before_mm``, ``position_rms_mm``: rms distance of both from the truth.
    """

    seed: int
    run: TableRun
    fit: ZeroFit
    before: PlanarTrack
    after: PlanarTrack
    position_before_mm: float
    position_rms_mm: float
    zero_error_m_s2: float  # length of the error of the zeros, mean over the run


@dataclass(frozen=True, eq=False)
class ZerosRuns:
    """All runs of one fit."""

    unknowns: Unknowns
    results: tuple[ZerosResult, ...]

    def summary(self) -> dict[str, Any]:
        """Return the keys of ``--json``: means over the runs."""
        return {
            "position_rms_mm": float(np.mean([result.position_rms_mm for result in self.results])),
            "zero_error_m_s2": float(np.mean([result.zero_error_m_s2 for result in self.results])),
            "position_before_rms_mm": float(np.mean([result.position_before_mm for result in self.results])),
            "residual_rms_mm": float(1e3 * np.mean([result.fit.residual_rms_m for result in self.results])),
            "runs": len(self.results),
        }


def zeros_run(
    unknowns: Unknowns = "two",
    seeds: Sequence[int] = range(6),
    duration_s: float = 15.0,
    *,
    start_fixes: int = 4,
    progress: Callable[[int], None] | None = None,
) -> ZerosRuns:
    """Estimate the zeros of the accelerometer from the samples and fixes of runs.

    The true zeros are 0.005 and -0.004 m/s² at the beginning, and drift by 0.002 and -0.0015 m/s² in 180 s.

    Parameters
    ----------
    unknowns : {'two', 'six', 'drift'}
        Constant zeros; also the start; also the slopes of the zeros.
    seeds : sequence of int
        One for each run.
    duration_s : float
        Duration of a run [s]: up to 20 s with two firings, longer around the table.
    start_fixes : int
        Number of fixes that determine the start of "two"; 2 in the source paper.
    progress : callable, optional
        Called with 1 after every run.

    Returns
    -------
    ZerosRuns
        Estimated and true zeros of all runs; `summary` has their statistics.

    Raises
    ------
    ValueError
        An argument is out of range.

    Examples
    --------
    >>> from sims import experiments
    >>> experiments.zeros_run("two", seeds=[0]).summary()["runs"]
    1
    """
    from sims.mockup.table_run import ImuErrors, TableScenario

    _check("unknowns", unknowns, UNKNOWNS, seeds, duration_s)
    drift = (_DRIFT_M_S3[0] * duration_s, _DRIFT_M_S3[1] * duration_s)
    scenario = TableScenario(
        "two-firings" if duration_s <= SHORT_S else "perimeter",
        duration_s,
        imu=ImuErrors(calibration_m_s2=0.0, zero_m_s2=ZERO_M_S2, drift_m_s2=drift),
    )
    results = []
    for seed in seeds:
        results.append(_zeros_result(unknowns, start_fixes, seed, _table_run(scenario, seed)))
        if progress is not None:
            progress(1)
    return ZerosRuns(unknowns, tuple(results))


def _zeros_result(unknowns: Unknowns, start_fixes: int, seed: int, run: TableRun) -> ZerosResult:
    from adcs.mockup.navigation.zeros import constant_zeros_after, heading_from_fixes, zero_problem, zeros_and_start

    fixes = run.fixes.in_time_order()
    if unknowns == "two" and not 2 <= start_fixes < len(fixes):
        raise ValueError(
            f"Input start_fixes must be 2 to {len(fixes) - 1}, less than the {len(fixes)} fixes of the run with seed "
            f"{seed}; instead received {start_fixes}."
        )
    heading, gyro_zero = heading_from_fixes(run.imu, fixes)
    imu = run.imu.subtract_zeros(0.0, gyro_zero)
    courses = (imu.time_s - 0.5 * imu.steps_s)[None] if unknowns == "drift" else None
    problem = zero_problem(imu, heading, fixes, courses)
    velocity = (fixes.position_m[1] - fixes.position_m[0]) / (fixes.time_s[1] - fixes.time_s[0])
    position = fixes.position_m[0] - velocity * (fixes.time_s[0] - imu.begin_s)
    fit = constant_zeros_after(problem, start_fixes) if unknowns == "two" else zeros_and_start(problem)
    heading_start = float(heading[0] - 0.5 * imu.rate_rad_s[0] * imu.steps_s[0])
    start = fit.start(heading_start)
    zeros = fit.zero_course(courses)
    before = strapdown(imu, replace(start, position_m=position, velocity_m_s=velocity))
    after = strapdown(imu.subtract_zeros(zeros, 0.0), start)
    error = float(np.linalg.norm(np.mean(zeros - run.zero_m_s2, axis=0)))
    return ZerosResult(seed, run, fit, before, after, _distance_mm(before, run), _distance_mm(after, run), error)


def _distance_mm(track: PlanarTrack, run: TableRun) -> float:
    return _rms(1e3 * np.linalg.norm(track.position_m - run.truth.position_m, axis=1))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _check(name: str, value: str, known: Sequence[str], seeds: Sequence[int], duration_s: float) -> None:
    if value not in known:
        raise ValueError(f"Input {name} must be one of {', '.join(known)}; instead received {value!r}.")
    if not seeds or min(seeds) < 0:
        raise ValueError(f"Input seeds must be numbers from 0 on, one at least; instead received {list(seeds)}.")
    if not SETTLED_S < duration_s <= 1e4:
        raise ValueError(
            f"Input duration_s must be more than {SETTLED_S:g} and up to 10000 s; instead received {duration_s:g} s."
        )
