"""Output of an attitude track: columns with units, and a summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from adcs.kalman.results import STATE_UNITS
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.sensors import NIS_SIZES
from arrays.io.tables import by_sigma

_NAMES = {"st": "star", "gyro": "gyro", "mag": "field", "sun": "sun"}
"""Names of the sensors' innovations in files."""


def estimate_columns(track: AttitudeTrack) -> dict[str, Any]:
    """Return the columns (n,) of estimates.csv at the log's rows.

    ``qw`` to ``qz`` are orbital from body, ``eci_qw`` to ``eci_qz`` inertial from body.
    """
    columns: dict[str, Any] = {"time_s": track.time_s}
    for prefix, q in (("", track.q_orbital), ("eci_", track.q)):
        if q is not None:
            columns |= dict(zip((f"{prefix}q{part}" for part in "wxyz"), q.T, strict=True))
    for state, shown in STATE_UNITS.items():
        for i, name in enumerate(shown.columns):
            for prefix, values in (("", track.states), ("sigma_", track.sigma)):
                if state in values:
                    columns[prefix + name] = shown.scale * values[state][:, i]
    if track.tuned_disturbance_s2 is not None:
        columns["tuned_disturbance_s2"] = track.tuned_disturbance_s2
    for sensor, nis in track.nis.items():
        if not np.isnan(nis).all():
            columns[f"nis_{_NAMES[sensor]}"] = nis
            if sensor in track.gated:
                columns[f"rejected_{_NAMES[sensor]}"] = track.gated[sensor]
    return {name: values[track.rows] for name, values in columns.items()}


def rows_of(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return one dict for every row of columns, as ``--json`` prints them."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*map(np.ndarray.tolist, columns.values()), strict=True)]


def summary_lines(track: AttitudeTrack) -> list[str]:
    """Return the result as text: the estimate at the end, and the fit of the readings."""
    if not len(track.rows):
        return [f"no rows; {track.title}"]
    columns = estimate_columns(track)
    lines = [f"{len(track.rows)} rows from {track.time_s[0]:g} to {track.time_s[-1]:g} s; {track.title}"]
    prefix = "eci_" if track.q_orbital is None else ""
    q = ", ".join(f"{columns[f'{prefix}q{part}'][-1]:.6f}" for part in "wxyz")
    lines.append(f"attitude at the end, {track.frame} from body (w, x, y, z)   {q}")
    for state, shown in STATE_UNITS.items():
        names = shown.columns
        if state not in track.sigma:
            continue
        sigma = max(float(columns[f"sigma_{name}"][-1]) for name in names)
        if state in track.states:
            cells = [by_sigma(float(columns[name][-1]), sigma) for name in names]
            values = ", ".join(value for value, _ in cells)
            lines.append(f"{shown.words:27s}{values} {shown.unit} (1σ {cells[0][1]})")
        else:
            lines.append(f"{shown.words + ', 1σ':27s}{sigma:.2g} {shown.unit}")
    if track.tuned_disturbance_s2 is not None:
        lines.append(f"{'disturbance, 1σ found':27s}{track.tuned_disturbance_s2[-1]:.2g} 1/s²")
    for sensor, name in _NAMES.items():
        numbers = NIS_SIZES[sensor]
        if f"nis_{name}" in columns:
            rejected = columns.get(f"rejected_{name}", np.zeros(len(track.rows), dtype=np.bool_))
            kept = columns[f"nis_{name}"][~rejected & ~np.isnan(columns[f"nis_{name}"])]
            nis = f"{kept.mean() / numbers:.3g}" if kept.size else "none is used"
            told = f", {rejected.sum()} rejected" if rejected.any() else ""
            lines.append(f"NIS of {name} / {numbers} (1 is consistent){'':3s}{nis}{told}")
    return [*lines, *unseen_line(track.unseen_torque_Nm)]


def unseen_line(torque_Nm: Mapping[float, float]) -> list[str]:
    """Return a line with the largest torque that the readings do not show, by period; no line without any."""
    each = ", ".join(f"{torque:.2g} N·m ({period:g} s)" for period, torque in torque_Nm.items())
    return [f"{'largest unseen torque (its period)':36s}{each}"] if each else []
