"""Files of attitude runs: figures, their data, and telemetry for ``adcs estimate``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from adcs.io.scenario_files import AttitudeFile, scenario_text
from adcs.io.telemetry_files import telemetry_columns
from adcs.kalman.bank import EstimatorSettings
from adcs.kalman.diagnostics import COLLINEAR, collinear_rows
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Telemetry
from sims.experiments.attitude import Outcome, Part, errors_in_units

if TYPE_CHECKING:
    import xarray as xr
from adcs.kalman.results import STATE_COLUMNS, STATE_UNITS, state_table
from arrays.typing import FloatArray


def attitude_files(
    file: AttitudeFile, estimate: EstimatorSettings, parts: Sequence[Part], outcome: Outcome
) -> Iterator[tuple[str, Any]]:
    """Yield the names and the contents of all files of some runs."""
    from adcs.plots.attitude import attitude_consistency_figure, sensor_gaps, states_figure

    first = parts[0]
    time_s, name = first.runs.time_s, file.name
    # The filter estimates truth minus estimate; an error is estimate minus truth.
    errors = -errors_in_units(first)[0]
    sigma = state_table(first.estimates.sigma_by_state)[0]
    title = f"{name}: {estimate.in_words}"
    seen = {name: there[0] for name, there in first.runs.readings.seen.items()}
    used = estimate.settings.sensors
    degraded = {COLLINEAR: collinear_rows(first.runs, used, 0)}
    gaps = sensor_gaps(seen, used.sensors.split("+"), degraded)
    seed = int(outcome.seeds[0])
    states = states_figure(f"{title}; seed {seed}", time_s, errors, sigma, are_errors=True, gaps=gaps)
    yield f"{name}-errors.png", states
    sigma_deg = np.sqrt(np.sum(sigma[:, :3] ** 2, axis=1))
    nees = outcome.nees, outcome.size, outcome.nis
    yield f"{name}-consistency.png", attitude_consistency_figure(title, time_s, outcome.error_deg, sigma_deg, *nees)
    columns: dict[str, Any] = {"time_s": time_s}
    columns |= {f"error_{key}": errors[:, i] for i, key in enumerate(STATE_COLUMNS) if not np.isnan(errors[:, i]).all()}
    columns |= {f"sigma_{key}": sigma[:, i] for i, key in enumerate(STATE_COLUMNS) if not np.isnan(sigma[:, i]).all()}
    yield (
        f"{name}.csv",
        columns
        | {
            "attitude_error_deg_median": np.median(outcome.error_deg, axis=0),
            "nees_per_dimension_mean": outcome.nees.mean(axis=0),
        },
    )
    yield f"{name}-runs.csv", _runs_table(outcome)
    yield f"{name}.nc", dataset_of(parts, estimate, title)
    log = Telemetry.of(first.runs, file.satellite.start)
    yield "telemetry.csv", telemetry_columns(log)
    yield "truth.csv", _truth_columns(first, log.time_s)
    yield "scenario.toml", scenario_text(file)


def _runs_table(outcome: Outcome) -> dict[str, Any]:
    columns: dict[str, Any] = {"seed": outcome.seeds}
    for i, key in enumerate(STATE_COLUMNS):
        if not np.isnan(outcome.axis_rms[:, i]).all():
            columns[f"rms_{key}"] = outcome.axis_rms[:, i]
    return columns | {
        "largest_error_last_minute_deg": outcome.error_deg[:, outcome.late].max(axis=1),
        "nees_per_dimension": outcome.nees[:, outcome.late].mean(axis=1),
        "diverged": outcome.diverged,
    }


def _truth_columns(part: Part, time_s: FloatArray) -> dict[str, Any]:
    """Return the truth at the instants of the telemetry."""
    runs = part.runs
    states = state_table({state: values[0] for state, values in runs.states.items()})
    columns: dict[str, Any] = {"time_s": time_s} | dict(zip(("qw", "qx", "qy", "qz"), runs.q[0].T, strict=True))
    return columns | dict(zip(STATE_COLUMNS[3:], states.T[3:], strict=True))


def dataset_of(parts: Sequence[Part], estimate: EstimatorSettings, title: str) -> xr.Dataset:
    """Return truth and estimates of all runs."""
    import xarray as xr

    from arrays.io.outputs import installed_version

    def join_tracks(values: Callable[[Part], FloatArray]) -> FloatArray:
        return np.concatenate([values(part) for part in parts])

    def of(state: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return estimates, truth and standard deviations of a state."""
        return (
            join_tracks(lambda part: part.estimates.states[state]),
            join_tracks(lambda part: part.runs.states[state]),
            join_tracks(lambda part: part.estimates.sigma_by_state[state]),
        )

    axis, component = ("run", "time", "axis"), ("run", "time", "component")
    rate, true_rate, sigma_rate = of("rate")
    sigma_attitude = join_tracks(lambda part: part.estimates.sigma_by_state["attitude"])
    nis = join_tracks(lambda part: part.estimates.nis)
    rejected = join_tracks(lambda part: part.estimates.rejected.astype(np.float64))
    listed: list[tuple[str, tuple[str, ...], FloatArray, str, str]] = [
        ("q", component, join_tracks(lambda part: part.estimates.q), "1", "attitude, orbital from body"),
        ("q_true", component, join_tracks(lambda part: part.runs.q), "1", "true attitude"),
        ("rate", axis, rate, "rad/s", "rate, body axes"),
        ("rate_true", axis, true_rate, "rad/s", "true rate"),
        ("sigma_attitude", axis, sigma_attitude, "rad", "standard deviation of the angle"),
        ("sigma_rate", axis, sigma_rate, "rad/s", "standard deviation of the rate"),
        ("nis", ("run", "time", "sensor"), nis, "1", "normalised innovation squared"),
        ("rejected", ("run", "time", "sensor"), rejected, "1", "whether a reading contradicted the rest, not used"),
    ]
    of_states = {"gyro-bias": "rad/s", "field-bias": "T", "disturbance": "s-2", "field-model": "T", "dipole": "A m2"}
    elements = {}
    for state, units in {**of_states, "field-gain": "1"}.items():
        if state in estimate.settings.sensors.states:
            name, (values, true, sigma), axes = state.replace("-", "_"), of(state), axis
            if state == "field-gain":
                axes, elements = ("run", "time", "element"), {"element": list(STATE_UNITS[state].axes)}
            listed += [
                (name, axes, values, units, state.replace("-", " ")),
                (f"{name}_true", axes, true, units, f"true {name}"),
                (f"sigma_{name}", axes, sigma, units, "standard deviation"),
            ]
    seeds = [seed for part in parts for seed in part.runs.prepared.seeds]
    return xr.Dataset(
        {name: (dims, values, {"units": units, "long_name": words}) for name, dims, values, units, words in listed},
        coords={
            "run": ("run", seeds, {"long_name": "seed"}),
            "time": ("time", parts[0].runs.time_s, {"units": "s", "long_name": "time since the start of the run"}),
            "axis": ("axis", ["x", "y", "z"]),
            "component": ("component", ["w", "x", "y", "z"]),
            "sensor": ("sensor", list(SENSORS)),
            **elements,
        },
        attrs={"Conventions": "CF-1.10", "title": title, "source": f"magloc {installed_version()}"},
    )
