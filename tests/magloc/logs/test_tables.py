"""Tables as logs: data frames, Parquet, HDF5 by h5py, TDMS by nptdms."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from nptdms import ChannelObject, TdmsWriter

import magloc
from arrays.io.errors import InputError

N = 30
TIME_S = 100.0 + 0.01 * np.arange(N)
FIELD_uT = np.random.default_rng(4).normal(0.0, 30.0, (N, 3))


def frame() -> pd.DataFrame:
    columns = {"time_s": TIME_S, "bx_uT": FIELD_uT[:, 0], "note": ["a"] * N}
    return pd.DataFrame(columns)


@pytest.mark.parametrize("is_file", [False, True])
def test_frame_and_parquet(tmp_path: Path, is_file: bool) -> None:
    frame().to_parquet(tmp_path / "log.parquet")
    log = magloc.read_log(tmp_path / "log.parquet" if is_file else frame())
    assert list(log) == ["time_s", "bx_uT"]
    channel = log["bx_uT"]
    np.testing.assert_array_equal(channel.time_s, TIME_S)
    np.testing.assert_allclose(channel.values, 1e-6 * FIELD_uT[:, 0], rtol=1e-15)
    assert (channel.unit, channel.clock, channel.rate_Hz) == ("T", "time_s", pytest.approx(100.0))


def test_dates_of_a_frame_are_the_clock() -> None:
    dated = pd.DataFrame({"Timestamp": pd.date_range("2026-05-12", periods=4, freq="20ms"), "bx [nT]": np.arange(4.0)})
    channel = magloc.read_log(dated)["bx [nT]"]
    assert channel.time_s[1] == pytest.approx(pd.Timestamp("2026-05-12").timestamp() + 0.02, abs=1e-6)
    assert (channel.unit, channel.clock) == ("T", "unix")


def test_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["run/imu/field"] = 1e3 * FIELD_uT
        file["run/imu/field"].attrs["units"] = "nT"
        file["run/imu/time_ms"] = 1e3 * TIME_S
        file["count"] = np.arange(5)
        file["picture"] = np.zeros((5, 40))
        file["name"] = "text"
        file["events"] = np.array([(1.0, 2), (3.0, 4)], [("voltage_v", "f8"), ("code", "i4")])
    log = magloc.read_log(path)
    assert set(log) == {*(f"run/imu/field[{i}]" for i in range(3)), "run/imu/time_ms", "count"} | {
        "events.voltage_v",
        "events.code",
    }
    time_s, field_T = log.vectors([f"run/imu/field[{i}]" for i in range(3)])
    np.testing.assert_allclose(time_s, TIME_S, rtol=1e-14)
    np.testing.assert_allclose(field_T, 1e-6 * FIELD_uT, rtol=1e-14)
    assert (log["count"].clock, log["events.voltage_v"].unit) == ("rows", "V")
    assert np.isnan(log["count"].rate_Hz)


def test_tdms(tmp_path: Path) -> None:
    path = tmp_path / "log.tdms"
    wave = {"wf_increment": 0.01, "wf_start_offset": 100.0, "unit_string": "uT"}
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject("field", "x", FIELD_uT[:, 0], properties=wave),
                ChannelObject("power", "time_s", TIME_S),
                ChannelObject("power", "current_a", np.ones(N)),
            ]
        )
    log = magloc.read_log(path)
    assert list(log) == ["field/x", "power/time_s", "power/current_a"]
    np.testing.assert_allclose(log["field/x"].time_s, TIME_S, rtol=1e-14)
    np.testing.assert_allclose(log["field/x"].values, 1e-6 * FIELD_uT[:, 0], rtol=1e-15)
    assert (log["power/current_a"].unit, log["power/current_a"].time_s[3]) == ("A", TIME_S[3])
    assert log.warnings == ()
    path.write_bytes(path.read_bytes()[:-16])
    cut = magloc.read_log(path)
    assert cut.warnings == (f"{path}: the last segment is cut; its whole values are read",)
    np.testing.assert_array_equal(cut["field/x"].values, log["field/x"].values[: len(cut["field/x"])])


@pytest.mark.parametrize(
    ("name", "magic"), [("a.h5", b"\x89HDF\r\n\x1a\n"), ("a.tdms", b"TDSm"), ("a.parquet", b"PAR1")]
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, magic: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(magic + bytes(range(64)))
    with pytest.raises(InputError, match=r"that cannot be read|without numbers"):
        magloc.read_log(path)


def test_a_frame_of_text_is_refused() -> None:
    with pytest.raises(InputError, match="no column of numbers"):
        magloc.read_log(pd.DataFrame({"a": ["x"]}))


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["a"] = np.zeros(3)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(InputError, match=r'needs the extra "logs": pip install "magloc\[logs\]"'):
        magloc.read_log(path)
