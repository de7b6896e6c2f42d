"""Picture of the page's tables: ``python -m tests.proof.picture FILE``.

Errors of all tools over ours, and NEES of those that state σ.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from tests.notebooks import small
from tests.proof import COLUMNS, PAGE, block, is_ours, rows_of, value_of
from tests.proof.parts import PARTS

LIMITS = (0.2, 50.0)
NEES_LIMITS = (0.05, 100.0)


def figure_of(page: str) -> Figure:
    """Return the median error of each tool over that of our first row, and the NEES of each, on logarithmic axes."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    labels: list[str] = []
    for part in PARTS:
        rows = rows_of(block(page, part.name))
        for case in dict.fromkeys(row[0] for row in rows):
            of_case = [row for row in rows if row[0] == case]
            first = next((value_of(row[COLUMNS.index("median")]) for row in of_case if is_ours(row)), None)
            if first is None:
                continue
            labels.append(f"{part.name}: {case}")
            for row in of_case:
                marker, color = ("o", "C0") if is_ours(row) else ("D", "C1")
                style = {"marker": marker, "color": color, "alpha": 0.7, "linestyle": "none", "markersize": 7}
                median, nees = (value_of(row[COLUMNS.index(name)]) for name in ("median", "NEES"))
                if median is not None:
                    ratio = np.clip(median / first, *LIMITS) if np.isfinite(median) else LIMITS[1]
                    left.plot(ratio, len(labels) - 1, **({**style, "marker": ">"} if ratio == LIMITS[1] else style))
                if nees is not None:
                    right.plot(np.clip(nees, *NEES_LIMITS), len(labels) - 1, **style)
    left.set_yticks(range(len(labels)), labels)
    left.invert_yaxis()
    left.set(xscale="log", xlim=(LIMITS[0], 1.1 * LIMITS[1]), xlabel="median error over that of our first row")
    right.set(xscale="log", xlim=NEES_LIMITS, xlabel="NEES per dimension: 1 is honest, more is too sure")
    for axes in (left, right):
        axes.axvline(1.0, color="0.4", linewidth=0.8)
        axes.grid(axis="y", linewidth=0.4)
    left.plot([], [], "o", color="C0", label="magloc, adcs")
    left.plot([], [], "D", color="C1", label="other tools")
    left.plot([], [], ">", color="C1", label=f"beyond {LIMITS[1]:g}, or no answer")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def draw(page: str, path: Path) -> None:
    """Write the picture of the page's tables."""
    written = io.BytesIO()
    figure_of(page).savefig(written, dpi=130)
    path.write_bytes(small(written.getvalue()))


if __name__ == "__main__":
    draw(PAGE.read_text(encoding="utf-8"), Path(sys.argv[1]))
