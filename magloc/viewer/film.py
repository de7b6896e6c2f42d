"""A page as a film: row by row where it has several, else once around what is seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import viser
from PIL import Image
from scipy.spatial.transform import Rotation

from arrays.io.errors import InputError
from arrays.io.text import replaced
from arrays.typing import FloatArray
from magloc.viewer.mp4 import mp4_of
from magloc.viewer.outputs import FILM_FORMATS
from magloc.viewer.pages.pages import Page
from magloc.viewer.server import opened_page

_MOST_FRAMES = 60
_TURN_S = 6.0
_FILM_PX = (960, 600)
_PALETTE_OF = 4  # lines, of which one tells the colours


def write_film(
    server: viser.ViserServer, page: Page, path: Path, progress: Callable[[int], None] | None = None
) -> None:
    """Write what a headless Chromium shows as a GIF, an animated PNG or an MP4, by the name of the file.

    `progress` is called with the number of frames finished since the last call.
    """
    kind = FILM_FORMATS[path.suffix.lower()]
    seconds = _TURN_S if page.playing is None else page.playing.duration_s
    pictures: list[Image.Image] = []
    with opened_page(server, _FILM_PX) as browser:
        client = next(iter(server.get_clients().values()))
        camera = server.initial_camera
        look_at, fov = np.array(camera.look_at), float(camera.fov)
        for position in _scenes(page, np.array(camera.position), look_at):
            wxyz = _looking_at(look_at, position)
            # The page draws what it was told before it was asked.
            shot = client.get_render(_FILM_PX[1], _FILM_PX[0], wxyz=wxyz, position=position, fov=fov)
            pictures.append(Image.fromarray(np.asarray(shot)[..., :3]))
            if progress is not None:
                progress(1)
        duration_ms = max(20, round(1e3 * seconds / len(pictures)))
        mp4 = mp4_of(browser, pictures, duration_ms) if kind == "MP4" else b""
    if kind == "GIF":
        # One palette of all: colours that changed from frame to frame would seem to mean something.
        every = Image.fromarray(np.concatenate([np.asarray(picture)[::_PALETTE_OF] for picture in pictures]))
        palette = every.quantize(256, dither=Image.Dither.NONE)
        pictures = [picture.quantize(256, palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    options: dict[str, Any] = {"duration": duration_ms, "loop": 0}
    try:
        with replaced(path) as written:
            if mp4:
                written.write_bytes(mp4)
            else:
                pictures[0].save(written, format=kind, save_all=True, append_images=pictures[1:], **options)
    except OSError as error:
        raise InputError(f"Input movie {path} cannot be written ({error.strerror}).") from None


def _scenes(page: Page, position_m: FloatArray, look_at_m: FloatArray) -> Iterator[FloatArray]:
    """Show one frame after the other, 60 at most, and give the place of its camera (3,)."""
    playing = page.playing
    if playing is not None:
        for i in np.linspace(0, len(playing.steps) - 1, min(len(playing.steps), _MOST_FRAMES)).round().astype(int):
            playing.show(playing.steps[i])
            yield position_m
        return
    for angle in np.linspace(0.0, 2.0 * np.pi, _MOST_FRAMES, endpoint=False):
        yield look_at_m + Rotation.from_rotvec([0.0, 0.0, angle]).apply(position_m - look_at_m)


def _looking_at(look_at_m: FloatArray, position_m: FloatArray) -> FloatArray:
    """Attitude wxyz of a camera whose axes are right, down and ahead, upright."""
    ahead = look_at_m - position_m
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return np.roll(Rotation.from_matrix(axes / np.linalg.norm(axes, axis=0)).as_quat(), 1)
