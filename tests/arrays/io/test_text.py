"""Files are read whole; what does not end, or is no text, is refused by a sentence with its name."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from arrays.io import text
from arrays.io.csv import read_table
from arrays.io.errors import InputError
from arrays.io.text import read_bytes, read_text, write_netcdf

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes in the file system, and devices")


class TestEndless:
    """Devices and pipes that do not end, and files larger than memory."""

    def test_device_without_lines(self) -> None:
        with pytest.raises(
            InputError, match=r"^/dev/zero: found no end of a line in \d+ MB of a pipe or device, expec"
        ):
            read_bytes("/dev/zero", "a picture")

    @pytest.mark.parametrize("device", ["/dev/zero", "/dev/urandom"])
    def test_device_as_text(self, device: str) -> None:
        with pytest.raises(InputError, match=device):
            read_table(device, "a header")

    def test_pipe_of_lines(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(text, "MOST_PIPED_BYTES", 10**6)
        monkeypatch.setattr(text, "_CHUNK", 2**16)
        with pytest.raises(InputError, match=r"no end of the data in 1 MB of a pipe"):
            read_text(piped(tmp_path, b"y\n" * 10**6), "a CSV file")

    def test_large_file(self, tmp_path: Path) -> None:
        """It is sparse: no byte of it is read or written."""
        path = tmp_path / "large.csv"
        with path.open("wb") as file:
            file.truncate(4 * 10**9 + 1)
        with pytest.raises(InputError, match=r"large\.csv: found more than 4 GB, expected a CSV file"):
            read_text(path, "a CSV file")

    def test_pipe_that_ends(self, tmp_path: Path) -> None:
        data = b"time_s,x\n" + b"".join(b"%d,1\n" % i for i in range(20_000))
        assert read_bytes(piped(tmp_path, data), "a CSV file") == data


def piped(folder: Path, data: bytes) -> Path:
    """A pipe that gives some bytes to whoever opens it."""
    path = folder / "pipe"
    os.mkfifo(path)

    def write() -> None:
        with contextlib.suppress(BrokenPipeError):  # the reader has had enough
            path.write_bytes(data)

    threading.Thread(target=write, daemon=True).start()
    return path


class TestEncodings:
    TEXT = "Zeit,Höhe\n1,2\n"

    @pytest.mark.parametrize(
        ("written", "stated"),
        [
            ("utf-8", None),
            ("utf-8-sig", None),
            ("utf-16", None),
            ("windows-1252", "windows-1252"),
            ("utf-16-le", "utf-16-le"),
            ("utf-16", "windows-1252"),  # a mark says more than a file of settings
        ],
    )
    def test_are_read(self, written: str, stated: str | None, tmp_path: Path) -> None:
        (tmp_path / "log.csv").write_bytes(self.TEXT.encode(written))
        assert read_text(tmp_path / "log.csv", "a CSV file", stated) == self.TEXT

    def test_one_that_it_is_not(self, tmp_path: Path) -> None:
        (tmp_path / "log.csv").write_bytes(self.TEXT.encode("windows-1252"))
        with pytest.raises(InputError, match=r"log.csv, line 1: found the byte 0xf6, which is not UTF-8"):
            read_text(tmp_path / "log.csv", "a CSV file")


class TestNetcdf:
    def test_a_signal_acts_after_the_file_is_written(self, tmp_path: Path) -> None:
        """Raised inside xarray, it would leave the lock of HDF5 locked."""

        class Dataset:
            def to_netcdf(self, path: Path) -> None:
                signal.raise_signal(signal.SIGINT)
                path.write_bytes(b"whole")

        with pytest.raises(KeyboardInterrupt):
            write_netcdf(Dataset(), tmp_path / "run.nc")  # type: ignore[arg-type]
        assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"whole"]
