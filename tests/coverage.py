"""``python -m tests.coverage``: shares of lines and branches that tests run, by package; 1 if they are too small."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

LEAST = {"lines": 92.0, "branches": 85.0}
COUNTS = {"lines": ("covered_lines", "num_statements"), "branches": ("covered_branches", "num_branches")}


def shares(report: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Per cent of lines and of branches of every package, and of all of them; of nothing, all is covered."""
    counts: dict[str, Counter[str]] = {"all": Counter()}
    for path, file in report["files"].items():
        package = PurePath(path).parts[0]
        for name in ("all", package):
            found = {key: file["summary"].get(key, 0) for pair in COUNTS.values() for key in pair}
            counts.setdefault(name, Counter()).update(found)
    return {
        name: {kind: 100.0 * n[some] / n[whole] if n[whole] else 100.0 for kind, (some, whole) in COUNTS.items()}
        for name, n in counts.items()
    }


def main() -> int:
    """Read what is measured, and print it."""
    command = [sys.executable, "-m", "coverage", "json", "--quiet", "-o", "-"]
    done = subprocess.run(command, stdout=subprocess.PIPE, encoding="utf-8", check=True)
    found = shares(json.loads(done.stdout))
    for name, of in found.items():
        print(f"{name:8s}{of['lines']:6.1f} % of lines{of['branches']:7.1f} % of branches")
    return int(any(found["all"][kind] < least for kind, least in LEAST.items()))


if __name__ == "__main__":
    sys.exit(main())
