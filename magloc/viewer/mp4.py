"""MP4 files in H.264, encoded by the browser that draws the pictures, so that no other encoder is needed."""

from __future__ import annotations

import base64
import struct
from collections.abc import Sequence

from PIL.Image import Image

from magloc.viewer.chromium import BrowserError, Chromium

_BITS_PER_PIXEL = 2.0  # of every picture: lines of one pixel keep their colours
_IDENTITY = struct.pack(">9i", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
_START = """
(async () => {
  const config = {codec: 'avc1.640028', width: %d, height: %d, bitrate: %d, framerate: %f, avc: {format: 'avc'}};
  if (!(await VideoEncoder.isConfigSupported(config)).supported) return false;
  const film = {pictures: [], time_us: 0};
  const base64 = data => btoa(Array.from(new Uint8Array(data), byte => String.fromCharCode(byte)).join(''));
  const addChunk = (chunk, metadata) => {
    const data = new Uint8Array(chunk.byteLength);
    chunk.copyTo(data);
    if (metadata.decoderConfig) film.avcC = base64(metadata.decoderConfig.description);
    film.pictures.push([base64(data), chunk.type === 'key']);
  };
  film.encoder = new VideoEncoder({output: addChunk, error: fault => { film.fault = String(fault); }});
  film.encoder.configure(config);
  window.film = film;
  return true;
})()
"""
_ADD = """
(() => {
  const pixels = Uint8Array.from(atob('%s'), letter => letter.charCodeAt(0));
  const options = {format: 'RGBX', codedWidth: %d, codedHeight: %d, timestamp: film.time_us, duration: %d};
  const frame = new VideoFrame(pixels, options);
  film.encoder.encode(frame, {keyFrame: film.time_us === 0});
  film.time_us += frame.duration;
  frame.close();
})()
"""
_FINISH = "film.encoder.flush().then(() => [film.avcC, film.pictures, film.fault])"


def encode_mp4(browser: Chromium, pictures: Sequence[Image], duration_ms: int) -> bytes:
    """Encode pictures of one size as an MP4 file; raise BrowserError if that is not possible.

    Width and height have to be even. The open page has to be one of this machine, because browsers encode for no other.
    """
    (width, height), fps = pictures[0].size, 1e3 / duration_ms
    if not browser.evaluate(_START % (width, height, _BITS_PER_PIXEL * width * height * fps, fps)):
        raise BrowserError("This browser has no H.264 encoder, which an MP4 needs; write a .gif instead.")
    for picture in pictures:
        pixels = base64.b64encode(picture.convert("RGBX").tobytes()).decode()
        browser.evaluate(_ADD % (pixels, width, height, 1000 * duration_ms))
    avcC, chunks, fault = browser.evaluate(_FINISH)
    if fault or len(chunks) != len(pictures):
        raise BrowserError(f"The browser encoded {len(chunks)} of {len(pictures)} pictures ({fault or 'no error'}).")
    samples = [base64.b64decode(data) for data, _ in chunks]
    keys = [i for i, (_, is_key) in enumerate(chunks, 1) if is_key]
    return _mp4_file(samples, keys, base64.b64decode(avcC), width, height, duration_ms)


def _mp4_file(
    samples: Sequence[bytes], keys: Sequence[int], avcC: bytes, width: int, height: int, each_ms: int
) -> bytes:
    """Return a file with one track of H.264 samples below their index (ISO/IEC 14496-12, -15).

    ``keys``: numbers of the key frames, from 1 on.
    """
    n, whole_ms = len(samples), len(samples) * each_ms
    colours = _box(b"colr", b"nclx", struct.pack(">3HB", 1, 1, 1, 0))  # BT.709
    entry = _box(
        b"avc1",
        struct.pack(">6xH16x2H2I4xH32x2h", 1, width, height, 72 << 16, 72 << 16, 1, 24, -1),
        _box(b"avcC", avcC),
        colours,
    )
    header = _box(b"ftyp", b"isom", struct.pack(">I", 0x200), b"isomiso2avc1mp41")

    def index(first_byte: int) -> bytes:
        table = _box(
            b"stbl",
            _full(b"stsd", struct.pack(">I", 1), entry),
            _full(b"stts", struct.pack(">3I", 1, n, each_ms)),
            _full(b"stss", struct.pack(f">I{len(keys)}I", len(keys), *keys)),
            _full(b"stsc", struct.pack(">4I", 1, 1, n, 1)),
            _full(b"stsz", struct.pack(f">2I{n}I", 0, n, *map(len, samples))),
            _full(b"stco", struct.pack(">2I", 1, first_byte)),
        )
        here = _box(b"dinf", _full(b"dref", struct.pack(">I", 1), _full(b"url ", flags=1)))
        medium = _box(
            b"mdia",
            _full(b"mdhd", struct.pack(">4I2H", 0, 0, 1000, whole_ms, 0x55C4, 0)),  # no language
            _full(b"hdlr", struct.pack(">I4s12x", 0, b"vide"), b"\0"),
            _box(b"minf", _full(b"vmhd", bytes(8), flags=1), here, table),
        )
        place = struct.pack(">5I8x4H", 0, 0, 1, 0, whole_ms, 0, 0, 0, 0) + _IDENTITY
        track = _full(b"tkhd", place, struct.pack(">2I", width << 16, height << 16), flags=3)
        film = struct.pack(">4IIH10x", 0, 0, 1000, whole_ms, 0x10000, 0x100) + _IDENTITY + bytes(24)
        return _box(b"moov", _full(b"mvhd", film, struct.pack(">I", 2)), _box(b"trak", track, medium))

    first_byte = len(header) + len(index(0)) + 8
    return header + index(first_byte) + _box(b"mdat", *samples)


def _box(kind: bytes, *content: bytes) -> bytes:
    data = b"".join(content)
    return struct.pack(">I4s", 8 + len(data), kind) + data


def _full(kind: bytes, *content: bytes, flags: int = 0) -> bytes:
    """Return a box with version 0 and flags."""
    return _box(kind, struct.pack(">I", flags), *content)
