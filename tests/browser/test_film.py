"""Films: a frame for every row, in which the source moves; and a turn, in which the array does."""

from __future__ import annotations

import base64
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

import magloc
from arrays.geometries import tetrahedron
from arrays.io.errors import InputError
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer import film
from magloc.viewer.mp4 import encode_mp4
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR
from tests.browser.screen import Screen, hue_of

ORANGE = hue_of(DIPOLE_COLOUR)
COLOURS = ((230, 159, 0), (0, 114, 178), (255, 255, 255), (40, 44, 52))
COLOUR_PAIRS = tuple(pairwise((*COLOURS, COLOURS[0])))
SIZE, EACH_MS = (96, 64), 250
PLAY = """
(async () => {
  const film = document.createElement('video'), canvas = document.createElement('canvas');
  const shown = () => new Promise(resolve => film.requestVideoFrameCallback(resolve));
  film.src = 'data:video/mp4;base64,%s';
  await shown();
  canvas.width = film.videoWidth, canvas.height = film.videoHeight;
  const context = canvas.getContext('2d'), colours = [];
  for (let i = %d - 1; i >= 0; i--) {  // never to the picture that is there already
    const next = shown();
    film.currentTime = (i + 0.5) * %f;
    await next;
    context.drawImage(film, 0, 0);
    const at = x => [...context.getImageData(x * canvas.width, canvas.height / 2, 1, 1).data];
    colours.unshift([at(0.25), at(0.75)]);
  }
  return {width: film.videoWidth, height: film.videoHeight, seconds: film.duration, colours};
})()
"""


def frames_of(path: Path) -> list[np.ndarray]:
    with PIL.Image.open(path) as picture:
        found = []
        for i in range(picture.n_frames):
            picture.seek(i)
            found.append(np.asarray(picture.convert("RGB")) / 255.0)
        return found


@pytest.mark.slow
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
    """Four views that differ; an MP4 has those of the animated PNG."""
    monkeypatch.setattr(film, "_MOST_FRAMES", 4)
    array = tetrahedron(1.5)
    magloc.view(array, movie=tmp_path / "array.apng")
    frames = frames_of(tmp_path / "array.apng")
    assert len(frames) == 4
    assert all(np.abs(one - other).max() > 0.3 for one, other in pairwise(frames))
    magloc.view(array, movie=tmp_path / "array.mp4")
    screen.browser.open(tmp_path.as_uri())
    shown = play(screen, (tmp_path / "array.mp4").read_bytes(), len(frames), film._TURN_S / len(frames))
    for frame, (left, _) in zip(frames, shown["colours"], strict=True):
        assert np.abs(255.0 * frame[len(frame) // 2, frame.shape[1] // 4] - left[:3]).max() <= 12


@pytest.fixture(scope="module")
def played(screen: Screen, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a browser, which knows nothing of how the film was made, shows in the middle of every picture's time."""
    screen.browser.open(tmp_path_factory.mktemp("film").as_uri())  # encoders are for pages of this machine
    return play(screen, encode_mp4(screen.browser, colour_pictures(), EACH_MS), len(COLOURS), EACH_MS / 1000.0)


def play(screen: Screen, mp4: bytes, n: int, each_s: float) -> dict[str, Any]:
    shown: dict[str, Any] = screen.evaluate(PLAY % (base64.b64encode(mp4).decode(), n, each_s))
    screen.leave()
    return shown


def colour_pictures() -> list[PIL.Image.Image]:
    """One colour on the left, the next one on the right."""
    pictures = []
    for left, right in COLOUR_PAIRS:
        picture = PIL.Image.new("RGB", SIZE, right)
        picture.paste(left, (0, 0, SIZE[0] // 2, SIZE[1]))
        pictures.append(picture)
    return pictures


class TestMp4:
    def test_size_and_time(self, played: dict[str, Any]) -> None:
        assert (played["width"], played["height"]) == SIZE
        assert played["seconds"] == pytest.approx(len(COLOURS) * EACH_MS / 1000.0)

    def test_every_picture_is_in_its_place(self, played: dict[str, Any]) -> None:
        """Within the rounding of 8 bits in limited range; the matrix of another standard is 10 off and more."""
        assert np.abs(np.array(played["colours"])[..., :3] - COLOUR_PAIRS).max() <= 6


def test_other_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected \.mp4, \.gif or \.apng"):
        magloc.view(tetrahedron(1.5), movie=tmp_path / "a.avi")
    assert not list(tmp_path.iterdir())
