"""Films of pages: row by row, or once around the scene of a page without rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import viser
from PIL import Image
from scipy.spatial.transform import Rotation

from arrays.io.text import replace_file
from arrays.typing import FloatArray
from magloc.viewer.mp4 import encode_mp4
from magloc.viewer.outputs import FILM_FORMATS
from magloc.viewer.pages.pages import Page
from magloc.viewer.server import open_page

_MOST_FRAMES = 60
_TURN_S = 6.0
_FILM_PX = (960, 600)
_PALETTE_STEP = 4  # every fourth line of the pictures determines the palette


def write_film(
    server: viser.ViserServer, page: Page, path: Path, progress: Callable[[int], None] | None = None
) -> None:
    """Write the page of a headless Chromium as a GIF, an animated PNG or an MP4.

    The suffix of the file gives the format. `progress` is called with the number of frames finished since the previous
    call.
    """
    kind = FILM_FORMATS[path.suffix.lower()]
    seconds = _TURN_S if page.playback is None else page.playback.duration_s
    pictures: list[Image.Image] = []
    with open_page(server, _FILM_PX) as browser:
        client = next(iter(server.get_clients().values()))
        camera = server.initial_camera
        look_at, fov = np.array(camera.look_at), float(camera.fov)
        for position in _show_frames(page, np.array(camera.position), look_at):
            wxyz = _camera_attitude(look_at, position)
            # The page applies all earlier changes before it draws.
            shot = client.get_render(_FILM_PX[1], _FILM_PX[0], wxyz=wxyz, position=position, fov=fov)
            pictures.append(Image.fromarray(np.asarray(shot)[..., :3]))
            if progress is not None:
                progress(1)
        duration_ms = max(20, round(1e3 * seconds / len(pictures)))
        mp4 = encode_mp4(browser, pictures, duration_ms) if kind == "MP4" else b""
    if kind == "GIF":
        # All frames have one palette, so that no colour changes from frame to frame.
        every = Image.fromarray(np.concatenate([np.asarray(picture)[::_PALETTE_STEP] for picture in pictures]))
        palette = every.quantize(256, dither=Image.Dither.NONE)
        pictures = [picture.quantize(256, palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    options: dict[str, Any] = {"duration": duration_ms, "loop": 0, "save_all": True, "append_images": pictures[1:]}
    if mp4:
        replace_file(path, lambda place: place.write_bytes(mp4))
    else:
        replace_file(path, lambda place: pictures[0].save(place, format=kind, **options))


def _show_frames(page: Page, position_m: FloatArray, look_at_m: FloatArray) -> Iterator[FloatArray]:
    """Show the frames one by one, at most 60, and yield the position of the camera (3,)."""
    playback = page.playback
    if playback is not None:
        n = len(playback.steps)
        for i in np.linspace(0, n - 1, min(n, _MOST_FRAMES)).round().astype(int):
            playback.show(playback.steps[i])
            yield position_m
        return
    for angle in np.linspace(0.0, 2.0 * np.pi, _MOST_FRAMES, endpoint=False):
        yield look_at_m + Rotation.from_rotvec([0.0, 0.0, angle]).apply(position_m - look_at_m)


def _camera_attitude(look_at_m: FloatArray, position_m: FloatArray) -> FloatArray:
    """Return the attitude wxyz of an upright camera with the axes right, down and ahead."""
    ahead = look_at_m - position_m
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return np.roll(Rotation.from_matrix(axes / np.linalg.norm(axes, axis=0)).as_quat(), 1)
