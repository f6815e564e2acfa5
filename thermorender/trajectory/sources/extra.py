"""Binary files and the libraries of the extra `logs` that read them."""

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any

from thermorender.errors import ThermorenderError


def library(name: str, what: str) -> Any:
    """Return a module of the extra `logs`."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ThermorenderError(
            f"{what} needs {name.partition('.')[0]}, which is not installed; run pip install 'thermorender[logs]'"
        ) from error


@contextmanager
def said_by_library() -> Iterator[io.StringIO]:
    """Yield the text that a library prints about damaged files, in place of the terminal."""
    text = io.StringIO()
    with redirect_stdout(text), redirect_stderr(text):
        yield text


def check_file(path: str, begins: bytes, what: str) -> None:
    """Raise if a file cannot be read or does not begin with these bytes."""
    try:
        with Path(path).open("rb") as file:
            start = file.read(len(begins))
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give {what}") from error
    if start != begins:
        raise ThermorenderError(f"{path} is not {what}: it begins with {start!r}, not {begins!r}; check format")
