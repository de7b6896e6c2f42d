"""A satellite with four magnetometers, and two loads whose fields switch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from adcs.quaternion import rotate_back
from adcs.satellite.sensors import Magnetometer
from arrays.array import SensorArray
from arrays.io.values import accept_seed, seed_of
from arrays.sensor import Sensor
from arrays.typing import FloatArray, Rng
from magloc.fields.dipole import total_field
from sims.attitude.scenario import AttitudeScenario
from sims.attitude.simulation import AttitudeRuns, prepare, simulate_motion
from sims.experiments.b_dot import ANYWHERE, three_units
from sims.noise import stream

NOISE_T = 15e-9
GAIN, AXES_RAD, PLACE_M = 0.01, math.radians(0.5), 1e-3
"""Standard deviations of gains, axes and position of a magnetometer, per component."""
LOADS = {"heater": ((0.02, -0.025, -0.06), (0.012, 0.0, 0.016)), "radio": ((-0.015, 0.02, 0.085), (0.06, -0.08, 0.0))}
"""Position [m] and moment [A·m²] of each load, in body axes: 0.02 and 0.1 A·m²."""
PLACES_M = ((0.045, 0.045, 0.165), (-0.045, 0.045, -0.165), (0.045, -0.045, 0.0), (-0.045, -0.045, 0.12))
"""Positions of the magnetometers; the first one serves the attitude filter."""


@dataclass(frozen=True, eq=False)
class LoadsRun:
    """Readings of a run, and their truth.

    Attributes
    ----------
    array : SensorArray
        The magnetometers ``m1`` to ``m4``, as their user knows them.
    readings_T, quiet_T : ndarray, shape (n, 12)
        Readings of the array with the loads, and the same without them.
    states : dict of str to ndarray, shape (n,)
        State of each load, 0 or 1.
    fields_T : ndarray, shape (K, 4, 3)
        Field of each load in the readings, body axes.
    run : AttitudeRuns
        Motion of the satellite, one run.
    """

    array: SensorArray
    readings_T: FloatArray
    quiet_T: FloatArray
    states: Mapping[str, FloatArray]
    fields_T: FloatArray
    run: AttitudeRuns

    @property
    def time_s(self) -> FloatArray:
        """Times of the rows, shape (n,)."""
        return self.run.time_s

    @property
    def gyro_rad_s(self) -> FloatArray:
        """Readings of the gyro, shape (n, 3)."""
        return self.run.readings.gyro_rad_s[0]

    @property
    def columns(self) -> dict[str, FloatArray]:
        """Columns (n,) of a log for ``adcs loads``."""
        channels = dict(zip((f"{name}_nT" for name in self.array.channel_names), 1e9 * self.readings_T.T, strict=True))
        gyro = dict(zip((f"gyro_{axis}_deg_s" for axis in "xyz"), np.degrees(self.gyro_rad_s.T), strict=True))
        return {"time_s": self.time_s, **channels, **gyro, **self.states}


@accept_seed
def switching_loads(rng: Rng, *, duration_s: float = 2400.0, rate_deg_s: float = 0.4) -> LoadsRun:
    """Simulate a tumbling satellite of 4 kg whose loads switch every 20 to 90 s.

    Parameters
    ----------
    rng : int or numpy.random.Generator
        Seed or generator of all random numbers.
    duration_s : float
        Duration [s], with one reading per second.
    rate_deg_s : float
        Standard deviation of the rate about each axis.

    Returns
    -------
    LoadsRun
        Readings, states of the loads, and the true fields.

    Examples
    --------
    >>> from sims import experiments
    >>> experiments.switching_loads(rng=0, duration_s=60.0).readings_T.shape
    (61, 12)
    """
    seed = seed_of(rng)
    generator = stream(seed, "loads")
    satellite = three_units(magnetometer=Magnetometer(sigma_T=NOISE_T))
    scenario = AttitudeScenario(
        satellite,
        conditions=ANYWHERE,
        duration_s=duration_s,
        torque_Nm=1e-8,
        gyro_bias_rad_s=math.radians(0.01),
        start_attitude_rad=1.0,
        start_rate_rad_s=math.radians(rate_deg_s),
    )
    prepared = prepare(scenario, [seed])
    n = scenario.n_instants
    states = {name: _switch_states(n, generator) for name in LOADS}
    moments = sum(states[name][:, None] * np.array(moment) for name, (_, moment) in LOADS.items())
    run = simulate_motion(replace(prepared, dipole_Am2=prepared.dipole_Am2 + moments))
    array = SensorArray(
        tuple(
            Sensor(f"m{i}", "vector", place, noise_T=NOISE_T, gain_uncertainty=GAIN, misalignment_rad=AXES_RAD)
            for i, place in enumerate(PLACES_M, start=1)
        ),
        # Relative change of the field of a dipole 0.1 m away, for 1 mm of the position.
        noise_fraction=3.0 * PLACE_M / 0.1,
    )
    places = array.positions + PLACE_M * generator.standard_normal((4, 3))
    response = np.eye(3) + np.where(np.eye(3), GAIN, AXES_RAD) * generator.standard_normal((4, 3, 3))
    own = np.stack([total_field(places, np.array([place]), np.array([moment])) for place, moment in LOADS.values()])
    fields = np.einsum("mij,kmj->kmi", response, own)
    ambient = rotate_back(run.q[0], prepared.true_field_orbital_T[0])
    quiet = np.einsum("mij,nj->nmi", response, ambient) + NOISE_T * generator.standard_normal((n, 4, 3))
    loaded = quiet + np.einsum("kn,kmi->nmi", np.stack(list(states.values())), fields)
    return LoadsRun(array, loaded.reshape(n, 12), quiet.reshape(n, 12), states, fields, run)


def _switch_states(n: int, rng: np.random.Generator) -> FloatArray:
    """Return states 0 and 1 of n rows, with changes 20 to 90 s apart."""
    changes = np.cumsum(rng.integers(20, 91, size=1 + n // 20))
    return np.asarray((np.searchsorted(changes, np.arange(n), side="right") % 2).astype(np.float64))
