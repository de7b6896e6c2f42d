"""Figures and data that ``adcs run mockup --out`` writes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from adcs.io.frame_files import read_frame, write_frame
from adcs.mockup.navigation.delayed_ekf import FilterTrack
from adcs.mockup.navigation.fixes import FixRecord
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarTrack
from adcs.mockup.vision.camera import Pose
from adcs.mockup.vision.sky import LedSky, write_sky
from adcs.plots import mockup_navigation, mockup_vision
from arrays.typing import FloatArray
from sims.experiments.mockup_navigation import FusionRuns, TrackErrors, ZerosRuns
from sims.experiments.mockup_recording import RecordRun
from sims.experiments.mockup_settings import METHOD_WORDS, SETTLED_S
from sims.experiments.mockup_vision import FrameResult, SkyRun, frame_result, random_frame
from sims.mockup.frames import Motion, pose_and_motion, rendered_frame
from sims.mockup.table_run import TableScenario, table_run

if TYPE_CHECKING:
    from sims.cli.mockup_options import MockupOptions

File = tuple[str, Any]
"""Name and content of a file, for :func:`arrays.io.outputs.write_file`."""
_DRIVE_S, _DRIVE_STEP_S = 150.0, 1.8
_REST_FRAMES, _REST_STEP_S = 40, 0.6
_REST_M, _REST_RAD = (-1.2228, 0.3), 0.5
"""Place of the rest in figure 10 of the source paper."""


def files_of(options: MockupOptions, run: Any) -> Iterator[File]:
    """Yield the files of a run of any kind."""
    match run:
        case SkyRun():
            return sky_files(options, run)
        case ZerosRuns():
            return zeros_files(run)
        case RecordRun():
            return record_files(run)
        case [FusionRuns() as only]:
            return fusion_files(only)
        case [*every]:
            return method_files(every)
    return frame_files(options, run)


def sky_files(options: MockupOptions, run: SkyRun) -> Iterator[File]:
    """Yield figures, a table, the sky and one frame of simulated frames."""
    sky, setup, seeds = options.led_sky, options.sky_setup(), options.runs(1)
    n_stars = np.array([len(result.stars) for result in run.results])
    errors_mm = 1e3 * run.position_errors_m
    title = f"{len(run.good)} frames, matcher {options.matcher_name}: {100.0 * run.good.mean():.1f} % good fixes"
    picture = mockup_vision.SkyPicture(
        title, sky.positions_m, run.truth[:, :2], errors_mm, run.good, run.false_fixes, n_stars
    )
    yield "mockup-sky.png", mockup_vision.sky_figure(picture)
    # The first frame with a good fix, or else the first one.
    seed, row = divmod(int(np.argmax(run.good)), setup.poses)
    image = random_frame(sky, setup, seeds[seed], row)[1].image
    result = frame_result(image, setup.believed_camera, options.sky_matcher(), options.finder())
    title = f"{result.matched} of {len(result.stars)} stars identified in {1e3 * result.identify_s:.1f} ms"
    yield "mockup-frame.png", _frame_figure(options, title, image, result)
    yield "mockup-drive.png", _drive_figure(options, sky)
    yield (
        "mockup-sky.csv",
        {
            "seed": np.repeat(np.array(seeds, dtype=np.int64), setup.poses),
            "pose": np.tile(np.arange(setup.poses), len(seeds)),
            **_pose_columns("true_", run.truth),
            **_pose_columns("", run.estimates),
            "position_error_mm": errors_mm,
            "heading_error_deg": np.degrees(run.heading_errors_rad),
            "stars": n_stars,
            "matched": np.array([result.matched for result in run.results]),
            "good": run.good,
            "false": run.false_fixes,
            "identify_ms": np.array([1e3 * result.identify_s for result in run.results]),
            "frame_ms": np.array([1e3 * result.frame_s for result in run.results]),
            "reason": [result.reason for result in run.results],
        },
    )
    yield "sky.toml", partial(write_sky, sky)
    yield "frame.png", partial(write_frame, image)


def _frame_figure(options: MockupOptions, title: str, image: Any, result: FrameResult) -> Figure:
    stars_px, lights_m = result.stars.positions_px, options.led_sky.positions_m
    return mockup_vision.frame_figure(title, image, stars_px, result.fix, lights_m, options.camera())


def _drive_figure(options: MockupOptions, sky: LedSky) -> Figure:
    """Draw the fixes of frames along a drive around the table, and at rest."""
    setup, matcher, finder, seed = options.sky_setup(), options.sky_matcher(), options.finder(), options.seed
    truth = table_run(TableScenario(duration_s=_DRIVE_S), seed).truth
    driven = truth.rows(slice(None, None, round(_DRIVE_STEP_S / (truth.time_s[1] - truth.time_s[0]))))
    rng = np.random.default_rng([seed, 2])

    def place(pose: Pose, motion: Motion) -> FloatArray:
        image = rendered_frame(sky, setup.camera, pose, rng, motion, setup).image
        return frame_result(image, setup.believed_camera, matcher, finder).pose[:2]

    fixes_m = np.array([place(*pose_and_motion(truth, at_s)) for at_s in driven.time_s.tolist()])
    rest_m = np.array([place(Pose(*_REST_M, _REST_RAD), Motion()) for _ in range(_REST_FRAMES)])
    return mockup_vision.drive_figure(
        f"Position by the camera alone, matcher {options.matcher_name}",
        sky.positions_m,
        driven.position_m,
        fixes_m,
        _REST_STEP_S * np.arange(_REST_FRAMES, dtype=np.float64),
        rest_m,
        np.array(_REST_M),
    )


def frame_files(options: MockupOptions, results: Mapping[Path, FrameResult]) -> Iterator[File]:
    """Yield a figure of every frame that was read, and a table."""
    for path, result in results.items():
        image = read_frame(path, options.camera())
        yield f"{path.stem}-stars.png", _frame_figure(options, path.name, image, result)
    every = list(results.values())
    yield (
        "mockup-frames.csv",
        {
            "file": [path.name for path in results],
            **_pose_columns("", np.array([result.pose for result in every])),
            "rms_mm": np.array([1e3 * getattr(result.fix, "rms_m", math.nan) for result in every]),
            "stars": np.array([len(result.stars) for result in every]),
            "reason": [result.reason for result in every],
        },
    )


def _columns(names: str, *values: FloatArray) -> dict[str, FloatArray]:
    """Return columns by their names; values have shape (n,), or (n, k) for k names."""
    return dict(zip(names.split(), np.column_stack(values).T, strict=True))


def _pose_columns(prefix: str, poses: FloatArray) -> dict[str, FloatArray]:
    return _columns(f"{prefix}x_m {prefix}y_m {prefix}heading_deg", poses[:, :2], np.degrees(poses[:, 2]))


def zeros_files(runs: ZerosRuns) -> Iterator[File]:
    """Yield figure and samples of the first run, and a row for every run."""
    first = runs.results[0]
    # A fit with slopes gives the zeros at the beginning.
    true_zeros, when = first.run.zero_m_s2, "on average"
    if runs.unknowns == "drift":
        true_zeros, when = true_zeros[:1], "at first"
    (x, y), (true_x, true_y) = first.fit.zero_m_s2, true_zeros.mean(axis=0)
    title = (
        f"zeros {x:.4f}, {y:.4f} m/s² found, {true_x:.4f}, {true_y:.4f} true {when}; "
        f"unknowns {runs.unknowns}, seed {first.seed}"
    ).replace("-", "\N{MINUS SIGN}")
    rms_mm = first.position_before_mm, first.position_rms_mm
    figure = mockup_navigation.zeros_figure(title, first.run.imu, first.run.fixes, first.before, first.after, *rms_mm)
    yield "mockup-zeros.png", figure
    samples = _imu_columns(first.run.imu)
    for prefix, track in (("true_", first.run.truth), ("before_", first.before), ("after_", first.after)):
        samples |= _columns(f"{prefix}x_m {prefix}y_m", track.position_m)
    yield "mockup-zeros.csv", samples | {"after_heading_deg": np.degrees(first.after.heading_rad)}
    runs_columns = {
        "seed": np.array([each.seed for each in runs.results]),
        "zero_x_m_s2": np.array([each.fit.zero_m_s2[0] for each in runs.results]),
        "zero_y_m_s2": np.array([each.fit.zero_m_s2[1] for each in runs.results]),
        "zero_error_m_s2": np.array([each.zero_error_m_s2 for each in runs.results]),
        "before_rms_mm": np.array([each.position_before_mm for each in runs.results]),
        "after_rms_mm": np.array([each.position_rms_mm for each in runs.results]),
        "fit_rms_mm": np.array([1e3 * each.fit.residual_rms_m for each in runs.results]),
    }
    yield "mockup-zeros-runs.csv", runs_columns
    yield "mockup-fixes.csv", _fix_columns(first.run.fixes)


def fusion_files(runs: FusionRuns) -> Iterator[File]:
    """Yield figures, samples and fixes of the first run, and a row for every run."""
    first = runs.results[0]
    run, track = first.run, first.fused.track
    fixes = run.fixes.rows(slice(len(first.fused.outcomes)))
    sigma = track.sigma if isinstance(track, FilterTrack) else None
    title = f"{METHOD_WORDS[runs.method]}: {first.errors.position_rms_mm:.1f} mm rms after {SETTLED_S:g} s"
    picture = mockup_navigation.FusionPicture(
        f"{title[:1].upper()}{title[1:]}, seed {first.seed}",
        run.truth,
        track,
        fixes,
        first.fused.outcomes,
        None if sigma is None else sigma[:, :2],
        None if sigma is None else sigma[:, 4],
        SETTLED_S,
    )
    yield "mockup-fusion.png", mockup_navigation.fusion_figure(picture)
    yield "mockup-fusion-errors.png", mockup_navigation.errors_figure(picture)
    samples = _imu_columns(run.imu) | _track_columns("true_", run.truth) | _track_columns("", track)
    # Only the file of a recording has the zero of the gyro.
    samples.pop("zero_rate_deg_s", None)
    yield "mockup-fusion.csv", samples
    errors = _error_columns([each.errors for each in runs.results])
    yield "mockup-fusion-runs.csv", {"seed": np.array([each.seed for each in runs.results])} | errors
    used = first.fused.used
    yield "mockup-fixes.csv", _fix_columns(fixes) | {"false": run.false[: len(used)], "used": used}


def method_files(every: Sequence[FusionRuns]) -> Iterator[File]:
    """Yield a figure of the first run by all methods, and a row for every run and method."""
    lines = []
    for runs in every:
        result = runs.results[0]
        distance = np.linalg.norm(result.fused.track.position_m - result.run.truth.position_m, axis=1)
        label = f"{runs.method}: {result.errors.position_rms_mm:.1f} mm rms"
        lines.append((label, result.run.truth.time_s, 1e3 * distance))
    yield "mockup-methods.png", mockup_navigation.methods_figure(lines, SETTLED_S)
    each = [(runs.method, one.seed, one.errors) for runs in every for one in runs.results]
    yield (
        "mockup-methods.csv",
        {
            "fusion": [method for method, _, _ in each],
            "seed": np.array([seed for _, seed, _ in each], dtype=np.int64),
            **_error_columns([errors for _, _, errors in each]),
        },
    )


def record_files(run: RecordRun) -> Iterator[File]:
    """Yield the estimate of a recording and its figure."""
    track = run.fused.track
    # A recording has no truth.
    picture = mockup_navigation.FusionPicture(
        f"Recording, fusion {run.method}",
        track,
        track,
        run.fixes.rows(slice(len(run.fused.outcomes))),
        run.fused.outcomes,
        begin_s=run.imu.begin_s + SETTLED_S,
    )
    yield "mockup-fusion.png", mockup_navigation.fusion_figure(picture)
    yield "mockup-estimate.csv", {"time_s": track.time_s} | _track_columns("", track)


def _error_columns(errors: Sequence[TrackErrors]) -> dict[str, FloatArray]:
    return {field.name: np.array([getattr(each, field.name) for each in errors]) for field in fields(TrackErrors)}


def _imu_columns(imu: ImuRecord) -> dict[str, FloatArray]:
    names = "time_s acceleration_x_m_s2 acceleration_y_m_s2 rate_deg_s"
    return _columns(names, imu.time_s, imu.acceleration_m_s2, np.degrees(imu.rate_rad_s))


def _track_columns(p: str, track: PlanarTrack) -> dict[str, FloatArray]:
    """Return the columns of a track, their names behind a prefix."""
    names = f"{p}x_m {p}y_m {p}vx_m_s {p}vy_m_s {p}heading_deg"
    columns = _columns(names, track.position_m, track.velocity_m_s, np.degrees(track.heading_rad))
    if isinstance(track, FilterTrack):
        columns |= _columns("zero_x_m_s2 zero_y_m_s2 zero_rate_deg_s", track.zero_m_s2, np.degrees(track.zero_rad_s))
        sigma = 1e3 * track.sigma[:, :2], np.degrees(track.sigma[:, 4])
        columns |= _columns("sigma_x_mm sigma_y_mm sigma_heading_deg", *sigma)
    return columns


def _fix_columns(fixes: FixRecord) -> dict[str, FloatArray]:
    names = "exposure_s arrival_s x_m y_m heading_deg"
    return _columns(names, fixes.time_s, fixes.arrival_s, fixes.position_m, np.degrees(fixes.heading_rad))
