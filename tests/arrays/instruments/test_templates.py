"""Templates of instruments: logs in the makers' formats are read without an array file."""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from tests.conftest import REPOSITORY

T0 = 1777109999.3  # 2026-04-25 09:39:59.3
N = 12
MAGARROW = (
    "Counter,Date,Time,Latitude,Longitude,Mag, MagValid,CompassX,Altitude,EventData\n"
    "120232,2026/04/25,09:39:59.300,48.1372,11.5755,48500.5,1,24246,521.5,,\n"
    "120332,2026/04/25,09:39:59.400,48.137201,11.5755,48501.5,1,24246,521.5,,\n"
)
KEYS = 'noise_fraction = 0.01\n[[sensor]]\nid = "mag"\nnoise_nT = 0.7\n[columns]\norigin = [48.1372, 11.5755, 521.0]\n'


class TestInstrument:
    def test_reads_a_log(self, tmp_path: Path) -> None:
        pytest.importorskip("pymap3d")
        (tmp_path / "log.csv").write_text(MAGARROW, encoding="utf-8")
        (tmp_path / "keys.toml").write_text(KEYS, encoding="utf-8")
        array = arrays.read_instrument("MagArrow").array(tmp_path / "log.csv", tmp_path / "keys.toml")
        readings = magloc.read_readings(tmp_path / "log.csv", array)
        np.testing.assert_allclose(readings.values_T, [[48500.5e-9], [48501.5e-9]])
        assert readings.time_s[0] == T0
        assert readings.array_position_m is not None
        np.testing.assert_allclose(readings.array_position_m, [[0.0, 0.0, 0.5], [0.0, 0.1112, 0.5]], atol=1e-3)

    def test_keys_replace_those_of_the_template(self, tmp_path: Path) -> None:
        (tmp_path / "log.csv").write_text(MAGARROW, encoding="utf-8")
        (tmp_path / "keys.toml").write_text(KEYS, encoding="utf-8")
        array = arrays.read_instrument("magarrow").array(tmp_path / "log.csv", tmp_path / "keys.toml")
        assert (array.noise_fraction, array.sensors[0].noise_T) == (0.01, 0.7e-9)
        assert array.columns is not None
        assert array.columns.clock == ("Date", "Time")

    def test_what_a_log_lacks_is_left_out(self, tmp_path: Path) -> None:
        (tmp_path / "log.csv").write_text(MAGARROW.replace(" MagValid", "Else"), encoding="utf-8")
        columns = arrays.read_instrument("magarrow").array(tmp_path / "log.csv").columns
        assert columns is not None
        assert columns.valid is None

    def test_another_log_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "log.csv").write_text("time_s,a\n1,2\n", encoding="utf-8")
        with pytest.raises(arrays.InputError, match=r"log\.csv: found no header of a log of Geometrics MagArrow"):
            arrays.read_instrument("magarrow").array(tmp_path / "log.csv")

    def test_an_unknown_name_lists_all(self) -> None:
        with pytest.raises(arrays.InputError, match="gsm19, gsmp, magarrow"):
            arrays.read_instrument("thermometer")


@pytest.mark.parametrize("name", arrays.instrument_names())
def test_every_template_is_documented(name: str) -> None:
    """The page has the row of the template: instrument, source, and what the user adds."""
    page = (REPOSITORY / "docs" / "guide" / "instruments.md").read_text(encoding="utf-8")
    instrument = arrays.read_instrument(name)
    source = instrument.source + " (secondary)" * instrument.is_secondary
    assert f"| `{name}` | {instrument.title} | {source} | {instrument.add or '–'} |" in page.splitlines()


# Imitations: text above the rows, a row, and a survey line between the rows. In braces: number k, date and time of day
# in several forms, latitude, longitude, east and north of the first place, height above sea and above the ground, the
# total field, and the field along east, north, up.
LOGS: dict[str, tuple[str, str, str]] = {
    "magarrow": (MAGARROW.splitlines()[0], "{k},{day:%Y/%m/%d},{day:%H:%M:%S.%f},{lat},{lon},{F},1,1,{sea},,", ""),
    "magdrone-r3": (
        "20260425_093959_MD-R3_#0001\nDate: 25.4.2026\nSampleFrequence: 9\n\nTimestamp [ms]; B1x [nT]; B1y [nT]; "
        "B1z [nT]; B2x [nT]; B2y [nT]; B2z [nT]; AccX [g]; Temp [Deg]; Latitude [Decimal Degrees]; "
        "Longitude [Decimal Degrees]; Altitude [m]; Quality; GPSTime; GPSDate; GPSTime [hh:mm:ss.sss];",
        "{ms};{E};{N};{U};{E};{N};{U};0.01;20.0;{lat};{lon};{sea};4;0;{day:%Y/%m/%d};{day:%H:%M:%S.%f};",
        "",
    ),
    "magdrone-r1": (
        "Date,Time,Latitude,Longitude,Heading,Next WP,Altitude,Altitude AGL,TMI,Bx,By,Bz",
        "{day:%Y/%m/%d},{day:%H:%M:%S.%f},{lat},{lon},0,{wp},{sea},{ground},{F},{E},{N},{U}",
        "",
    ),
    "magdrone-asc": (
        "Timestamp [ms]\tTrack ID\tSensor ID\tLatitude [°]\tLongitude [°]\tAltitude [m]\tMag-X [nT]\tMag-Y [nT]\t"
        "Mag-Z [nT]\tTotal field anomaly [nT]",
        "{ms}\t1\t1\t{lat}\t{lon}\t{sea}\t{E}\t{N}\t{U}\t2.5",
        "",
    ),
    "gsm19": (
        "/Gem Systems GSM-19GWV 7122568 v7.0 4 V 2011 M ewv10fl.v7vbs\n/ID 1 file 24survey.wg  02VIII12\n/00106 sensor "
        "distance cm\n/X Y elevation nT nT/m sq cor-nT sat time picket-x picket-y\nline  000010",
        "0{lat:.7f}  0{lon:.7f}  {sea}  {F}  0012.61 99  000000.00 07 {day:%H%M%S.%f}  4.00 *",
        "line  000020",
    ),
    "gsmp": (
        "/ a remark\n/time;nT;sq;lat;lon;alt;laser;mm/dd/yyyy;Next WP",
        "{day:%H:%M:%S.%f};{F};99;{lat};{lon};{sea};{ground};{day:%m/%d/%Y};{wp}",
        "",
    ),
    "magnimbus": (
        "Date,Time,Sensor ID,Latitude,Longitude,Heading,Next WP,Altitude,Altitude AGL,Valid,TMI,Bx,By,Bz",
        "{day:%Y/%m/%d},{day:%H:%M:%S.%f},1,{lat},{lon},0,{wp},{sea},{ground},1,{F},{E},{N},{U}",
        "",
    ),
    "quspin": (
        "Date,Time,Sensor ID,Latitude,Longitude,Heading,Next WP,Altitude,Altitude AGL,Data valid,TMI,ScSensitivity",
        "{day:%Y/%m/%d},{day:%H:%M:%S.%f},1,{lat},{lon},0,{wp},{sea},{ground},1,{F},90",
        "",
    ),
    "seaspy2": (
        "# Marine\nReading_Date,Reading_Time,Magnetic_Field,Depth,Altitude,Mag_Latitude,Mag_Longitude,Line_Name",
        "{day:%d-%b-%Y},{day:%H:%M:%S.%f},{F},2.0,{ground},{lat},{lon},{name}",
        "",
    ),
    "g858": (
        "           X           Y     TOP_RDG  BOTTOM_RDG    VRT_GRAD        TIME        DATE        LINE        MARK",
        "  {east:.3f}  {north:.3f}  {F}  {F}  0.000  {day:%H:%M:%S.%f}  {day:%m/%d/%y}  {wp}  0",
        "",
    ),
    "px4": (
        "timestamp,timestamp_sample,device_id,magnetometer_ga[0],magnetometer_ga[1],magnetometer_ga[2],calibration_count",
        "{us},{us},396825,{Egauss},{Ngauss},{Ugauss},1",
        "",
    ),
    "fga-logger": (
        "Timestamp_ms,B1x_nT,B1y_nT,B1z_nT,B1v_nT,B2x_nT,B2y_nT,B2z_nT,B2v_nT,Lat_deg,Lon_deg,Alt_m,SIV,Fix,HDOP_m",
        "{ms},{E},{N},{U},{F},{E},{N},{U},{F},{lat},{lon},{sea},12,1,0.8",
        "",
    ),
    "aerosmartmag": (
        "UTC_date,UTC_time,Time_zone,Field,Error,Lat,Lon,Alt,hAcc,vAcc,Line",
        "{day:%d-%m-%Y},{day:%H:%M:%S.%f},0,{F},0,{lat},{lon},{sea},0.01,0.02,{wp}",
        "",
    ),
    "smagall": (
        "Time,magneticX,magneticY,magneticZ,magneticTotal,longitude,latitude,altitude,Line",
        "{day:%Y-%m-%d %H:%M:%S.%f},{E},{N},{U},{F},{lon},{lat},{sea},{wp}",
        "",
    ),
}
WITH_LINES = {"magdrone-r1": "12", "gsmp": "12", "magnimbus": "12", "quspin": "12", "seaspy2": "AB", "g858": "12"}
WITH_LINES |= {"aerosmartmag": "12", "smagall": "12", "gsm19": "12"}
ABOVE_GROUND = {"magdrone-r1", "gsmp", "magnimbus", "quspin", "seaspy2", "g858"}
WITHOUT_DATE = {"magdrone-r3", "magdrone-asc", "gsm19", "fga-logger", "px4"}
FIELD = np.array([1200.0, 21000.0, -43700.0])


def imitation(name: str) -> str:
    """Return a log of N rows, 0.1 s and 0.11 m north apart; the second half is another line."""
    above, row, between = LOGS[name]
    lines = [above]
    for k in range(N):
        lines += [between] if k == N // 2 and between else []
        day = datetime.datetime.fromtimestamp(T0 + 0.1 * k, datetime.UTC)
        gauss = dict(zip(("Egauss", "Ngauss", "Ugauss"), FIELD / 1e5, strict=True))
        field = dict(zip("ENU", FIELD, strict=True)) | gauss | {"F": 48500.0 + k}
        place = {
            "lat": 48.1372 + 1e-6 * k,
            "lon": 11.5755,
            "sea": 521.5,
            "ground": 1.5,
            "east": 0.0,
            "north": 0.1112 * k,
        }
        line = {"wp": 1 + (k >= N // 2), "name": "AB"[int(k >= N // 2)]}
        lines.append(row.format(k=k, ms=5000 + 100 * k, us=5_000_000 + 100_000 * k, day=day, **field, **place, **line))
    return "\n".join([*lines, ""])


def test_every_template_has_an_imitation() -> None:
    assert set(LOGS) == set(arrays.instrument_names())


@pytest.mark.parametrize("name", LOGS)
def test_reads_its_imitation(name: str, tmp_path: Path) -> None:
    pytest.importorskip("pymap3d")
    log = tmp_path / "log.txt"
    log.write_text(imitation(name), encoding="utf-8")
    array = arrays.read_instrument(name).array(log)
    assert array.columns is not None
    if array.columns.is_geodetic:
        array = replace(array, columns=replace(array.columns, origin=(48.1372, 11.5755, 520.0)))
    readings = magloc.read_readings(log, array)
    np.testing.assert_allclose(np.diff(readings.time_s), 0.1, atol=1e-6)
    if name not in WITHOUT_DATE:
        assert readings.time_s[0] == pytest.approx(T0, abs=1e-6)
    for sensor in range(array.n_sensors):
        own = readings.values_T[:, array.channel_sensor == sensor]
        is_scalar = array.sensors[sensor].kind == "scalar"
        expected = 48500.0 + np.arange(N)[:, None] if is_scalar else np.tile(FIELD, (N, 1))
        np.testing.assert_allclose(own, 1e-9 * expected)
    if array.columns.place:
        assert readings.array_position_m is not None
        north = 0.1112 * np.arange(N)
        height = 0.3 if name == "g858" else 1.5
        np.testing.assert_allclose(
            readings.array_position_m, np.stack([0.0 * north, north, 0.0 * north + height], 1), atol=2e-3
        )
    names = WITH_LINES.get(name, "")
    numbers = tuple(f"0000{number}0" for number in names) if name == "gsm19" else tuple(names)
    assert tuple(line for _, line in readings.lines) == numbers


def test_sensors_beside_each_other_follow_the_course(tmp_path: Path) -> None:
    """A carrier that flies north has its left sensor in the west."""
    pytest.importorskip("pymap3d")
    (tmp_path / "log.csv").write_text(imitation("magdrone-r3"), encoding="utf-8")
    array = arrays.read_instrument("magdrone-r3").array(tmp_path / "log.csv")
    assert array.columns is not None
    array = replace(array, columns=replace(array.columns, origin=(48.1372, 11.5755, 520.0)))
    readings = magloc.read_readings(tmp_path / "log.csv", array)
    assert readings.array_rotation is not None
    np.testing.assert_allclose(
        readings.array_rotation.apply(array.positions[0].copy()), np.tile([-0.5, 0.0, 0.0], (N, 1)), atol=1e-6
    )


class TestGsm19:
    @pytest.mark.parametrize(
        ("row", "position", "of_day"),
        [
            ("0607366.62 6357597.20 001499 56700.00 99 000000.00 08 10:00:30.0", True, 36030.0),
            ("0607366.62 6357597.20 001499 56700.00 99 000000.00 08 100030.0", True, 36030.0),
            ("047.9263435 015.8653717 001089 48382.35 99 000000.00 07 115950.0", False, 43190.0),
            ("047.9263435 015.8653717 001089 48382.35 99 000000.00 07 11:59:50.0", False, 43190.0),
        ],
    )
    def test_forms_of_places_and_times(self, row: str, position: bool, of_day: float, tmp_path: Path) -> None:
        pytest.importorskip("pymap3d")
        (tmp_path / "log.txt").write_text(f"/UTC-07\n/X Y elev rawmag sq cormag sat time\n{row}\n", encoding="utf-8")
        array = arrays.read_instrument("gsm19").array(tmp_path / "log.txt")
        assert array.columns is not None
        assert (array.columns.position is not None) == position
        if not position:
            array = replace(array, columns=replace(array.columns, origin=(47.926, 15.865, 1000.0)))
        assert magloc.read_readings(tmp_path / "log.txt", array).time_s.tolist() == [of_day]


def test_a_constant_height_replaces_a_column_of_heights(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(MAGARROW, encoding="utf-8")
    (tmp_path / "keys.toml").write_text("[columns]\nheight_m = 0.5\n", encoding="utf-8")
    columns = arrays.read_instrument("magarrow").array(tmp_path / "log.csv", tmp_path / "keys.toml").columns
    assert columns is not None
    assert (columns.geodetic, columns.height_m) == (("Latitude", "Longitude"), 0.5)


class TestTracks:
    """Positions of RTKLIB, 5 a second, for a log of 20 rows a second."""

    HEAD = (
        "% program   : RTKLIB\n%  {scale}                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)\n"
    )

    def read(self, folder: Path, scale: str = "UTC", date: str = "2026-04-25") -> magloc.Readings:
        pytest.importorskip("pymap3d")
        lines = [self.HEAD.format(scale=scale)]
        for k in range(-3, 13):
            day = datetime.datetime.fromtimestamp(T0 + 0.2 * k + 18.0 * (scale == "GPST"), datetime.UTC)
            place = f"{48.1372 + 2e-6 * k:.9f}   11.575500000    521.5000"
            lines.append(f"{day:%Y/%m/%d %H:%M:%S.%f}   {place}   {5 if k in (4, 5) else 1}  12   0.0100\n")
        (folder / "walk.pos").write_text("".join(lines), encoding="utf-8")
        rows = [
            f"{datetime.datetime.fromtimestamp(T0 + 0.05 * k, datetime.UTC):%H:%M:%S.%f},48500\n" for k in range(80)
        ]
        (folder / "log.csv").write_text("t,F\n" + "".join(rows), encoding="utf-8")
        columns = arrays.LogColumns(
            time="t",
            time_unit="iso",
            date=date,
            sensors={"m": "F"},
            origin=(48.1372, 11.5755, 520.0),
            track=arrays.read_track(folder / "walk.pos"),
        )
        array = arrays.SensorArray((arrays.Sensor("m", "scalar", (0.0, 0.0, 0.0), 1e-10),), columns=columns)
        return magloc.read_readings(folder / "log.csv", array)

    @pytest.mark.parametrize("scale", ["UTC", "GPST"])
    def test_places_the_rows_of_a_log(self, scale: str, tmp_path: Path) -> None:
        """Rows after the last solution are ignored; those without a solution have an error."""
        found = self.read(tmp_path, scale)
        assert found.array_position_m is not None
        assert found.interpolated_m is not None
        after_s = found.time_s - T0
        assert after_s[-1] == pytest.approx(2.4, abs=0.051)
        north = 2e-6 / 0.2 * after_s * 111_200.0
        np.testing.assert_allclose(
            found.array_position_m, np.stack([0.0 * north, north, 0.0 * north + 1.5], 1), atol=2e-3
        )
        assert found.interpolated_m.shape == after_s.shape

    def test_clocks_that_overlap_in_part(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        """The log ends 1.55 s after the positions, as with a clock that is late."""
        self.read(tmp_path)
        assert "31 of 80 rows of the log have no position" in caplog.text
        assert "GPS time by 18 s" in caplog.text

    def test_clocks_apart(self, tmp_path: Path) -> None:
        with pytest.raises(
            arrays.InputError, match=r"walk\.pos: found 1777\d+ to 1777\d+ s, expected positions from 1774"
        ):
            self.read(tmp_path, date="2026-03-25")

    @pytest.mark.parametrize("places", ["x-ecef(m) y-ecef(m) z-ecef(m)", "e-baseline(m) n-baseline(m) u-baseline(m)"])
    def test_other_coordinates_are_refused(self, places: str, tmp_path: Path) -> None:
        (tmp_path / "walk.pos").write_text(f"%  UTC {places} Q ns\n2026/04/25 09:40:00.000 3.1 4.2 0.1 1 12\n")
        with pytest.raises(arrays.InputError, match="expected one of RTKLIB and Emlid"):
            arrays.read_track(tmp_path / "walk.pos")

    def test_another_file(self, tmp_path: Path) -> None:
        (tmp_path / "log.csv").write_text(MAGARROW, encoding="utf-8")
        with pytest.raises(arrays.InputError, match="expected one of RTKLIB and Emlid"):
            arrays.read_track(tmp_path / "log.csv")
