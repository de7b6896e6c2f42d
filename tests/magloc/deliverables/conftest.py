"""A short survey, and its map in a projected and in a geographic system."""

from __future__ import annotations

from dataclasses import replace

import pytest

import magloc
import sims
from magloc.deliverables.map_frame import MapFrame

ORIGIN = (52.41, 13.12, 41.0)


@pytest.fixture(scope="session")
def survey() -> magloc.Survey:
    """Three targets under six lines."""
    scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    field = sims.simulate(scenario, rng=1)
    return magloc.survey(field.array, field.readings)


@pytest.fixture(params=["EPSG:32633", "EPSG:4326"])
def frame(request: pytest.FixtureRequest) -> MapFrame:
    """A map in UTM or in longitudes and latitudes."""
    return MapFrame(ORIGIN, request.param)
