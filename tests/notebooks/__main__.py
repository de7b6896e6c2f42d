"""``python -m tests.notebooks [NAME…]``: execute the notebooks, write them back, and the gallery's pictures of them."""

from __future__ import annotations

import sys
import time
import nbformat
from tests.notebooks import DOCS, FOLDER, NOTEBOOKS, SHOWN, executed, kept, pictures


def main(names: list[str]) -> None:
    """Execute the notebooks whose file name contains one of the names; all without names."""
    for path in (p for p in NOTEBOOKS if not names or any(name in p.name for name in names)):
        start = time.perf_counter()
        notebook = kept(executed(path, FOLDER))
        nbformat.write(notebook, path)
        if path.stem in SHOWN:
            (DOCS / f"notebook-{path.stem}.png").write_bytes(pictures(notebook)[SHOWN[path.stem]])
        print(f"{path.name}: {time.perf_counter() - start:.1f} s, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
