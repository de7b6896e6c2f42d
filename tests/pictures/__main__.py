"""``python -m tests.pictures [NAME…]``: draw pictures of the pages anew, those whose inputs changed by default."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

from tests.pictures import DOCS, DRAWN, PICTURES, drawn, fingerprint, stale


def main(names: list[str]) -> None:
    """Draw the pictures whose file name contains one of the names, and those that changed where none is given."""
    kept = drawn()
    for name in [file for file in PICTURES if any(part in file for part in names)] if names else stale():
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            (DOCS / name).write_bytes(PICTURES[name].draw(Path(folder)))
        kept[name] = fingerprint(PICTURES[name])
        ordered = {file: kept[file] for file in PICTURES if file in kept}
        DRAWN.write_text(json.dumps(ordered, indent=2) + "\n", encoding="utf-8")
        print(f"{name}: {time.perf_counter() - start:.1f} s, {(DOCS / name).stat().st_size / 1000:.0f} kB: look at it")


if __name__ == "__main__":
    main(sys.argv[1:])
