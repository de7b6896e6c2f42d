"""Films: a frame for every row, in which the source moves; and a turn, in which the array does."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

import magloc
from arrays.geometries import tetrahedron
from arrays.io.errors import InputError
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer import film
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR
from tests.browser.screen import Screen, hue_of

ORANGE = hue_of(DIPOLE_COLOUR)


def frames_of(path: Path) -> list[np.ndarray]:
    with PIL.Image.open(path) as picture:
        found = []
        for i in range(picture.n_frames):
            picture.seek(i)
            found.append(np.asarray(picture.convert("RGB")) / 255.0)
        return found


def test_the_source_moves_from_frame_to_frame(screen: Screen, tmp_path: Path) -> None:
    """To the right in the picture, as its x does, and in its colour: the palette is one of all frames."""
    places = np.stack([np.linspace(-4.0, 4.0, 4), np.zeros(4), np.ones(4)], axis=1)
    points = tuple(
        TrackPoint(float(i), place, np.array([0.0, 0.0, 1.0]), np.eye(6) * 0.01) for i, place in enumerate(places)
    )
    path = tmp_path / "track.gif"
    magloc.view(None, TrackResult(points, is_truth=False), movie=path)
    across = [np.mean(np.nonzero(ORANGE(frame))[1]) for frame in frames_of(path)]
    assert len(across) == 4
    assert (np.diff(across) > 20.0).all()


@pytest.mark.slow
def test_a_turn(screen: Screen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "_MOST_FRAMES", 4)
    path = tmp_path / "array.apng"
    magloc.view(tetrahedron(1.5), movie=path)
    frames = frames_of(path)
    assert len(frames) == 4
    assert all(np.abs(one - other).max() > 0.3 for one, other in pairwise(frames))


@pytest.mark.parametrize(("name", "words"), [("a.mp4", "MP4 is not written"), ("a.avi", "expected .gif or .apng")])
def test_other_formats_are_refused(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        magloc.view(tetrahedron(1.5), movie=tmp_path / name)
    assert not list(tmp_path.iterdir())
