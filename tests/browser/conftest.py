"""One browser for all tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from arrays.io.errors import InputError
from magloc.viewer.chromium import find_chromium
from tests.browser.browser import Browser
from tests.browser.screen import Screen
from tests.conftest import REPOSITORY

ARTEFACTS = REPOSITORY / ".artefacts" / "browser"
# Software draws each pixel of every frame, beside the other tests.
SIZE = (960, 600)


@pytest.fixture(scope="package")
def screen() -> Iterator[Screen]:
    """Closed after this folder: its connection draws from `random` in a thread, which hypothesis elsewhere refuses."""
    try:
        find_chromium()
    except InputError:
        pytest.skip("needs Chromium or Chrome on the PATH: on Debian and Ubuntu, apt-get install chromium")
    with Browser("about:blank", SIZE) as browser:
        yield Screen(browser, ARTEFACTS)
