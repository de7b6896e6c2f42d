"""``adcs run mockup``: the table-top satellite under its sky of LEDs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import sims.experiments
from adcs.cli.options import ReportOptions
from arrays.io.errors import naming_options
from magloc.cli.framework import progress, warn
from sims.cli.mockup_options import MockupOptions, value_or
from sims.cli.mockup_replay import ReplayOptions
from sims.experiments.mockup_settings import METHODS, SETTLED_S, Method

if TYPE_CHECKING:
    from sims.experiments.mockup_navigation import FusionRuns, ZerosRuns
    from sims.experiments.mockup_vision import FrameResult


def frame_entries(results: dict[Path, FrameResult]) -> list[dict[str, Any]]:
    """Return the JSON entry of every file."""
    from adcs.mockup.vision.paper_matcher import CameraFix

    entries = []
    for path, result in results.items():
        fix = result.fix
        entry: dict[str, Any] = {"file": path.name, "stars": len(result.stars)}
        if isinstance(fix, CameraFix):
            entry |= {
                "position_m": fix.position_m.tolist(),
                "heading_deg": math.degrees(fix.heading_rad),
                "matched": len(fix.stars),
                "rms_mm": 1e3 * fix.rms_m,
            }
        else:
            entry |= {"position_m": None, "reason": fix.reason}
        entries.append(entry)
    return entries


def sky_lines(options: MockupOptions, result: dict[str, Any]) -> list[str]:
    """Return the result of frames as text."""
    setup = options.sky_setup()
    damage = [f"noise {setup.noise_DN:g} DN"]
    damage += [f"{100.0 * setup.lost:g} % of the lights lost"] if setup.lost else []
    damage += [f"{setup.spurious} spurious"] if setup.spurious else []
    damage += [f"{setup.hot_pixels} hot pixels"] if setup.hot_pixels else []
    damage += [f"{setup.speed_m_s:g} m/s"] if setup.speed_m_s else []
    damage += [f"{math.degrees(setup.turn_rate_rad_s):g} °/s"] if setup.turn_rate_rad_s else []
    damage += [f"k1 {setup.k1:g} (believed {setup.believed_k1:g})"] if setup.k1 or setup.believed_k1 else []
    poses, good = result["poses"], round(result["success"] * result["poses"])
    return [
        f"{poses} frames {setup.footprint_m:g} m wide, matcher {options.matcher_name}",
        ", ".join(damage),
        f"good fixes, within 20 mm and 2°    {good} of {poses} ({100.0 * result['success']:.1f} %)",
        f"false fixes                        {result['false_fixes']}",
        f"position of good fixes, rms [mm]   {_number(result['position_rms_mm'], 3)}",
        f"heading of good fixes, rms [°]     {_number(result['heading_rms_deg'], 4)}",
        f"identification, median [ms]        {result['identify_ms_median']:.2f}",
        f"whole frame, median [ms]           {result['frame_ms_median']:.2f}",
    ]


def frame_lines(entries: Sequence[dict[str, Any]]) -> list[str]:
    """Return the fixes of files as a table."""
    width = max(5, *(len(entry["file"]) for entry in entries))
    lines = [f"{'frame':{width}s}  stars  matched    X [m]    Y [m]  heading [°]  rms [mm]"]
    for entry in entries:
        start = f"{entry['file']:{width}s}  {entry['stars']:5d}"
        if entry["position_m"] is None:
            lines.append(f"{start}  no fix: {entry['reason']}")
            continue
        x, y = entry["position_m"]
        lines.append(
            f"{start}  {entry['matched']:7d}  {x:7.4f}  {y:7.4f}  {entry['heading_deg']:11.3f}  {entry['rms_mm']:8.2f}"
        )
    return lines


def fusion_lines(runs: FusionRuns, duration_s: float) -> list[str]:
    """Return the result of drives as text."""
    from adcs.mockup.navigation.fixes import counts_in_words

    result = runs.summary()
    return [
        f"{_runs(result['runs'])} of {duration_s:g} s, fusion {runs.method}, errors after {SETTLED_S:g} s:",
        f"position, rms / 95 % / largest [mm]  {result['position_rms_mm']:.2f} / {result['position_p95_mm']:.2f} /"
        f" {result['position_max_mm']:.2f}",
        f"velocity, rms [mm/s]                 {result['velocity_rms_mm_s']:.2f}",
        f"heading, rms [°]                     {result['heading_rms_deg']:.4f}",
        f"exposure to fix, median [ms]         {_number(result['delay_ms_median'], 1)}",
        f"fixes                                {result['fixes']}:"
        f" {counts_in_words(result['used_fixes'], result['unused_fixes'])}; {result['false_fixes']} of them false",
    ]


def methods_lines(every: Sequence[FusionRuns], duration_s: float) -> list[str]:
    """Return the results of several methods as a table."""
    first = every[0].summary()
    lines = [
        f"{_runs(first['runs'])} of {duration_s:g} s, errors after {SETTLED_S:g} s:",
        f"{'fusion':20s}{'position: rms':>14s}{'95 %':>9s}{'max [mm]':>10s}"
        f"{'velocity [mm/s]':>17s}{'heading [°]':>13s}",
    ]
    for runs in every:
        result = runs.summary()
        lines.append(
            f"{runs.method:20s}{result['position_rms_mm']:14.2f}{result['position_p95_mm']:9.2f}"
            f"{result['position_max_mm']:10.2f}{result['velocity_rms_mm_s']:17.2f}{result['heading_rms_deg']:13.4f}"
        )
    return lines


def zeros_lines(runs: ZerosRuns, duration_s: float) -> list[str]:
    """Return the result of fits as text."""
    result = runs.summary()
    return [
        f"{_runs(result['runs'])} of {duration_s:g} s, unknowns {runs.unknowns}:",
        f"integrated position before, rms [mm]  {result['position_before_rms_mm']:.2f}",
        f"integrated position after, rms [mm]   {result['position_rms_mm']:.2f}",
        f"error of the zeros, mean [m/s²]       {result['zero_error_m_s2']:.5f}",
        f"distance from the fixes, rms [mm]     {result['residual_rms_mm']:.2f}",
    ]


def _number(value: float | None, decimals: int) -> str:
    return "none" if value is None else f"{value:.{decimals}f}"


def _runs(number: int) -> str:
    return f"{number} run{'' if number == 1 else 's'}"


def mockup(
    *,
    options: MockupOptions = MockupOptions(),  # noqa: B008 - frozen
    replay: ReplayOptions = ReplayOptions(),  # noqa: B008 - frozen
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Run the table-top satellite: star identification, accelerometer zeros, fusion of delayed fixes.

    Parameters
    ----------
    options : MockupOptions
        Part of the mock-up to simulate, and its settings.
    replay : ReplayOptions
        Replay of the first drive.
    report : ReportOptions
        Outputs.
    """
    options.check()
    replay.check(options, json=report.json)
    report.check()
    if replay.wanted:
        from sims.cli.mockup_replay import check_places, show_replay

        check_places(replay)
    if options.frames is not None:
        outcome = _frames(options, options.frames)
    elif options.samples is not None and options.fixes is not None:
        outcome = _recording(options.samples, options.fixes, options, report)
    else:
        kinds = {"sky": _sky, "zeros": _zeros, "fusion": _drives, "all": _drives}
        outcome = kinds[options.part](options, report)
    if report.out is not None:
        from sims.cli.mockup_files import files_of

        report.write(files_of(options, outcome.run))
    report.print(outcome.result, outcome.lines)
    if replay.wanted:
        show_replay(outcome.run[0], options.table_camera(), replay)


class Report(NamedTuple):
    """A run of any kind, its JSON object, and its text."""

    run: Any
    result: dict[str, Any]
    lines: list[str]


def _frames(options: MockupOptions, frames: Path) -> Report:
    from adcs.io.frame_files import frame_paths

    sky_matcher, finder = options.sky_matcher(), options.finder()
    results = sims.experiments.identified_files(frame_paths(frames), options.camera(), sky_matcher, finder)
    entries = frame_entries(results)
    fixed = sum(entry["position_m"] is not None for entry in entries)
    return Report(results, {"frames": entries, "identified": fixed}, frame_lines(entries))


def _recording(samples: Path, fixes: Path, options: MockupOptions, report: ReportOptions) -> Report:
    from sims.experiments.mockup_recording import record_lines

    run = sims.experiments.fused_record(samples, fixes, value_or(options.fusion, "ekf"))
    warn(run.warnings)
    return Report(run, run.summary(), record_lines(run))


def _sky(options: MockupOptions, report: ReportOptions) -> Report:
    setup, seeds = options.sky_setup(), options.runs(1)
    sky, matcher, finder = options.led_sky, options.sky_matcher(), options.finder()
    with progress(setup.poses * len(seeds), "frames") as advance:
        run = sims.experiments.sky_run(sky, matcher, setup, seeds, advance, finder)
    result = run.summary()
    return Report(run, result, sky_lines(options, result))


def _zeros(options: MockupOptions, report: ReportOptions) -> Report:
    seeds, unknowns, start_fixes = options.runs(6), value_or(options.unknowns, "six"), value_or(options.start_fixes, 4)
    with progress(len(seeds), "runs") as advance, naming_options("start_fixes"):
        runs = sims.experiments.zeros_run(
            unknowns, seeds, options.duration_s, start_fixes=start_fixes, progress=advance
        )
    return Report(runs, runs.summary(), zeros_lines(runs, options.duration_s))


def _drives(options: MockupOptions, report: ReportOptions) -> Report:
    scenario, seeds = options.table_scenario(), options.runs(6)
    wanted = value_or(options.fusion, "ekf")
    methods: tuple[Method, ...] = METHODS if wanted == "all" else (wanted,)
    with progress(len(seeds) * len(methods), "runs") as advance:
        simulate = lru_cache(maxsize=len(seeds))(options.table_camera().run) if options.part == "all" else None
        every = [sims.experiments.fused_runs(method, scenario, seeds, advance, simulate) for method in methods]
    if wanted == "all":
        result = {str(one.method): one.summary() for one in every}
        return Report(every, result, methods_lines(every, options.duration_s))
    return Report(every, every[0].summary(), fusion_lines(every[0], options.duration_s))
