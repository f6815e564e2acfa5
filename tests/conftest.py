"""Shared fixtures: real data where it is present."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("THERMORENDER_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory):
    """Keep the tests' traced light out of the user's own cache."""
    before = os.environ.get("THERMORENDER_CACHE")
    os.environ["THERMORENDER_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    os.environ.pop("THERMORENDER_CACHE")
    if before is not None:
        os.environ["THERMORENDER_CACHE"] = before


def shared_data(path):
    """Path of a file of the real data sets, or a skip that says where it was looked for."""
    found = DATA / path
    if not found.exists():
        pytest.skip(f"real data not present: {found} (set THERMORENDER_DATA to the folder that holds it)")
    return found
