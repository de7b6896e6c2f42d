"""A source followed through a stream: as through the file, whatever happens to its rows on the way."""

from __future__ import annotations

import json
import logging
import random
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import magloc
from arrays.io.errors import InputError
from magloc.live import follower as follower_module
from magloc.live import tally as tally_module
from magloc.live.follower import RESTING, SKIPPED, STOPPED, Follower, track
from magloc.live.senders import Batch
from magloc.live.transports import Stream
from magloc.readings import Readings, write_readings
from magloc.tracking.motion import RandomWalk
from magloc.tracking.results import TrackPoint
from tests.moving_magnets import Magnets, board
from tests.passing_source import ARRAY, SLOW, moving_source, readings_of

FloatArray = NDArray[np.float64]
N_ROWS = 400
DT_S = 0.02


def passage(seed: int = 0, n: int = N_ROWS) -> tuple[Readings, FloatArray]:
    """Readings at 50 Hz of a source that passes at 0.08 m/s, and where it is."""
    time_s, p, m = moving_source(n, DT_S)
    return Readings(readings_of(ARRAY, p, m, seed), time_s=time_s), p


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    path = tmp_path_factory.mktemp("follower") / "rows.csv"
    write_readings(path, passage()[0], ARRAY)
    return path.read_text().splitlines()


def assert_same(found: list[TrackPoint], expected: list[TrackPoint]) -> None:
    """As :mod:`tests.magloc.tracking.test_batch` holds compiled and readable steps together."""
    assert [point.status for point in found] == [point.status for point in expected]
    for a, b in zip(found, expected, strict=True):
        assert a.time_s == b.time_s
        if a.position_m is not None and b.position_m is not None:
            np.testing.assert_allclose(a.position_m, b.position_m, rtol=0.0, atol=1e-9)


@pytest.fixture(scope="module")
def expected() -> list[TrackPoint]:
    return list(magloc.track(ARRAY, passage()[0], motion=SLOW))


class TestSources:
    """The same points, whatever the rows come as."""

    def test_a_replayed_file(self, lines: list[str], expected: list[TrackPoint], tmp_path: Path) -> None:
        (tmp_path / "rows.csv").write_text("\n".join(lines))
        found = list(track(f"replay:{tmp_path / 'rows.csv'}", ARRAY, motion=SLOW, replay_speed=1e3))
        assert_same(list(found), expected)
        assert found[-1].tally.rows == N_ROWS
        assert found[-1].tally.faults == 0

    def test_readings(self, expected: list[TrackPoint]) -> None:
        assert_same(list(track(passage()[0], ARRAY, motion=SLOW)), expected)

    def test_lines(self, lines: list[str], expected: list[TrackPoint]) -> None:
        assert_same(list(track(lines, ARRAY, motion=SLOW)), expected)

    def test_mappings(self, lines: list[str], expected: list[TrackPoint]) -> None:
        names = lines[0].split(",")
        rows = [dict(zip(names, map(float, line.split(",")), strict=True)) for line in lines[1:]]
        assert_same(list(track(rows, ARRAY, motion=SLOW)), expected)
        assert_same(list(track(map(json.dumps, rows), ARRAY, motion=SLOW)), expected)

    def test_an_array_with_a_pose(self) -> None:
        """Rows in the world, where each tells how the array moves since the one before."""
        diver = magloc.datasets.load("diver")
        motion = RandomWalk(1e-3, 1e-3)
        tracker = magloc.Tracker(diver.array, motion)
        readings = diver.readings[:20]
        expected = [tracker.update(row) for row in readings]
        assert_same(list(track(readings, diver.array, motion=motion)), expected)


class TestSeveral:
    BOARD = board()

    def test_are_those_of_a_tracker(self) -> None:
        """Two magnets through a replayed stream with a line that is no row."""
        rng = np.random.default_rng(1)
        readings = Magnets.drawn(2, 30, 0.03, rng).readings_T(self.BOARD, rng)
        rows = [Readings(values[None], time_s=np.array([0.01 * i])) for i, values in enumerate(readings)]
        tracker = magloc.SourcesTracker(self.BOARD, sources=2)
        expected = [tracker.update(row) for row in rows]
        lines: list[Readings | str] = [*rows[:9], "noise", *rows[9:]]
        found = list(track(lines, self.BOARD, sources=2))
        assert found[-1].tally.garbled == 1
        assert found[-1].tally.tracked == len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert one.sources is not None
            assert (one.status, one.nis) == (other.status, other.chi2)
            assert [source.id for source in one.sources.tracks] == [source.id for source in other.tracks] == [1, 2]
            for of_one, of_other in zip(one.sources.tracks, other.tracks, strict=True):
                np.testing.assert_array_equal(of_one.position_m, of_other.position_m)

    def test_while_nothing_is_followed_there_are_none(self) -> None:
        follower = Follower(self.BOARD, sources="auto", rest_s=0.02)
        rows = [Readings(np.zeros((1, self.BOARD.n_channels)), time_s=np.array([0.01 * i])) for i in range(4)]
        found = list(follower.follow(rows))
        assert [point.status for point in found] == [RESTING, RESTING, "no source", "no source"]
        assert all(point.sources is not None and point.sources.tracks == () for point in found)

    def test_refuses_the_motion_of_the_other(self) -> None:
        with pytest.raises(ValueError, match="Input motion must be a FreeMotion for several sources; instead received"):
            Follower(self.BOARD, SLOW, sources=2)
        with pytest.raises(ValueError, match="Input motion must be a motion of one source where sources are not given"):
            Follower(self.BOARD, magloc.FreeMotion())


class TestDamage:
    @pytest.mark.parametrize("seed", range(4))
    def test_a_tenth_lost_and_a_hundredth_garbled_is_no_wrong_track(self, lines: list[str], seed: int) -> None:
        """NEES of the position in all rows; one row in 10 million of a right track is above the limit."""
        rng = random.Random(seed)
        truth = dict(zip(passage()[0].time_s.tolist(), passage()[1], strict=True))
        sent, n_lost, n_garbled, doubled = [lines[0]], 0, 0, 0
        for line in lines[1:]:
            chance = rng.random()
            if chance < 0.1 and len(sent) > 20 and line is not lines[-1]:
                n_lost += 1
                continue
            if chance < 0.11:
                at = rng.randrange(len(line))
                sent.append(line[:at] + rng.choice("x;\0") + line[at + 1 :])
                n_garbled += 1
                n_lost += len(sent) > 20 and line is not lines[-1]
                continue
            sent.append(line)
            if chance > 0.98:
                sent.append(line)
                doubled += 1
        points = list(track(sent, ARRAY, motion=SLOW))
        tally = points[-1].tally
        assert (tally.garbled, tally.doubled, tally.late) == (n_garbled, doubled, 0)
        assert abs(tally.lost - n_lost) <= n_garbled
        tracked = [point for point in points if point.position_m is not None]
        assert len(tracked) > 0.97 * len(points)
        for point in tracked:
            assert point.position_m is not None
            assert point.covariance is not None
            error = point.position_m - truth[point.time_s]
            assert error @ np.linalg.solve(point.covariance[:3, :3], error) < 35.3

    def test_a_clock_that_is_set_back_starts_a_new_track(self) -> None:
        readings, _ = passage()
        points = list(track([readings, readings], ARRAY, motion=SLOW))
        assert points[-1].tally.restarts == 1
        assert [point.status for point in points].count("acquired") == 2
        assert points[-1].status == "tracked"


def batches_of(lines: list[str], size: int, waited_s: float = 0.0) -> Iterator[Batch]:
    for i in range(0, len(lines), size):
        encoded = [line.encode() for line in lines[i : i + size]]
        yield Batch(encoded, arrival_s=time.perf_counter() - waited_s)


class TestWhoFallsBehind:
    """Where the sender does not wait, only the newest of the waiting rows starts a track; all follow one."""

    def points(self, lines: list[str], size: int, motion: magloc.RandomWalk = SLOW) -> list[TrackPoint]:
        stream = Stream("the stream", batches_of(lines, size))
        return list(Follower(ARRAY, motion)._follow_stream(stream, waits=False))

    def test_before_there_is_a_track(self, lines: list[str]) -> None:
        points = self.points(lines, 50)
        assert len(points) == N_ROWS
        assert [point.status for point in points[:49]] == [SKIPPED] * 48 + ["acquired"]
        assert {point.status for point in points[49:]} == {"tracked"}

    def test_rows_that_waited_too_long_are_skipped(self, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
        """All but the newest of a batch, though there is a track; it is said with both rates, once."""
        batches = [*batches_of(lines[:50], 1), *batches_of(lines[50:], 50, waited_s=60.0)]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(tally_module, "_PACE_S", 0.01)
            follower = Follower(ARRAY, SLOW)
            points = list(follower._follow_stream(Stream("the stream", iter(batches)), waits=False))
        assert len(points) == N_ROWS
        assert [point.status for point in points[49:]] == ([SKIPPED] * 49 + ["tracked"]) * 7 + ["tracked"]
        assert follower.tally.skipped == 49 * 7
        (message,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
        assert re.fullmatch(
            r"the stream: \S+ rows arrive a second, but only \S+ can be followed; the oldest are skipped", message
        )

    def test_nobody_is_behind_with_single_rows(self, lines: list[str]) -> None:
        assert SKIPPED not in {point.status for point in self.points(lines, 1)}


class TestButtons:
    def test_stop_and_start(self) -> None:
        readings, _ = passage()
        follower = Follower(ARRAY, SLOW)
        statuses = []
        for i, point in enumerate(follower.follow(readings)):
            statuses.append(point.status)
            if i == 100:
                follower.stop()
            if i == 200:
                follower.start()
        assert statuses[101:201] == [STOPPED] * 100
        assert statuses[201] == "acquired"
        assert follower.tally.rows == N_ROWS

    def test_tare(self) -> None:
        """Later rows are as if there had always been nothing; here the source is tared away.

        What its motion leaves of it may begin a track, which the next rows contradict, but none where the source is.
        """
        readings, true_m = passage()
        follower = Follower(ARRAY, SLOW)
        points = []
        for i, point in enumerate(follower.follow(readings[:210])):
            points.append(point)
            if i == 100:
                follower.tare(2.0)
        assert {point.status for point in points[101:201]} == {follower_module.RESTING}
        left = [(p, true) for p, true in zip(points[201:], true_m[201:], strict=False) if p.position_m is not None]
        assert all(np.linalg.norm(point.position_m - true) > 0.5 for point, true in left)

    def test_a_moving_array_has_no_rest(self) -> None:
        diver = magloc.datasets.load("diver")
        follower = Follower(diver.array)
        next(follower.follow(diver.readings))
        with pytest.raises(InputError, match="an array that does not move"):
            follower.tare(1.0)
        with pytest.raises(InputError, match="an array that does not move"):
            next(Follower(diver.array, rest_s=1.0).follow(diver.readings))


class TestEnds:
    @pytest.mark.parametrize(
        ("text", "what"),
        [
            ("", "found nothing, expected a header"),
            ("HEADER", "found a header without rows"),
            ("HEADER\nx", r"found only garbled lines \(1\)"),
            ("x\ny", r"found only garbled lines \(2\)"),
        ],
    )
    def test_without_a_row(self, lines: list[str], tmp_path: Path, text: str, what: str) -> None:
        (tmp_path / "rows.csv").write_text(text.replace("HEADER", lines[0]))
        with pytest.raises(InputError, match=what):
            list(track(f"replay:{tmp_path / 'rows.csv'}", ARRAY))


class TestDoubts:
    """The first rows and the first points of a track are judged as a record is."""

    def test_an_array_in_millimetres(self, caplog: pytest.LogCaptureFixture) -> None:
        sensors = [replace(one, position_m=tuple(1e3 * x for x in one.position_m)) for one in ARRAY.sensors]
        follower = Follower(replace(ARRAY, sensors=tuple(sensors)), SLOW)
        with caplog.at_level(logging.WARNING):
            points = list(follower.follow(passage(n=60)[0]))
        assert points[-1].is_on_track
        assert sum("the sensors span" in text for text in caplog.messages) == 1
        assert sum("the moment is" in text for text in caplog.messages) == 1

    def test_none_of_what_is_right(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING):
            list(Follower(ARRAY, SLOW).follow(passage(n=60)[0]))
        assert not caplog.messages
