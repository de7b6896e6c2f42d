"""Scenarios of both kinds: an array of magnetometers, or a satellite."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from adcs.io.scenario_files import built_in_scenarios as built_in_satellites
from adcs.io.scenario_files import read_scenario as read_satellite
from arrays.io.errors import InputError
from arrays.io.toml import read_toml
from arrays.io.values import accept_seed, seed_of
from arrays.typing import Rng
from sims.attitude.files import simulation_of
from sims.attitude.scenario import AttitudeScenario
from sims.attitude.simulation import AttitudeRuns
from sims.attitude.simulation import simulate as simulate_attitude
from sims.magnetics.scenario import MagneticScenario
from sims.magnetics.scenario_files import built_in_scenarios
from sims.magnetics.scenario_files import read_scenario as read_magnetic
from sims.magnetics.simulation import Simulation
from sims.magnetics.simulation import simulate as simulate_magnetic


def read_scenario(name_or_path: str) -> MagneticScenario | AttitudeScenario:
    """Read a scenario of a simulation.

    Parameters
    ----------
    name_or_path : str
        Name of a built-in scenario of ``magloc simulate`` or ``adcs run``, or a TOML file of either. A file with a
        table ``satellite`` describes a satellite.

    Returns
    -------
    MagneticScenario or AttitudeScenario
        Scenario of the file.

    Raises
    ------
    InputError
        The file cannot be read or does not describe a scenario; the text says where and why.

    Examples
    --------
    >>> import sims
    >>> sims.read_scenario("weaving").rate_Hz
    2.0
    >>> sims.read_scenario("tabletsat").satellite.field_model
    'IGRF-14'
    """
    if name_or_path not in built_in_scenarios() and _is_of_a_satellite(name_or_path):
        return simulation_of(read_satellite(name_or_path))
    return read_magnetic(name_or_path)


def _is_of_a_satellite(name_or_path: str) -> bool:
    if name_or_path in built_in_satellites():
        return True
    try:
        return "satellite" in read_toml(name_or_path, "")
    except InputError:
        return False  # the reader of the other kind says what is wrong


@overload
def simulate(scenario: MagneticScenario, rng: Rng) -> Simulation: ...
@overload
def simulate(scenario: AttitudeScenario, rng: Rng | Sequence[int]) -> AttitudeRuns: ...
@accept_seed
def simulate(scenario: MagneticScenario | AttitudeScenario, rng: Rng | Sequence[int]) -> Simulation | AttitudeRuns:
    """Simulate the readings of a scenario, and their truth.

    Parameters
    ----------
    scenario : MagneticScenario or AttitudeScenario
        Scenario from :func:`read_scenario`, or made in Python.
    rng : int or numpy.random.Generator
        Seed or generator of all random numbers. For a satellite also several seeds, one for each run.

    Returns
    -------
    Simulation or AttitudeRuns
        Readings and truth; of a satellite also its telemetry, for all seeds.

    Raises
    ------
    ValueError
        A sensor comes too near to a source, or a satellite's start conditions hold at no time.

    Examples
    --------
    >>> import sims
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("weaving"), duration_s=5.0)
    >>> simulation = sims.simulate(scenario, rng=0)
    >>> simulation.readings.values_T.shape
    (11, 12)
    """
    if isinstance(scenario, AttitudeScenario):
        return simulate_attitude(scenario, rng if isinstance(rng, Sequence) else [seed_of(rng)])
    if isinstance(rng, Sequence):
        raise ValueError(f"Input rng must be one seed or generator for an array; instead received {rng}.")
    return simulate_magnetic(scenario, seed_of(rng))
