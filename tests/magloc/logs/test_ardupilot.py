"""DataFlash logs against pymavlink."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary

import magloc
from arrays.io.errors import InputError
from tests.written_logs import dataflash

CLOCK = np.arange(2_000_000, 12_000_000, 100_000, dtype=np.uint64)
N = len(CLOCK)
RNG = np.random.default_rng(1)
MAG = {
    "TimeUS": CLOCK,
    "I": np.arange(N, dtype=np.uint8) % 2,
    **{f"Mag{a}": RNG.integers(-500, 500, N, np.int16) for a in "XYZ"},
}
IMU = {"TimeUS": CLOCK, "I": np.zeros(N, np.uint8), **{f"Gyr{a}": RNG.normal(size=N).astype(np.float32) for a in "XYZ"}}
GPS = {
    "TimeUS": CLOCK,
    "GMS": (np.arange(N) * 100 + 7_000).astype(np.uint32),
    "GWk": np.full(N, 2200, np.uint16),
    "Lat": np.full(N, 481234567, np.int32),
    "Lng": np.full(N, 114321987, np.int32),
}
PARM = {
    "TimeUS": CLOCK[:2],
    "Name": np.array([b"COMPASS_OFS_X", b"COMPASS_OFS_Y"], "S16"),
    "Value": np.float32([12.5, -3.0]),
}
MESSAGES = (
    ("PARM", PARM, "s--", "F--"),
    ("MAG", MAG, "s#GGG", "F-CCC"),
    ("IMU", IMU, "s#EEE", "F-000"),
    ("GPS", GPS, "s--DU", "F--GG"),
)


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    path = tmp_path / "flight.BIN"
    path.write_bytes(dataflash(MESSAGES))
    return path


def test_every_number_is_that_of_pymavlink(flight: Path) -> None:
    log = magloc.read_log(flight)
    reader = DFReader_binary(str(flight), zero_time_base=True)
    expected: dict[str, list[float]] = {}
    while (message := reader.recv_msg()) is not None:
        kind = message.get_type()
        if kind not in ("MAG", "IMU", "GPS"):
            continue
        for field in message.get_fieldnames():
            if field not in ("TimeUS", "I"):
                k = getattr(message, "I", 0)
                expected.setdefault(f"{kind}[{k}].{field}" if k else f"{kind}.{field}", []).append(
                    getattr(message, field)
                )
    assert set(log) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(log[name].values / log[name].si_per_unit, values, rtol=1e-12)
    assert reader.params == log.parameters
    reader.data_map.close()
    reader.filehandle.close()


def test_units_are_those_that_the_log_states(flight: Path) -> None:
    log = magloc.read_log(flight)
    mag = log["MAG[1].MagX"]
    assert (mag.unit, mag.si_per_unit, mag.logged_unit) == ("T", pytest.approx(1e-7), "0.001 Gauss")
    np.testing.assert_allclose(mag.values, 1e-7 * MAG["MagX"][1::2])
    np.testing.assert_allclose(mag.time_s, 1e-6 * CLOCK[1::2])
    assert log["IMU.GyrX"].unit == "rad/s"
    assert log["GPS.Lat"].unit == "deg"
    assert log["GPS.Lat"].values[0] == pytest.approx(48.1234567, abs=1e-12)


def test_the_date_is_that_of_the_receiver(flight: Path) -> None:
    """Week 2200 began on 2022-03-06 at 00:00 of GPS, 18 s before that hour of UTC ends the leap seconds."""
    zero_s = magloc.read_log(flight).unix_zero_s
    week_s = np.datetime64("2022-03-06T00:00:00", "s").astype(int)
    assert zero_s == pytest.approx(week_s - 18.0 + 7.0 - 2.0)


def test_a_log_without_stated_units(tmp_path: Path) -> None:
    path = tmp_path / "old.bin"
    path.write_bytes(dataflash(MESSAGES, units=False))
    log = magloc.read_log(path)
    assert (log["MAG[1].MagX"].unit, log["MAG[1].MagX"].si_per_unit) == ("T", pytest.approx(1e-7))
    assert (log["IMU.GyrX"].unit, log["GPS.Lng"].unit) == ("rad/s", "deg")


def test_damaged_and_cut_logs_give_their_whole_messages(flight: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = flight.read_bytes()
    whole = magloc.read_log(flight)
    flight.write_bytes(data[:-5])
    assert (
        sum(
            len(whole[name]) - len(magloc.read_log(flight)[name])
            for name in ("MAG.MagX", "MAG[1].MagX", "GPS.Lat", "IMU.GyrX")
        )
        == 1
    )
    assert "damaged or cut" in caplog.text
    at = len(data) // 2
    flight.write_bytes(data[:at] + b"\x13" * 400 + data[at:])
    broken = magloc.read_log(flight)
    assert sum(len(whole[name]) - len(broken[name]) for name in ("MAG.MagX", "MAG[1].MagX", "GPS.Lat", "IMU.GyrX")) <= 1


def test_padding_of_the_last_page_is_no_damage(flight: Path) -> None:
    flight.write_bytes(flight.read_bytes() + b"\xff" * 200)
    assert magloc.read_log(flight).warnings == ()


@pytest.mark.parametrize("data", [b"\xa3\x95\x80", b"\xa3\x95\x80" + bytes(200)])
def test_a_log_without_messages_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "empty.bin"
    path.write_bytes(data)
    with pytest.raises(InputError, match="without messages"):
        magloc.read_log(path)
