"""Points of Sobol's sequence against SciPy's."""

import numpy as np
import pytest
from scipy.stats import qmc

from thermorender.render.sobol import sobol


@pytest.mark.parametrize("dimensions", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [1, 2, 3, 16, 1000, 1 << 15])
def test_points_are_scipys(dimensions, count):
    theirs = qmc.Sobol(dimensions, scramble=False).random_base2(int(count).bit_length())[:count]
    np.testing.assert_array_equal(sobol(dimensions, count), theirs)
