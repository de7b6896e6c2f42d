"""The replay of ``adcs run mockup --part fusion``: --view, --html and --png."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from adcs.commands.common import print_note
from adcs.commands.mockup_fusion import FusionResult, FusionRuns
from adcs.commands.mockup_options import ReplayOptions
from adcs.commands.mockup_picture import METHOD_WORDS
from arrays.errors import InputError
from magloc.output_files import refuse_unwritable

if TYPE_CHECKING:
    from adcs.viewer.drive import Drive, SeenFrame


def check_places(replay: ReplayOptions) -> None:
    """Refuse, before long work, files that cannot be written.

    Parameters
    ----------
    replay : ReplayOptions

    Raises
    ------
    InputError
        There is no such folder, or no browser for a picture.
    """
    from magloc.viewer.browser import find_chromium

    if replay.html is not None:
        refuse_unwritable(replay.html, "--html")
    if replay.png is not None:
        refuse_unwritable(replay.png, "--png", ".png")
        try:
            find_chromium()
        except InputError as error:
            raise InputError(f"--png: {error}") from None


def show_replay(runs: FusionRuns, replay: ReplayOptions, *, quiet: bool) -> None:
    """Show the first drive until Ctrl-C, or write it.

    Parameters
    ----------
    runs : FusionRuns
    replay : ReplayOptions
    quiet : bool
        No notes on stderr.

    Raises
    ------
    InputError
        A file cannot be written, there is no free port, or the browser fails.
    """
    from adcs.viewer.drive_page import drive_page, write_playing_page
    from magloc.viewer.browser import BrowserError
    from magloc.viewer.server import address, free_port, opened, wait_for_interruption, write_picture

    drive = drive_of(runs.results[0], runs.method)
    at_s = 0.5 * drive.duration_s if replay.at is None else replay.at
    used = free_port(replay.port) if replay.view else 0
    if used not in (0, replay.port) and replay.port and not quiet:
        print_note(f"port {replay.port} is in use, {used} is taken")
    with opened(used, f"adcs · mockup {runs.method}") as server:
        page, player = drive_page(server, drive, at_s)
        try:
            if replay.png is not None:
                write_picture(server, replay.png)
            if replay.html is not None:
                write_playing_page(server, page, player, drive, replay.html)
        except BrowserError as error:
            raise InputError(f"--png: {error}") from None
        if not replay.view:
            if not quiet:
                print_note(f"wrote {', '.join(str(file) for file in (replay.html, replay.png) if file is not None)}")
            return
        print(address(server), flush=True)
        if not quiet:
            print_note("open this address in a browser; Ctrl-C ends the viewer")
        wait_for_interruption()
        page.close()


def drive_of(result: FusionResult, method: str) -> Drive:
    """What a replay shows of a run.

    Parameters
    ----------
    result : FusionResult
    method : str

    Returns
    -------
    Drive
    """
    from adcs.mockup.camera import Camera
    from adcs.mockup.delayed_filter import FilterTrack
    from adcs.mockup.sky import led_sky
    from adcs.viewer.drive import Drive

    run, track = result.run, result.fused.track
    sky, camera = led_sky(), Camera()
    arrived = slice(len(result.fused.outcomes))
    return Drive(
        title=f"Table-top satellite: {METHOD_WORDS[method]}",
        lights_m=sky.positions_m,
        camera=camera,
        truth=run.truth,
        track=track,
        fixes=run.fixes.rows(arrived),
        exposure_s=run.exposure_s[arrived],
        outcomes=result.fused.outcomes,
        sigma_m=track.sigma[:, :2] if isinstance(track, FilterTrack) else None,
        frame_of=_frames_of(result),
    )


def _frames_of(result: FusionResult) -> Callable[[int], SeenFrame]:
    """Frames of a run's fixes, rendered where the satellite truly was, and identified."""
    from adcs.mockup.camera import Camera, Pose, undistorted
    from adcs.mockup.centroids import find_stars
    from adcs.mockup.robust_matching import RobustMatcher
    from adcs.mockup.sky import led_sky
    from adcs.mockup.triangles import TriangleCatalogue
    from adcs.viewer.drive import SeenFrame
    from sims.mockup.frames import Motion, rendered_frame

    sky, camera, truth = led_sky(), Camera(), result.run.truth
    matcher = RobustMatcher(TriangleCatalogue.of(sky.positions_m), camera.m_per_px)
    rate = np.gradient(truth.heading_rad, truth.time_s)

    def frame_of(fix: int) -> SeenFrame:
        at_s = result.run.exposure_s[fix]
        x, y, heading, along_x, along_y, turn = (
            float(np.interp(at_s, truth.time_s, values))
            for values in (*truth.position_m.T, truth.heading_rad, *truth.velocity_m_s.T, rate)
        )
        # One image for a fix that comes twice.
        rng = np.random.default_rng([result.seed, round(1e3 * at_s)])
        frame = rendered_frame(sky, camera, Pose(x, y, heading), rng, Motion((along_x, along_y), turn))
        stars = find_stars(frame.image)
        return SeenFrame(frame.image, stars.positions_px, matcher.identify(undistorted(camera, stars.positions_px)))

    return frame_of
