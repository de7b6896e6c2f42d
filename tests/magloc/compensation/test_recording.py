"""An excerpt of a flight beside the correction of another program, which has 18 terms and a ridge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from magloc.compensation.signals import band_passed
from magloc.readings import Readings

ARRAY = arrays.SensorArray(
    (arrays.Sensor("mag_1", "scalar", (0.0, 0.0, 0.0), 1e-11), arrays.Sensor("flux", "vector", (1.0, 0.0, 0.0), 1e-9))
)


def test_beside_the_correction_of_another_program(data_folder: Path) -> None:
    """In the band of the manoeuvres both leave a third of the readings' deviation, and correct the same."""
    folder = data_folder / "aeromagnetic-compensation"
    if not folder.is_dir():
        pytest.skip("needs the recording aeromagnetic-compensation")
    flight, peer = (np.genfromtxt(folder / name, delimiter=",", names=True) for name in ("flight.csv", "reference.csv"))
    names = ("mag_1_nT", "flux_x_nT", "flux_y_nT", "flux_z_nT")
    rows = Readings(1e-9 * np.stack([flight[name] for name in names], axis=1), time_s=flight["time_s"])
    found = magloc.compensate(ARRAY, rows)
    ours = 1e9 * found.values_T[:, 0]
    fast_raw, fast_ours, fast_peer = (
        band_passed(flight["time_s"], each, 2.5) for each in (flight["mag_1_nT"], ours, peer["mag_1_compensated_nT"])
    )
    assert fast_ours.std() < 1.1 * fast_peer.std()
    assert fast_ours.std() < fast_raw.std() / 3.0
    assert np.corrcoef(fast_raw - fast_ours, fast_raw - fast_peer)[0, 1] > 0.97
