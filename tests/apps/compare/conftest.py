"""Fixtures of comparisons."""

import numpy as np
import pytest
from compare_support import structured

from scenes import write_terrain


@pytest.fixture(scope="session")
def ground(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ground") / "ground"
    classes = np.ones((64, 64), int)
    classes[:, 40:] = 2
    return write_terrain(folder, height=np.zeros((32, 32)), temperature=structured(), classes=classes)
