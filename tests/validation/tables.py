"""Tables that ``make validation`` repeats: page, section, command lines, and where a number of each cell is printed."""

from __future__ import annotations

from tests.validation import Reader, Table, found, key

_SENSORS = {"star tracker": "st", "magnetometer, Sun sensor, gyro": "mag+sun+gyro"}
_SENSORS |= {"magnetometer, Sun sensor": "mag+sun", "magnetometer, gyro": "mag+gyro"}
_PROBLEMS = ("eclipse", "collinearity", "star-blinded", "field-error", "one-vector")
_FILTERS = {"explicit": "explicit", "gauss-newton": "gauss-newton", "adaptive error-state filter": "adaptive"}
_MATCHERS = ("paper", "robust", "odds")
_FUSIONS = ("ekf", "velocity-corrected", "paper")
_APPROACH = (0, 5, 10, 20, 30, 40, 50)


def _ends(of: str, kind: str) -> Reader:
    """Reader of the least and the greatest distance of a reach."""
    return lambda outputs: [key(of, kind, end)(outputs)[0] for end in ("least", "greatest")]


TABLES = (
    Table(
        "attitude",
        "Kalman bank",
        (
            f"adcs compare tabletsat --sensors {','.join(_SENSORS.values())} --seeds 10 --json",
            *(f"adcs run {name} --json" for name in _PROBLEMS),
        ),
        {(row, 1): key("rows", i, "angle_rms_deg") for i, row in enumerate(_SENSORS)}
        | {(f"`{name}`", 1): key("angle_rms_deg", of=i) for i, name in enumerate(_PROBLEMS, 1)}
        | {(f"`{name}`", 2): key("worst_deg", of=i) for i, name in enumerate(_PROBLEMS, 1)},
    ),
    Table(
        "attitude",
        "Complementary filters",
        tuple(f"adcs run complementary --filter {name} --json" for name in _FILTERS.values()),
        {(row, 1): key("rms_deg", of=i) for i, row in enumerate(_FILTERS)},
    ),
    Table(
        "attitude",
        "Star camera of the table-top satellite",
        tuple(f"adcs run mockup --part sky --matcher {name} --json" for name in _MATCHERS),
        {
            ("at rest", i): lambda outputs, of=i - 1: [
                key("success", of=of, scale=100.0)(outputs)[0],
                key("position_rms_mm", of=of)(outputs)[0],
            ]
            for i in range(1, 4)
        },
    ),
    Table(
        "attitude",
        "Fusion of late fixes on the table",
        tuple(f"adcs run mockup --part fusion --fusion {name} --json" for name in _FUSIONS),
        {(f"`{name}`", 1): key("position_rms_mm", of=i) for i, name in enumerate(_FUSIONS)}
        | {("`ekf`", 2): key("position_max_mm"), ("`paper`", 2): key("position_max_mm", of=2)},
    ),
    Table(
        "attitude",
        "Zeros of the accelerometer",
        (
            "adcs run mockup --part zeros --unknowns two --json",
            "adcs run mockup --part zeros --json",
            "adcs run mockup --part zeros --unknowns two --start-fixes 2 --json",
        ),
        {
            ("closed form, from 15 s", 1): key("zero_error_m_s2"),
            ("with the start estimated too", 1): key("zero_error_m_s2", of=1),
            (
                "with the start from two fixes, as published (`--unknowns two --start-fixes 2`)",
                1,
            ): key("zero_error_m_s2", of=2),
        },
    ),
    Table(
        "arrays",
        "How far an array reaches",
        ("magloc bounds --moment-Am2 0 0 100 --accuracy-m 0.5 --json",),
        {
            ("range known to 0.5 m, for 95 % of the moments", 1): _ends("accuracy_range_m", "q95"),
            ("source found (matched filter, false alarms 1 in 1,000, probability 90 %)", 1): _ends(
                "detection_range_m", "q95"
            ),
        },
    ),
    Table(
        "convergence",
        "The published half ball",
        ("magloc map --json --out paper", "magloc map wide --json --out wide"),
        {
            (row, of + 1): key(name, of=of, scale=scale)
            for of in (0, 1)
            for row, name, scale in (
                ("front half, within 13 m", "front_within_13m_fraction", 100.0),
                ("back half", "back_fraction", 100.0),
                ("median passes of those that converge", "median_iterations", 1.0),
            )
        },
    ),
    Table(
        "tracks",
        "A weak source that comes nearer",
        ("python -m docs.studies.weak_approach --first 21000 --seeds 64",),
        {(str(row), 1): found(rf"(?m)^{row}: \d+ of \d+, ([\d.]+)") for row in _APPROACH}
        | {(str(row), 2): found(rf"(?m)^{row}: \d+ of \d+, [\d.]+, ([\d.]+) \(([\d.]+)\)") for row in _APPROACH}
        | {(str(row), 3): found(rf"(?m)^{row}: \d+ of .*?([\d.]+) %") for row in _APPROACH},
    ),
    Table(
        "surveys",
        "A field from a drone",
        ("python -m docs.studies.survey_figures survey-drone --first 200 --seeds 12",),
        {
            ("visible targets that are found", 2): found(r"found (\d+) of (\d+) visible"),
            ("false targets in a field", 2): found(r"visible, (\d+) false"),
        },
    ),
    Table(
        "surveys",
        "Near the ground: a cart",
        ("python -m docs.studies.survey_figures survey-cart --first 524 --seeds 8",),
        {
            ("visible targets that are found", 2): found(r"found (\d+) of (\d+) visible"),
            ("false targets", 2): found(r"visible, (\d+) false"),
        },
    ),
)
