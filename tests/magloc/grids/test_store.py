"""Maps streamed to disk: interrupted, damaged, full, resumed, on a cluster.

| what | who checks it |
|---|---|
| a stored map | the same map made in memory, to the last bit |
| nothing is done twice | a log of every box that was computed; the files' times |
| memory | the peak of a process that makes a map with eight times the points |
"""

from __future__ import annotations

import gc
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from arrays.io.errors import InputError
from magloc.convergence.filters import IekfFilter
from magloc.convergence.over_starts import StartsMap, StartsScenario, summary
from magloc.grids.cube import Box, Tally, Variable, boxes, computed, in_memory
from magloc.grids.store import Sweep, chunk_seconds, open_map
from tests.conftest import REPOSITORY
from tests.waiting import wait_for


@dataclass(frozen=True)
class Waves:
    """A map that costs nothing, and notes down what it computes."""

    grid: int
    log: Path
    edge: int = 32
    phase: float = 0.0
    pause_s: float = 0.0
    point: str = "point"

    @property
    def axis(self) -> np.ndarray:
        return np.linspace(-1.0, 1.0, self.grid)

    @property
    def variables(self) -> dict[str, Variable]:
        return {
            "height": Variable(np.float64, {"units": "m"}),
            "sign": Variable(np.int8, {"flag_values": np.array([-1, 1], np.int8), "flag_meanings": "below above"}),
        }

    @property
    def attributes(self) -> dict[str, Any]:
        return {"phase": self.phase, "grid": self.grid, "centroid": np.zeros(3)}

    @property
    def findings(self) -> dict[str, Any]:
        return {"found": 1.5}

    def values(self, box: Box) -> dict[str, np.ndarray]:
        if box.region[0].start % self.edge == 0:  # a box is computed layer by layer
            with self.log.open("a") as log:
                log.write(f"{box.place}\n")
        time.sleep(self.pause_s)
        height = np.sin(box.points(self.axis) @ [3.0, 5.0, 7.0] + self.phase).reshape(box.shape)
        return {"height": height, "sign": np.where(height < 0.0, -1, 1).astype(np.int8)}


@pytest.fixture
def waves(tmp_path):
    return Waves(40, tmp_path / "log", edge=16)  # 27 chunks, those at the end smaller


def run(cube, path):
    with Sweep(cube, path) as sweep:
        sweep.write(map(partial(computed, cube), sweep.unfinished()))
        return sweep


def computed_boxes(cube):
    return cube.log.read_text().splitlines()


def assert_same(path, expected):
    """A stored map has the values and attributes of one in memory, to the last bit."""
    with open_map(path) as stored:
        xr.testing.assert_identical(stored.drop_attrs(), expected.drop_attrs())
        assert set(stored.attrs) == set(expected.attrs)
        for key in set(expected.attrs) - {"seconds"}:
            np.testing.assert_array_equal(stored.attrs[key], expected.attrs[key])


class TestStore:
    def test_the_map_in_memory(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_opens_in_xarray_with_cf_attributes(self, tmp_path):
        scenario = StartsScenario(method=IekfFilter())
        run(StartsMap.of(scenario, 5), tmp_path / "map.zarr")
        dataset = xr.open_zarr(tmp_path / "map.zarr")
        expected = in_memory(StartsMap.of(scenario, 5))
        assert dataset.attrs["Conventions"] == "CF-1.10"
        assert float(dataset.seconds_of_chunk.sum()) > 0.0
        for name, variable in expected.variables.items():
            stored = dataset[name]
            np.testing.assert_array_equal(stored.values, variable.values)
            assert stored.dtype == variable.dtype
            assert set(stored.attrs) == set(variable.attrs)
            for key, value in variable.attrs.items():
                np.testing.assert_array_equal(stored.attrs[key], value)

    def test_summary_is_that_of_the_whole_map(self, tmp_path):
        cube = StartsMap.of(StartsScenario(), 40)
        run(cube, tmp_path / "map.zarr")
        with open_map(tmp_path / "map.zarr") as dataset:
            counts = summary(dataset)
            whole = dataset.load()
        converged = whole.status.to_numpy() == 0
        assert counts == summary(whole)
        assert counts.converged == converged.sum()
        assert counts.front_fraction == converged[whole.half.to_numpy() == 1].mean()
        assert counts.median_iterations == np.median(whole.iterations.to_numpy()[converged])
        assert counts.iterations_total == whole.iterations.to_numpy().sum()

    def test_netcdf_of_a_store(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        with open_map(tmp_path / "map.zarr") as stored:
            stored.to_netcdf(tmp_path / "map.nc")
        with xr.open_dataset(tmp_path / "map.nc") as again:
            np.testing.assert_array_equal(again.height, in_memory(waves).height)
            assert again.sign.attrs["flag_values"].dtype == np.int8

    def test_boxes_do_not_matter(self, waves):
        fine = in_memory(waves)
        coarse = in_memory(Waves(40, waves.log, edge=64))
        xr.testing.assert_equal(fine, coarse)

    @pytest.mark.parametrize("n", [1, 2, 7, 8])
    def test_median_of_a_histogram(self, n):
        iterations = np.random.default_rng(n).integers(1, 9, n)
        halves = (iterations[: n // 2], iterations[n // 2 :])
        tally = sum((Tally.of({"converged": np.ones(len(half), bool)}, half) for half in halves), Tally())
        assert tally.median_iterations() == np.median(iterations)


class TestInterruption:
    def test_waits_for_a_part_of_a_box_and_not_for_the_box(self, waves, monkeypatch):
        parts = []

        def values(_, box):
            parts.append(box.shape)
            signal.raise_signal(signal.SIGINT)
            return {}

        monkeypatch.setattr(Waves, "values", values)
        with pytest.raises(KeyboardInterrupt):
            next(map(partial(computed, waves), boxes(waves)))
        assert parts == [(6, 16, 16)]

    @pytest.mark.parametrize("passes", [100, 500])
    def test_starts_that_may_take_eight_times_as_long_have_boxes_of_half_the_edge(self, passes):
        edges = [
            StartsMap.of(StartsScenario(method=IekfFilter(max_iterations=times * passes)), 100).edge for times in (1, 8)
        ]
        assert edges[0] // 2 == edges[1]


class TestResume:
    def test_finished_is_finished(self, waves, tmp_path):
        first = run(waves, tmp_path / "map.zarr")
        seconds = chunk_seconds(tmp_path / "map.zarr")
        again = run(waves, tmp_path / "map.zarr")
        np.testing.assert_array_equal(chunk_seconds(tmp_path / "map.zarr"), seconds)
        assert len(computed_boxes(waves)) == 27
        assert again.chunks_done == again.n_chunks == first.chunks_done == 27

    def test_after_an_error(self, waves, tmp_path):
        def broken():
            yield from list(map(partial(computed, waves), boxes(waves)))[:5]
            raise KeyboardInterrupt

        with Sweep(waves, tmp_path / "map.zarr") as sweep, pytest.raises(KeyboardInterrupt):
            sweep.write(broken())
        waves.log.unlink()
        with Sweep(waves, tmp_path / "map.zarr") as sweep:
            assert sweep.points_done == sum(box.size for box in list(boxes(waves))[:5])
        assert run(waves, tmp_path / "map.zarr").chunks_done == 27
        assert len(computed_boxes(waves)) == 22
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_after_kill_9(self, waves, tmp_path):
        script = (
            "import sys; from pathlib import Path; from tests.magloc.grids.test_store import Waves, run;"
            f"run(Waves(40, Path({str(waves.log)!r}), edge=16, pause_s=0.02), {str(tmp_path / 'map.zarr')!r})"
        )
        process = subprocess.Popen([sys.executable, "-c", script], cwd=REPOSITORY)
        marks = tmp_path / "map.zarr" / "seconds_of_chunk" / "c"
        wait_for(lambda: len(chunk_files(marks)) >= 5)
        process.send_signal(signal.SIGKILL)
        process.wait()
        done = {path: path.stat().st_mtime_ns for path in chunk_files(marks)}
        assert 5 <= len(done) < 27
        for mark in list(done):  # and all that belongs to them
            for name in waves.variables:
                path = tmp_path / "map.zarr" / name / mark.relative_to(tmp_path / "map.zarr" / "seconds_of_chunk")
                done[path] = path.stat().st_mtime_ns
        before = computed_boxes(waves)
        with Sweep(waves, tmp_path / "map.zarr") as sweep:
            assert sweep.chunks_done == len(done) / 3
            sweep.write(map(partial(computed, waves), sweep.unfinished()))
        assert {path: path.stat().st_mtime_ns for path in done} == done
        # The one that was being computed or written is computed again, no other.
        assert len(computed_boxes(waves)) <= 28
        assert len(before) - len(done) / 3 <= 1
        assert set(map(str, (box.place for box in boxes(waves)))) == set(computed_boxes(waves))
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_a_store_with_other_chunks(self, waves, tmp_path):
        """How large new chunks are may change; a store goes on with its own."""
        with Sweep(waves, tmp_path / "map.zarr") as sweep:
            sweep.write(itertools.islice(map(partial(computed, waves), sweep.unfinished()), 5))
        assert run(replace(waves, edge=20), tmp_path / "map.zarr").chunks_done == 27
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_written_without_its_mark(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        (tmp_path / "map.zarr/seconds_of_chunk/c/1/1/1").unlink()
        truncate(tmp_path / "map.zarr/height/c/1/1/1")
        waves.log.unlink()
        sweep = run(waves, tmp_path / "map.zarr")
        assert computed_boxes(waves) == ["(1, 1, 1)"]
        assert sweep.unreadable == []
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("name", ["height", "sign"])
    @pytest.mark.parametrize("place", [(0, 1, 0), (2, 2, 2)])
    def test_a_damaged_chunk_is_reported_and_done_again(self, waves, name, place, tmp_path):
        run(waves, tmp_path / "map.zarr")
        truncate(tmp_path / "map.zarr" / name / "c" / "/".join(map(str, place)))
        waves.log.unlink()
        sweep = run(waves, tmp_path / "map.zarr")
        assert computed_boxes(waves) == [str(place)]
        (sentence,) = sweep.unreadable
        assert f"chunk {place} cannot be read" in sentence
        assert sweep.points_done == 40**3
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_a_flipped_bit_is_noticed(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        path = tmp_path / "map.zarr/height/c/0/0/0"
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
        assert len(run(waves, tmp_path / "map.zarr").unreadable) == 1
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_a_chunk_that_states_a_huge_size(self, waves, tmp_path):
        """The decoder would allocate the size that the chunk's header states."""
        run(waves, tmp_path / "map.zarr")
        path = tmp_path / "map.zarr/height/c/0/0/0"
        data = path.read_bytes()
        width = (data[4] >> 5 & 1, 2, 4, 8)[data[4] >> 6]
        begin = 6 - (data[4] >> 5 & 1)
        stated = int.from_bytes(data[begin : begin + width], "little") + (256 if width == 2 else 0)
        assert stated == 16**3 * 8  # the field of RFC 8878 is where this test looks for it
        header = data[:4] + bytes([data[4] & 0x3F | 0xC0]) + data[5:begin] + (2**34).to_bytes(8, "little")
        path.write_bytes(header + data[begin + width :])
        with pytest.raises(ValueError, match=f"states {2**34} bytes"):
            open_map(tmp_path / "map.zarr")
        assert len(run(waves, tmp_path / "map.zarr").unreadable) == 1
        assert_same(tmp_path / "map.zarr", in_memory(waves))

    def test_a_damaged_mark(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        truncate(tmp_path / "map.zarr/seconds_of_chunk/c/0/0/1")
        waves.log.unlink()
        run(waves, tmp_path / "map.zarr")
        assert computed_boxes(waves) == ["(0, 0, 1)"]

    def test_a_missing_chunk(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        (tmp_path / "map.zarr/sign/c/0/0/0").unlink()
        assert "sign is missing" in run(waves, tmp_path / "map.zarr").unreadable[0]
        assert_same(tmp_path / "map.zarr", in_memory(waves))


class TestRefused:
    def test_another_map(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        before = snapshot(tmp_path)
        with pytest.raises(InputError, match=r"found another map, with phase 0.0 instead of 1.0"):
            Sweep(Waves(40, waves.log, edge=16, phase=1.0), tmp_path / "map.zarr")
        with pytest.raises(InputError, match="with grid 40 instead of 41"):
            Sweep(Waves(41, waves.log, edge=16), tmp_path / "map.zarr")
        assert snapshot(tmp_path) == before

    @pytest.mark.parametrize("what", ["file", "folder", "group"])
    def test_something_else(self, waves, what, tmp_path):
        path = tmp_path / "map.zarr"
        if what == "file":
            path.write_text("kept")
        else:
            path.mkdir()
            (path / ("notes.txt" if what == "folder" else "zarr.json")).write_text("{}")
        before = snapshot(tmp_path)
        with pytest.raises(InputError, match=r"map\.zarr: found .*, expected a map or nothing"):
            Sweep(waves, path)
        assert snapshot(tmp_path) == before

    def test_a_map_of_which_a_part_is_missing(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        (tmp_path / "map.zarr/height/zarr.json").unlink()
        with pytest.raises(InputError, match="incomplete map"):
            Sweep(waves, tmp_path / "map.zarr")

    def test_parts_that_are_missing_are_told_once(self, waves, tmp_path, caplog):
        """Tasks that fail beside the first one say nothing when they are collected."""
        run(waves, tmp_path / "map.zarr")
        for file in (tmp_path / "map.zarr").glob("*/zarr.json"):
            file.unlink()
        with pytest.raises(KeyError):
            open_map(tmp_path / "map.zarr")
        gc.collect()
        assert not caplog.text

    @pytest.mark.skipif(sys.platform == "win32", reason="there are no devices in folders")
    @pytest.mark.parametrize("name", ["height/c/0/0/0", "x/zarr.json"])
    def test_a_device_in_place_of_a_file(self, waves, name, tmp_path):
        run(waves, tmp_path / "map.zarr")
        (tmp_path / "map.zarr" / name).unlink()
        (tmp_path / "map.zarr" / name).symlink_to("/dev/zero")
        for attempt in (lambda: Sweep(waves, tmp_path / "map.zarr"), lambda: open_map(tmp_path / "map.zarr")):
            with pytest.raises(InputError, match=f"found {name}, which is neither a file nor a folder"):
                attempt()

    def test_marks_of_other_chunks(self, waves, tmp_path):
        run(waves, tmp_path / "map.zarr")
        path = tmp_path / "map.zarr/seconds_of_chunk/zarr.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"shape": [2, 2, 2]}))
        with pytest.raises(InputError, match="found chunks that are not those of a map"):
            Sweep(waves, tmp_path / "map.zarr")

    @pytest.mark.skipif(sys.platform == "win32", reason="needs file locks")
    def test_two_processes_at_once(self, waves, tmp_path):
        with (
            Sweep(waves, tmp_path / "map.zarr"),
            pytest.raises(InputError, match="another process is writing"),
        ):
            Sweep(waves, tmp_path / "map.zarr")
        assert run(waves, tmp_path / "map.zarr").chunks_done == 27

    def test_another_process_made_it_in_the_meantime(self, waves, tmp_path, monkeypatch):
        """Between the look at the path and the new store in its place."""
        path = tmp_path / "map.zarr"
        run(waves, path)
        exists, first = Path.exists, iter([False])
        monkeypatch.setattr(Path, "exists", lambda place, **_: next(first, True) and exists(place))
        with Sweep(waves, path) as sweep:
            assert sweep.chunks_done == 27
        assert {place.name for place in tmp_path.iterdir()} == {"log", "map.zarr"}


class TestFullDisk:
    def test_keeps_what_was_done(self, waves, tmp_path):
        disk = tmp_path / "disk"
        disk.mkdir()
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(disk)], capture_output=True, text=True
        )
        if mounted.returncode:  # only root may
            pytest.skip(f"cannot mount a small file system: {mounted.stderr.strip()}")
        try:
            with Sweep(waves, disk / "map.zarr") as sweep:
                with pytest.raises(OSError, match="No space left on device"):
                    sweep.write(map(partial(computed, waves), sweep.unfinished()))
                done = sweep.chunks_done
            assert 0 < done < 27
            subprocess.run(["mount", "-o", "remount,size=20m", str(disk)], check=True)
            with Sweep(waves, disk / "map.zarr") as sweep:
                assert sweep.chunks_done == done
                assert sweep.unreadable == []
                sweep.write(map(partial(computed, waves), sweep.unfinished()))
            assert_same(disk / "map.zarr", in_memory(waves))
        finally:
            subprocess.run(["umount", str(disk)], check=True)


class TestMemory:
    @pytest.mark.slow
    def test_does_not_grow_with_the_map(self, tmp_path):
        peaks = [peak_mib(tmp_path, grid) for grid in (64, 128)]
        # In memory, 128³ points would take 128³ · (8 + 1) bytes = 18 MiB more even without a copy.
        assert peaks[1] - peaks[0] < 8.0


def peak_mib(folder: Path, grid: int) -> float:
    script = (
        "import resource; from pathlib import Path; from tests.magloc.grids.test_store import Waves, run;"
        f"run(Waves({grid}, Path({str(folder / 'log')!r})), {str(folder / f'{grid}.zarr')!r});"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    result = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, check=True, capture_output=True, text=True)
    return int(result.stdout) / 1024.0


def chunk_files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".partial"]


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def snapshot(folder: Path) -> dict[Path, tuple[int, bytes]]:
    return {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in sorted(folder.rglob("*")) if p.is_file()}
