"""All scenarios by name, and the figures of their runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.tracking_figures import one_source, several_sources, streams
from tests.tracking_figures.figures import Figures, Run

STORED = Path(__file__).with_name("figures.json")
QUICK = (
    "paper",
    "weaving",
    "carrier, vectors",
    "known modulus, 8 m",
    "one magnet, auto",
    "stream, first rows",
)
"""Those of ``make test``, some seconds together; the others are slow."""


@dataclass(frozen=True)
class Scenario:
    """A scenario and its seeds."""

    name: str
    run: Callable[[int], Run]
    seeds: range

    def figures(self) -> Figures:
        """Of all its seeds."""
        return Figures.of([self.run(seed) for seed in self.seeds])


SCENARIOS = {
    name: Scenario(name, run, seeds)
    for name, (run, seeds) in (one_source.RUNS | several_sources.RUNS | streams.RUNS).items()
}


def read_stored() -> dict[str, Figures]:
    """Figures that are stored."""
    return {name: Figures.read(entry) for name, entry in json.loads(STORED.read_text(encoding="utf-8")).items()}


def store(figures: dict[str, Figures]) -> None:
    """Store figures, a line for each scenario, in the order of the scenarios."""
    lines = [f"{json.dumps(name)}: {json.dumps(figures[name].json)}" for name in SCENARIOS if name in figures]
    STORED.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
