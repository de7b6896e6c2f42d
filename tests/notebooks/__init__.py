"""The notebooks of ``notebooks/``: how they are executed, and what is kept of it.

They are kept with their outputs, so that the pictures show wherever they are read; ``python -m tests.notebooks``
executes them and writes them back. Cells are executed with this Python, whatever kernels are installed elsewhere.
"""

from __future__ import annotations

import base64
import io
import os
import sys
from copy import deepcopy
from pathlib import Path
import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image


FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
DOCS = FOLDER.parent / "docs"
# Which picture of a notebook stands in the gallery, as docs/notebook-NAME.png.
SHOWN = {
    "01-first-fix": 1,
    "02-convergence-map": 0,
    "03-real-magnet": 0,
    "04-scalar-sign": 0,
    "05-tracking": 1,
    "06-which-array": 1,
    "07-own-csv": 1,
    "08-calibration": 1,
    "09-several-sources": 1,
    "10-ship": 1,
    "11-uncertain-pose": 0,
}
# Another page's picture of a notebook.
ON_PAGES = {"kalman-bank": ("attitude-track.png", 0)}
LONGEST_CELL_S = 300
"""A cell that compiles what it uses, on slow cores."""
KERNEL_WARNINGS = "error,ignore:There is no current event loop:DeprecationWarning"
"""PYTHONWARNINGS of a kernel: ipykernel itself causes the one that is ignored, with Python 3.13."""
# Otherwise jupyter_core warns that its folders will move.
os.environ.setdefault("JUPYTER_PLATFORM_DIRS", "1")
MOST_PIXELS = 1000
"""Across a picture: those that commands write are for print."""


def with_commands() -> str:
    """PATH with the commands of this Python first."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def executed(path: Path, folder: Path) -> NotebookNode:
    """The notebook with the outputs of an execution in a folder.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        A cell raises.
    """
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        timeout=LONGEST_CELL_S,
        record_timing=False,
    ).execute(env={**os.environ, "PATH": with_commands()})
    return notebook


def kept(notebook: NotebookNode) -> NotebookNode:
    """The notebook with small pictures, and with nothing that differs from machine to machine but the numbers."""
    notebook.metadata = NotebookNode(
        kernelspec={"name": "python3", "display_name": "Python 3", "language": "python"},
        language_info={"name": "python", "pygments_lexer": "ipython3"},
    )
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number:02d}"
        cell.metadata = NotebookNode()
        for output in cell.get("outputs", []):
            if output.output_type in ("display_data", "execute_result"):
                output.metadata = NotebookNode()
                if "<iframe" in output.data.get("text/html", ""):
                    output.data["text/plain"] = "<View>"  # its address is that of a server that is gone
                if "image/png" in output.data:
                    picture = base64.b64encode(small(base64.b64decode(output.data["image/png"]))).decode()
                    output.data = NotebookNode({"image/png": picture, "text/plain": "<Figure>"})
    return notebook


def small(png: bytes, widest_px: int = MOST_PIXELS) -> bytes:
    """A picture with a palette of its own: less than half the size, and the same to the eye."""
    result = io.BytesIO()
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.thumbnail((widest_px, widest_px), Image.Resampling.LANCZOS)
    # Maximum coverage keeps small spots of a colour that is rare, such as a star on a map; means keep large areas.
    picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE).save(
        result, "png", optimize=True
    )
    return result.getvalue()


def pictures(notebook: NotebookNode) -> list[bytes]:
    """Its pictures as PNG files."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [base64.b64decode(o.data["image/png"]) for o in outputs if "image/png" in o.get("data", {})]


def picture_files(path: Path, notebook: NotebookNode) -> dict[Path, bytes]:
    """Files of the pages with pictures of a notebook."""
    all_of_it, name = pictures(notebook), path.stem
    files = {f"notebook-{name}.png": SHOWN[name]} if name in SHOWN else {}
    files |= dict([ON_PAGES[name]]) if name in ON_PAGES else {}
    return {DOCS / file: all_of_it[number] for file, number in files.items()}


def without_views(notebook: NotebookNode) -> NotebookNode:
    """The notebook without the pages of the viewer, which show in a browser whoever reads it."""
    copy = deepcopy(notebook)
    for cell in copy.cells:
        for output in cell.get("outputs", []):
            if "<iframe" in output.get("data", {}).get("text/html", ""):
                output.data = NotebookNode({"text/plain": "View"})
    return copy


def views(notebook: NotebookNode) -> int:
    """How many pages of the viewer it keeps."""
    return nbformat.writes(notebook).count("<iframe srcdoc=")


def texts(notebook: NotebookNode) -> str:
    """All that the notebook's cells print or display as text."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "\n".join(o.get("text", "") + o.get("data", {}).get("text/markdown", "") for o in outputs)
