"""Proposals for logs: what is certain is right, and what the log does not say is asked."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import arrays
import magloc
from arrays.io.errors import InputError
from arrays.logs.proposal import propose_columns

ROWS = [(0.1 * k, 10.0 + 0.5 * k, 20.0 - k, 1.5, 48000.0 + k) for k in range(12)]


def written(folder: Path, head: str, row: str, encoding: str = "utf-8") -> Path:
    path = folder / "log.txt"
    lines = [row.format(*numbers, ms=round(1000 * numbers[0]), clock=f"09:14:0{numbers[0]:.1f}") for numbers in ROWS]
    path.write_bytes("\n".join([head, *lines, ""]).encode(encoding))
    return path


LOGS = {
    "commas": ("time_s,x,y,z,Mag [nT]", "{0:.1f},{1},{2},{3},{4}"),
    "preamble": ("Logger of mine;\nserial;12;\n\nTime [ms];East;North;Height;Mag [nT];", "{ms};{1};{2};{3};{4};"),
    "remarks": ("/some words about it all\n/ X  Y  elev  nT  time_s\n/line 1", " {1} {2}  {3} {4} {0:.1f} "),
    "lines": ("Time;X;Y;Z;Mag\nh;m;m;m;nT\nLine 10", "{clock};{1};{2};{3};{4}"),
    "words": ("TOW [s],x,y,Height above ground [m],TF", "{0:.1f},{1},{2},{3},{4}"),
    "named lines": ("/ X Y ALT UTC TMI\n/====\nLine  L1000", " {1} {2} {3} {clock} {4}"),
    "tabs": ("Zeit [s]\tRechtswert\tHochwert\tHöhe\tFeldstärke [nT]", "{0:.1f}\t{1}\t{2}\t{3}\t{4}"),
}


class TestProposal:
    @pytest.mark.parametrize("name", LOGS)
    @pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "windows-1252"])
    def test_reads_the_log(self, name: str, encoding: str, tmp_path: Path) -> None:
        """Units, places, times and fields are those of the rows; the offset of a clock is its own."""
        path = written(tmp_path, *LOGS[name], encoding)
        (tmp_path / "array.toml").write_text(propose_columns(path).toml(), encoding="utf-8")
        found = magloc.read_readings(path, arrays.read_sensors(tmp_path / "array.toml"))
        true = np.array(ROWS)
        np.testing.assert_allclose(found.time_s - found.time_s[0], true[:, 0], atol=1e-9)
        assert found.array_position_m is not None
        np.testing.assert_allclose(found.array_position_m, true[:, 1:4])
        np.testing.assert_allclose(1e9 * found.values_T[:, 0], true[:, 4])

    @pytest.mark.parametrize(
        ("day", "day_first"),
        [("12.05.2026", True), ("13/05/2026", True), ("05/13/26", False), ("05/12/2026", None)],
    )
    def test_order_of_a_date(self, day: str, day_first: bool | None, tmp_path: Path) -> None:
        found = propose_columns(written(tmp_path, "Date,Time,Mag", f"{day},{{clock}},{{4}}"))
        assert found.keys.get("day_first") == day_first
        assert any("begin with the day" in question for question in found.asked) == (day_first is None)

    def test_height_above_the_ground(self, tmp_path: Path) -> None:
        path = written(tmp_path, "time_s,Lat,Lon,Altitude,Altitude AGL,Mag", "{0:.1f},48.1,11.5,521.5,1.5,{4}")
        found = propose_columns(path).keys
        assert (found["geodetic"], found["height_is"]) == (("Lat", "Lon", "Altitude AGL"), "ground")
        assert found["origin"] == (48.1, 11.5, 0.0)

    def test_a_log_without_a_header(self, tmp_path: Path) -> None:
        """Columns have numbers as names, and the one with the Earth's field is found."""
        found = propose_columns(written(tmp_path, "/ me", "M1;{0:.1f};{1};{4}"))
        assert (found.keys["names"], found.sensors, found.header_line) == (("c1", "c2", "c3", "c4"), {"s1": "c4"}, 2)
        assert any("no header" in question for question in found.asked)

    @pytest.mark.parametrize("first", [200.0, 48.0])
    @pytest.mark.parametrize("unit", ["[uT]", "(µT)", "_µT"])
    def test_hall_sensors_with_offsets(self, first: float, unit: str, tmp_path: Path) -> None:
        """All triples with the unit of a field are sensors, also where one reads like the Earth's field."""
        triples = {f"s{k}": tuple(f"H{k}_B{c}{unit}" for c in "xyz") for k in (1, 2, 3)}
        head = ",".join(["millis", *(name for triple in triples.values() for name in triple), "ax_g,ay_g,az_g"])
        path = written(tmp_path, head, f"{{ms}},0,0,{first},900,-31,-1200,0,0,1e5,0,0,1")
        found = propose_columns(path)
        assert found.sensors == triples
        assert (found.keys["time"], found.keys["time_unit"]) == ("millis", "ms")
        assert found.keys["unit"] in ("uT", "µT")
        assert any("offsets" in question for question in found.asked) == (first == 200.0)

    def test_vectors_and_their_unit(self, tmp_path: Path) -> None:
        path = written(tmp_path, "time_s,B1x [uT],B1y [uT],B1z [uT],Temp", "{0:.1f},{1},{2},40,31")
        found = propose_columns(path)
        assert found.sensors == {"s1": ("B1x [uT]", "B1y [uT]", "B1z [uT]")}
        assert found.keys["unit"] == "uT"

    def test_a_drone(self, tmp_path: Path) -> None:
        """Angles, and a vector sensor beside a scalar one."""
        head = "UTC,Latitude,Longitude,AGL_m,Yaw,Pitch,Roll,TMI,Fx,Fy,Fz,Motor_A"
        found = propose_columns(written(tmp_path, head, "{clock},52.4,13.4,{3},90,1,2,{4},{1},{2},{4},12"))
        assert (found.keys["angles"], found.keys["height_is"]) == (("Yaw", "Pitch", "Roll"), "ground")
        assert set(found.sensors.values()) == {"TMI", ("Fx", "Fy", "Fz")}

    @pytest.mark.parametrize(
        ("head", "row", "words"),
        [
            ("Clock,Mag", "{ms},{4}", "the unit of Clock, which begins with 0 and grows by 100 a row"),
            ("time_s,Mag", "{0:.1f},{4}", "are the readings in nT"),
            ("time_s,East,North,Mag", "{0:.1f},372125.2,5808303.8,{4}", "which grid are these places of"),
            ("time_s,East,North,Mag", "{0:.1f},{1},{2},{4}", "the height of the array above the ground"),
            ("Time,Mag,B", "{clock},{4},{4}", "the date of the first row"),
            ("Time,Mag,B", "12/05/2026 {clock},{4},{4}", "begin with the day"),
            ("time_s,Mag,MagValid", "{0:.1f},{4},1", "which values of MagValid are valid"),
            ("time_s,X,Y,HAG,Mag,Q", "{0:.1f},{1},{2},{3},{4},4", "which values of Q are valid"),
            ("time_s,X,Y,HAG,Mag1,Mag2", "{0:.1f},{1},{2},{3},{4},{4}", "course = true"),
            ("time_s,A,C", "{0:.1f},{4},1", "no column reads like the Earth's field"),
        ],
    )
    def test_asks(self, head: str, row: str, words: str, tmp_path: Path) -> None:
        assert any(words in question for question in propose_columns(written(tmp_path, head, row)).asked)

    def test_numbers_beyond_all_fields_are_no_sensor(self, tmp_path: Path) -> None:
        path = written(tmp_path, "time_s,x,y,z,Bx_nT,By_nT,Bz_nT", "{0:.1f},{1},{2},{3},1e300,1e300,{4}")
        assert propose_columns(path).sensors == {}

    @given(st.binary(max_size=400))
    def test_anything_else_is_refused_in_a_sentence(self, data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "log")
            path.write_bytes(data)
            with pytest.raises(InputError, match="expected"):
                propose_columns(path)
