"""The Sun of OPS-SAT: its on-board quaternions and our Sun predict what its photodiodes measured in November 2020.

What the columns mean is inferred from the data: the quaternion turns inertial components into body ones, PD3 is the
elevation of the Sun above the face +X and PD6 above -Z [rad]. Rows are missing in eclipse, which is what shows it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import adcs
from adcs import quaternion
from adcs.environment.orbit import Sgp4Orbit
from adcs.environment.sun import illuminated_fraction, sun_position_eci
from adcs.frames import Instants, instants

Array = NDArray[np.float64]
# No elements come with the record. These were fitted to it: mean motion, node and mean anomaly such that no row lies
# in an eclipse and the eclipses are as long as that allows, for the inclination of a Sun-synchronous orbit.
ELEMENTS = (
    "1 44878U 19092F   20327.00000000  .00000000  00000-0  10000-4 0    04",
    "2 44878  97.4700 147.8821 0005000   0.0000 203.9517 15.15852310    04",
)
ORBIT = Sgp4Orbit(*ELEMENTS)
CONFIG = f"""
step_s = 10.0
[satellite]
inertia_kgm2 = [[0.04, 0, 0], [0, 0.04, 0], [0, 0, 0.012]]
[orbit]
start = "2020-11-15T00:00:00"
elements = ["{ELEMENTS[0]}", "{ELEMENTS[1]}"]
[sensors.star_tracker]
noise_deg = 0.1
[estimate]
sensors = "st"
longest_gap_s = 20.0
[estimate.process_noise]
rate_rad_s = 1e-3
[log]
time = "TIMESTAMP"
time_format = "utc"
[log.star_tracker]
columns = ["w", "x", "y", "z"]
direction = "body-from-inertial"
"""
LONGEST_GAP_S = 16.0
FASTEST_RAD_S = np.radians(3.0)


def read(path: Path, names: tuple[str, ...]) -> tuple[Instants, Array]:
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding=None)
    return instants(table["TIMESTAMP"]), np.stack([table[name] for name in names], axis=-1)


@pytest.fixture(scope="module")
def diodes(data_folder: Path) -> tuple[Instants, Array]:
    return read(data_folder / "opssat" / "labeled_I_PD_THETA.csv", ("PD3", "PD6"))


@pytest.fixture(scope="module")
def attitudes(data_folder: Path) -> tuple[Instants, Array]:
    utc, q = read(data_folder / "opssat" / "labeled_O_Q_FB_FI_EST.csv", tuple("wxyz"))
    return utc, quaternion.normalised(q)


def sunlit(utc: Instants) -> NDArray[np.bool_]:
    position, _ = ORBIT.position_velocity_eci(utc)
    return np.asarray(illuminated_fraction(position, sun_position_eci(utc)) >= 0.5)


class TestElevations:
    def test_of_both_diodes(self, diodes: tuple[Instants, Array], attitudes: tuple[Instants, Array]) -> None:
        (at, measured), (known, q) = diodes, attitudes
        since, knots = ((utc - known[0]) / np.timedelta64(1, "s") for utc in (at, known))
        before = np.clip(np.searchsorted(knots, since, side="right") - 1, 0, len(knots) - 2)
        gap = knots[before + 1] - knots[before]
        turn = quaternion.log(quaternion.multiply(quaternion.conjugate(q[before]), q[before + 1]))
        part = (since - knots[before]) / gap
        body_from_eci = quaternion.multiply(q[before], quaternion.exp(part[:, None] * turn))
        usable = (part >= 0.0) & (part <= 1.0) & (gap <= LONGEST_GAP_S) & sunlit(at)
        usable &= np.linalg.norm(turn, axis=-1) / gap < FASTEST_RAD_S
        assert usable.sum() > 7000
        sun = quaternion.rotate(body_from_eci, sun_position_eci(at))
        sun /= np.linalg.norm(sun, axis=-1, keepdims=True)
        for elevation, reading in ((np.arcsin(sun[:, 0]), measured[:, 0]), (np.arcsin(-sun[:, 2]), measured[:, 1])):
            rows = usable & (elevation > 0.0)
            assert rows.sum() > 4000
            # Measured: 3.1° and 3.5°; the spread is albedo.
            assert np.degrees(np.median(np.abs(elevation - reading)[rows])) < 4.0


class TestEclipses:
    def test_rows_are_in_the_sunlight(self, diodes: tuple[Instants, Array]) -> None:
        # A fifth of the time is dark; 0.6 % of the rows are.
        day = instants(diodes[0][0], np.arange(0.0, 86_400.0, 10.0))
        assert 0.15 < np.mean(~sunlit(day)) < 0.25
        assert np.mean(~sunlit(diodes[0])) < 0.01

    def test_rows_end_at_the_entries(self, diodes: tuple[Instants, Array]) -> None:
        # Entries with rows in the minutes before. Half of them are within 40 s of the last row (measured); before the
        # others the rows end up to 2.5 minutes early, for other reasons.
        utc = diodes[0]
        grid = instants(utc[0], np.arange(0.0, 14.9 * 86_400.0, 10.0))
        light = sunlit(grid)
        entries = grid[1:][light[:-1] & ~light[1:]]
        rows, found = (utc - utc[0]) / np.timedelta64(1, "s"), []
        for entry in (entries - utc[0]) / np.timedelta64(1, "s"):
            if np.sum((rows > entry - 200.0) & (rows < entry - 60.0)) >= 8:
                found.append(rows[rows < entry + 300.0].max() - entry)
        assert len(found) >= 10
        assert np.median(np.abs(found)) < 60.0


class TestLog:
    """The quaternions as they are: times in UTC, columns of its own, from inertial to body, 72 gaps."""

    @pytest.mark.slow
    def test_every_row_is_read_and_estimated(self, data_folder: Path, tmp_path: Path) -> None:
        config = tmp_path / "opssat.toml"
        config.write_text(CONFIG)
        scenario = adcs.read_scenario(str(config))
        path = data_folder / "opssat" / "labeled_O_Q_FB_FI_EST.csv"
        log = adcs.read_telemetry(path, scenario.step_s, layout=scenario.log)
        assert len(log.time_s) == 4776
        track = adcs.estimate(log, scenario.satellite, sensors=scenario.estimator())
        assert len(track.rows) == 4776
        assert "gaps longer than 20 s" in track.warnings[0]
        used = track.seen["st"] & ~track.gated["st"]
        angle = np.degrees((track.rotation[track.rows] * Rotation.from_quat(log.star).inv()).magnitude())
        assert np.median(angle[used[track.rows]]) < 0.2
