"""What ``adcs run mockup --out`` writes: figures, and the data behind them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adcs.io.frame_files import read_frame, write_frame
from adcs.mockup.navigation.delayed_ekf import FilterTrack
from adcs.mockup.navigation.fixes import Outcome
from adcs.mockup.vision.camera import Camera, Pose
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.mockup.vision.sky import LedSky, write_sky
from arrays.io.csv import Column, write_columns, write_table
from magloc.plots import style
from sims.experiments.mockup_navigation import FusionResult, FusionRuns, ZerosResult, ZerosRuns
from sims.experiments.mockup_settings import METHOD_WORDS, SETTLED_S, MockupOptions, value_or
from sims.experiments.mockup_vision import FrameResult, SkyRun, frame_result, random_frame

if TYPE_CHECKING:
    from adcs.plots.mockup_vision import DrivePicture, FramePicture
    from sims.mockup.frames import Motion
from arrays.typing import FloatArray
from sims.experiments.mockup_recording import RecordRun

_DRIVE_S, _DRIVE_STEP_S = 150.0, 1.8
_REST_FRAMES, _REST_STEP_S = 40, 0.6
_REST_M, _REST_RAD = (-1.2228, 0.3), 0.5
"""About where the source's figure 10 is."""


def write_sky_run(options: MockupOptions, run: SkyRun, out: Path) -> list[str]:
    """Write frames' results: figures, a table, the sky, and a frame of the kind."""
    from adcs.plots.mockup_vision import SkyPicture, drive_figure, frame_figure, sky_figure

    sky, setup = options.led_sky, options.sky_setup()
    errors_mm = 1e3 * run.position_errors_m
    heading_deg = np.degrees(run.heading_errors_rad)
    per_seed = setup.poses
    columns: dict[str, Column] = {
        "seed": np.repeat(np.array(options.runs(1), dtype=np.int64), per_seed),
        "pose": np.tile(np.arange(per_seed), len(options.runs(1))),
        "true_x_m": run.truth[:, 0],
        "true_y_m": run.truth[:, 1],
        "true_heading_deg": np.degrees(run.truth[:, 2]),
        "x_m": run.estimates[:, 0],
        "y_m": run.estimates[:, 1],
        "heading_deg": np.degrees(run.estimates[:, 2]),
        "position_error_mm": errors_mm,
        "heading_error_deg": heading_deg,
        "stars": run.n_stars.astype(np.int64),
        "matched": run.n_matched.astype(np.int64),
        "good": run.good,
        "false": run.false_fixes,
        "identify_ms": 1e3 * run.identify_s,
        "frame_ms": 1e3 * run.frame_s,
        "reason": list(run.reasons),
    }
    write_columns(columns, out / "mockup-sky.csv")
    write_sky(sky, out / "sky.toml")
    name = value_or(options.matcher, "robust")
    title = f"{len(run.good)} frames, matcher {name}: {100.0 * run.good.mean():.1f} % good fixes"
    sky_picture = SkyPicture(
        title, sky.positions_m, run.truth[:, :2], errors_mm, run.good, run.false_fixes, run.n_stars
    )
    style.save(sky_figure(sky_picture), out / "mockup-sky.png")
    picture = example_picture(options, sky, run)
    write_frame(picture.image, out / "frame.png")
    style.save(frame_figure(picture), out / "mockup-frame.png")
    style.save(drive_figure(drive_picture(options, sky)), out / "mockup-drive.png")
    return ["mockup-sky.png", "mockup-frame.png", "mockup-drive.png", "mockup-sky.csv", "sky.toml", "frame.png"]


def example_picture(options: MockupOptions, sky: LedSky, run: SkyRun) -> FramePicture:
    """The run's first frame with a good fix, or the first one."""
    from adcs.plots.mockup_vision import FramePicture

    setup = options.sky_setup()
    seed, row = divmod(int(np.argmax(run.good)), setup.poses)
    _, frame = random_frame(sky, setup, options.seed + seed, row)
    result = frame_result(frame.image, setup.believed_camera, options.matcher_of(sky), options.finder())
    matched = len(result.fix.stars) if isinstance(result.fix, CameraFix) else 0
    title = f"{matched} of {len(result.stars)} stars identified in {1e3 * result.identify_s:.1f} ms"
    return FramePicture(
        title, frame.image, result.stars.positions_px, result.fix, sky.positions_m, setup.believed_camera
    )


def _pose(values: ArrayLike) -> Pose:
    x, y, heading = np.asarray(values, dtype=np.float64).tolist()
    return Pose(x, y, heading)


def drive_picture(options: MockupOptions, sky: LedSky) -> DrivePicture:
    """Frames along a drive around the table, at its speed, and at rest, all identified."""
    from adcs.plots.mockup_vision import DrivePicture
    from sims.mockup.frames import Motion, rendered_frame
    from sims.mockup.table_run import TableScenario, table_run

    setup, matcher, finder, seed = options.sky_setup(), options.matcher_of(sky), options.finder(), options.seed
    truth = table_run(TableScenario(duration_s=_DRIVE_S), seed).truth
    rows = np.arange(0, len(truth), round(_DRIVE_STEP_S / (truth.time_s[1] - truth.time_s[0])))
    rate = np.gradient(truth.heading_rad, truth.time_s)
    rng = np.random.default_rng([seed, 2])

    def place(pose: Pose, motion: Motion) -> FloatArray:
        image = rendered_frame(sky, setup.camera, pose, rng, motion, setup.quality).image
        fix = frame_result(image, setup.believed_camera, matcher, finder).fix
        return fix.position_m if isinstance(fix, CameraFix) else np.full(2, np.nan)

    driven = [
        place(
            _pose([*truth.position_m[row], truth.heading_rad[row]]),
            Motion((float(truth.velocity_m_s[row, 0]), float(truth.velocity_m_s[row, 1])), float(rate[row])),
        )
        for row in rows
    ]
    rest = [place(Pose(*_REST_M, _REST_RAD), Motion()) for _ in range(_REST_FRAMES)]
    return DrivePicture(
        f"Position by the camera alone, matcher {value_or(options.matcher, 'robust')}",
        sky.positions_m,
        truth.position_m[rows],
        np.array(driven),
        _REST_STEP_S * np.arange(_REST_FRAMES, dtype=np.float64),
        np.array(rest),
        np.array(_REST_M),
    )


def write_frames(results: Mapping[Path, FrameResult], sky: LedSky, camera: Camera, out: Path) -> list[str]:
    """Write a figure of every frame that was read, and a table."""
    from adcs.plots.mockup_vision import FramePicture, frame_figure

    names: list[str] = []
    rows: list[list[float]] = []
    for path, result in results.items():
        fix, stars = result.fix, result.stars
        if isinstance(fix, CameraFix):
            rows.append([*fix.position_m, math.degrees(fix.heading_rad), 1e3 * fix.rms_m])
        else:
            rows.append([math.nan] * 4)
        picture = FramePicture(path.name, read_frame(path, camera), stars.positions_px, fix, sky.positions_m, camera)
        names.append(f"{path.stem}-stars.png")
        style.save(frame_figure(picture), out / names[-1])
    columns = {
        "file": [path.name for path in results],
        **dict(zip(("x_m", "y_m", "heading_deg", "rms_mm"), np.array(rows).T, strict=True)),
        "stars": np.array([len(result.stars) for result in results.values()], dtype=np.int64),
        "reason": ["" if isinstance(r.fix, CameraFix) else r.fix.reason for r in results.values()],
    }
    write_columns(columns, out / "mockup-frames.csv")
    return [*names, "mockup-frames.csv"]


def write_zeros(runs: ZerosRuns, out: Path) -> list[str]:
    """Write the first run's figure and samples, and a row of every run."""
    from adcs.plots.mockup_navigation import ZerosPicture, zeros_figure

    first = runs.results[0]
    # With slopes, what is found is the zeros at the beginning.
    true_zeros, when = first.run.zero_m_s2, "on average"
    if runs.unknowns == "drift":
        true_zeros, when = true_zeros[:1], "at first"
    (x, y), (true_x, true_y) = first.fit.zero_m_s2, true_zeros.mean(axis=0)
    title = (
        f"zeros {x:.4f}, {y:.4f} m/s² found, {true_x:.4f}, {true_y:.4f} true {when}; "
        f"unknowns {runs.unknowns}, seed {first.seed}"
    ).replace("-", "\N{MINUS SIGN}")
    picture = ZerosPicture(
        title, first.run.imu, first.run.fixes, first.run.truth, first.before, first.after,
        first.position_before_mm, first.position_rms_mm,
    )  # fmt: skip
    style.save(zeros_figure(picture), out / "mockup-zeros.png")
    write_table(out / "mockup-zeros.csv", _ZEROS_SAMPLES, _zeros_samples(first))
    rows = [
        [each.seed, *each.fit.zero_m_s2, each.zero_error_m_s2, each.position_before_mm, each.position_rms_mm,
         1e3 * each.fit.residual_rms_m]
        for each in runs.results
    ]  # fmt: skip
    columns = ("seed", "zero_x_m_s2", "zero_y_m_s2", "zero_error_m_s2", "before_rms_mm", "after_rms_mm", "fit_rms_mm")
    write_table(out / "mockup-zeros-runs.csv", columns, np.array(rows))
    _write_fixes(first.run.fixes.time_s, first.run.fixes.arrival_s, first.run.fixes.position_m,
                 first.run.fixes.heading_rad, out / "mockup-fixes.csv")  # fmt: skip
    return ["mockup-zeros.png", "mockup-zeros.csv", "mockup-zeros-runs.csv", "mockup-fixes.csv"]


_ZEROS_SAMPLES = (
    *("time_s", "acceleration_x_m_s2", "acceleration_y_m_s2", "rate_deg_s", "true_x_m", "true_y_m"),
    *("before_x_m", "before_y_m", "after_x_m", "after_y_m", "after_heading_deg"),
)


def _zeros_samples(result: ZerosResult) -> FloatArray:
    imu = result.run.imu
    return np.column_stack(
        [
            imu.time_s,
            imu.acceleration_m_s2,
            np.degrees(imu.rate_rad_s),
            result.run.truth.position_m,
            result.before.position_m,
            result.after.position_m,
            np.degrees(result.after.heading_rad),
        ]
    )


def write_fusion(runs: FusionRuns, out: Path) -> list[str]:
    """Write the first run's figures, samples and fixes, and a row of every run."""
    from adcs.plots.mockup_navigation import FusionPicture, errors_figure, fusion_figure

    first = runs.results[0]
    run, track = first.run, first.fused.track
    fixes = run.fixes.rows(slice(len(first.fused.outcomes)))
    sigma = track.sigma if isinstance(track, FilterTrack) else None
    title = f"{METHOD_WORDS[runs.method]}: {first.errors.position_rms_mm:.1f} mm rms after {SETTLED_S:g} s"
    picture = FusionPicture(
        f"{title[:1].upper()}{title[1:]}, seed {first.seed}",
        run.truth,
        track,
        fixes,
        first.fused.outcomes,
        None if sigma is None else sigma[:, :2],
        None if sigma is None else sigma[:, 4],
        SETTLED_S,
    )
    style.save(fusion_figure(picture), out / "mockup-fusion.png")
    style.save(errors_figure(picture), out / "mockup-fusion-errors.png")
    columns, table = _fusion_samples(first)
    write_table(out / "mockup-fusion.csv", columns, table)
    rows = [[each.seed, *(getattr(each.errors, name) for name in _ERRORS)] for each in runs.results]
    write_table(out / "mockup-fusion-runs.csv", ("seed", *_ERRORS), np.array(rows))
    used = np.array([outcome in (Outcome.USED, Outcome.REACQUIRED) for outcome in first.fused.outcomes])
    _write_fixes(
        fixes.time_s, fixes.arrival_s, fixes.position_m, fixes.heading_rad, out / "mockup-fixes.csv",
        {"false": run.false[: len(used)], "used": used},
    )  # fmt: skip
    return [
        *("mockup-fusion.png", "mockup-fusion-errors.png", "mockup-fusion.csv", "mockup-fusion-runs.csv"),
        "mockup-fixes.csv",
    ]


def write_methods(every: Sequence[FusionRuns], out: Path) -> list[str]:
    """Write a figure of the first run by all methods, and a row of every run and method."""
    from adcs.plots.mockup_navigation import methods_figure

    lines = []
    for runs in every:
        result = runs.results[0]
        distance = np.linalg.norm(result.fused.track.position_m - result.run.truth.position_m, axis=1)
        label = f"{runs.method}: {result.errors.position_rms_mm:.1f} mm rms"
        lines.append((label, result.run.truth.time_s, 1e3 * distance))
    style.save(methods_figure(lines, SETTLED_S), out / "mockup-methods.png")
    each = [(runs.method, one.seed, one.errors) for runs in every for one in runs.results]
    columns: dict[str, Column] = {
        "fusion": [method for method, _, _ in each],
        "seed": np.array([seed for _, seed, _ in each], dtype=np.int64),
        **{name: np.array([getattr(errors, name) for _, _, errors in each]) for name in _ERRORS},
    }
    write_columns(columns, out / "mockup-methods.csv")
    return ["mockup-methods.png", "mockup-methods.csv"]


_ERRORS = ("position_rms_mm", "position_p95_mm", "position_max_mm", "velocity_rms_mm_s", "heading_rms_deg")


def _fusion_samples(result: FusionResult) -> tuple[tuple[str, ...], FloatArray]:
    truth, track, imu = result.run.truth, result.fused.track, result.run.imu
    table = {
        "time_s": track.time_s,
        "acceleration_x_m_s2": imu.acceleration_m_s2[:, 0],
        "acceleration_y_m_s2": imu.acceleration_m_s2[:, 1],
        "rate_deg_s": np.degrees(imu.rate_rad_s),
    }
    for name, one in (("true_", truth), ("", track)):
        table |= {
            f"{name}x_m": one.position_m[:, 0],
            f"{name}y_m": one.position_m[:, 1],
            f"{name}vx_m_s": one.velocity_m_s[:, 0],
            f"{name}vy_m_s": one.velocity_m_s[:, 1],
            f"{name}heading_deg": np.degrees(one.heading_rad),
        }
    if isinstance(track, FilterTrack):
        table |= {
            "zero_x_m_s2": track.zero_m_s2[:, 0],
            "zero_y_m_s2": track.zero_m_s2[:, 1],
            "sigma_x_mm": 1e3 * track.sigma[:, 0],
            "sigma_y_mm": 1e3 * track.sigma[:, 1],
            "sigma_heading_deg": np.degrees(track.sigma[:, 4]),
        }
    return tuple(table), np.stack(list(table.values()), axis=1)


def _write_fixes(
    time_s: FloatArray,
    arrival_s: FloatArray,
    position_m: FloatArray,
    heading_rad: FloatArray,
    path: Path,
    more: Mapping[str, NDArray[np.bool_]] | None = None,
) -> None:
    columns: dict[str, Column] = {
        "exposure_s": time_s,
        "arrival_s": arrival_s,
        "x_m": position_m[:, 0],
        "y_m": position_m[:, 1],
        "heading_deg": np.degrees(heading_rad),
    }
    write_columns({**columns, **(more or {})}, path)


def write_record(run: RecordRun, out: Path) -> list[str]:
    """Write the estimate and its figure."""
    from adcs.plots.mockup_navigation import FusionPicture, fusion_figure
    from magloc.plots import style

    track = run.fused.track
    table = {
        "time_s": track.time_s,
        "x_m": track.position_m[:, 0],
        "y_m": track.position_m[:, 1],
        "vx_m_s": track.velocity_m_s[:, 0],
        "vy_m_s": track.velocity_m_s[:, 1],
        "heading_deg": np.degrees(track.heading_rad),
    }
    if isinstance(track, FilterTrack):
        table |= {
            "zero_x_m_s2": track.zero_m_s2[:, 0],
            "zero_y_m_s2": track.zero_m_s2[:, 1],
            "zero_rate_deg_s": np.degrees(track.zero_rad_s),
            "sigma_x_mm": 1e3 * track.sigma[:, 0],
            "sigma_y_mm": 1e3 * track.sigma[:, 1],
            "sigma_heading_deg": np.degrees(track.sigma[:, 4]),
        }
    write_table(out / "mockup-estimate.csv", tuple(table), np.stack(list(table.values()), axis=1))
    # There is no truth; this figure shows none.
    picture = FusionPicture(
        f"Recording, fusion {run.method}",
        track,
        track,
        run.fixes.rows(slice(len(run.fused.outcomes))),
        run.fused.outcomes,
        begin_s=run.imu.begin_s + SETTLED_S,
    )
    style.save(fusion_figure(picture), out / "mockup-fusion.png")
    return ["mockup-fusion.png", "mockup-estimate.csv"]
