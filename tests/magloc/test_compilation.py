"""Where compiled code cannot be kept, or what was kept is damaged, it is compiled anew, and that is said once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import WAIT_S

MODULE = """
from magloc.compilation import compiled

@compiled
def twice(x):
    return 2.0 * x

@compiled
def thrice(x):
    return twice(x) + x
"""
CALL = """
import logging, sys
{before}
logging.basicConfig(format="%(message)s")
import kernels
print(kernels.thrice(2.0), sum(kernels.thrice.stats.cache_hits.values()))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "kernels.py").write_text(MODULE)
    return tmp_path


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a module that was compiled there."""
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "kernels.py").write_text(MODULE)
    assert call(folder) == ("6.0 0", "")
    return folder


@pytest.fixture
def kept(compiled_once: Path, tmp_path: Path) -> Path:
    """A copy of it for one test, which counts as kept as well."""
    return Path(shutil.copytree(compiled_once, tmp_path / "kept"))


def call(folder: Path, before: str = "", **environment: str) -> tuple[str, str]:
    """What a process of its own prints: a result, and whether it found what was compiled on disk."""
    repository = str(Path(__file__).parents[2])
    changed = {**os.environ, "PYTHONPATH": repository, **environment}
    command = [sys.executable, "-c", CALL.format(before=before)]
    done = subprocess.run(command, cwd=folder, env=changed, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


@pytest.mark.slow
def test_kept(kept: Path) -> None:
    assert call(kept) == ("6.0 1", "")


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("ending", "share"),
    [
        ("nbi", 0.0),
        ("nbc", 0.5),
        *(pytest.param(*other, marks=pytest.mark.slow) for other in [("nbi", 0.5), ("nbc", 0.0)]),
    ],
)
def test_cut_short(kept: Path, ending: str, share: float) -> None:
    for path in (kept / "__pycache__").glob(f"*.{ending}"):
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert call(kept) == ("6.0 0", "")
    assert call(kept) == ("6.0 1", "")


def test_nowhere_to_keep_it(folder: Path) -> None:
    """As where package and home are read only; a folder for this process alone, which it removes."""
    (folder / "tmp").mkdir()
    before = "from numba.core import caching as c; c.CacheImpl._locator_classes = c.CacheImpl._locator_classes[:1]"
    out, err = call(folder, before, TMPDIR=str(folder / "tmp"))
    assert out == "6.0 0"
    (line,) = err.splitlines()
    assert line.startswith("compiled code cannot be kept for the next run (neither beside the package nor")
    assert not list((folder / "tmp").iterdir())


def test_full_disk(folder: Path) -> None:
    before = """
from numba.core import caching
def full(*_):
    raise OSError(28, "No space left on device")
caching.IndexDataCacheFile.save = full"""
    out, err = call(folder, before)
    assert out == "6.0 0"
    place = folder / "__pycache__"
    assert err == f"compiled code cannot be kept for the next run ({place}: No space left on device)\n"
