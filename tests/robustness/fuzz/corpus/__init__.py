"""A small undamaged file for each reader of the package, and the reader: the basis of damaged files."""

from tests.robustness.fuzz.corpus import arrays, images, kept, meshes, settings, surveys, tables  # noqa: F401
from tests.robustness.fuzz.corpus.registry import READERS, Reader

__all__ = ["READERS", "Reader"]
