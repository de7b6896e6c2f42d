"""Scenarios whose noise an array file with white noise describes."""

from dataclasses import replace

from sims.magnetics.scenario import MagneticScenario, Platform
from sims.magnetics.sensors import SensorModel


def with_white_noise_only(scenario: MagneticScenario) -> MagneticScenario:
    """A scenario without anything that an array file with white noise does not describe.

    No 1/f noise, bandwidth, rounding, misalignment, error of gain, drift and noise of the platform; saturation,
    pulsations, the ambient field and missing readings stay, and so does the noise of one sample.
    """
    rate_Hz = scenario.rate_Hz
    models = tuple(
        SensorModel(model.reads, 0.0, range_T=model.range_T).with_sigma(model.sigma_T(rate_Hz), rate_Hz)
        for model in scenario.models
    )
    return replace(scenario, models=models, platform=Platform())
