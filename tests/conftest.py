"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of recordings: the one that MAGLOC_DATA names, else ``../shared/data`` beside the repository."""
    named = os.environ.get("MAGLOC_DATA")
    beside = REPOSITORY.parent / "shared" / "data"
    for folder in (Path(named) if named else beside, beside):
        if folder.is_dir():
            return folder
    pytest.skip("needs recordings, but neither MAGLOC_DATA nor ../shared/data is a folder")
