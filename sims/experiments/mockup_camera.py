"""The mock-up end to end, with rendered frames: ``adcs run mockup --part all``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adcs.mockup.navigation.fixes import FixRecord
from adcs.mockup.navigation.strapdown import PlanarTrack
from adcs.mockup.vision.centroids import find_stars
from adcs.mockup.vision.paper_matcher import Matcher
from adcs.mockup.vision.sky import LedSky
from sims.experiments.mockup_vision import Finder, FrameResult, SkyRun, SkySetup, frame_result
from sims.mockup.frames import Frame, pose_and_motion, rendered_frame
from sims.mockup.table_run import TableRun, TableScenario, table_run


@dataclass(frozen=True, eq=False)
class TableCamera:
    """Camera of a drive, and the processing of its frames.

    Attributes
    ----------
    sky : LedSky
    setup : SkySetup
        Quality of the frames, and the calibration of the camera; positions and motions are from the drive.
    matcher, finder : callable
        Functions as in :func:`sims.experiments.sky_run`.
    delay_s : float, optional
        Delay from the middle of an exposure to its fix [s]; by default the rest of the exposure, and the time that this
        machine takes to find and identify the stars.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> from sims.experiments.mockup_camera import TableCamera
    >>> from sims.experiments.mockup_vision import SkySetup
    >>> sky, setup = mockup.led_sky(), SkySetup()
    >>> matcher = mockup.RobustMatcher(mockup.TriangleCatalogue.of(sky.positions_m), setup.camera.m_per_px)
    >>> run = TableCamera(sky, setup, matcher, delay_s=0.1).run(sims.TableScenario(duration_s=12.0), seed=0)
    >>> len(run.fixes), int(run.false.sum())
    (20, 0)
    """

    sky: LedSky
    setup: SkySetup
    matcher: Matcher
    finder: Finder = find_stars
    delay_s: float | None = None

    def look(self, truth: PlanarTrack, at_s: float, seed: int) -> tuple[Frame, FrameResult]:
        """Render the frame at an instant of a drive, always the same, and locate it."""
        pose, motion = pose_and_motion(truth, at_s)
        rng = np.random.default_rng([seed, round(1e3 * at_s)])
        frame = rendered_frame(self.sky, self.setup.camera, pose, rng, motion, self.setup)
        return frame, frame_result(frame.image, self.setup.believed_camera, self.matcher, self.finder)

    def run(self, scenario: TableScenario, seed: int) -> TableRun:
        """Simulate a drive with the fixes of its frames; of the camera's errors only outages remain."""
        exact = replace(scenario.camera, failed=0.0, false=0.0, overtaken=0.0, repeated=0.0)
        run = table_run(replace(scenario, camera=exact), seed)
        exposure_s = np.sort(run.exposure_s)
        if not exposure_s.size:
            return run
        self.look(run.truth, float(exposure_s[0]), seed)  # the first frame fills caches
        results = tuple(self.look(run.truth, at_s, seed)[1] for at_s in exposure_s.tolist())
        delay_s = np.array([self._delay_s(result) for result in results])
        true = run.truth.at(exposure_s)
        seen = SkyRun(np.column_stack([true.position_m, true.heading_rad]), results)
        stamp_s = exposure_s + scenario.camera.latency_s
        arrival_s = np.maximum(exposure_s + delay_s, stamp_s)
        row = np.flatnonzero(seen.found)
        row = row[np.argsort(arrival_s[row], kind="stable")]
        x, y, heading = seen.estimates[row].T
        sigma = np.array([result.sigma for result in results])[row]
        fixes = FixRecord(stamp_s[row], arrival_s[row], np.column_stack([x, y]), heading, sigma)
        return replace(run, fixes=fixes, exposure_s=exposure_s[row], false=seen.false_fixes[row])

    def _delay_s(self, result: FrameResult) -> float:
        if self.delay_s is not None:
            return self.delay_s
        return 0.5 * self.setup.camera.exposure_s + result.frame_s
