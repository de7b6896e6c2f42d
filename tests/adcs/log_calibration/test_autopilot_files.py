"""Parameters of autopilots: a reading that the autopilot's own formula corrects is the true field in body axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
from adcs.log_calibration.autopilot_files import ardupilot_parameters, px4_parameters, writer_of
from sims.attitude.flights import FlightSettings
from tests.adcs.log_calibration.flights import FIELD_T, calibrated

NUMBER = 2  # ROTATION_YAW_90
MOUNTING = Rotation.from_euler("z", 90.0, degrees=True)  # body axes from sensor axes
CURRENT_A = 20.0


@pytest.fixture(scope="module")
def calibration():
    return calibrated(21, FlightSettings(duration_s=150.0, mounting=MOUNTING.inv()))


@pytest.fixture(scope="module")
def readings(calibration):
    """Return fields in body axes [T], and noiseless readings of them."""
    flight, _ = calibration
    body_T = Rotation.random(50, rng=1).apply(FIELD_T)
    return body_T, body_T @ flight.scale[0].T + flight.offset_T[0] + CURRENT_A * flight.current_T_A[0]


def symmetric(values, diagonal, other):
    """Return the matrix of parameters; X, Y, Z of the other elements are xy, xz and yz."""
    x, y, z = (values[other.format(axis)] for axis in "XYZ")
    a, b, c = (values[diagonal.format(axis)] for axis in "XYZ")
    return np.array([[a, x, y], [x, b, z], [y, z, c]])


def angles_deg(one, other):
    cosine = np.sum(one * other, axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def test_px4(calibration, readings):
    """Correct() of Magnetometer.hpp: R S ((r + P c) - o), gauss; P is the current in kA (VehicleMagnetometer.cpp)."""
    values = px4_parameters(calibration[1])
    assert (values["CAL_MAG0_ROT"], values["CAL_MAG_COMP_TYP"]) == (NUMBER, 2)
    offset, comp = (np.array([values[f"CAL_MAG0_{axis}{word}"] for axis in "XYZ"]) for word in ("OFF", "COMP"))
    S = symmetric(values, "CAL_MAG0_{}SCALE", "CAL_MAG0_{}ODIAG")
    corrected = MOUNTING.apply((1e4 * readings[1] + 1e-3 * CURRENT_A * comp - offset) @ S.T)
    # An error of the axes of 1 to 2° has no parameter.
    assert angles_deg(corrected, readings[0]).max() < 4.0
    np.testing.assert_allclose(np.linalg.norm(corrected, axis=1), 1e4 * np.linalg.norm(FIELD_T), rtol=0.02)


def test_ardupilot(calibration, readings):
    """correct_field of AP_Compass_Backend.cpp: S (r + o) + P c, milligauss, r in body axes, P the current in A."""
    values = ardupilot_parameters(calibration[1])
    assert (values["COMPASS_ORIENT"], values["COMPASS_MOTCT"]) == (NUMBER, 2)
    offset, motor = (np.array([values[f"COMPASS_{word}_{axis}"] for axis in "XYZ"]) for word in ("OFS", "MOT"))
    S = symmetric(values, "COMPASS_DIA_{}", "COMPASS_ODI_{}")
    corrected = (1e7 * MOUNTING.apply(readings[1]) + offset) @ S.T + CURRENT_A * motor
    assert angles_deg(corrected, readings[0]).max() < 4.0
    np.testing.assert_allclose(np.linalg.norm(corrected, axis=1), 1e7 * np.linalg.norm(FIELD_T), rtol=0.02)


def test_array_file(calibration, readings, tmp_path):
    writer_of(tmp_path / "mag.toml")(calibration[1], tmp_path / "mag.toml")
    flight = calibration[0]
    without_current = readings[1] - CURRENT_A * flight.current_T_A[0]
    array = arrays.read_array(tmp_path / "mag.toml")
    assert array.common_field_T is not None
    assert 67e-6 < array.common_field_T < 75e-6  # the Earth's field is 67 µT at most
    field_T = array.calibrated_field(without_current)[:, 0]
    np.testing.assert_allclose(field_T, readings[0], atol=600e-9)


def test_files(calibration, tmp_path):
    for name in ("a.params", "a.parm"):
        writer_of(tmp_path / name)(calibration[1], tmp_path / name)
    lines = [line.split("\t") for line in (tmp_path / "a.params").read_text().splitlines() if line[0] != "#"]
    assert {len(line) for line in lines} == {5}
    types = {line[2]: (line[3], line[4]) for line in lines}
    assert types["CAL_MAG0_ROT"] == ("2", "6")
    assert types["CAL_MAG0_XOFF"][1] == "9"
    pairs = dict(line.split(",") for line in (tmp_path / "a.parm").read_text().splitlines())
    assert float(pairs["COMPASS_OFS_X"]) == pytest.approx(
        ardupilot_parameters(calibration[1])["COMPASS_OFS_X"], rel=1e-5
    )


def test_undetermined_terms_are_not_written():
    _, found = calibrated(5, FlightSettings(duration_s=60.0, turns=False, tilt_deg=3.0))
    assert not [name for name in px4_parameters(found) if name.endswith(("OFF", "SCALE", "ODIAG"))]
    assert not [name for name in ardupilot_parameters(found) if "OFS" in name or "DIA" in name]


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(arrays.InputError, match=r"found mag\.csv, expected a name that ends in"):
        writer_of(tmp_path / "mag.csv")
