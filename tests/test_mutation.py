"""What the mutation script changes, and by which tests it lets that be seen."""

from __future__ import annotations

import ast

import pytest

from tests.mutation import PACKAGES, REPOSITORY, Reach, drawn, mutants

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
        (8, "constant", "15.0"),
    }


@pytest.mark.parametrize("seed", [0, 1])
def test_a_change_is_one_that_can_be_read_and_differs(seed: int) -> None:
    chosen = drawn(100, seed, PACKAGES)
    assert len({(one.path, one.line) for one in chosen}) == 100
    for one in chosen:
        source = (REPOSITORY / one.path).read_bytes()
        assert ast.dump(ast.parse(one.applied(source))) != ast.dump(ast.parse(source))
        assert one.diff(source)


def test_the_mirror_comes_first() -> None:
    reach = Reach()
    assert reach.tests("magloc/kalman.py")[0] == "tests/magloc/test_kalman.py"
    assert reach.tests("adcs/kalman/mekf_compiled.py")[0] == "tests/adcs/kalman/test_mekf.py"
    assert "tests/magloc/test_kalman.py" not in reach.tests("adcs/kalman/mekf_compiled.py")
