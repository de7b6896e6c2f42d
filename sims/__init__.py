"""Truth and readings for :mod:`magloc` and :mod:`adcs`: uses their models, never their estimators."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Scenario": "sims.magnetics.scenario",
        "Simulation": "sims.magnetics.simulation",
        "built_in_scenarios": "sims.magnetics.scenario_files",
        "read_scenario": "sims.magnetics.scenario_files",
        "simulate": "sims.magnetics.simulation",
        "write_simulation": "sims.magnetics.files",
    },
)
