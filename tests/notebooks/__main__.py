"""``python -m tests.notebooks [NAME…]``: execute the notebooks, write them back, and the pages' pictures of them."""

from __future__ import annotations

import sys
import time
import nbformat
from tests.notebooks import FOLDER, NOTEBOOKS, executed, kept, picture_files


def main(names: list[str]) -> None:
    """Execute the notebooks whose file name contains one of the names; all without names."""
    for path in (p for p in NOTEBOOKS if not names or any(name in p.name for name in names)):
        start = time.perf_counter()
        notebook = kept(executed(path, FOLDER))
        nbformat.write(notebook, path)
        for file, picture in picture_files(path, notebook).items():
            file.write_bytes(picture)
        print(f"{path.name}: {time.perf_counter() - start:.1f} s, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
