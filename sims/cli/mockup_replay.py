"""Replay of a drive of ``adcs run mockup``: --view, --html and --png."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from arrays.io.errors import InputError
from magloc.cli.framework import Flag, refuse_outside
from magloc.cli.options import Port, naming_outputs
from sims.cli.mockup_options import MockupOptions
from sims.experiments.mockup_settings import METHOD_WORDS

if TYPE_CHECKING:
    from adcs.viewer.drive import Drive
    from sims.experiments.mockup_camera import TableCamera
    from sims.experiments.mockup_navigation import FusionResult, FusionRuns


def check_places(replay: ReplayOptions) -> None:
    """Refuse, before long work, files that cannot be written, and pictures without a browser."""
    from magloc.viewer.outputs import check_outputs

    with naming_outputs():
        check_outputs(replay.html, replay.png)


def show_replay(runs: FusionRuns, camera: TableCamera, replay: ReplayOptions) -> None:
    """Show the first drive until Ctrl-C, or write it."""
    from adcs.viewer.drive_page import drive_page
    from magloc.cli.view import write_or_serve
    from magloc.viewer.view import View, open_view

    drive = drive_of(runs.results[0], runs.method, camera)
    at_s = 0.5 * drive.duration_s if replay.at is None else replay.at
    files = {"html": replay.html, "png": replay.png}

    def scene(port: int) -> View:
        title = f"adcs · mockup {runs.method}"
        return open_view(
            title, lambda server: drive_page(server, drive, at_s)[0], **files, movie=None, open=False, port=port
        )

    written = [str(file) for file in files.values() if file is not None]
    write_or_serve(scene, written, replay.port)


def drive_of(result: FusionResult, method: str, camera: TableCamera) -> Drive:
    """Return the drive of a run for a replay, with frames at the true positions."""
    from adcs.mockup.navigation.delayed_ekf import FilterTrack
    from adcs.viewer.drive import Drive, IdentifiedFrame

    run, track = result.run, result.fused.track

    def frame_of(fix: int) -> IdentifiedFrame:
        # The image of a fix does not depend on how often the fix comes.
        frame, found = camera.look(run.truth, float(run.exposure_s[fix]), result.seed)
        return IdentifiedFrame(frame.image, found.stars.positions_px, found.fix)

    arrived = slice(len(result.fused.outcomes))
    return Drive(
        title=f"Table-top satellite: {METHOD_WORDS[method]}",
        lights_m=camera.sky.positions_m,
        camera=camera.setup.camera,
        truth=run.truth,
        track=track,
        fixes=run.fixes.rows(arrived),
        exposure_s=run.exposure_s[arrived],
        outcomes=result.fused.outcomes,
        sigma_m=track.sigma[:, :2] if isinstance(track, FilterTrack) else None,
        frame_of=frame_of,
    )


@Parameter(name="*", group="Replay")
@dataclass(frozen=True)
class ReplayOptions:
    """Replay of the first drive, with --part fusion or all.

    Parameters
    ----------
    view : bool
        Start a server on this machine, and print its address for a browser on this machine.
    html : Path, optional
        HTML file to write; it plays the drive and needs no server.
    png : Path, optional
        Picture to write (.png); needs Chromium or Chrome.
    at : float, optional
        Time that the replay shows at first [s]; by default the middle of the drive.
    port : int
        Port of the server; the next free one if it is in use.
    """

    view: Flag = False
    html: Path | None = None
    png: Path | None = None
    at: float | None = None
    port: Port = 8080

    @property
    def wanted(self) -> bool:
        """Return whether a replay is to be shown or written."""
        return self.view or self.html is not None or self.png is not None

    def check(self, options: MockupOptions, *, json: bool) -> None:
        """Refuse options of a replay that contradict the others."""
        if not self.wanted:
            for name, given in (("--at", self.at is not None), ("--port", self.port != ReplayOptions.port)):
                if given:
                    raise InputError(f"{name}: found without a replay, expected --view, --html or --png too.")
            return
        option = "--view" if self.view else "--html" if self.html is not None else "--png"
        if options.part not in ("fusion", "all"):
            raise InputError(f"{option}: found with --part {options.part}, expected with --part fusion or all.")
        if options.samples is not None:
            raise InputError(f"{option}: found with --samples, expected with simulated drives, whose truth it shows.")
        if options.fusion == "all":
            raise InputError(f"{option}: found with --fusion all, expected one method.")
        if self.view and (self.html is not None or self.png is not None):
            raise InputError("--view: found with --html or --png, expected one or the other.")
        if self.view and json:
            raise InputError("--view: found with --json, expected one or the other: the address is printed too.")
        refuse_outside(0.0, options.duration_s, f"0 to {options.duration_s:g} s", unit=" s", at=self.at)
