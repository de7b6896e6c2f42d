"""Tests of adcs.io.frame_files: what was written is read.

And one sentence says what is wrong with a file.
"""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from adcs.io.frame_files import frame_paths, read_frame, write_frame
from adcs.mockup.vision.camera import Camera, Pose
from adcs.mockup.vision.sky import led_sky
from arrays.io.errors import InputError
from sims.mockup.frames import rendered_frame


@pytest.fixture(scope="module")
def image():
    return rendered_frame(led_sky(0), Camera(), Pose(0.2, 0.1, 0.5), np.random.default_rng(0)).image


def refusal(path):
    with pytest.raises(InputError) as raised:
        read_frame(path)
    text = str(raised.value)
    assert str(path) in text
    assert "\n" not in text
    assert text.endswith(".")
    return text


class TestRoundTrip:
    def test_exact(self, image, tmp_path):
        write_frame(image, tmp_path / "frame.png")
        np.testing.assert_array_equal(read_frame(tmp_path / "frame.png"), image)
        assert [path.name for path in tmp_path.iterdir()] == ["frame.png"]

    def test_as_pillow_reads_it(self, image, tmp_path):
        write_frame(image, tmp_path / "frame.png")
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "frame.png")), image)

    def test_other_camera(self, image, tmp_path):
        write_frame(image[:200, :320], tmp_path / "frame.png")
        assert read_frame(tmp_path / "frame.png", Camera(width_px=320, height_px=200)).shape == (200, 320)


class TestRefused:
    def test_no_file(self, tmp_path):
        assert "does not exist" in refusal(tmp_path / "frame.png")

    def test_folder(self, tmp_path):
        assert "is a directory" in refusal(tmp_path)

    @pytest.mark.parametrize("content", [b"", b"no image", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0" + bytes(100)])
    def test_no_image(self, tmp_path, content):
        (tmp_path / "frame.png").write_bytes(content)
        assert "found no PNG image" in refusal(tmp_path / "frame.png")

    def test_jpeg_by_the_name_of_png(self, image, tmp_path):
        Image.fromarray(image).save(tmp_path / "frame.png", format="JPEG")
        assert "found no PNG image" in refusal(tmp_path / "frame.png")

    @pytest.mark.parametrize("kept", [0.02, 0.5, 0.999])
    def test_cut_off(self, image, tmp_path, kept):
        write_frame(image, tmp_path / "frame.png")
        content = (tmp_path / "frame.png").read_bytes()
        (tmp_path / "frame.png").write_bytes(content[: int(kept * len(content))])
        assert "damaged" in refusal(tmp_path / "frame.png")

    @pytest.mark.parametrize("seed", range(20))
    def test_damaged_bytes(self, image, tmp_path, seed):
        """Whatever bytes are changed: an error of one sentence, or an image."""
        write_frame(image, tmp_path / "frame.png")
        content = bytearray((tmp_path / "frame.png").read_bytes())
        rng = np.random.default_rng(seed)
        for place in rng.integers(0, 200, 3):
            content[place] = rng.integers(0, 256)
        (tmp_path / "frame.png").write_bytes(content)
        said = ""
        try:
            read_frame(tmp_path / "frame.png")
        except InputError as error:
            said = str(error)
        assert "\n" not in said

    def test_size(self, image, tmp_path):
        write_frame(image[:, :600], tmp_path / "frame.png")
        assert "found 600 × 480 pixels, expected 640 × 480" in refusal(tmp_path / "frame.png")

    @pytest.mark.parametrize(("mode", "words"), [("RGB", "colours"), ("RGBA", "colours"), ("P", "colours")])
    def test_colours(self, image, tmp_path, mode, words):
        Image.fromarray(image).convert(mode).save(tmp_path / "frame.png")
        assert words in refusal(tmp_path / "frame.png")

    def test_depth(self, image, tmp_path):
        Image.fromarray(image.astype(np.uint16) * 256).save(tmp_path / "frame.png")
        assert "more than 8 bits" in refusal(tmp_path / "frame.png")
        Image.fromarray(image > 100).save(tmp_path / "frame.png")
        assert "black and white" in refusal(tmp_path / "frame.png")

    @pytest.mark.parametrize(("value", "words"), [(0, "black"), (255, "saturated"), (40, "40 in all pixels")])
    def test_nothing_to_see(self, image, tmp_path, value, words):
        write_frame(np.full_like(image, value), tmp_path / "frame.png")
        assert words in refusal(tmp_path / "frame.png")

    @pytest.mark.parametrize("width", [20_000, 200_000])
    def test_bomb(self, tmp_path, width):
        """A header of billions of pixels, which Pillow warns of or refuses."""
        header = b"IHDR" + struct.pack(">IIBBBBB", width, 10_000, 8, 0, 0, 0, 0)
        content = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
        (tmp_path / "frame.png").write_bytes(content + struct.pack(">I", 0) + b"IDAT" + bytes(4))
        assert "too many pixels" in refusal(tmp_path / "frame.png")


class TestPaths:
    def test_folder_in_the_order_of_names(self, image, tmp_path):
        for name in ("b.png", "a.PNG", "c.txt"):
            write_frame(image, tmp_path / name)
        assert [path.name for path in frame_paths(tmp_path)] == ["a.PNG", "b.png"]

    def test_one_file(self, image, tmp_path):
        write_frame(image, tmp_path / "b.png")
        assert frame_paths(tmp_path / "b.png") == [tmp_path / "b.png"]

    def test_nothing(self, tmp_path):
        with pytest.raises(InputError, match=r"no file \*.png"):
            frame_paths(tmp_path)
        with pytest.raises(InputError, match="does not exist"):
            frame_paths(tmp_path / "none")
