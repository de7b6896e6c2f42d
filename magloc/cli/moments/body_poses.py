"""``--body`` of ``magloc locate``, ``track``, ``live`` and ``bounds``: poses of a body of several magnets."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from arrays.io.errors import InputError, naming
from magloc.cli.framework import note, print_json, print_json_list, print_result
from magloc.cli.moments.known_path import refuse_bounds
from magloc.cli.options import KnownOptions, ambient_field

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.bodies.body import MagnetBody
    from magloc.bodies.poses import BodyPoses
    from magloc.bodies.track import BodyMotion
    from magloc.cli.options import MotionOptions
    from magloc.cli.track import ConditioningOptions
    from magloc.live.follower import Follower
    from magloc.readings import Readings


def refuse_with_body(options: Mapping[str, object]) -> None:
    """Refuse options of a single source together with a body."""
    for name, value in options.items():
        if value not in (None, False):
            raise InputError(f"{name}: found together with --body, expected one of them.")


def read_with_readings(
    readings: Path, array: Path, body: Path, known: KnownOptions, *, ordered: bool = False
) -> tuple[SensorArray, MagnetBody, Readings]:
    """Read array, body and readings, with the ambient field of the options."""
    import magloc
    from magloc.bodies.body_file import read_body

    refuse_bounds(known)
    refuse_with_body({"--known-moment-Am2": known.known_moment_Am2})
    magnets = read_body(body)
    used = known.array(array)
    rows = magloc.read_readings(readings, used, sensors=known.ids, ordered=ordered)
    used, ambient_T = ambient_field(used, rows, known.where)
    return used, magnets, rows if ambient_T is None else replace(rows, ambient_T=ambient_T)


def locate_with_body(
    readings: Path, array: Path, body: Path, known: KnownOptions, *, as_json: bool, out: Path | None
) -> None:
    """Print the poses of a body in every row, each row on its own."""
    from magloc.bodies.locator import locate_body

    used, magnets, rows = read_with_readings(readings, array, body, known)
    with naming(str(array), readings=str(readings)):
        poses = locate_body(used, magnets, rows)
    _print(poses, as_json=as_json)
    _refuse_unsolved(poses, readings)
    _write(poses, out)
    _note(poses, as_json=as_json)


def track_with_body(
    readings: Path,
    array: Path,
    body: Path,
    known: KnownOptions,
    motion: MotionOptions,
    conditioning: ConditioningOptions,
    *,
    as_json: bool,
    jsonl: bool,
    out: Path | None,
) -> None:
    """Print the track of a body."""
    from magloc.bodies.filter import track_body

    used, magnets, rows = read_with_readings(readings, array, body, known, ordered=True)
    rows, used = conditioning.apply(rows, used, readings)
    with naming(str(array), readings=str(readings)):
        track = track_body(used, magnets, rows, motion=motion_of_body(motion))
    if jsonl:
        for entry in track.entries():
            print_json(entry)
    else:
        _print(track, as_json=as_json)
    _refuse_unsolved(track, readings)
    _write(track, out)
    _note(track, as_json=as_json or jsonl)


def motion_of_body(motion: MotionOptions) -> BodyMotion:
    """Return the motion of the options; those that are not given have the values of a hand's movement."""
    import math

    from magloc.bodies.track import BodyMotion
    from magloc.cli.options import MotionOptions, refuse_not_positive

    if motion.sources is not None or motion.motion not in (None, "wandering"):
        name = "--sources" if motion.sources is not None else "--motion"
        raise InputError(f"{name}: found together with --body, expected one of them.")
    refuse_not_positive(motion, "speed_m_s", "turn_deg_s", "correlation_s")
    default = BodyMotion()
    speed = default.speed_m_s if motion.speed_m_s == MotionOptions.speed_m_s else motion.speed_m_s
    turn = default.turn_rad_s if motion.turn_deg_s is None else math.radians(motion.turn_deg_s)
    return BodyMotion(speed, turn, default.correlation_s if motion.correlation_s is None else motion.correlation_s)


def body_follower(
    array: SensorArray, body: Path, motion: MotionOptions, known: KnownOptions, rest_s: float
) -> Follower:
    """Return the tracker of a body in a stream."""
    from magloc.bodies.body_file import read_body
    from magloc.live.follower import Follower

    refuse_bounds(known)
    refuse_with_body({"--known-moment-Am2": known.known_moment_Am2})
    moves, magnets = motion_of_body(motion), read_body(body)
    return Follower(array, moves, sensors=known.ids, place=known.where, rest_s=rest_s, body=magnets)


def bounds_with_body(array: Path, body: Path, *, as_json: bool) -> None:
    """Print the bounds of a body's pose over its limits."""
    import arrays
    from magloc.bodies.body_file import read_body
    from magloc.bounds.bodies import body_bounds

    used, magnets = arrays.read_array(array), read_body(body)
    with naming(str(array)):
        result = body_bounds(used, magnets)
    print_result(result.json(), result.lines(), as_json=as_json)


def _print(poses: BodyPoses, *, as_json: bool) -> None:
    if as_json:
        print_json_list("results", poses.entries())
    else:
        print(poses.table())


def _write(poses: BodyPoses, out: Path | None) -> None:
    """Write the poses and their figure."""
    if out is None:
        return
    from arrays.io.outputs import write_files

    write_files(out, [("poses.png", poses.plot()), ("poses.csv", poses.columns())])


def _refuse_unsolved(poses: BodyPoses, readings: Path) -> None:
    """Refuse readings without a single pose."""
    if not poses.solved.any():
        raise InputError(f"{readings}: found no row with a pose of the body ({_reasons(poses)}).")


def _reasons(poses: BodyPoses) -> str:
    """Return the reasons of rows without a pose; each limit is one reason, with the values of its first row."""
    from magloc.cli.locate import count_reasons

    of_rows = [reason for reason in poses.reason if reason]
    kinds = [re.sub(r": [^:]*, expected [^:]*$", "", reason) for reason in of_rows]
    first = {kind: reason for kind, reason in reversed(list(zip(kinds, of_rows, strict=True)))}
    return count_reasons(first[kind] for kind in kinds)


def _note(poses: BodyPoses, *, as_json: bool) -> None:
    """Print what the flags mean."""
    from magloc.bodies.poses import FLAGS

    reasons = _reasons(poses)
    n = int(poses.solved.sum())
    if not as_json:
        note(f"{n} of {len(poses)} rows with a pose" + (f"; not solved: {reasons}" if reasons else ""))
    if poses.symmetry:
        note(f"note: {poses.symmetry}")
    several = int((poses.n_poses > 1).sum())
    if several:
        note(f"warning: {several} of {len(poses)} rows fit several poses; --json lists all, and one of them is true")
    words = {flag for flags in poses.flags for flag in flags}
    for word in sorted(words):
        rows = sum(word in flags for flags in poses.flags)
        note(f"warning: {word} in {rows} of {len(poses)} rows: {FLAGS[word.split()[0]]}")
