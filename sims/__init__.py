"""Truth and readings for :mod:`magloc` and :mod:`adcs`, and estimators run on many of them."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "AttitudeScenario": "sims.attitude.scenario",
        "MagneticScenario": "sims.magnetics.scenario",
        "experiments": ":sims.experiments",
        "read_scenario": "sims.scenarios",
        "run_many": "sims.montecarlo",
        "simulate": "sims.scenarios",
        "write_simulation": "sims.magnetics.files",
    },
)
