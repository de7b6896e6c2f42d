"""Templates of instruments: logs in the makers' formats are read without an array file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc

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
        assert readings.time_s[0] == 1777109999.3
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
        with pytest.raises(arrays.InputError, match="gsm19, magarrow"):
            arrays.read_instrument("thermometer")


@pytest.mark.parametrize("name", arrays.instrument_names())
def test_every_template_states_its_source(name: str) -> None:
    instrument = arrays.read_instrument(name)
    assert instrument.title
    assert len(instrument.source) > 20
