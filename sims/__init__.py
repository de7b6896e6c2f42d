"""Truth and readings for :mod:`magloc` and :mod:`adcs`: uses their models, never their estimators.

The names below are loaded when they are first used. :func:`sims.montecarlo.run` gives many simulations to an estimator.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sims.files import write_simulation
    from sims.scenario import Scenario
    from sims.scenarios import built_in_scenarios, read_scenario
    from sims.simulation import Simulation, simulate

__all__ = ["Scenario", "Simulation", "built_in_scenarios", "read_scenario", "simulate", "write_simulation"]

_MODULES = ("scenario", "scenarios", "simulation", "files")


def __getattr__(name: str) -> object:
    if name in __all__:
        for module in _MODULES:
            contents = vars(import_module(f"{__name__}.{module}"))
            if name in contents:
                return contents[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
