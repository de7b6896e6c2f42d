"""Outputs that cannot be written are refused before long work, by the name of their option."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from arrays.io.errors import InputError
from arrays.io.outputs import make_folder, refuse_file, refuse_one_for_two, refuse_unwritable
from arrays.io.text import replaced
from magloc.plots import style

# Nobody can make a file in it.
CLOSED = Path("/proc")


class TestRefuseUnwritable:
    def test_leaves_a_file_and_its_folder_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "old.csv"
        path.write_text("old")
        refuse_unwritable(path, "--out")
        refuse_unwritable(tmp_path / "new.PNG", "--png", ".png")
        assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("old.csv", "old")]

    def test_refused(self, tmp_path: Path) -> None:
        for path, fault in (
            (tmp_path, "found a folder, expected a file"),
            (tmp_path / "none" / "a.csv", "found no folder"),
            (CLOSED / "a.csv", f"no file can be made in {CLOSED}"),
            (tmp_path / ("a" * 250), "File name too long"),
        ):
            with pytest.raises(InputError) as refused:
                refuse_unwritable(path, "--out")
            assert str(refused.value).startswith(f"--out {path}: ")
            assert fault in str(refused.value)

    def test_through_a_link(self, tmp_path: Path) -> None:
        """The target is replaced, so that its folder counts."""
        link = tmp_path / "link.csv"
        link.symlink_to(CLOSED / "a.csv")
        with pytest.raises(InputError, match=f"no file can be made in {CLOSED}"):
            refuse_unwritable(link, "--out")

    def test_suffix(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"--png .*found a name that ends with '.xyz', expected .png"):
            refuse_unwritable(tmp_path / "a.xyz", "--png", ".png")

    def test_what_is_no_file_is_written_in_place(self, tmp_path: Path) -> None:
        refuse_unwritable(Path(os.devnull), "--out")


class TestInterrupted:
    def test_the_file_that_is_tried_is_not_left(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = tempfile.NamedTemporaryFile
        kept: list[Any] = []  # as a traceback keeps it: else its own end would remove it

        def interrupted(**options: Any) -> Any:
            file = made(**options)
            kept.append(file)
            signal.raise_signal(signal.SIGINT)
            return file

        monkeypatch.setattr(tempfile, "NamedTemporaryFile", interrupted)
        with pytest.raises(KeyboardInterrupt):
            refuse_unwritable(tmp_path / "map.png", "--out")
        assert list(tmp_path.iterdir()) == []


class TestFolders:
    def test_nothing_is_made(self, tmp_path: Path) -> None:
        refuse_file(tmp_path / "new" / "folder", "--out")
        assert not list(tmp_path.iterdir())

    def test_refused(self, tmp_path: Path) -> None:
        file = tmp_path / "file"
        file.write_text("")
        for folder in (file, file / "below"):
            with pytest.raises(InputError, match=f"--out {folder}: found a file, expected a folder"):
                refuse_file(folder, "--out")
        for folder in (CLOSED, CLOSED / "new" / "folder"):
            with pytest.raises(InputError, match=f"--out {folder}: no file can be made in {CLOSED}"):
                refuse_file(folder, "--out")
        with pytest.raises(InputError, match=f"--out {CLOSED}: no file can be made in {CLOSED}"):
            make_folder(CLOSED, "--out")


class TestOneForTwo:
    def test_refused_by_whatever_name(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        with pytest.raises(InputError, match="--png a: found the file of --out, expected another one"):
            refuse_one_for_two({"--out": tmp_path / "b" / ".." / "a", "--png": Path("a")})

    def test_several_and_none(self, tmp_path: Path) -> None:
        refuse_one_for_two({"--out": tmp_path / "a", "--png": None, "--json": None, "--csv": tmp_path / "b"})


class TestReplaced:
    """A file is there as it was or as it is to be; nothing of the attempt is left."""

    def test_whole_at_the_end(self, tmp_path: Path) -> None:
        path = tmp_path / "a.png"
        path.write_text("old")
        with replaced(path) as written:
            written.write_text("ne")
            assert path.read_text() == "old"
        assert path.read_text() == "ne"
        assert [file.name for file in tmp_path.iterdir()] == ["a.png"]

    @pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device"), ValueError("no")])
    def test_not_at_all(self, tmp_path: Path, error: BaseException) -> None:
        path = tmp_path / "a.png"
        path.write_text("old")

        def attempt() -> None:
            with replaced(path) as written:
                written.write_text("half")
                raise error

        with pytest.raises(type(error)) as raised:
            attempt()
        assert getattr(raised.value, "filename", None) in (None, str(path))
        assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a.png", "old")]

    def test_a_full_disk_leaves_the_old_figure(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(_: Figure, place: Path, **__: object) -> None:
            place.write_bytes(b"\x89PNG")
            raise OSError(28, "No space left on device")

        path = tmp_path / "a.png"
        style.save(style.new_figure(1.0), path)
        before = path.read_bytes()
        monkeypatch.setattr(Figure, "savefig", full)
        with pytest.raises(InputError, match=r"a\.png cannot be written \(No space left on device\)"):
            style.save(style.new_figure(1.0), path)
        assert [file.read_bytes() for file in tmp_path.iterdir()] == [before]

    def test_a_link_keeps_leading_there_and_a_pipe_is_written_to(self, tmp_path: Path) -> None:
        (tmp_path / "link").symlink_to(tmp_path / "target")
        for place in (tmp_path / "link", Path(os.devnull)):
            with replaced(place) as written:
                written.write_text("new")
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "target").read_text() == "new"
        assert not Path(os.devnull).is_file()
