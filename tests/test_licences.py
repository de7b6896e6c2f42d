"""What an installation without extras is under."""

from __future__ import annotations

import pytest

from tests.licences import COPYLEFT, copyleft, required
from tests.test_packaging import PROJECT, declared


def test_the_base_has_no_copyleft() -> None:
    base = required({name.lower() for name in declared(PROJECT["dependencies"])})
    assert {"numpy", "pycparser", "rich"} <= base  # its own needs, and theirs
    assert copyleft(base) == []


@pytest.mark.parametrize(
    ("text", "is_copyleft"),
    [
        ("GPL-3.0-only", True),
        ("LGPLv2+", True),
        ("AGPL-3.0", True),
        ("GNU General Public License v3 (GPLv3)", True),
        ("GNU Lesser General Public License v3", True),
        ("MPL-2.0 AND MIT", False),  # file by file
        ("BSD-3-Clause", False),
    ],
)
def test_copyleft_is_known_by_its_names(text: str, is_copyleft: bool) -> None:
    assert bool(COPYLEFT.search(text)) is is_copyleft
