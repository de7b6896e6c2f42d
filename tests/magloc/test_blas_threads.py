"""Whatever loops over small matrices has one thread of BLAS, and gives back what was there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - it loads a BLAS of its own
from threadpoolctl import ThreadpoolController, threadpool_limits

import magloc
from magloc.blas_threads import one_blas_thread

BLAS = ThreadpoolController().select(user_api="blas").lib_controllers
HERE = 2


def threads() -> set[int]:
    return {library.num_threads for library in BLAS}


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    with threadpool_limits(HERE, user_api="blas"):
        if threads() != {HERE}:
            pytest.skip("this BLAS has one thread at most")
        yield


class TestDoors:
    @pytest.fixture
    def inside(self, monkeypatch: pytest.MonkeyPatch) -> set[int]:
        """The numbers of threads that linear algebra meets from now on."""
        met: set[int] = set()

        def watched(function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any, **options: Any) -> Any:
                met.update(threads())
                return function(*arguments, **options)

            return call

        for name in ("norm", "svd", "qr", "solve", "inv", "cholesky", "eigh", "lstsq"):
            monkeypatch.setattr(np.linalg, name, watched(getattr(np.linalg, name)))
        return met

    @pytest.mark.parametrize("door", ["track", "consistency", "locate", "fit", "calibrate", "detection_range"])
    def test_one_inside_and_those_of_before_after(self, door: str, inside: set[int]) -> None:
        board = magloc.datasets.load("board")
        array, rows, sparse = board.array, board.readings[:5], board.readings[::5]
        few = array.subset(array.ids[:4])
        calls: dict[str, Callable[[], object]] = {
            "track": lambda: magloc.track(array, rows),
            "locate": lambda: magloc.locate(array, rows),
            "calibrate": lambda: magloc.calibrate(array, sparse, truth=board.truth),
            "detection_range": lambda: magloc.detection_range(few, 1.0, false_alarm_rate=0.1),
        }
        if door == "fit":
            locator = magloc.Locator(array)
            calls["fit"] = lambda: locator.fit(rows.values_T[0])
        elif door == "consistency":
            track = magloc.track(array, rows)
            calls["consistency"] = lambda: track.consistency(board.truth)
        inside.clear()
        calls[door]()
        assert inside == {1}
        assert threads() == {HERE}


class TestDecorator:
    def test_an_error_gives_back(self) -> None:
        with pytest.raises(ZeroDivisionError):
            one_blas_thread(lambda: 1 / 0)()
        assert threads() == {HERE}

    def test_one_inside_another(self) -> None:
        outer = one_blas_thread(lambda: (one_blas_thread(threads)(), threads()))
        assert outer() == ({1}, {1})
        assert threads() == {HERE}
