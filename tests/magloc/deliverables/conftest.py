"""A short survey, and its map in a projected and in a geographic system."""

from __future__ import annotations

from dataclasses import replace

import pytest
from matplotlib.figure import Figure

import magloc
import sims
from magloc.deliverables.map_frame import MapFrame
from magloc.plots.profiles import survey_profiles

ORIGIN = (52.41, 13.12, 41.0)


@pytest.fixture(scope="session")
def survey() -> magloc.Survey:
    """Three targets under six lines."""
    scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    field = sims.simulate(scenario, rng=1)
    return magloc.survey(field.array, field.readings)


@pytest.fixture(scope="session", params=["EPSG:32633", "EPSG:4326"])
def frame(request: pytest.FixtureRequest) -> MapFrame:
    """A map in UTM or in longitudes and latitudes."""
    return MapFrame(ORIGIN, request.param)


@pytest.fixture(scope="session")
def figures(survey: magloc.Survey) -> tuple[Figure, Figure]:
    """Maps and profiles of the survey."""
    return survey.plot(), survey_profiles(survey)
