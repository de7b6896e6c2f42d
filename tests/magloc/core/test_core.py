"""The library of kernels: what it exports and needs, how problems are described, and threads over blocks."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from magloc import core
from tests.waiting import WAIT_S

HERE = Path(core.__file__).parent
HEADER = (HERE / "include" / "magloc.h").read_text(encoding="utf-8")
KERNELS = set(re.findall(r"int64_t (magloc_\w+)\(const", HEADER))


def symbols(*options: str) -> list[tuple[str, str]]:
    """Kind and name of the symbols of the library, as nm lists them."""
    if not (nm := shutil.which("nm")):
        pytest.skip("needs nm, of binutils")
    library = next(path for path in HERE.iterdir() if path.suffix in (".so", ".dll"))
    done = subprocess.run([nm, *options, str(library)], capture_output=True, encoding="utf-8", check=True)
    return [(line.split()[-2], line.split()[-1]) for line in done.stdout.splitlines()]


@pytest.mark.skipif(sys.platform != "linux", reason="lists of symbols differ between systems")
class TestSymbols:
    def test_exports_the_functions_of_the_header_alone(self) -> None:
        exported = {name for kind, name in symbols("--dynamic", "--defined-only") if kind == "T"}
        assert exported == KERNELS | {"magloc_instruction_set", "magloc_use_instruction_set"}

    def test_needs_no_library_but_copies_of_memory(self) -> None:
        needed = {name.partition("@")[0] for kind, name in symbols("--dynamic", "--undefined-only") if kind == "U"}
        assert needed <= {"memcpy", "memset", "memmove"}

    def test_instruction_sets_never_share_a_function(self) -> None:
        """The linker merges functions of equal names, so every shared one would be code of any instruction set."""
        shared = [name for kind, name in symbols("--demangle=none") if kind in "WVu" and "magloc" in name]
        assert all(re.search("baseline|avx2|avx512", name) for name in shared)


class TestInstructionSet:
    def test_the_best_one_is_used_and_any_other_by_name(self) -> None:
        before = core.instruction_set()
        core.use_instruction_set("baseline")
        assert core.instruction_set() == "baseline"
        core.use_instruction_set(before)
        assert core.instruction_set() == before

    def test_an_unknown_one_changes_nothing(self) -> None:
        before = core.instruction_set()
        with pytest.raises(ValueError, match="'sse9' is unknown, or this machine or build does not have it"):
            core.use_instruction_set("sse9")
        assert core.instruction_set() == before


def dipoles(n: int = 3) -> dict[str, object]:
    points = np.arange(3.0 * n).reshape(n, 3) + 1.0
    source, moment = np.zeros((1, 3)), np.ones((1, 3))
    out = np.full((n, 3), np.nan)
    return {"n_points": n, "n_sources": 1, "points": points, "sources": source, "moments": moment, "out": out}


class TestProblem:
    def test_fields_must_be_those_of_the_header(self) -> None:
        with pytest.raises(TypeError, match="magloc_dipoles has the fields"):
            core.problem("dipoles", n_points=3)

    @pytest.mark.parametrize(
        "points", [np.ones((3, 3), np.float32), np.ones((3, 3), order="F")[:, ::-1], np.ones(6, np.int64)]
    )
    def test_arrays_must_have_the_type_and_order_of_the_header(self, points: np.ndarray) -> None:
        with pytest.raises(TypeError, match="points must be a C-contiguous array of float64"):
            core.problem("dipoles", **{**dipoles(), "points": points})


class TestRun:
    @pytest.mark.parametrize("n", [0, 1, 5, 64])
    @pytest.mark.parametrize("block", [1, 7, 100])
    def test_every_item_is_computed_by_any_number_of_threads(self, n: int, block: int) -> None:
        before, results = core.threads(), []
        for threads in (1, 3):
            core.set_threads(threads)
            fields = dipoles(n)
            core.run("dipole_fields", core.problem("dipoles", **fields), n, block=block)
            results.append(np.asarray(fields["out"]))
        core.set_threads(before)
        assert np.isfinite(results[0]).all()
        np.testing.assert_array_equal(*results)

    @pytest.mark.skipif(sys.platform == "win32", reason="signals to a thread")
    @pytest.mark.parametrize("threads", [1, 2])
    def test_ctrl_c_ends_it_between_blocks(self, threads: int) -> None:
        code = f"""
import signal, threading
import numpy as np
from magloc import core
from tests.waiting import WAIT_S
n, k = 1_000_000, 100_000  # half an hour
points, sources, out = np.ones((n, 3)), np.zeros((k, 3)), np.empty((n, 3))
work = core.problem("dipoles", n_points=n, n_sources=k, points=points, sources=sources, moments=sources, out=out)
core.set_threads({threads})
main = threading.get_ident()
threading.Timer(0.3, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
try:
    core.run("dipole_fields", work, n, block=50)
except KeyboardInterrupt:
    print("interrupted")
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", timeout=WAIT_S)
        assert done.stdout == "interrupted\n", done.stderr


class TestHeaders:
    def test_are_installed(self) -> None:
        assert {"magloc.h", "magloc/dipole.hpp", "magloc/numbers.hpp", "adcs/mekf.hpp"} <= {
            path.relative_to(core.include_dir()).as_posix() for path in core.include_dir().rglob("*") if path.is_file()
        }

    def test_the_list_of_kernels_is_that_of_the_header(self) -> None:
        listed = re.findall(r"X\((\w+), \w+\)", (core.include_dir() / "magloc" / "kernel.hpp").read_text())
        assert {f"magloc_{name}" for name in listed if name != "kernel"} == KERNELS


class TestEnvironment:
    @pytest.mark.parametrize(
        ("variable", "value", "expected"),
        [("MAGLOC_ISA", "sse9", "baseline, avx2 or avx512"), ("MAGLOC_NUM_THREADS", "two", "a number above 0")],
    )
    def test_a_wrong_value_is_named_in_one_sentence(self, variable: str, value: str, expected: str) -> None:
        code = "import sys; from magloc.cli.__main__ import main; sys.exit(main())"
        command = [sys.executable, "-c", code, "map", "--grid", "3"]
        environment = {**os.environ, variable: value}
        done = subprocess.run(command, capture_output=True, encoding="utf-8", env=environment, timeout=WAIT_S)
        assert done.returncode == 2
        assert f"Environment variable {variable}: found {value!r}, expected {expected}" in done.stderr
        assert done.stderr.count("\n") == 1
