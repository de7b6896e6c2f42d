"""The browser without a window: nothing of it is left."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from magloc.viewer.chromium import BINARIES, BrowserError, Chromium

# A browser that ends at once, but whose child writes into its folder for seconds if nobody ends it.
BROWSER = """#!/bin/sh
for word; do case "$word" in --user-data-dir=*) folder="${word#*=}";; esac; done
(i=0; while [ $i -lt 3000 ]; do mkdir -p "$folder/$i/deep"; echo "$i" > "$folder/$i/deep/file"; i=$((i + 1)); done) &
exit 1
"""


@pytest.mark.skipif(os.name != "posix", reason="needs groups of processes")
def test_children_that_outlive_it_leave_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (programs := tmp_path / "programs").mkdir()
    (temporary := tmp_path / "temporary").mkdir()
    (programs / BINARIES[0]).write_text(BROWSER, encoding="utf-8")
    (programs / BINARIES[0]).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    with pytest.raises(BrowserError, match="ended at once"):
        Chromium("about:blank")
    assert list(temporary.iterdir()) == []
