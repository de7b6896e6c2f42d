"""A survey of two tiles: as good as one, whoever works on it, and after interruptions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import magloc
import sims
from magloc.grids.work import workers
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import Ground, measure_targets, strongest_sources
from magloc.surveying.preparation import whole_rows
from magloc.surveying.tiled import TiledSurvey
from sims.magnetics.paths import Lawnmower, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Source
from sims.magnetics.simulation import Simulation

# Shallow targets make small tiles: 13 m with margins of 3.4 m. One on the seam, a weak one west of it, and one east of
# the other tile's margin, which is felt there by hundreds of nanotesla.
SHALLOW = magloc.SourcePrior(low_m=(-np.inf, -np.inf, -1.6))
TARGETS = (
    ((0.05, 1.0, -0.5), (1.0, -2.0, -5.0)),
    ((-7.0, -1.0, -0.4), (0.6, 1.6, -1.0)),
    ((8.0, 0.0, -0.6), (20.0, 5.0, -20.0)),
)


@cache
def field() -> Simulation:
    whole = sims.read_scenario("survey-drone")
    assert isinstance(whole, MagneticScenario)
    assert isinstance(whole.carrier.path, Lawnmower)
    path = replace(whole.carrier.path, start_m=(-13.0, 2.5, 1.7), length_m=26.0, lines=6)
    carrier = replace(whole.carrier, path=path)
    sources = tuple(Source(Carrier(Steered(place)), moment) for place, moment in TARGETS)
    seconds = (6 * 26.0 + 5 * np.pi / 2.0) / path.speed_m_s
    scenario = replace(whole, carrier=carrier, targets=None, sources=sources, duration_s=seconds, rate_Hz=8.0)
    return sims.simulate(scenario, rng=911)


@cache
def tiled() -> TiledSurvey:
    array, rows = whole_rows(field().array, field().readings)
    return TiledSurvey.of(array, rows, Ground(SHALLOW, magloc.Terrain(), 15.0, 25.0))


@cache
def surveyed(processes: int) -> magloc.Survey:
    return magloc.survey(field().array, field().readings, prior=SHALLOW, processes=processes)


class TestTwoTiles:
    def test_there_are_two(self) -> None:
        assert len(tiled().tiles) == 2

    def test_each_target_once(self) -> None:
        """What one tile finds is not a ghost in the other; errors within what is claimed."""
        found = surveyed(1)
        assert len(found) == len(TARGETS)
        for place, _ in TARGETS:
            target = min(found, key=lambda target: float(np.linalg.norm(target.position_m - place)))
            error = target.position_m - place
            assert np.linalg.norm(error) < 0.2
            # χ² of three: 1 in 10,000 right ones is beyond 21.
            assert error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0

    def test_every_row_once(self) -> None:
        rows = surveyed(1).rows
        assert len(rows.time_s) == len(field().readings)
        assert (np.diff(rows.time_s) > 0.0).all()

    @pytest.mark.slow
    def test_processes_change_nothing(self) -> None:
        for one, other in zip(surveyed(1), surveyed(2), strict=True):
            np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-6)
            assert one.flags == other.flags

    def test_one_is_told_what_the_other_found(self) -> None:
        """At first neither knows of any; then the western one is told of the strong target in the east."""
        first = tiled()
        assert len(first.piece(0).outside) == 0
        with workers(1, None, None) as each:
            then = first.search(strongest_sources, [1], each, lambda _: None)
        assert then.changes() == [0]
        strongest = np.argmax(np.linalg.norm(then.piece(0).outside.moment_Am2, axis=1))
        np.testing.assert_allclose(then.piece(0).outside.position_m[strongest], TARGETS[2][0], atol=0.2)

    def test_an_interrupted_one_goes_on(self, tmp_path: Path) -> None:
        """After the first tile; the folder is gone when all is done."""

        kept = tmp_path / "kept"
        arguments = {"prior": SHALLOW, "processes": 1, "unfinished": kept}

        def interrupted_after(tiles: int) -> None:
            told: list[str] = []

            def interrupt(said: str) -> None:
                told.append(said)
                if len(told) == tiles:
                    raise KeyboardInterrupt

            with pytest.raises(KeyboardInterrupt):
                magloc.survey(field().array, field().readings, progress=interrupt, **arguments)

        interrupted_after(1)
        (first,) = kept.iterdir()
        before = first.stat().st_mtime_ns
        interrupted_after(2)
        assert first.stat().st_mtime_ns == before
        assert len(list(kept.iterdir())) == 2


class TestChanged:
    """The western tile: x below 0, rows of the margin up to 3.4 m."""

    @staticmethod
    def told(x_m: float, moment_Am2: float) -> TiledSurvey:
        """All had been told what they found, but of one more source."""
        more = Sources(np.array([[x_m, 0.0, -0.5]]), np.array([[0.0, 0.0, moment_Am2]]))
        return replace(tiled(), sources=more)

    @pytest.mark.parametrize(("moment_Am2", "changed"), [(0.03, False), (3.0, True)])
    def test_what_its_margin_alone_feels_is_none(self, moment_Am2: float, changed: bool) -> None:
        then = self.told(5.6, moment_Am2)
        outside = then.piece(0).outside
        assert len(outside) == 1
        assert (0 in then.changes()) == changed

    def test_one_that_is_new_is_sought_once(self) -> None:
        """Told of it, and not finding it, a tile would say the same again."""
        then = self.told(-0.5, 1.0)
        assert 0 in then.changes()
        assert 0 not in replace(then, known=[then.sources] * 2).changes()
        assert 0 not in replace(then, found=[then.sources] * 2).changes()


class TestGround:
    def test_tiles_have_it_in_common(self) -> None:
        """The poles of both are those of the whole survey: a target does not depend on where the seams are."""
        first, other = (set(map(tuple, tiled().piece(k).model().layer.places_m[:, :2].round(6))) for k in (0, 1))
        assert len(first & other) > 10
        both = np.array(sorted(first | other))
        steps = (both - both[0]) / 4.0  # 15 m / 2.5 / 1.5
        np.testing.assert_allclose(steps, steps.round(), atol=1e-6)


class TestReach:
    def test_it_goes_on_to_the_seam(self) -> None:
        """Also where no rows are near it: 6 m on either side."""
        array, rows = whole_rows(field().array, field().readings)
        assert rows.array_position_m is not None
        apart = rows[np.abs(rows.array_position_m[:, 0]) > 6.0]
        west = TiledSurvey.of(array, apart, Ground(SHALLOW, magloc.Terrain(), 15.0, 25.0)).piece(0)
        places = measure_targets(west)["reach_m"]
        for depth in set(places[:, 2]):
            assert abs(places[places[:, 2] == depth, 0].max()) < 1.0  # half a step between places


class TestBadInput:
    @pytest.mark.parametrize(("width_m", "said"), [(0.1, True), (2.0, False)])
    def test_one_line_tells_little_of_sides(self, width_m: float, said: bool, caplog: pytest.LogCaptureFixture) -> None:
        array, rows = whole_rows(field().array, field().readings)
        assert rows.array_position_m is not None
        wave = np.sin(np.arange(len(rows)))[:, None] * [0.0, width_m, 0.0]
        line = replace(rows, array_position_m=rows.array_position_m * [1.0, 0.0, 1.0] + wave)
        TiledSurvey.of(array, line, Ground(SHALLOW, magloc.Terrain(), 15.0, 25.0))
        assert ("lie on one line" in caplog.text) == said

    def test_rows_that_are_far_from_each_other(self) -> None:
        readings = field().readings[:40]
        assert readings.array_position_m is not None
        places = readings.array_position_m + np.outer(np.arange(40), [1e3, 0.0, 0.0])
        with pytest.raises(ValueError, match="near each other"):
            magloc.survey(field().array, replace(readings, array_position_m=places))
