"""``magloc survey``."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pyogrio
import pyproj
import pytest

import magloc
import sims
from tests.command_line import Run, assert_refused

SCENARIO = """format_version = 1
duration_s = 60.0
rate_Hz = 8.0
[[array.sensor]]
id = "low"
kind = "scalar"
position_m = [0.0, 0.0, 0.0]
noise_nT = 0.1
[[array.sensor]]
id = "high"
kind = "scalar"
position_m = [0.0, 0.0, 0.8]
noise_nT = 0.1
[carrier.path]
kind = "lawnmower"
start_m = [-3.0, 2.0, 1.0]
course_deg = 90.0
length_m = 6.0
spacing_m = 0.8
lines = 6
speed_m_s = 0.8
[ambient]
field_nT = [1000.0, 20000.0, -44000.0]
[targets]
number = 1
x_m = [-1.5, 1.5]
y_m = [-1.5, 1.5]
moment_Am2 = [2.0, 5.0]
[geology]
field_nT = 1.0
[pose]
position_m = 0.01
correlation_s = 5.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated survey."""
    place = tmp_path_factory.mktemp("survey")
    (place / "ground.toml").write_text(SCENARIO)
    field = sims.simulate(sims.read_scenario(str(place / "ground.toml")), rng=11)
    sims.write_simulation(field, place / "ground.csv")
    return place


class TestSurvey:
    def test_json(self, folder: Path, run: Run) -> None:
        done = run("survey", folder / "ground.csv", "--array", folder / "ground-array.toml", "--json")
        assert done.status == 0, done.err
        found = json.loads(done.out)
        with (folder / "ground-targets.csv").open() as file:
            (truth,) = csv.DictReader(file)
        (target,) = found["targets"]
        for value, axis in zip(target["position_m"], "xyz", strict=True):
            assert value == pytest.approx(float(truth[f"{axis}_m"]), abs=0.06)
        low, high = target["depth_interval95_m"]
        assert low < -target["position_m"][2] < high
        assert len(target["covariance"]) == len(target["covariance"][0]) == 6
        assert set(target) >= {"id", "moment_Am2", "significance", "flags"}
        assert found["rows"] == 481
        assert found["seconds"] > 0.0

    @pytest.mark.usefixtures("without_lag")
    def test_files(self, folder: Path, tmp_path: Path, run: Run) -> None:
        pytest.importorskip("pymap3d")
        outputs = (
            "--out",
            tmp_path / "out",
            "--html",
            tmp_path / "t.html",
            "--geojson",
            tmp_path / "t.json",
            "--kml",
            tmp_path / "t.kml",
        )
        array = folder / "ground-array.toml"
        done = run("survey", folder / "ground.csv", "--array", array, *outputs, "--place", 48, 11, 500)
        assert done.status == 0, done.err
        own = {"profiles.png", "reach.csv", "residual.csv", "survey.png", "targets.csv"}
        assert {path.name for path in (tmp_path / "out").iterdir()} - {"report.pdf"} == own | MAP_FILES
        assert len(json.loads((tmp_path / "t.json").read_text())["features"]) == 1
        assert "__VISER_EMBED_DATA__" in (tmp_path / "t.html").read_text()
        assert "<Placemark>" in (tmp_path / "t.kml").read_text()
        assert "t1" in done.out

    @pytest.mark.usefixtures("without_pictures", "without_lag")
    def test_a_review_is_applied_and_written(self, folder: Path, tmp_path: Path, run: Run) -> None:
        log = tmp_path / "decisions.jsonl"
        log.write_text('{"action": "exclude", "from_s": 0, "to_s": 5}\n{"action": "split", "target": "t1"}\n')
        place = ("--place", 48, 11, 500)
        command = ("survey", folder / "ground.csv", "--array", folder / "ground-array.toml", *place)
        done = run(*command, "--decisions", log, "--out", tmp_path / "out", "--json")
        assert done.status == 0, done.err
        found = json.loads(done.out)
        assert sorted(target["id"] for target in found["targets"]) == ["t1a", "t1b"]
        assert found["rows"] == 481 - 41
        assert [entry["action"] for entry in found["decisions"]] == ["exclude", "split", "refit"]
        written = (tmp_path / "out" / "decisions.jsonl").read_text()
        assert [json.loads(line) for line in written.splitlines()] == found["decisions"]
        words = "1 target split, rows excluded in 1 place"
        assert words in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        again = run(*command, "--decisions", tmp_path / "out" / "decisions.jsonl", "--json")
        repeated = json.loads(again.out)
        assert repeated["decisions"] == found["decisions"]
        assert repeated["targets"] == found["targets"]
        without = run(*command[:4], "--out", tmp_path / "out")
        assert "decisions.jsonl, targets.geojson" in without.err
        assert "are of an earlier run" in without.err

    @pytest.mark.usefixtures("without_pictures", "without_lag")
    def test_the_page_of_a_review_saves_into_the_folder(
        self, folder: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The page's own tests press its buttons; here it saves at once."""
        asked: list[dict[str, object]] = []

        class Page:
            address = "http://127.0.0.1:8080"
            wait = close = staticmethod(lambda: None)

        def view_survey(found: magloc.Survey, save: Callable[[magloc.Survey], str], **options: object) -> Page:
            asked.append({**options, "words": save(magloc.Review(found).drop("t1").refit().found)})
            return Page()

        monkeypatch.setattr("magloc.viewer.view.view_survey", view_survey)
        command = ("survey", folder / "ground.csv", "--array", folder / "ground-array.toml")
        done = run(*command, "--out", tmp_path / "out", "--view", "--port", 0)
        assert done.status == 0, done.err
        assert done.out.splitlines()[-1] == Page.address
        assert [one["words"] for one in asked] == [f"saved in {tmp_path / 'out'}"]
        assert len((tmp_path / "out" / "targets.csv").read_text().splitlines()) == 1
        assert '"action":"drop"' in (tmp_path / "out" / "decisions.jsonl").read_text()
        assert_refused(run(*command, "--view"), "--view", "--out")

    def test_a_review_of_another_survey(self, folder: Path, tmp_path: Path, run: Run) -> None:
        log = tmp_path / "decisions.jsonl"
        array = folder / "ground-array.toml"
        command = ("survey", folder / "ground.csv", "--array", array, "--json", "--decisions", log)
        assert_refused(run(*command), str(log))
        log.write_text('{"action": "drop", "target": "t7"}')
        assert_refused(run(*command), f"{log}: entry 1: target must be one of t1; instead received t7")
        log.write_text('{"action": "drop"}')
        assert_refused(run(*command), f"{log}, line 1: ", "target")

    def test_two_files_are_one_survey(self, folder: Path, tmp_path: Path, run: Run) -> None:
        head, *rows = (folder / "ground.csv").read_text().splitlines()
        parts = []
        for k, part in enumerate((rows[:240], rows[240:])):
            parts.append(tmp_path / f"{k}.csv")
            parts[-1].write_text("\n".join([head, *part, ""]))
        whole, both = (
            json.loads(run("survey", *files, "--array", folder / "ground-array.toml", "--json").out)["targets"]
            for files in ([folder / "ground.csv"], parts)
        )
        assert whole == both

    @pytest.mark.usefixtures("without_lag")
    def test_base_station(self, folder: Path, tmp_path: Path, run: Run) -> None:
        """A storm at the sensors and at the base station changes nothing."""
        head, *rows = (folder / "ground.csv").read_text().splitlines()
        columns, storm = head.split(","), []
        base = ["time_s,base_nT"]
        for row in rows:
            cells = dict(zip(columns, map(float, row.split(",")), strict=True))
            change = 80.0 * math.sin(cells["time_s"] / 3.0)
            cells |= {name: cells[name] + change for name in ("low_nT", "high_nT")}
            storm.append(",".join(map(repr, cells.values())))
            base.append(f"{cells['time_s']!r},{48000.0 + change!r}")
        (tmp_path / "storm.csv").write_text("\n".join([head, *storm, ""]))
        (tmp_path / "base.csv").write_text("\n".join([*base, ""]))
        line = ("--array", folder / "ground-array.toml", "--json")
        quiet = run("survey", folder / "ground.csv", *line)
        done = run("survey", tmp_path / "storm.csv", *line, "--base", tmp_path / "base.csv")
        (target,), (expected,) = (json.loads(each.out)["targets"] for each in (done, quiet))
        assert target["position_m"] == pytest.approx(expected["position_m"], abs=1e-3)
        (tmp_path / "short.csv").write_text("\n".join([*base[:100], ""]))
        assert_refused(
            run("survey", tmp_path / "storm.csv", *line, "--base", tmp_path / "short.csv"), "--base must cover"
        )

    def test_bad_input(self, folder: Path, run: Run) -> None:
        line = ("survey", folder / "ground.csv", "--array", folder / "ground-array.toml")
        assert_refused(run(*line, "--kml", folder / "t.kml"), "--place")
        assert_refused(run(*line, "--ground-m", 5), "--ground-m")
        assert_refused(run(*line, "--false-per-hectare", 0), "--false-per-hectare")
        assert_refused(run(*line, "--region", "z>1"), "room below the ground")


@pytest.mark.usefixtures("without_lag")
class TestDoubts:
    """Numbers of another frame or field are refused or named, in the JSON too."""

    def changed(self, folder: Path, tmp_path: Path, change: Callable[[dict[str, float]], dict[str, float]]) -> Path:
        """The survey with every row changed."""
        head, *rows = (folder / "ground.csv").read_text().splitlines()
        columns, path = head.split(","), tmp_path / "changed.csv"
        changed = [change(dict(zip(columns, map(float, row.split(",")), strict=True))) for row in rows]
        path.write_text("\n".join([head, *(",".join(map(repr, row.values())) for row in changed), ""]))
        return path

    @pytest.mark.parametrize("command", ["survey", "track"])
    @pytest.mark.parametrize("output", ["--geojson", "--kml"])
    def test_grid_coordinates_are_put_nowhere(
        self, command: str, output: str, folder: Path, tmp_path: Path, run: Run
    ) -> None:
        far = self.changed(folder, tmp_path, lambda row: row | {"array_y_m": row["array_y_m"] + 5.8e6})
        place = ("--place", "52.4", "13.1", "41")
        outcome = run(command, far, "--array", folder / "ground-array.toml", *place, output, tmp_path / "map")
        assert_refused(outcome, "changed.csv: places must lie within 100 km", "northings of a grid")
        assert not (tmp_path / "map").exists()

    def test_field_that_is_another_one(self, folder: Path, tmp_path: Path, run: Run) -> None:
        off = self.changed(folder, tmp_path, lambda row: row | {"ambient_z_nT": row["ambient_z_nT"] - 1700.0})
        found = json.loads(run("survey", off, "--array", folder / "ground-array.toml", "--json").out)
        said = [sentence for sentence in found["warnings"] if "less than the ambient field" in sentence]
        assert len(said) == 1
        assert len(found["targets"]) == 1

    def test_heights_above_the_sea(self, folder: Path, tmp_path: Path, run: Run) -> None:
        high = self.changed(folder, tmp_path, lambda row: row | {"array_z_m": row["array_z_m"] + 83.0})
        line = ("survey", high, "--array", folder / "ground-array.toml", "--json")
        found, right = (json.loads(run(*line, *more).out) for more in ((), ("--ground-m", "83")))
        assert any("state the height of the ground" in sentence for sentence in found["warnings"])
        assert right["warnings"] == []
        assert len(right["targets"]) == 1


LATITUDE, LONGITUDE, HEIGHT_M = 52.41, 13.12, 41.0
TOPOCENTRIC = (
    f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={LATITUDE} +lon_0={LONGITUDE} +h_0={HEIGHT_M}"
    " +step +inv +proj=cart +ellps=WGS84"
)
UTM_COLUMNS = '[columns]\nposition = ["E", "N", "H"]\ncrs = "EPSG:32633"\n'
MAP_FILES = {"targets.gpkg", "targets.geojson", "targets.kml", "field.tif", "residual.tif", "lines.xyz", "report.html"}


@pytest.fixture(scope="module")
def log(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log in UTM, by PROJ's own topocentric frame, beside its array file."""
    place = tmp_path_factory.mktemp("utm")
    table = pd.read_csv(folder / "ground.csv")
    names = ["array_x_m", "array_y_m", "array_z_m"]
    longitude, latitude, table["H"] = pyproj.Transformer.from_pipeline(TOPOCENTRIC).transform(
        *table[names].to_numpy().T
    )
    table["E"], table["N"] = pyproj.Proj("EPSG:32633")(longitude, latitude)
    table.drop(columns=names).to_csv(place / "log.csv", index=False)
    (place / "array.toml").write_text((folder / "ground-array.toml").read_text() + UTM_COLUMNS)
    return place / "log.csv"


@pytest.fixture(scope="module")
def target(folder: Path) -> dict[str, float]:
    """Coordinates of the true target."""
    truth = sims.simulate(sims.read_scenario(str(folder / "ground.toml")), rng=11).target_position_m[0]
    longitude, latitude, _ = pyproj.Transformer.from_pipeline(TOPOCENTRIC).transform(*truth)
    easting, northing = pyproj.Proj("EPSG:32633")(longitude, latitude)
    return {"easting": easting, "northing": northing, "latitude": latitude, "longitude": longitude}


@pytest.mark.usefixtures("without_lag")
class TestMaps:
    """A log in UTM becomes what a client's map opens: targets in the log's system and in WGS 84."""

    @pytest.mark.usefixtures("without_pictures")
    def test_in_one_command(self, log: Path, target: dict[str, float], run: Run, tmp_path: Path) -> None:
        outcome = run(
            "survey", log, "--array", log.with_name("array.toml"), "--ground-m", -1, "--out", tmp_path, "--json"
        )
        assert outcome.status == 0, outcome.err
        assert "the origin of the world frame is the first place of" in outcome.err
        assert {path.name for path in tmp_path.iterdir()} >= MAP_FILES
        report = json.loads(outcome.out)
        assert report["crs"] == "EPSG:32633"
        metadata, _, _, fields = pyogrio.raw.read(tmp_path / "targets.gpkg", layer="targets")
        of_layer = {name: field[0] for name, field in zip(metadata["fields"], fields, strict=True)}
        with (tmp_path / "targets.csv").open() as file:
            of_table = next(csv.DictReader(file))
        for found in (report["targets"][0], of_layer, of_table):
            assert float(found["easting"]) == pytest.approx(target["easting"], abs=0.05)
            assert float(found["northing"]) == pytest.approx(target["northing"], abs=0.05)
            assert float(found["latitude"]) == pytest.approx(target["latitude"], abs=5e-7)
            assert float(found["longitude"]) == pytest.approx(target["longitude"], abs=8e-7)

    def test_in_another_system(self, log: Path, target: dict[str, float], run: Run) -> None:
        """Web Mercator, by PROJ."""
        more = ("--ground-m", "-1", "--crs", "EPSG:3857", "--json")
        outcome = run("survey", log, "--array", log.with_name("array.toml"), *more)
        found = json.loads(outcome.out)["targets"][0]
        expected = pyproj.Proj("EPSG:3857")(target["longitude"], target["latitude"])
        assert (found["easting"], found["northing"]) == (
            pytest.approx(expected[0], abs=0.1),
            pytest.approx(expected[1], abs=0.1),
        )

    def test_the_origin_of_the_array_file_counts(
        self, log: Path, target: dict[str, float], run: Run, tmp_path: Path
    ) -> None:
        """--place for the ambient field, 1 km away, moves no map."""
        array = tmp_path / "array.toml"
        array.write_text(log.with_name("array.toml").read_text() + f"origin = {[LATITUDE, LONGITUDE, HEIGHT_M]}\n")
        place = ("--place", LATITUDE + 0.01, LONGITUDE, HEIGHT_M)
        outcome = run("survey", log, "--array", array, *place, "--geojson", tmp_path / "map.geojson", "--json")
        report = json.loads(outcome.out)
        assert any("--place is not the origin of the array file" in warning for warning in report["warnings"])
        (feature,) = json.loads((tmp_path / "map.geojson").read_text())["features"]
        expected = (target["longitude"], target["latitude"])
        assert feature["geometry"]["coordinates"][:2] == pytest.approx(expected, rel=0.0, abs=8e-7)
        assert report["targets"][0]["latitude"] == pytest.approx(target["latitude"], abs=5e-7)

    def test_an_unknown_system(self, log: Path, run: Run) -> None:
        outcome = run("survey", log, "--array", log.with_name("array.toml"), "--crs", "EPSG:1", "--quiet")
        assert_refused(outcome, "--crs", "'EPSG:1'", "a system that PROJ knows")

    def test_a_system_without_a_place(self, folder: Path, run: Run) -> None:
        outcome = run("survey", folder / "ground.csv", "--array", folder / "ground-array.toml", "--crs", "EPSG:3857")
        assert_refused(outcome, "--crs", "--place")

    def test_a_system_of_another_continent(self, log: Path, run: Run, tmp_path: Path) -> None:
        line = ("survey", log, "--array", log.with_name("array.toml"), "--out", tmp_path / "out", "--quiet")
        assert_refused(run(*line, "--crs", "EPSG:32610"), "--crs", "longitude -126 to -120")
        assert not (tmp_path / "out").exists()

    def test_an_origin_far_away(self, log: Path, run: Run, tmp_path: Path) -> None:
        """A map there has no digits left; the sentence comes before the work."""
        line = ("survey", log, "--array", log.with_name("array.toml"), "--out", tmp_path / "out", "--quiet")
        assert_refused(run(*line, "--place", 48, 11, 0), "within 100 km", "513")
        assert not (tmp_path / "out").exists()

    def test_the_ground_counts_from_the_first_place(self, log: Path, run: Run) -> None:
        outcome = run("survey", log, "--array", log.with_name("array.toml"))
        assert outcome.status == 2
        assert "--ground-m is measured from the height of that place, negative below it" in outcome.err
