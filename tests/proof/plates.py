"""Twenty-four magnets in wells at once, and a coil that a stage moves away from one magnetometer."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares

from arrays.array import SensorArray
from arrays.array_file import write_array
from arrays.typing import FloatArray
from docs.studies.beating_tissue import FIRST_ROW, WELL, plate, readings_T
from magloc.fields import dipole
from magloc.localization.line_ranging import distance_along_line, fit_source_line
from tests.proof import Part, Row, Size, row_of_errors, row_of_offsets, run_command
from tests.proof.dipole_peers import dipole_jacobian

AVERAGED_ROWS = 100
CYLINDER = ("--magnet", "cylinder", "--size-m", "0.00075", "0.001")
MOST_STARTS = 4
"""Starts of all 24 magnets at once, which take many seconds each."""
WRONG_WELL_M = 5e-3
DEEP, SIDES = np.array([0.0, 0.0, -5e-3]), np.array([1.0, 1.0, 0.0])
STAGE_M = 0.01 * np.arange(81)
COIL_NOISE_T, COIL_FRACTION = 0.03e-6, 0.02
FARTHEST_M = 0.52
"""Where noise alone makes 1 cm of distance."""

# ---- 24 magnets


def _plate(data: Path) -> tuple[SensorArray, FloatArray]:
    """Return the plate and the mean of some rows (216,)."""
    return plate(), readings_T(data / "curibio")[FIRST_ROW : FIRST_ROW + AVERAGED_ROWS].mean(axis=0)


def _joint_residual(array: SensorArray, values_T: FloatArray, x: FloatArray) -> FloatArray:
    p, m = np.split(x.reshape(-1, 6), 2, axis=1)
    field = dipole.field(array.positions[:, None], p, m).sum(axis=1)
    return ((field - values_T.reshape(-1, 3)) / array.sensors[0].noise_T).ravel()


def _joint_jacobian(array: SensorArray, x: FloatArray) -> FloatArray:
    sigma = np.full((len(array.positions), 1), array.sensors[0].noise_T)
    return np.concatenate([dipole_jacobian(array.positions, sigma, one) for one in x.reshape(-1, 6)], axis=1)


def joint_fit(array: SensorArray, values_T: FloatArray, places: FloatArray) -> tuple[FloatArray, float]:
    """Return places (24, 3) of a joint fit from first places, and its cost."""
    sigma = array.sensors[0].noise_T
    one = np.full((len(array.positions), 1), sigma)
    by_moment = [dipole_jacobian(array.positions, one, np.array([*p, 1.0, 0.0, 0.0]))[:, 3:] for p in places]
    moments = np.linalg.lstsq(np.concatenate(by_moment, axis=1), values_T / sigma)[0].reshape(-1, 3)
    fit = least_squares(
        lambda x: _joint_residual(array, values_T, x),
        np.concatenate([places, moments], axis=1).ravel(),
        lambda x: _joint_jacobian(array, x),
        method="lm",
        x_scale="jac",
        max_nfev=300,
    )
    return fit.x.reshape(-1, 6)[:, :3], float(fit.cost)


def _off_wells(found: FloatArray) -> FloatArray:
    """Return horizontal offsets (24, 2) of the magnet found nearest to each well's centre; NaN where there is none."""
    off = np.full((len(WELL), 2), np.nan)
    for place in found:
        well = int(np.argmin(np.linalg.norm(WELL[:, :2] - place[:2], axis=1)))
        from_centre = place[:2] - WELL[well, :2]
        if not np.linalg.norm(off[well]) <= np.linalg.norm(from_centre):
            off[well] = from_centre
    return off


def our_plate(data: Path, _: Size) -> Iterator[Row]:
    """All magnets at once, from no start."""
    array, values = _plate(data)
    with TemporaryDirectory() as name:
        readings, path = Path(name) / "plate.csv", Path(name) / "plate.toml"
        columns = [f"{sensor}_{axis}_nT" for sensor in array.ids for axis in "xyz"]
        numbers = ",".join(f"{1e9 * value:.1f}" for value in values)
        readings.write_text(f"time_s,{','.join(columns)}\n0,{numbers}\n", encoding="utf-8")
        write_array(path, array)
        for shape, needs in ((), ""), (CYLINDER, ", their size and shape"):
            text, seconds = run_command(
                "magloc", "locate", readings, "--array", path, "--sources", str(len(WELL)), *shape, "--json"
            )
            (entry,) = json.loads(text)["results"]
            found = np.array([source["position_m"] for source in entry["solutions"][0]["sources"]])
            tool = f"`magloc {' '.join(['locate --sources 24', *shape[:2]])}`"
            needs = f"array file, number of magnets{needs}"
            yield row_of_offsets("mean of 100 rows", tool, needs, seconds, _off_wells(found), WRONG_WELL_M)


def scipy_plate(data: Path, size: Size) -> Iterator[Row]:
    """Joint fits from the wells, and from random places above the plate."""
    array, values = _plate(data)
    began = time.process_time()
    places, _ = joint_fit(array, values, WELL + DEEP)
    needs = "array file, a start for every magnet: its well, 5 mm deep"
    took = time.process_time() - began
    yield row_of_offsets("mean of 100 rows", "scipy, from the wells", needs, took, _off_wells(places), WRONG_WELL_M)
    rng = np.random.default_rng(0)
    low, high = WELL.min(axis=0) + 2.0 * DEEP - 0.01 * SIDES, WELL.max(axis=0) + 0.6 * DEEP + 0.01 * SIDES
    began = time.process_time()
    starts = min(MOST_STARTS, size.starts)
    fits = [joint_fit(array, values, rng.uniform(low, high, WELL.shape)) for _ in range(starts)]
    places = min(fits, key=lambda fit: fit[1])[0]
    needs = f"array file, number of magnets, box, {starts} starts"
    took = time.process_time() - began
    yield row_of_offsets("mean of 100 rows", "scipy, random starts", needs, took, _off_wells(places), WRONG_WELL_M)


PLATE = Part("curibio", "mm", "none within 5 mm of the well's centre", our_plate, {"scipy": scipy_plate})

# ---- a coil on a stage


def _coil_T(data: Path) -> FloatArray:
    names = ["forward_readings_averaged", "backward_readings_averaged"]
    record = loadmat(data / "coil-range" / "exp_1_dump.mat", variable_names=names)
    return 0.5e-6 * (record[names[0]] - record[names[1]])


def _halves() -> Iterator[tuple[FloatArray, FloatArray]]:
    for first in (0, 1):
        yield np.arange(1 - first, 81, 2), np.arange(first, 81, 2)


def _coil_rows(tool: str, needs: str, took: float, error: FloatArray, sigma: FloatArray | None) -> Iterator[Row]:
    """Return rows of the near distances and of all of them."""
    for case, rows in (("up to 0.52 m", STAGE_M <= FARTHEST_M), ("up to 0.8 m", np.inf > STAGE_M)):
        within = None if sigma is None else 1e3 * sigma[rows]
        yield row_of_errors(case, tool, needs, took / len(STAGE_M), 1e3 * error[rows], 50.0, within)


def our_coil(data: Path, _: Size) -> Iterator[Row]:
    """Distances of the rows that the fit of the line has not seen."""
    field = _coil_T(data)
    for coil in (True, False):
        error, sigma = np.empty((2, len(STAGE_M)))
        began = time.process_time()
        for seen, unseen in _halves():
            line = fit_source_line(STAGE_M[seen], field[seen], COIL_NOISE_T, noise_fraction=COIL_FRACTION, coil=coil)
            found, sigma[unseen] = distance_along_line(
                line, field[unseen], COIL_NOISE_T, noise_fraction=COIL_FRACTION, within_m=(-0.05, 1.2)
            )
            error[unseen] = found - STAGE_M[unseen]
        tool = f"`magloc.fit_source_line`, {'coil' if coil else 'dipole'}"
        yield from _coil_rows(tool, "41 fields at known distances", time.process_time() - began, error, sigma)


def scipy_coil(data: Path, size: Size) -> Iterator[Row]:
    """Power law of the modulus by ``curve_fit``, and a dipole on a line by least squares from random starts."""
    field = _coil_T(data)
    modulus = np.linalg.norm(field, axis=1)
    error, errors = np.empty((2, len(STAGE_M)))
    rng, took = np.random.default_rng(0), [0.0, 0.0]
    sigma = np.hypot(COIL_NOISE_T, COIL_FRACTION * modulus)[:, None]
    for seen, unseen in _halves():
        began = time.process_time()
        law = least_squares(
            lambda x, s=seen: (np.exp(x[0]) / np.abs(STAGE_M[s] + x[1]) ** 3 - modulus[s]) / sigma[s, 0], [-18.0, 0.1]
        ).x
        error[unseen] = np.cbrt(np.exp(law[0]) / modulus[unseen]) - law[1] - STAGE_M[unseen]
        took[0] += time.process_time() - began
        began = time.process_time()

        def on_line(x: FloatArray, distance: FloatArray) -> FloatArray:
            source = x[:3] + distance[:, None] * x[3:6] / np.linalg.norm(x[3:6])
            return dipole.field(np.zeros(3), source, x[6:])

        starts = np.concatenate(
            [
                rng.uniform(-0.3, 0.3, (size.starts, 3)),
                rng.normal(size=(size.starts, 3)),
                rng.normal(size=(size.starts, 3)),
            ],
            axis=1,
        )
        best = min(
            (
                least_squares(lambda x, s=seen: ((on_line(x, STAGE_M[s]) - field[s]) / sigma[s]).ravel(), start)
                for start in starts
            ),
            key=lambda fit: fit.cost,
        ).x
        grid = np.linspace(-0.05, 1.2, 5001)
        model = on_line(best, grid)
        nearest = np.argmin(np.linalg.norm(model - field[unseen, None], axis=2), axis=1)
        errors[unseen] = grid[nearest] - STAGE_M[unseen]
        took[1] += time.process_time() - began
    needs = "41 fields at known distances"
    yield from _coil_rows("scipy, cubic law of the modulus", needs, took[0], error, None)
    yield from _coil_rows(
        "scipy `least_squares`, dipole on a line", f"{needs}, {size.starts} starts", took[1], errors, None
    )


COIL = Part("coil-range", "mm", "beyond 50 mm", our_coil, {"scipy": scipy_coil})
