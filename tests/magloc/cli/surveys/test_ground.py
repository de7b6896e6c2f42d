"""``--terrain``: a map of heights, a log above ground, an altimeter."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.command_line import Run, assert_refused
from tests.hills import AMBIENT_T, CLEARANCE_M, hills, walk

pymap3d, pyproj = pytest.importorskip("pymap3d"), pytest.importorskip("pyproj")
rasterio = pytest.importorskip("rasterio")

ORIGIN = (52.41, 13.12, 0.0)
FLOWN = walk(61, hills, 5.0, 3)
ARRAY = """ambient_world_nT = [{}, {}, {}]
[[sensor]]
id = "low"
kind = "scalar"
position_m = [0.0, 0.0, 0.0]
noise_nT = 0.1
[[sensor]]
id = "high"
kind = "scalar"
position_m = [0.0, 0.0, 1.0]
noise_nT = 0.1
[pose]
position_m = 0.02
correlation_s = 10.0
[columns]
crs = "EPSG:32633"
position = ["E", "N", "{}"]
height_is = "{}"
sensors = {{low = "low", high = "high"}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk in UTM with heights above the sea and above ground, and a map of the hills in ETRS89."""
    place, rows = tmp_path_factory.mktemp("hills"), FLOWN.readings
    assert rows.array_position_m is not None
    latitude, longitude, height = pymap3d.enu2geodetic(*rows.array_position_m.T, *ORIGIN)
    to_grid = pyproj.Transformer.from_crs(4326, 32633, always_xy=True).transform
    columns = dict(zip(("E", "N"), np.round(to_grid(longitude, latitude), 4), strict=True))
    above = rows.array_position_m[:, 2] - hills(rows.array_position_m[:, :2])
    columns |= {"time_s": rows.time_s, "H": np.round(height, 4), "Above": np.round(above, 4)}
    columns |= dict(zip(("low", "high"), 1e9 * rows.values_T.T, strict=True))
    pd.DataFrame(columns).to_csv(place / "walk.csv", index=False)
    for name, column, level in (("sea", "H", "geoid"), ("ground", "Above", "ground")):
        (place / f"{name}.toml").write_text(ARRAY.format(*(1e9 * AMBIENT_T), column, level))
    east, north = (np.floor(np.ptp([low]) + low) for low in to_grid(*ORIGIN[1::-1]))
    corner = np.array([east - 40.0, north + 40.0])
    at = np.stack(np.meshgrid(corner[0] + np.arange(80) + 0.5, corner[1] - np.arange(80) - 0.5), axis=-1).reshape(-1, 2)
    where = pyproj.Transformer.from_crs(25833, 4326, always_xy=True).transform(*at.T)
    heights = hills(np.stack(pymap3d.geodetic2enu(where[1], where[0], 0.0, *ORIGIN)[:2], axis=-1)).reshape(80, 80)
    profile = {"driver": "GTiff", "height": 80, "width": 80, "count": 1, "dtype": "float64", "crs": "EPSG:25833"}
    transform = rasterio.Affine(1.0, 0.0, corner[0], 0.0, -1.0, corner[1])
    with rasterio.open(place / "dem.tif", "w", transform=transform, **profile) as file:
        file.write(heights, 1)
    return place


def assert_depths(targets: list[dict[str, float]]) -> None:
    """All targets within 5 cm of the truth."""
    found = sorted(target["depth_m"] for target in targets)
    np.testing.assert_allclose(found, np.sort(FLOWN.depth_m), atol=0.05)


class TestTerrain:
    @pytest.mark.usefixtures("without_lag")
    def test_a_map_of_heights(self, folder: Path, run: Run) -> None:
        line = ("--array", folder / "sea.toml", "--terrain", folder / "dem.tif", "--json")
        done = run("survey", folder / "walk.csv", *line)
        assert done.status == 0, done.err
        assert_depths(json.loads(done.out)["targets"])

    @pytest.mark.usefixtures("without_pictures", "without_lag")
    def test_heights_above_ground_in_the_log(self, folder: Path, tmp_path: Path, run: Run) -> None:
        """Heights of the map are those of the terrain: targets lie 0.3 to 1.5 m below the hills at 33 m."""
        raw = pytest.importorskip("pyogrio.raw")
        line = ("--array", folder / "ground.toml", "--terrain", folder / "dem.tif", "--out", tmp_path / "out", "--json")
        done = run("survey", folder / "walk.csv", *line)
        assert done.status == 0, done.err
        assert "the origin is on the ground, at a height of 3" in done.err
        found = json.loads(done.out)
        assert_depths(found["targets"])
        path = tmp_path / "out" / "targets.gpkg"
        heights, flown = (raw.read(path, layer=name, columns=["height_m"])[3][0] for name in ("targets", "lines"))
        np.testing.assert_allclose(np.sort(heights), np.sort(FLOWN.position_m[:, 2]), atol=0.06)
        assert "dem.tif, at heights of 32." in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        np.testing.assert_allclose(flown, CLEARANCE_M + 0.5, atol=0.05)  # the middle of both sensors

    @pytest.mark.usefixtures("without_lag")
    @pytest.mark.parametrize("down_m", [0.0, 45.0])
    def test_heights_of_the_ellipsoid_above_a_map_of_the_sea(self, folder: Path, run: Run, down_m: float) -> None:
        """The sea is 45 m above the ellipsoid: a note names the median height of the lower sensor above the terrain."""
        line = ("--array", folder / "sea.toml", "--terrain", folder / "dem.tif", "--ground-m", -down_m)
        done = run("qc", folder / "walk.csv", *line)
        assert done.status == 0, done.err
        assert ("raise the terrain by the difference" in done.err) == (down_m > 0.0)
        assert not down_m or f"in the median {down_m + CLEARANCE_M:.4g} m, above" in done.err

    @pytest.mark.usefixtures("without_lag")
    @pytest.mark.parametrize("unit_m", [1.0, 0.3048])
    def test_an_altimeter_in_feet(self, folder: Path, tmp_path: Path, run: Run, unit_m: float) -> None:
        """Flat ground: the altimeter follows the height of the log, and its unit is told by the ratio."""
        log = pd.read_csv(folder / "walk.csv")
        log["H"] = 30.0 + 0.2 * np.sin(0.7 * log["time_s"])
        noise = 0.02 * np.random.default_rng(5).standard_normal(len(log))
        log.assign(Above=(log["H"] - 29.0 + noise) / unit_m).to_csv(tmp_path / "walk.csv", index=False)
        done = run("qc", tmp_path / "walk.csv", "--array", folder / "sea.toml", "--terrain", "Above")
        assert done.status == 0, done.err
        assert ("changes by 3." in done.err and "A foot is 0.3048 m" in done.err) == (unit_m < 1.0)
        assert "is it in metres" not in done.err or unit_m < 1.0

    @pytest.mark.usefixtures("without_lag")
    def test_an_altimeter(self, folder: Path, run: Run) -> None:
        done = run("survey", folder / "walk.csv", "--array", folder / "sea.toml", "--terrain", "Above", "--json")
        assert done.status == 0, done.err
        assert_depths(json.loads(done.out)["targets"])

    def test_bad_input(self, folder: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
        line = ("survey", folder / "walk.csv", "--array", folder / "sea.toml", "--terrain")
        (tmp_path / "far.csv").write_text("lon,lat,height\n13,53,1\n13.1,53,1\n13,53.1,1\n")
        assert_refused(run(*line, tmp_path / "far.csv", "--quiet"), "expected terrain that covers all lines")
        assert_refused(run(*line, tmp_path / "none.tif", "--quiet"), "does not exist")
        assert_refused(run(*line, "Sonar", "--quiet"), "column Sonar: found no such column")
        for column in ("time_s", "low"):
            assert_refused(run(*line, column, "--quiet"), "expected heights above ground")
        assert_refused(run(*line, folder / "dem.tif", "--ground-m", 47.0, "--quiet"), "--ground-m")
        above = ("survey", folder / "walk.csv", "--array", folder / "ground.toml", "--terrain", "Above")
        assert_refused(run(*above, "--quiet"), "expected heights above the sea or the ellipsoid")
        monkeypatch.setitem(sys.modules, "rasterio", None)
        assert_refused(run(*line, folder / "dem.tif", "--quiet"), 'needs the extra "gis"')
