"""Truth and readings for :mod:`magloc` and :mod:`adcs`, and estimators run on many of them."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "AttitudeScenario": "sims.attitude.scenario",
        "CameraErrors": "sims.mockup.table_run",
        "FlightSettings": "sims.attitude.flights",
        "MagneticScenario": "sims.magnetics.scenario",
        "TableScenario": "sims.mockup.table_run",
        "experiments": ":sims.experiments",
        "joystick": ":sims.magnetics.joystick",
        "read_scenario": "sims.scenarios",
        "rendered_frame": "sims.mockup.frames",
        "run_many": "sims.montecarlo",
        "simulate": "sims.scenarios",
        "simulate_flight": "sims.attitude.flights",
        "table_run": "sims.mockup.table_run",
        "write_simulation": "sims.magnetics.files",
    },
)
