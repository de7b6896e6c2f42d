"""Proposal of the table ``columns`` for a binary log, from its units and the names of autopilots."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator

import numpy as np

from arrays.columns import NANOTESLA
from arrays.logs.proposal import Proposal
from magloc.logs.channels import Log, Topic
from magloc.logs.sensors import axes_of, magnetometer_names, readings_vary

_ANGLES = (
    [f"vehicle_attitude.{name}_deg" for name in ("yaw", "pitch", "roll")],
    [f"ATT.{name}" for name in ("Yaw", "Pitch", "Roll")],
)
_LATITUDE, _LONGITUDE, _HEIGHT = (re.compile(word, re.IGNORECASE) for word in ("lat.*", "lon.*|lng", "alt.*|height.*"))
_FRONT_RIGHT_DOWN = "rotation_xyzw = [1.0, 0.0, 0.0, 0.0]  # from forward, right, down to forward, left, up"


def propose_log_columns(log: Log) -> Proposal:
    """Return a proposal for reading the magnetometers, places and attitude of a binary log."""
    asked = ["places and noise of the sensors, in the tables below"]
    keys: dict[str, object] = {}
    sensors = _sensors(log, asked)
    if sensors:
        first = log[next(iter(sensors.values()))[0]]
        names = [unit for unit, size in NANOTESLA.items() if abs(1e9 * first.si_per_unit / size - 1.0) < 1e-6]
        keys |= {"unit": names[0] if names else 1e9 * first.si_per_unit} if names[:1] != ["nT"] else {}
        others = {log[names[0]].time_s.tobytes() for names in sensors.values()}
        if len(others) > 1:
            asked.append("sensors have other clocks: rows follow the first one, and the others are interpolated")
    else:
        asked.append('no channel is a magnetic field by its unit: name those of the sensors as s1 = ["bx", "by", "bz"]')
    keys |= _places(log, asked)
    is_autopilot = log.kind.startswith(("PX4", "ArduPilot"))
    angles = next((names for names in _ANGLES if set(names) <= set(log)), None)
    quaternion = next((name[:-1] for name in log if name.endswith(".orientation.x")), None)
    if "geodetic" in keys and angles is not None:
        keys["angles"] = tuple(angles)
    elif "geodetic" in keys and quaternion is not None:
        keys["quaternion"] = tuple(f"{quaternion}{axis}" for axis in "xyzw")
    about = f"{log.kind}. Channels, by the messages that share their times:"
    channels: dict[str, str] = {}
    for topic in log.topics:
        is_inside = topic.name in channels  # a sensor of the same message with a separate clock
        name = f"{topic.name} (own clock of {next(iter(topic.fields))})" if is_inside else topic.name or "table"
        channels[name] = _described(topic)
    lines = (_FRONT_RIGHT_DOWN,) if is_autopilot else ()
    return Proposal(channels, keys, {key: tuple(names) for key, names in sensors.items()}, asked, 0, about, lines)


def _sensors(log: Log, asked: list[str]) -> dict[str, tuple[str, ...]]:
    """Return the columns of magnetometers: those that autopilots name, or else all triples in a unit of a field."""
    known = [axes_of(name) for name in magnetometer_names(log)]
    if not known:
        fields = [name for name in log if log[name].unit == "T"]
        known = [
            axes_of(name) for name in fields if name.endswith(("x", "X", "[0]")) and set(axes_of(name)) <= set(fields)
        ]
        known = known or [(name,) for name in fields]  # type: ignore[misc]
    working = [names for names in known if any(readings_vary(log[name].values[:, None]) for name in names)]
    asked += [f"{names[0]} does not change: it is ignored" for names in known if names not in working]
    return {f"s{k}": names for k, names in enumerate(working, start=1)}


def _places(log: Log, asked: list[str]) -> dict[str, object]:
    """Return the keys of the positions in the message that has most of them."""
    best: tuple[int, list[str]] = (0, [])
    for topic in log.topics:
        named = {field: name for name, field in topic.channel_names().items()}
        places = [field for field in named if topic.units.get(field) is not None and topic.units[field].si == "deg"]
        heights = [field for field in named if _HEIGHT.fullmatch(field) and topic.units.get(field) is not None]
        found = [next((of for of in places if kind.fullmatch(of)), None) for kind in (_LATITUDE, _LONGITUDE)]
        if None not in found and len(topic.time_s) > best[0]:
            best = len(topic.time_s), [named[of] for of in (*found, *heights[:1]) if of is not None]
    names = best[1]
    if not names:
        asked.append("no channels of a place were found: position or geodetic, if the array moves")
        return {}
    values = np.array([log[name].values for name in names])
    known = values[:, (values[:2] != 0.0).all(axis=0) & np.isfinite(values).all(axis=0)]
    keys: dict[str, object] = {"geodetic": tuple(names)}
    if len(names) == 3:
        keys["height_is"] = "ellipsoid" if "/" in names[2] else "geoid"  # ROS; autopilots
    else:
        asked.append("the height of the array above the ground: height_m = 0.4")
    if known.size:
        height_m = float(known[2, 0]) if len(names) == 3 else 0.0
        keys["origin"] = (round(float(known[0, 0]), 5), round(float(known[1, 0]), 5), round(height_m, 2))
        asked.append("the origin of the world's frame is put at the first place. --ground-m counts from its height")
    return keys


def _described(topic: Topic) -> str:
    """Return a description of a message: rows, rate, and fields with their units."""
    step_s = float(np.median(np.diff(topic.time_s))) if len(topic.time_s) > 1 else 0.0
    rate = f", {1.0 / step_s:.4g} Hz" if step_s > 0.0 and topic.clock != "rows" else ""
    fields = ", ".join(_fields(topic))
    return f"{len(topic.time_s)} rows{rate}: {fields}"


def _fields(topic: Topic) -> Iterator[str]:
    """Yield the fields, grouped by array."""
    for stem, group in itertools.groupby(topic.fields, key=lambda field: re.sub(r"\[\d+\]$", "", field)):
        members = list(group)
        unit = topic.units.get(members[0])
        last = f"[0-{len(members) - 1}]" if len(members) > 1 else members[0][len(stem) :]
        yield f"{stem}{last}" + (f" [{unit.logged}]" if unit is not None and unit.logged else "")
