"""Array files for the logs of some makers: heads of files as the makers' documents have them are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from tests.conftest import REPOSITORY

FOLDER = REPOSITORY / "docs" / "guide" / "logs"
# Names of the columns, and two rows 0.1 s and a millionth of a degree of latitude, 11 cm, apart.
LOGS = {
    "fgsensors-fga-logger": (
        "Timestamp_ms,B1x_nT,B1y_nT,B1z_nT,B1v_nT,B2x_nT,B2y_nT,B2z_nT,B2v_nT,Lat_deg,Lon_deg,Alt_m,SIV,Fix,HDOP_m",
        "{ms},1200,21000,-43700,48500,1210,21020,-43650,48470,{latitude},11.5755,521.5,12,1,0.8",
        [[1200.0, 21000.0, -43700.0, 1210.0, 21020.0, -43650.0]] * 2,
    ),
    "sensys-magdrone-asc": (
        "Timestamp [ms]\tTrack ID\tSensor ID\tLatitude [°]\tLongitude [°]\tAltitude [m]\tMag-X [nT]\tMag-Y [nT]\t"
        "Mag-Z [nT]\tTotal field anomaly [nT]",
        "{ms}\t1\t1\t{latitude}\t11.5755\t521.5\t1200\t21000\t-43700\t2.5",
        [[1200.0, 21000.0, -43700.0]] * 2,
    ),
    "geometrics-magarrow": (
        "Counter,Date,Time,Latitude,Longitude,Mag, MagValid,CompassX, CompassY, CompassZ,Altitude",
        "{ms},2026/09/21,7:49:57.300,{latitude},11.5755,48500.5,1,24246,-11815,-20435,521.5",
        [[48500.5]] * 2,
    ),
}


class TestMakersLogs:
    def test_every_file_has_a_log(self) -> None:
        assert {path.stem for path in FOLDER.iterdir()} == set(LOGS)

    @pytest.mark.parametrize("name", LOGS)
    def test_is_read(self, name: str, tmp_path: Path) -> None:
        pytest.importorskip("pymap3d")
        header, row, values_nT = LOGS[name]
        rows = [row.format(ms=ms, latitude=latitude) for ms, latitude in ((5000, "48.1372"), (5100, "48.137201"))]
        (tmp_path / "log.csv").write_text("\n".join([header, *rows, ""]), encoding="utf-8")
        array = arrays.read_sensors(FOLDER / f"{name}.toml")
        readings = magloc.read_readings(tmp_path / "log.csv", array)
        np.testing.assert_allclose(readings.values_T, 1e-9 * np.array(values_nT))
        np.testing.assert_allclose(readings.time_s, [5.0, 5.1])
        assert readings.array_position_m is not None
        np.testing.assert_allclose(readings.array_position_m, [[0.0, 0.0, 1.5], [0.0, 0.1112, 1.5]], atol=1e-3)
