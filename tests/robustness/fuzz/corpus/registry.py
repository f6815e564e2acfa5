"""The definition of a reader under test, and the list of all of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes
    ----------
    file : str
        Name of its input file in a folder.
    make : callable
        Folder → None; writes that file, undamaged, and the files it needs beside it.
    read : callable
        Path → the content, of which all numbers must be finite.
    """

    file: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]


READERS: dict[str, Reader] = {}


def reader(name, file, source):
    """Register a reader: `source` is a function of the path that writes the file, its text, or a shipped file."""

    def register(read):
        def make(folder):
            path = folder / file
            path.parent.mkdir(exist_ok=True)
            if callable(source):
                source(path)
            else:
                path.write_bytes(source.read_bytes() if hasattr(source, "read_bytes") else source.encode())

        READERS[name] = Reader(file, make, read)
        return read

    return register
