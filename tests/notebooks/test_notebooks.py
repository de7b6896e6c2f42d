"""What is kept of the notebooks, and the one that runs with and without its recording; nbmake executes them all."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
import nbformat
import pytest
from nbformat import NotebookNode
from tests.notebooks import (
    FOLDER,
    KERNEL_WARNINGS,
    NOTEBOOKS,
    SHOWN,
    executed,
    picture_files,
    pictures,
    texts,
    views,
    without_views,
)


LARGEST_BYTES, LARGEST_VIEW_BYTES = 400_000, 1_200_000
# Folders of a machine: no output may name one.
MACHINE_PATH = re.compile(r"(?<![\w.])/[a-zA-Z]\w*/|ipykernel_\d|\b[A-Z]:\\")


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request) -> Path:
    return request.param


@pytest.fixture
def notebook(path) -> NotebookNode:
    return nbformat.read(path, as_version=4)


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_all_are_there():
    assert {path.stem for path in NOTEBOOKS} >= SHOWN.keys()


class TestKeptOutputs:
    def test_every_cell_was_executed_in_order(self, notebook):
        counts = [cell.execution_count for cell in code_cells(notebook)]
        assert counts == list(range(1, len(counts) + 1))

    def test_nothing_was_raised_or_warned(self, notebook):
        outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
        assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]

    def test_no_machine_is_named(self, notebook):
        assert not MACHINE_PATH.search(texts(notebook))

    def test_they_are_small_and_have_pictures(self, notebook, path):
        assert pictures(notebook)
        assert len(nbformat.writes(without_views(notebook)).encode()) < LARGEST_BYTES
        assert path.stat().st_size < LARGEST_BYTES + LARGEST_VIEW_BYTES

    def test_the_viewer_shows_once_at_most(self, notebook):
        assert views(notebook) <= 1

    def test_the_pages_have_its_pictures(self, notebook, path):
        for file, picture in picture_files(path, notebook).items():
            assert file.read_bytes() == picture

    def test_what_is_not_known_is_said(self, notebook, path):
        if path.stem not in SHOWN:
            pytest.skip("a notebook of another package")
        assert any("## What is not known" in cell.source for cell in notebook.cells)


@pytest.mark.parametrize("name", ["03-real-magnet", pytest.param("from-a-log", marks=pytest.mark.slow)])
class TestRecordings:
    @pytest.mark.slow
    def test_without_the_recording_a_simulated_twin_tells_the_story(self, name, tmp_path, monkeypatch):
        monkeypatch.delenv("MAGLOC_DATA", raising=False)
        monkeypatch.setenv("PYTHONWARNINGS", KERNEL_WARNINGS)
        path = Path(shutil.copy(FOLDER / f"{name}.ipynb", tmp_path))
        said = texts(executed(path, tmp_path))
        assert "Notice: the recording is not on this machine" in said
        assert "Real data" not in said

    def test_the_kept_outputs_are_those_of_the_recording(self, name):
        assert "Real data" in texts(nbformat.read(FOLDER / f"{name}.ipynb", as_version=4))
