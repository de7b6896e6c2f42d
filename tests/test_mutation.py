"""What the mutation script changes, and by which tests it lets that be seen."""

from __future__ import annotations

import ast
import itertools
from pathlib import Path

import pytest

from tests.mutation import (
    HANGS,
    LONGEST_S,
    REPOSITORY,
    UNTESTED,
    Laboratory,
    Mutant,
    Reach,
    StoppedError,
    drawn,
    mutants,
)

SOURCE = '''"""Words of 3 lines."""
import a.b

def function(x: int | None, n_of: int = 5) -> "float | None":
    """Not 1 < 2."""
    if n_of < 3:
        raise ValueError(f"Input {1 + 2} µT")
    return call(x, -1.5)
'''


def test_all_changes_of_a_small_file() -> None:
    found = {(one.line, one.kind, one.text) for one in mutants("file.py", SOURCE.encode())}
    assert found == {
        (4, "constant", "6"),  # a default; neither the types nor the words
        (6, "comparison", "(n_of >= 3)"),
        (6, "edge", "(n_of <= 3)"),
        (6, "constant", "4"),
        (7, "statement", "pass"),
        (8, "arguments", "(call(-1.5, x))"),
        (8, "sign", "(1.5)"),
        (8, "constant", "1.5150000000000001"),
    }


@pytest.mark.parametrize(
    ("code", "changes"),
    [
        ("x = 3.0", {("constant", "30.0")}),  # a choice
        ("y = 3.0 + x", {("operator", "(3.0 - x)"), ("constant", "3.0300000000000002")}),  # a factor
        (
            "abs(y - 1e-9)",
            {("statement", "pass"), ("call", "(y - 1e-09)"), ("operator", "(y + 1e-09)"), ("constant", "1e-08")},
        ),
        ("y = a[i]", {("index", "i - 1")}),
        ("y = a[key]", set()),
        ("y = float(x)", set()),
        ("if x:\n    return y", {("condition", "(not x)"), ("return", "pass")}),
        ("ax.plot(x, lw=1.5, color=c)", {("statement", "pass")}),
        ("_LOG.info(1 + 2)", set()),
        ("class A(B, kw_only=True):\n    pass", set()),
        ("def __repr__(self):\n    return 1", set()),
        ("zip(x, y, strict=True)", {("statement", "pass"), ("arguments", "(zip(y, x, strict=True))")}),
    ],
)
def test_changes_of_a_line(code: str, changes: set[tuple[str, str]]) -> None:
    assert {(one.kind, one.text) for one in mutants("file.py", code.encode())} == changes


class TestVerdict:
    """In a tree of two files."""

    CODE = "def double(x):\n    return 2 * x\n"
    TESTS = "from code_ import double\ndef test_it():\n    assert double(1) == 2\n"

    def laboratory(self, folder: Path, tests: str) -> Laboratory:
        unchanged = folder / "unchanged"
        unchanged.mkdir()
        (unchanged / "code_.py").write_text(self.CODE, encoding="utf-8", newline="\n")
        (unchanged / "test_code.py").write_text(tests, encoding="utf-8", newline="\n")
        reach = object.__new__(Reach)
        reach.tests = lambda path: ["test_code.py"]
        return Laboratory(folder / "changed", unchanged, reach, {})

    @pytest.mark.parametrize(
        ("tests", "verdict"),
        [
            (TESTS, "test_code.py::test_it"),
            (TESTS.replace("double(1) == 2", "double(0) == 0"), ""),
            (TESTS.replace("== 2", "== 4"), UNTESTED),  # which fails anyway
            (TESTS.replace("def test_it", "assert double(1) == 2\ndef test_it"), "test_code.py"),  # before any test
        ],
    )
    def test_is_that_of_the_tests(
        self, tests: str, verdict: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
        laboratory = self.laboratory(tmp_path, tests)
        change = next(one for one in mutants("code_.py", self.CODE.encode()) if one.kind == "constant")
        assert laboratory.verdict(change, 6, 60.0) == verdict
        assert (laboratory.root / "code_.py").read_text(encoding="utf-8") == self.CODE

    @pytest.mark.parametrize(("also_unchanged", "verdict"), [("", f"test_code.py: {HANGS}"), (HANGS, UNTESTED)])
    def test_is_a_hang_if_the_tests_alone_do_not(
        self, also_unchanged: str, verdict: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        laboratory = self.laboratory(tmp_path, self.TESTS)
        clock = itertools.count(0.0, LONGEST_S if also_unchanged else 1.0)
        monkeypatch.setattr("tests.mutation.time.monotonic", lambda: next(clock))
        outcomes = {laboratory.root: f"test_code.py: {HANGS}", laboratory.unchanged: also_unchanged}
        monkeypatch.setattr(laboratory, "_run", lambda root, *_: outcomes[root])
        assert laboratory.verdict(Mutant("code_.py", 2, "constant", 26, 27, "3"), 6, 180.0) == verdict

    def test_is_none_of_tests_that_are_ended(self, tmp_path: Path) -> None:
        laboratory = self.laboratory(tmp_path, self.TESTS)
        laboratory.stop()
        with pytest.raises(StoppedError):
            laboratory.verdict(Mutant("code_.py", 2, "constant", 26, 27, "3"), 6, 60.0)


@pytest.mark.slow
def test_a_change_is_one_that_can_be_read_and_differs() -> None:
    chosen = drawn(100, 0, ("arrays", "sims"))
    assert len({(one.path, one.line) for one in chosen}) == 100
    for one in chosen:
        source = (REPOSITORY / one.path).read_bytes()
        assert ast.dump(ast.parse(one.applied(source))) != ast.dump(ast.parse(source))
        assert one.diff(source)


@pytest.mark.slow
def test_the_mirror_comes_first() -> None:
    reach = Reach()
    assert reach.tests("magloc/state_space.py")[0] == "tests/magloc/test_state_space.py"
    assert reach.tests("adcs/kalman/mekf.py")[0] == "tests/adcs/kalman/test_mekf.py"
    assert "tests/magloc/test_state_space.py" not in reach.tests("adcs/kalman/mekf.py")
