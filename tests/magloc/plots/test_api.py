"""``magloc.plots``: a figure of every public result, by the name of what it draws."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import magloc
from arrays.geometries import tetrahedron
from magloc.localization.fit.export import fix_columns
from magloc.localization.fit.fixes import Fixes
from magloc.localization.locator import locate
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings

ARRAY = tetrahedron(1.5)
PLACES = np.stack([np.linspace(-2.0, 2.0, 5), np.full(5, 3.0), np.full(5, 0.5)], axis=-1)
READINGS = Readings(np.array([predicted_channels(ARRAY, place, [0.0, 80.0, 30.0]) for place in PLACES]))


@pytest.fixture(scope="module")
def fixes() -> Fixes:
    return locate(ARRAY, READINGS)


def drawn(figure: Figure, label: str) -> np.ndarray:
    """What the first panel draws under a label (n, 2)."""
    (line,) = [line for line in figure.axes[0].lines if line.get_label() == label]
    return np.asarray(line.get_xydata())


class TestNames:
    """Names that stay what they are, whatever is imported."""

    def test_no_function_has_the_name_of_a_module(self) -> None:
        modules = {path.stem for path in Path(magloc.plots.__file__ or "").parent.glob("*.py")}
        assert not modules & set(magloc.plots.__all__)

    def test_all_are_functions_and_in_the_stub(self) -> None:
        assert all(callable(getattr(magloc.plots, name)) for name in magloc.plots.__all__)
        tree = ast.parse((Path(magloc.plots.__file__ or "").parent / "__init__.pyi").read_text(encoding="utf-8"))
        imported = [alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
        assigned = [ast.unparse(node.targets[0]) for node in tree.body if isinstance(node, ast.Assign)]
        assert (
            sorted({*imported, *assigned} - {"_bounds", "_signatures", "_surveys", "_tracks"}) == magloc.plots.__all__
        )


@pytest.mark.filterwarnings("error")
class TestFixes:
    """Fixes draw themselves, with and without their array."""

    def test_alone(self, fixes: Fixes) -> None:
        figure = fixes.plot()
        np.testing.assert_allclose(drawn(figure, "fixes"), fixes.position_m[:, :2])
        assert "sensors" not in [line.get_label() for line in figure.axes[0].lines]

    def test_with_the_array_and_the_truth(self, fixes: Fixes) -> None:
        figure = magloc.plots.fixes(fixes, ARRAY, READINGS, PLACES)
        np.testing.assert_allclose(drawn(figure, "sensors"), ARRAY.positions[:, :2])
        assert "error" in [line.get_label() for line in figure.axes[3].lines]

    def test_no_range_and_no_fix(self, fixes: Fixes) -> None:
        noise = np.random.default_rng(0).normal(0.0, ARRAY.channel_noise_T, READINGS.values_T.shape)
        assert not fix_columns(locate(ARRAY, noise)).range_observable.any()
        for found in (locate(ARRAY, noise), Fixes.unsolved(fixes.time_s, "nothing was read")):
            assert found.plot().axes
            assert magloc.plots.fixes(found, ARRAY).axes


def test_residuals_are_the_same_in_either_frame(fixes: Fixes) -> None:
    turn = Rotation.from_rotvec(np.tile([0.1, 0.2, 0.3], (5, 1)))
    moved = Readings(READINGS.values_T, array_position_m=np.ones((5, 3)), array_rotation=turn)
    figures = [
        magloc.plots.residuals(ARRAY, READINGS, fixes),
        magloc.plots.residuals(ARRAY, moved, locate(ARRAY, moved)),
    ]
    here, there = ([line.get_ydata() for line in figure.axes[0].lines] for figure in figures)
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)  # standard deviations


class TestEveryResult:
    """Whatever a door gives draws itself."""

    def test_bounds_are_drawn_over_the_distance(self) -> None:
        places = np.array([[6.0, 0.0, 0.5], [2.0, 0.0, 0.5], [4.0, 0.0, 0.5]])
        bounds = magloc.cramer_rao_bounds(ARRAY, places, [0.0, 0.0, 100.0])
        position, range_ = bounds.plot().axes[0].lines
        order = np.argsort(bounds.range_m)
        per_m = 1e3 if bounds.sigma_position_m.max() < 1.0 else 1.0
        np.testing.assert_allclose(position.get_xdata(), bounds.range_m[order])
        np.testing.assert_allclose(position.get_ydata(), per_m * bounds.sigma_position_m[order])
        np.testing.assert_allclose(range_.get_ydata(), per_m * bounds.sigma_range_m[order])

    def test_bounds_that_are_infinite_are_not_drawn(self) -> None:
        known_nothing = magloc.cramer_rao_bounds(ARRAY, [1.0, 2.0, 3.0], [0.0, 0.0, 0.0])
        assert known_nothing.plot().axes

    def test_signature(self) -> None:
        ship = magloc.datasets.load("ship")
        assert ship.truth is not None
        found = magloc.fit_signature(
            ship.array, ship.readings, magloc.ObjectPath(ship.truth.time_s, ship.truth.position_m)
        )
        parts, turns = found.plot().axes
        assert [text.get_text() for text in parts.get_yticklabels()] == list(found.names)
        east, north, up = turns.lines
        moment, _ = found.moment(np.asarray(east.get_xdata()))
        np.testing.assert_allclose(np.array([line.get_ydata() for line in (east, north, up)]).T, moment)
