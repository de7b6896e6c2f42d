"""Logs with random damage: they are read in part, or refused in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from nptdms import ChannelObject, TdmsWriter

import adcs
import magloc
from arrays.io.errors import InputError
from magloc.logs.proposal import propose_log_columns
from tests.robot_flights import Flight

CASES = 40


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder, flight = tmp_path_factory.mktemp("whole"), Flight(0, duration_s=3.0)
    with h5py.File(folder / "h5", "w") as file:
        file["a/time_s"], file["a/b"] = np.arange(50) / 10.0, np.zeros((50, 3))
    pd.DataFrame({"time_s": np.arange(50.0), "b_nT": np.zeros(50)}).to_parquet(folder / "parquet")
    with TdmsWriter(folder / "tdms") as writer:
        writer.write_segment([ChannelObject("g", "x", np.arange(50.0), properties={"wf_increment": 0.1})])
    tables = {name: (folder / name).read_bytes() for name in ("h5", "parquet", "tdms")}
    return {"ulg": flight.px4(), "BIN": flight.ardupilot(), **tables}


def damaged(data: bytes) -> Iterator[bytes]:
    """Yield the log with bytes that are wrong, most of them near the begin; some are cut."""
    rng = np.random.default_rng(5)
    for _ in range(CASES):
        broken = bytearray(data)
        for last in rng.choice([min(3000, len(data)), len(data)], rng.integers(1, 6)):
            broken[rng.integers(8, last)] = rng.integers(256)
        yield bytes(broken[: rng.integers(8, len(broken))] if rng.random() < 0.3 else broken)


@pytest.mark.parametrize("name", ["ulg", "BIN", "h5", "parquet", "tdms"])
def test_damage_ends_in_one_sentence_at_most(logs: dict[str, bytes], tmp_path: Path, name: str) -> None:
    path, said = tmp_path / f"log.{name}", list[str]()
    for data in damaged(logs[name]):
        path.write_bytes(data)
        try:
            propose_log_columns(magloc.read_log(path)).toml()
            if name in ("ulg", "BIN"):
                adcs.read_imu(path)
        except InputError as error:
            said.append(str(error))
    assert said
    assert [words for words in said if str(path) not in words or "\n" in words] == []
