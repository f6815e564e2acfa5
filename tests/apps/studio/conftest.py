"""Fixtures of the studio: a browser, a tiny scene, its studio, and a tab that leaves no edit behind."""

import numpy as np
import pytest
from studio_support import ARGUMENTS, CHROMIUM, Page, served

from scenes import write_terrain


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("needs Chromium (Debian: chromium)")
    try:
        import nicegui  # noqa: F401
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        pytest.skip(f"needs playwright and thermorender[studio] ({error})")
    with sync_playwright() as started:
        made = started.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield made
        made.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    rows, columns = np.mgrid[:32, :32]
    classes = np.where(columns < 16, 1, 2)
    return write_terrain(
        tmp_path_factory.mktemp("studio") / "tiny", classes=classes, temperature=290.0 + 0.2 * (rows + columns)
    )


@pytest.fixture(scope="module")
def address(folder, browser):
    with served(folder) as found:
        yield found


@pytest.fixture
def page(browser, address):
    made = Page(browser, address)
    yield made
    made.end()
