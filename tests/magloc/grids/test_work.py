"""Work on many items: wherever it is done, and after interruptions, it comes to the same."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arrays.io.errors import InputError
from magloc import core
from magloc.grids import work
from magloc.grids.work import Arrays, workers

ITEMS = [np.arange(3.0), np.arange(4.0), np.ones(2)]


def squared(item: Any) -> Arrays:
    return {"square": item**2, "name": np.array(["a", "bc"])}


def threads(_: Any) -> Arrays:
    return {"threads": np.array(core.threads())}


def died(_: Any) -> Arrays:
    os._exit(1)


class TestWorkers:
    def test_a_process_that_dies_is_said(self) -> None:
        with pytest.raises(InputError, match=r"a process died.*__main__"), workers(2, None, None) as each:
            list(each(died, ITEMS))

    @pytest.mark.parametrize("processes", [1, 2])
    def test_every_item_once(self, processes: int) -> None:
        with workers(processes, None, None) as each:
            done = dict(each(squared, ITEMS))
        assert sorted(done) == [0, 1, 2]
        for number, item in enumerate(ITEMS):
            np.testing.assert_array_equal(done[number]["square"], item**2)

    def test_a_process_has_one_thread(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("MAGLOC_NUM_THREADS", "3")
        with workers(2, None, None) as each:
            assert [int(made["threads"]) for _, made in each(threads, ITEMS)] == [1, 1, 1]

    def test_what_is_done_is_kept(self, tmp_path: Path) -> None:
        """Of an interrupted run everything that it had finished."""
        with workers(1, None, tmp_path / "kept") as each:
            first, _ = next(each(squared, ITEMS))
            files = list((tmp_path / "kept").iterdir())
        assert first == 0
        assert [path.suffix for path in files] == [".npz"]
        before = files[0].stat().st_mtime_ns
        with workers(1, None, tmp_path / "kept") as each:
            done = dict(each(squared, ITEMS))
        assert files[0].stat().st_mtime_ns == before
        assert len(list((tmp_path / "kept").iterdir())) == 3
        np.testing.assert_array_equal(done[0]["square"], ITEMS[0] ** 2)
        assert done[0]["name"].tolist() == ["a", "bc"]

    def test_another_item_is_other_work(self, tmp_path: Path) -> None:
        with workers(1, None, tmp_path) as each:
            list(each(squared, ITEMS))
            done = dict(each(squared, [ITEMS[0] + 1.0]))
        np.testing.assert_array_equal(done[0]["square"], (ITEMS[0] + 1.0) ** 2)

    def test_results_of_other_code_are_computed_again(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        def again() -> list[str]:
            with workers(1, None, tmp_path) as each:
                list(each(squared, ITEMS))
            return [record.message for record in caplog.records]

        assert again() == again() == []
        before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
        monkeypatch.setattr(work, "_code", lambda: "another")
        (sentence,) = again()
        assert sentence.endswith("3 finished parts are of another version of magloc and are computed again")
        assert len(list(tmp_path.iterdir())) == 6
        assert before == {path: path.stat().st_mtime_ns for path in before}

    @pytest.mark.parametrize("length", [0, 30])
    def test_a_file_that_is_cut_short(self, tmp_path: Path, length: int) -> None:
        with workers(1, None, tmp_path) as each:
            list(each(squared, ITEMS[:1]))
        (file,) = tmp_path.iterdir()
        file.write_bytes(file.read_bytes()[:length])
        with workers(1, None, tmp_path) as each:
            ((_, again),) = each(squared, ITEMS[:1])
        np.testing.assert_array_equal(again["square"], ITEMS[0] ** 2)

    def test_items_are_made_as_they_are_needed(self) -> None:
        made = []

        def items() -> Iterator[Any]:
            for item in ITEMS:
                made.append(item)
                yield item

        with workers(1, None, None) as each:
            next(each(squared, items()))
        assert len(made) == 1
