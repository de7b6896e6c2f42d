"""A valid, short command line for every command, and the files that these read."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path

import numpy as np
from cyclopts import App, ArgumentCollection
from PIL import Image
from scipy.spatial.transform import Rotation

import adcs
import arrays
from adcs.cli.app import app as adcs_app
from adcs.cli.app import main as adcs_main
from arrays.io.csv import write_columns
from magloc.bodies.body_file import write_body
from magloc.cli.app import app as magloc_app
from magloc.cli.app import main as magloc_main
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings, write_readings
from sims.experiments.loads import switching_loads
from tests.adcs.stars.test_identification import random_sky, write_frames
from tests.magloc.bodies.devices import hall_ring, knob, random_poses, readings_of
from tests.magloc.compensation.flights import Flight, Platform, array_of
from tests.magloc.live.test_turning import board as turned_board
from tests.magloc.live.test_turning import turned as turned_rows
from tests.robot_flights import Flight as RobotFlight

APPS = {"magloc": magloc_app, "adcs": adcs_app}
MAINS = {"magloc": magloc_main, "adcs": adcs_main}

# What is written is written into "out"; a command that is not here fails the test that reads this table.
LINES: dict[str, tuple[str, ...]] = {
    "magloc simulate": (
        "simulate.toml --out out.csv --json",
        "moving.toml --out out.csv --body-length-m 0.01",
        "ground.toml --out out.csv",
    ),
    "magloc survey": (
        "ground.csv --array ground-array.toml --json",
        "ground.csv --array ground-array.toml --ground-m -0.1 --region=z>-2 --out out",
        "ground.csv --array ground-array.toml --region=z>-0.3 --threads 1 --json",
        "magarrow.csv --instrument magarrow --place 48 11 500 --json",
        "magarrow.csv --instrument magarrow --positions magarrow.pos --place 48 11 500 --json",
        "ground.csv --array ground-array.toml --decisions decisions.jsonl --out out",
    ),
    "magloc qc": (
        "ground.csv --array ground-array.toml --json",
        "ground.csv --array ground-array.toml --ground-m -0.1 --out out",
    ),
    "magloc compensate": (
        "flight.csv --array flight.toml --currents motor_A --json",
        "flight.csv --array flight.toml --currents motor_A --calibration flight.csv --out out.csv",
    ),
    "magloc locate": (
        "readings.csv --array array.toml --json",
        "readings.csv --array array.toml --sources auto --json",
        "readings.csv --array array.toml --position 3 0.5 0.3 --json",
        "readings.csv --array array.toml --region=z<2 --max-moment-Am2 1000 --json",
        "readings.csv --array array.toml --average",
        "readings.csv --array array.toml --magnet cylinder --size-m 0.1 0.2 --json",
        "scalar.csv --array scalar.toml --json",
        "moving.csv --array moving-array.toml",
        "body.csv --array body-array.toml --body body.toml --json",
    ),
    "magloc track": (
        "readings.csv --array array.toml --json",
        "moving.csv --array moving-array.toml --truth moving-truth.csv --smooth",
        "- --array array.toml --jsonl",
        "readings.csv --array array.toml --magnet sphere --size-m 0.1 --jsonl",
        "readings.csv --array array.toml --sources auto --jsonl",
        "readings.csv --array array.toml --sources 1 --out out",
        "passing.csv --array passing-array.toml --object-path passing-path.csv --path-sigma-m 1 --smooth --json",
        "readings.csv --array array.toml --position 3 0.5 0.306 --truth readings-truth.csv",
        "body.csv --array body-array.toml --body body.toml --out out",
    ),
    "magloc live": (
        "--array array.toml --from - --speed-m-s 0.1",
        "--array array.toml --from replay:readings.csv --replay-speed 1e6 --rest-s 3 --out out.csv",
        "--array log.toml --from replay:log.csv --replay-speed 1e6",
        "--array turned.toml --from replay:turned.csv --replay-speed 1e6 --calibrate --out-array out.toml",
        "--array body-array.toml --body body.toml --from replay:body.csv --replay-speed 1e6",
        "--array body-array.toml --body body.toml --from replay:body-rest.csv --replay-speed 1e6 --rest-s 0.2"
        " --out out.csv",
    ),
    "magloc signature": (
        "passing.csv --array passing-array.toml --object-path passing-path.csv --depth-m 2 --json",
        "passing.csv --array passing-array.toml --object-path passing-path.csv --eddy --attitude-sigma-deg 1",
    ),
    "magloc calibrate": (
        "readings.csv --array array.toml --truth readings-truth.csv --out out.toml --json",
        "body.csv --array body-array.toml --body body.toml --truth body-truth.csv --json"
        " --magnet-position-prior-mm 0.2",
        "body.csv --array body-array.toml --body body.toml --truth body-truth.csv --free-rows"
        " --magnet-strength-prior 0.03 --out-array out.toml --out-body out-body.toml",
    ),
    "magloc map": (
        "paper --grid 3 --out out --json",
        "map.toml --method iekf --grid 3 --out out",
        "map.toml --over sources --grid 3 --body-length-m 0.1 --out out --json",
    ),
    "magloc bounds": (
        "map.toml --grid 3 --moments 4 --out out --json",
        "--array array.toml --grid 3 --moments 4",
        "--array body-array.toml --body body.toml --json",
    ),
    "magloc design": (
        "task.toml --out out.toml --json",
        "body-task.toml --array body-array.toml --body body.toml --out-body out.toml --json",
    ),
    "magloc view": (
        "array.toml --html out.html",
        "readings.csv --array array.toml --html out.html",
        "track.json --array array.toml --readings readings.csv --html out.html",
        "sources.json --array array.toml --html out.html",
        "readings-truth.csv --html out.html",
        "map --html out.html",
    ),
    "magloc new-array": ("out.toml --shape tetrahedron --size-m 1.5 --noise-nT 1",),
    "magloc columns": (
        "readings.csv",
        "readings.csv --out out.toml",
        "magarrow.csv --instrument magarrow",
        "robot.ulg --out out.toml",
        "robot.ulg --rest out",
    ),
    "magloc export-config": ("array.toml --to header", "array.toml --out out.hpp", "scenario.toml --out out.hpp"),
    "magloc demo": ("out",),
    "magloc warm-up": ("",),
    "adcs demo": ("out",),
    "adcs warm-up": ("",),
    "adcs run": ("scenario.toml --duration 20 --seeds 1 --json", "tabletsat --duration 20 --seeds 1"),
    "adcs run complementary": ("--duration 3000 --json",),
    "adcs run detumbling": ("--seeds 1 --duration 20 --json",),
    "adcs run ellipsoid": ("--duration 300 --seeds 2 --json", "--closed-loop --duration 300 --seeds 1"),
    "adcs run mockup": (
        "--part fusion --duration 12 --seeds 1 --json",
        "--part zeros --duration 12 --seeds 1",
        "--part sky --poses 1 --sky sky.toml --json",
        "--part all --duration 12 --seeds 1 --delay-s 0.1 --sky sky.toml --json",
    ),
    "adcs compare": ("scenario.toml eclipse --duration 20 --seeds 1 --json",),
    "adcs tables": ("--duration 20 --seeds 1 --json",),
    "adcs estimate": (
        "telemetry.csv --config scenario.toml --json",
        "telemetry.csv --config scenario.toml --sensors mag+sun+gyro --filter smoother --out out",
    ),
    "adcs vectors": (
        "telemetry.csv --config scenario.toml --json",
        "telemetry.csv --config scenario.toml --method triad --out out",
    ),
    "adcs view": (
        "telemetry.csv --config scenario.toml --html out.html",
        "imu.csv --config imu.toml --html out.html",
    ),
    "adcs loads": ("loads.csv --array loads.toml --json --out out.csv",),
    "adcs live": (
        "--from replay:imu.csv --replay-speed 1e6 --config imu.toml",
        "--from replay:imu.csv --replay-speed 1e6 --lag-s 0.01",
    ),
    "adcs imu": ("imu.csv --config imu.toml --json", "imu.csv --offline --out out", "robot.ulg --json"),
    "adcs calibrate-log": (
        "imu.csv --config imu.toml --out out.toml --json",
        "imu.csv --place 48 11 500 --date 2026-05-01 --out out.params",
    ),
    "adcs calibrate": ("telemetry.csv --config scenario.toml --json --out out.csv",),
    "adcs stars": (
        "frames --catalogue stars.csv --json",
        "sky.png --catalogue stars.csv --scale-arcsec 15.8 --near 40 20 5 --wcs out --json",
        "sky.png --catalogue stars.csv --lens lens.toml --json",
    ),
}  # fmt: skip
_OF_GROUND = ("time_s", "array_x_m", "array_y_m", "array_z_m", "m_nT")
# How often beside one of the others: seconds each, and a demonstration reads nothing that could be mangled.
SELDOM = {
    "magloc bounds": 0.1,
    "magloc design": 0.1,
    "magloc demo": 0.02,
    "magloc warm-up": 0.02,
    "adcs demo": 0.02,
    "adcs warm-up": 0.02,
}
STREAM = "readings.csv"  # what stands on stdin where a line reads from there

_FILES = {
    "decisions.jsonl": """{"action": "exclude", "from_s": 3.0, "to_s": 4.0}
{"action": "add", "place_m": [0.2, 0.1], "when": "2026-11-29T03:50:00Z"}
{"action": "refit"}
""",
    "imu.toml": """format_version = 1
[log]
[log.gyro]
columns = ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"]
unit = "rad/s"
samples = "point"
[log.accelerometer]
[log.magnetometer]
""",
    "simulate.toml": """format_version = 1
duration_s = 11.0
rate_Hz = 1.0
[array]
geometry = "tetrahedron"
edge_m = 1.5
kind = "vector"
noise_nT = 1.0
[[source]]
moment_Am2 = [100.0, 0.0, 0.0]
path = { kind = "fixed", position_m = [3.0, 0.5, 0.306] }
""",
    "ground.toml": """format_version = 1
duration_s = 12.0
rate_Hz = 4.0
[[array.sensor]]
id = "m"
kind = "scalar"
position_m = [0.0, 0.0, 0.0]
noise_nT = 0.2
[carrier.path]
kind = "lawnmower"
start_m = [-1.5, 1.0, 0.8]
course_deg = 90.0
length_m = 3.0
spacing_m = 0.8
lines = 3
speed_m_s = 1.0
[ambient]
field_nT = [1000.0, 20000.0, -44000.0]
[targets]
number = 1
x_m = [-0.5, 0.5]
y_m = [-0.5, 0.5]
moment_Am2 = [2.0, 3.0]
[geology]
field_nT = 1.0
[pose]
position_m = 0.01
""",
    "moving.toml": """format_version = 1
duration_s = 4.0
rate_Hz = 1.0
[array]
geometry = "tetrahedron"
edge_m = 0.6
kind = "vector"
noise_nT = 0.05
[carrier]
attitude = "course"
[carrier.path]
kind = "line"
start_m = [-2.0, 0.8, 1.2]
course_deg = 90.0
speed_m_s = 0.5
[[source]]
moment_Am2 = [12.0, -5.0, 9.0]
path = { kind = "fixed", position_m = [0.0, 0.0, -0.6] }
""",
    "passing.toml": """format_version = 1
duration_s = 8.0
rate_Hz = 1.0
[array]
geometry = "tetrahedron"
edge_m = 1.5
kind = "vector"
noise_nT = 1.0
[ambient]
field_nT = [1000.0, 18000.0, -45000.0]
[[source]]
attitude = "course"
moment_Am2 = [100.0, 20.0, -50.0]
polarisability_m3 = [2.0, 1.0, 1.0]
path = { kind = "course", start_m = [-4.0, 1.0, 4.0], course_deg = 80.0, speed_m_s = 1.0, turn_deg_s = 5.0 }
path_sigma_m = 0.1
""",
    "scalar.toml": """format_version = 1
geometry = "cube"
edge_m = 1.0
kind = "scalar"
noise_nT = 0.01
ambient_nT = [20000.0, 1000.0, 45000.0]
""",
    "map.toml": """format_version = 1
method = "repeated"
half_width_m = 8.0
[array]
geometry = "tetrahedron"
edge_m = 1.5
kind = "vector"
noise_nT = 1.0
[source]
position_m = [5.0, 0.0, 0.306]
moment_Am2 = [100.0, 0.0, 0.0]
[repeated]
position_step_m = 0.1
moment_step_Am2 = 100.0
max_iterations = 50
[iekf]
position_sigma_m = 3.0
moment_sigma_Am2 = 300.0
[sources]
half_width_m = 6.0
nearest_m = 1.0
farthest_m = 6.0
moment_Am2 = 300.0
""",
    "task.toml": """format_version = 1
[sensors]
count = 4
kind = "vector"
noise_nT = 1.0
[volume]
shape = "ball"
radius_m = 0.92
[sources]
region = "half-space"
towards = [1.0, 0.0, 0.0]
nearest_m = 2.0
farthest_m = 2.0
moment_Am2 = 100.0
""",
    "body-task.toml": """format_version = 1
[magnets]
least_spacing_m = 0.004
directions = "free"
[volume]
shape = "cylinder"
radius_m = 0.008
height_m = 0.0
[search]
starts = 1
refined = 1
poses = 64
iterations = 3
""",
}


def commands() -> Iterator[tuple[str, list[str]]]:
    """Every command of both programs by name, with the names of its options, as the programs know them."""
    for name, arguments in parsed_arguments():
        yield name, [option for one in arguments for option in one.names if option[0] == "-"]


def parsed_arguments() -> Iterator[tuple[str, ArgumentCollection]]:
    """Every command of both programs by name, with its arguments as cyclopts reads them."""
    for program, app in APPS.items():
        yield from _parsed_arguments(program, app)


def _parsed_arguments(name: str, app: App) -> Iterator[tuple[str, ArgumentCollection]]:
    inner = [key for key in app if not key.startswith("-")]
    for key in inner:
        yield from _parsed_arguments(f"{name} {key}", app[key])
    if app.default_command is not None:
        yield name, app.assemble_argument_collection()


def write_files(folder: Path) -> None:
    """All files that the lines read, in a folder."""

    def run(program: str, line: str) -> None:
        with chdir(folder):
            if MAINS[program]([*line.split(), "--quiet"]) != 0:
                raise RuntimeError(f"{program} {line}")

    for name, text in _FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    run("magloc", "simulate simulate.toml --out readings.csv")
    (folder / "readings-array.toml").rename(folder / "array.toml")
    run("magloc", "simulate moving.toml --out moving.csv")
    run("magloc", "simulate ground.toml --out ground.csv")
    run("magloc", "simulate passing.toml --out passing.csv")
    run("magloc", "map paper --grid 3 --out map")
    run("adcs", "run tabletsat --duration 20 --seeds 1 --out sat")
    run("adcs", "run mockup --part sky --poses 1 --out sky")
    for made in ("sat/telemetry.csv", "sat/scenario.toml", "sky/sky.toml"):
        (folder / made).rename(folder / Path(made).name)
    for made in ("sat", "sky"):
        shutil.rmtree(folder / made)
    with (folder / "track.json").open("w") as file, redirect_stdout(file):
        run("magloc", "track readings.csv --array array.toml --json")
    with (folder / "sources.json").open("w") as file, redirect_stdout(file):
        run("magloc", "track readings.csv --array array.toml --sources 1 --json")
    _write_log(folder)
    (folder / "robot.ulg").write_bytes(RobotFlight(duration_s=5.0, swing_rad=0.0).px4())
    _write_magarrow(folder)
    rows = Path(adcs.datasets.load("imu").path).read_text(encoding="utf-8").splitlines()
    (folder / "imu.csv").write_text("\n".join(rows[:101]), encoding="utf-8")
    _write_scalars(folder)
    _write_flight(folder)
    _write_body(folder)
    board = turned_board()
    arrays.write_array(folder / "turned.toml", board)
    write_readings(folder / "turned.csv", turned_rows(250), board)
    flight = switching_loads(rng=0, duration_s=150.0)
    write_columns(flight.columns, folder / "loads.csv")
    arrays.write_array(folder / "loads.toml", flight.array)
    _write_stars(folder)


def _write_log(folder: Path) -> None:
    """The readings as another program logs them, and their array."""
    text = (folder / "readings.csv").read_text()
    (folder / "log.csv").write_text(text.replace(",", ";").replace(".", ",").replace("time_s", "T"))
    columns = '\n[columns]\nseparator = "semicolon"\ndecimal = ","\ntime = "T"\nunit = "uT"\n'
    (folder / "log.toml").write_text((folder / "array.toml").read_text() + columns)


def _write_body(folder: Path) -> None:
    """Readings of a knob with three magnets over three sensors, with the files of both."""
    array, body = hall_ring(), knob()
    rng = np.random.default_rng(0)
    position_m, R = random_poses(body, 10, rng)
    values_T = readings_of(array, body, position_m, R, rng)
    arrays.write_array(folder / "body-array.toml", array)
    write_body(folder / "body.toml", body)
    times = 0.1 * np.arange(10)
    write_readings(folder / "body.csv", Readings(values_T, time_s=times), array)
    rest_T = rng.normal(scale=array.sensors[0].noise_T, size=(5, values_T.shape[1]))  # the body is not there yet
    rested = Readings(np.vstack([rest_T, values_T]), time_s=0.1 * np.arange(15))
    write_readings(folder / "body-rest.csv", rested, array)
    of_truth = np.column_stack([times, position_m, Rotation.from_matrix(R).as_quat()])
    names = ("time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    write_columns(dict(zip(names, of_truth.T, strict=True)), folder / "body-truth.csv")


def _write_magarrow(folder: Path) -> None:
    """The readings of the survey as a MagArrow logs them, and the positions as RTKLIB computes them."""
    table = np.genfromtxt(folder / "ground.csv", delimiter=",", names=True)
    rows = ["Counter,Date,Time,Latitude,Longitude,Mag, MagValid,Altitude"]
    for k, (t, x, y, z, mag) in enumerate(zip(*(table[name] for name in _OF_GROUND), strict=True)):
        place = f"{48.0 + y / 111e3:.9f},{11.0 + x / 74e3:.9f}"
        rows.append(f"{k},2026/04/25,09:40:{t:06.3f},{place},{mag:.3f},1,{500.0 + z:.3f}")
    (folder / "magarrow.csv").write_text("\n".join(rows) + "\n")
    cells = [row.split(",") for row in rows[1:]]
    solution = [f"2026/04/25 {row[2]} {row[3]} {row[4]} {row[7]} 1 12" for row in cells]
    (folder / "magarrow.pos").write_text(
        "\n".join(["%  UTC latitude(deg) longitude(deg) height(m) Q ns", *solution, ""])
    )


def _write_scalars(folder: Path) -> None:
    """Readings of total-field sensors near a dipole."""
    array = arrays.read_array(folder / "scalar.toml")
    values = predicted_channels(array, np.array([2.0, 1.0, 0.5]), np.array([50.0, 20.0, -80.0]))
    noise = 1e-11 * np.random.default_rng(0).standard_normal((3, len(values)))
    rows = [",".join([str(float(i)), *(f"{1e9 * value:.5f}" for value in row)]) for i, row in enumerate(values + noise)]
    head = ",".join(["time_s", *(f"{name}_nT" for name in array.channel_names)])
    (folder / "scalar.csv").write_text("\n".join([head, *rows]) + "\n")


def _write_flight(folder: Path) -> None:
    """A short flight with manoeuvres, and a column of currents."""
    rng, array = np.random.default_rng(0), array_of()
    flight = Flight.cloverleaf(rng, rate_Hz=2.0)
    platforms = {sensor.id: Platform.draw(rng, sensor) for sensor in array.sensors}
    rows = flight.readings(array, platforms, rng)[:160]
    write_readings(folder / "flight.csv", rows, array)
    header, *lines = (folder / "flight.csv").read_text().splitlines()
    lines = [f"{line},{current:.6f}" for line, current in zip(lines, flight.current_A, strict=False)]
    (folder / "flight.csv").write_text("\n".join([f"{header},motor_A", *lines]) + "\n")
    arrays.write_array(folder / "flight.toml", array)


def _write_stars(folder: Path) -> None:
    """Two frames of a small sky, and its catalogue."""
    sky = random_sky(3_000)
    ra, dec = np.degrees(np.arctan2(*sky.directions.T[1::-1])) % 360.0, np.degrees(np.arcsin(sky.directions[:, 2]))
    rows = zip(sky.numbers, ra, dec, sky.magnitudes, strict=True)
    lines = [f"{number},{a:.9f},{d:.9f},{m:.3f}\n" for number, a, d, m in rows]
    (folder / "stars.csv").write_text("hip,ra_deg,dec_deg,mag\n" + "".join(lines))
    dark = np.random.default_rng(0).normal(20.0, 3.0, (128, 128))
    Image.fromarray(dark.astype(np.uint8)).save(folder / "sky.png")
    lens = 'projection = "pinhole"\nwidth_px = 128\nheight_px = 128\nscale_arcsec = 15.8\nradial = 0.1\n'
    (folder / "lens.toml").write_text(lens + "scale_sigma_arcsec = 0.01\nradial_sigma = 0.01\n")
    write_frames(folder / "frames", sky, Rotation.random(2, random_state=1).as_matrix(), np.random.default_rng(2))
