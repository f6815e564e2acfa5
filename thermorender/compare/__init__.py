"""Comparisons: learned 2D translation with the render, learned maps with a data set, and frames with their cost.

The package itself can be called, since `thermorender.compare` is also the name of the public function.
"""

import sys
from types import ModuleType
from typing import Any


class _Compare(ModuleType):
    """The package, which is called as `thermorender.compare.referee.run.compare`."""

    def __call__(self, *arguments: Any, **options: Any) -> dict[str, Any]:
        from thermorender.compare.referee.run import compare

        return compare(*arguments, **options)


sys.modules[__name__].__class__ = _Compare
