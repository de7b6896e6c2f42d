"""Files that a test writes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

WriteFile = Callable[[str | bytes], Path]


def writer(name: str) -> Callable[[Path], WriteFile]:
    """Return a fixture that writes the file of a name."""

    @pytest.fixture
    def write(tmp_path: Path) -> WriteFile:
        def write_file(content: str | bytes) -> Path:
            path = tmp_path / name
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
            return path

        return write_file

    return write
