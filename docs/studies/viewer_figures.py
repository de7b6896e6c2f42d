"""How long a page of the viewer takes in the browser: ``python -m docs.studies.viewer_figures``.

Times of the page are processor times of its main thread, and the whole time until its text appears. A
machine without a graphics card draws in software, on the same processors; frames are counted beside it.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import arrays
import magloc
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.tracking.files import json_of_track, read_track
from magloc.tracking.results import TrackPoint
from magloc.viewer.live_view import LiveView
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR
from tests.browser.browser import Browser
from tests.browser.screen import Screen, Sight, hue_of

# Notes when the words of a panel change, and how long frames and tasks of the main thread take.
WATCH = """(() => {
  window.words = {}, window.frames_ms = [], window.tasks_ms = [];
  const note = text => {
    const found = text && text.match(/(?:time|row) [0-9.]+(?= s| of)/);
    if (found && !(found[0] in words)) words[found[0]] = performance.timeOrigin + performance.now();
  };
  const look = changes => changes.forEach(change => note(change.target.textContent));
  new MutationObserver(look).observe(document.body, {subtree: true, childList: true, characterData: true});
  let last = performance.now();
  const frame = now => { frames_ms.push(now - last); last = now; requestAnimationFrame(frame); };
  requestAnimationFrame(frame);
  const tasks = list => list.getEntries().forEach(entry => tasks_ms.push(entry.duration));
  new PerformanceObserver(tasks).observe({entryTypes: ['longtask']});
})()"""
IDLE_S = 5.0


class Watch:
    """What a page does meanwhile."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        browser.call("Performance.disable")
        browser.call("Performance.setTimeDomain", timeDomain="threadTicks")
        browser.call("Performance.enable")
        browser.evaluate(WATCH)
        self._idle = self._main_thread_s(lambda: time.sleep(IDLE_S)) / IDLE_S

    def during(self, work: Callable[[], object]) -> tuple[float, list[float], list[float]]:
        """Processor time of the main thread beyond that of an idle page [s]; frames and long tasks [ms]."""
        self._browser.evaluate("frames_ms.length = 0; tasks_ms.length = 0; words = {}")
        begin = time.monotonic()
        busy = self._main_thread_s(work)
        busy -= self._idle * (time.monotonic() - begin)
        return busy, self._browser.evaluate("frames_ms"), self._browser.evaluate("tasks_ms")

    def words(self) -> dict[str, float]:
        """When words came up first [ms since 1970]."""
        return dict(self._browser.evaluate("words"))

    def _main_thread_s(self, work: Callable[[], object]) -> float:
        before = self._task_s()
        work()
        return self._task_s() - before

    def _task_s(self) -> float:
        metrics: list[dict[str, Any]] = self._browser.call("Performance.getMetrics")["metrics"]
        return next(metric["value"] for metric in metrics if metric["name"] == "TaskDuration")


def ms(values: Sequence[float]) -> str:
    """Median, and what nineteen of twenty do not exceed."""
    return f"median {np.median(values):.0f} ms, 95 % within {np.percentile(values, 95):.0f} ms"


def live_page(screen: Screen, n: int = 150, warm: int = 30) -> None:
    """Thirty vector sensors, ten rows a second: every one is drawn alone."""
    array = arrays.grid(6, 5, 0.1)
    angle = 0.02 * np.arange(warm + n)
    places = np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), np.full_like(angle, 0.3)], axis=1)
    noise = 1e-9 * np.random.default_rng(0).normal(size=(len(angle), array.n_channels))
    fields = np.array([predicted_channels(array, place, np.array([0.0, 0.0, 1.0])) for place in places])
    rows = Readings(fields + noise, time_s=0.1 * np.arange(len(angle)))
    tracker = magloc.Tracker(array, magloc.RandomWalk(0.1, 0.1))
    points = [tracker.update(row) for row in rows]
    sent: dict[str, float] = {}
    with LiveView(array, port=0, open=False) as view:
        screen.open_server(view._server)

        def play(indices: range) -> None:
            for i in indices:
                sent[f"time {points[i].time_s:.3f}"] = 1e3 * time.time()
                view.update(points[i], rows[i])
                time.sleep(0.1)

        play(range(warm))
        watch = Watch(screen.browser)
        ours = time.process_time()
        page_s, frames, tasks = watch.during(lambda: play(range(warm, warm + n)))
        ours = time.process_time() - ours
        shown = [at - sent[words] for words, at in watch.words().items() if words in sent]
        screen.leave()
    print(f"30 sensors, {n} updates: page {1e3 * page_s / n:.1f} ms, Python {1e3 * ours / n:.1f} ms of processor each")
    print(f"  {len(shown)} shown, from update to words {ms(shown)}")
    print(
        f"  frames {ms(frames)}, longest {max(frames):.0f} ms; {len(tasks)} tasks above 50 ms, {max(tasks, default=0)}"
    )


def long_track(screen: Screen, n: int = 100_000, steps: int = 60) -> None:
    """A track of many rows with its readings: opened, and its slider dragged from end to end."""
    array = arrays.tetrahedron(1.5)
    time_s = 0.01 * np.arange(n)
    angle = 0.02 * time_s
    positions = np.stack([3.0 * np.cos(angle), 3.0 * np.sin(3.1 * angle), 1.0 + np.sin(7.3 * angle)], axis=1)
    moment, covariance = np.array([0.0, 0.0, 80.0]), np.diag([1e-2] * 3 + [1.0] * 3)
    points = tuple(
        TrackPoint(float(t), place, moment, covariance, nis=9.0, nis_dof=9, status="tracked")
        for t, place in zip(time_s, positions, strict=True)
    )
    rows = Readings(np.random.default_rng(0).normal(size=(n, 12)) * 1e-9, time_s=time_s)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "track.json"
        file.write_bytes(msgspec.json.encode(json_of_track(points, None), enc_hook=np.ndarray.tolist))
        begin = time.monotonic()
        result = read_track(file)
        print(f"{n:,} rows: {file.stat().st_size / 1e6:.0f} MB of JSON read in {time.monotonic() - begin:.2f} s")
    begin = time.monotonic()
    with magloc.view(array, result, readings=rows, port=0, open=False) as view:
        served_s = time.monotonic() - begin
        screen.open_server(view._server)
        screen.browser.wait_for("/row [0-9]+ of/.test(document.body.innerText)")
        print(f"  served after {served_s:.2f} s, said in the page after {time.monotonic() - begin:.2f} s")
        places = screen.live_camera(view._server).pixels(positions[-1:])
        screen.until_seen(Sight("the source", places, hue_of(DIPOLE_COLOUR), radius=9))
        print(f"  drawn after {time.monotonic() - begin:.2f} s")
        time.sleep(3.0)
        watch = Watch(screen.browser)
        track, thumb = (screen.input("Time [s]", f".mantine-Slider-{part}") for part in ("track", "thumb"))
        y, x = thumb["y"] + 0.5 * thumb["height"], thumb["x"] + 0.5 * thumb["width"]
        ours = time.process_time()
        begin = time.monotonic()
        page_s, frames, tasks = watch.during(lambda: screen.browser.drag((x, y), (track["x"], y), steps=steps))
        took_s = time.monotonic() - begin
        screen.until(lambda: "row 1 of" in screen.text(), "the first row")
        late_s = time.monotonic() - begin - took_s
        ours = time.process_time() - ours
        seen = len(watch.words())
        screen.leave()
    print(
        f"  scrubbed in {steps} steps, {took_s:.1f} s: {seen} rows shown, the last one {late_s:.2f} s after the mouse"
    )
    print(f"  page {1e3 * page_s / steps:.1f} ms, Python {1e3 * ours / steps:.1f} ms of processor a step")
    print(
        f"  frames {ms(frames)}, longest {max(frames):.0f} ms; {len(tasks)} tasks above 50 ms, {max(tasks, default=0)}"
    )


def main() -> None:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as folder, Browser("about:blank") as browser:
        screen = Screen(browser, Path(folder))
        live_page(screen)
        long_track(screen)


if __name__ == "__main__":
    main()
