"""Where compiled code cannot be kept, or what was kept is damaged, it is compiled anew, and that is said once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from magloc import compilation
from tests.waiting import WAIT_S

MODULE = """
from magloc.compilation import compiled, inlined_sum, internal

@compiled
def twice(x):
    return 2.0 * x

@compiled
def thrice(x):
    return twice(x) + x

@internal
def term(x, i):
    return x[i]

@inlined_sum
def total(x):
    sum_ = 0.0
    for i in range(len(x)):
        sum_ += term(x, i)
    return sum_

@internal
def root(x):
    if total(x) < 0.0:
        raise ValueError(f"of {len(x)} numbers")
    return total(x) ** 0.5

@compiled
def norm(x):
    return root(x * x)

@compiled
def norm_of_sum(x):
    return root(x)
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


def call(folder: Path, before: str = "", script: str = CALL, **environment: str) -> tuple[str, str]:
    """What a process of its own prints: a result, and whether it found what was compiled on disk."""
    repository = str(Path(__file__).parents[2])
    changed = {**os.environ, "PYTHONPATH": repository, **environment}
    command = [sys.executable, "-c", script.format(before=before)]
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


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("name", "was", "becomes"),
    [
        ("others", "1.0 * x", "10.0 * x"),
        ("constants", "NUMBER = 2.0", "NUMBER = 20.0"),
        ("constants", "TUPLE = (1.0,)", "TUPLE = (10.0,)"),
        ("constants", "array([1.0])", "array([10.0])"),
    ],
)
def test_what_a_kernel_is_made_of_has_changed(name: str, was: str, becomes: str, tmp_path: Path) -> None:
    """In a file of its own, at which numba does not look."""
    kernels = MODULE.replace("    return 2.0 * x", "    return other(x) * NUMBER * TUPLE[0] * ARRAY[0]")
    (tmp_path / "kernels.py").write_text(f"from constants import *\nfrom others import other\n{kernels}")
    constants = "import numpy\nNUMBER = 2.0\nTUPLE = (1.0,)\nARRAY = numpy.array([1.0])\n"
    (tmp_path / "constants.py").write_text(constants)
    (tmp_path / "others.py").write_text(MODULE.split("@compiled")[0] + "@compiled\ndef other(x):\n    return 1.0 * x\n")
    assert call(tmp_path) == ("6.0 0", "")
    assert call(tmp_path) == ("6.0 1", "")
    changed = tmp_path / f"{name}.py"
    changed.write_text(changed.read_text().replace(was, becomes))
    assert call(tmp_path) == ("42.0 0", "")


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


INTERNAL = """
{before}
import numpy as np, kernels
print(kernels.norm(np.array([3.0, 4.0])), sum(kernels.root.stats.cache_hits.values()))
try:
    kernels.norm_of_sum(np.array([1.0, -2.0]))
except ValueError as error:
    print(error)
"""
AS_NUMBA_DOES = "from magloc.compilation import compiler; compiler.CAN_LINK_ONLY = False"


class TestInternal:
    """Functions that only kernels call; what they need of Python they find inside the kernel."""

    def files(self, folder: Path, name: str) -> list[Path]:
        return sorted((folder / "__pycache__").glob(f"{name}-*.nb?"))

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("before", ["", AS_NUMBA_DOES])
    def test_linked_from_memory_and_from_disk(self, folder: Path, before: str) -> None:
        out = "5.0 {}\nof 2 numbers"
        assert call(folder, before, INTERNAL) == (out.format(0), "")
        kept = self.files(folder, "internal-kernels.root")
        assert len(kept) == (0 if before else 2)
        assert call(folder, before, INTERNAL) == (out.format(0), "")  # the kernel is read, and all in it
        for n_read, names in ((1, ["kernels.norm"]), (0, ["kernels.norm", "kernels.norm_of_sum", "*kernels.root"])):
            for name in names:
                for path in self.files(folder, name):
                    path.unlink()
            assert call(folder, before, INTERNAL) == (out.format(n_read), "")
            assert self.files(folder, "internal-kernels.root") == kept

    def test_is_no_machine_code(self, folder: Path) -> None:
        script = """
import numpy as np, kernels
kernels.norm(np.ones(2))
for kernel in (kernels.total, kernels.root, kernels.norm):
    (made,) = kernel.overloads.values()
    print(made.library.get_pointer_to_function(made.fndesc.llvm_func_name) != 0)
"""
        assert call(folder, script=script)[0].split() == ["False", "False", "True"]


TYPES = """
import operator
from itertools import product
from numba import types
from numba.core.registry import cpu_target
from magloc.compilation import compiler

NUMBERS = [getattr(types, name) for name in "boolean int8 uint8 int32 int64 uint64 float32 float64 complex128".split()]
NUMBERS += [types.literal(2), types.literal(True), types.Optional(types.float64)]
ARRAYS = [kind(dtype, n, "C") for kind in [types.Array] for dtype in NUMBERS[4:9] for n in (1, 2)]
ARRAYS += [types.Array(types.float64, 2, "A", readonly=True), types.UniTuple(types.float64, 3)]
INDICES = [types.int64, types.uint8, types.literal(1), types.boolean, types.slice2_type, types.none, types.float64]
INDICES += [types.UniTuple(types.int64, 2), types.Tuple((types.slice2_type, types.literal(0)))]
INDICES += [types.Array(types.int64, 1, "C")]
typing = cpu_target.typing_context

def all_types():
    typing.refresh()
    pairs = list(product(NUMBERS + ARRAYS[:2], repeat=2))
    cases = list(product(compiler._OF_NUMBERS, pairs))
    cases += [(operator.neg, (kind,)) for kind in NUMBERS]
    cases += [(operator.getitem, pair) for pair in product(ARRAYS, INDICES)]
    cases += [(operator.setitem, case) for case in product(ARRAYS, INDICES, NUMBERS)]
    found = {{}}
    for operation, arguments in cases:
        try:
            found[operation, arguments] = typing.resolve_function_type(operation, arguments, {{}})
        except Exception as error:
            found[operation, arguments] = type(error)
    return found

before = all_types()
compiler._register()
after = all_types()
print(sum(isinstance(kind, type) for kind in before.values()) < len(before) / 2, len(before) > 1000)
print([(case, before[case], after[case]) for case in before if before[case] != after[case]])
"""


@pytest.mark.slow
def test_types_are_those_that_numba_finds(folder: Path) -> None:
    assert call(folder, script=TYPES) == ("True True\n[]", "")


class TestOverRows:
    """Rows are shared out among threads, each of them once; few rows of a quick kernel are not worth a thread."""

    @pytest.mark.parametrize(
        ("n_rows", "rows_a_thread", "n_parts"),
        [(1, 1, 1), (3, 1, 3), (100, 1, 16), (100, 50, 8), (100, 51, 1), (199, 100, 1), (200, 100, 8)],
    )
    def test_parts(self, n_rows: int, rows_a_thread: int, n_parts: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(compilation, "get_num_threads", lambda: 4)
        count, parts = np.zeros(n_rows, dtype=int), []

        def kernel(begin: int, end: int, step: int) -> None:
            count[begin:end] += step
            parts.append((begin, end))

        compilation.over_rows(kernel, n_rows, 1, rows_a_thread=rows_a_thread)
        np.testing.assert_array_equal(count, 1)
        assert len(parts) == n_parts
