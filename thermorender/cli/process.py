"""How a command line runs: signals, errors as one sentence, and exit status."""

import io
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import typer

from thermorender.errors import ThermorenderError, ThermorenderWarning

# The exception of typer for a wrong command line; depending on the version, typer's or click's.
UsageError: Any = typer.BadParameter.__base__


def run(app: typer.Typer, without_arguments: Sequence[str] = ("--help",)) -> NoReturn:
    """Run an application of typer and exit: a user's mistake is one sentence and status 2; a stop cleans up first.

    `without_arguments` stands for an empty command line.
    """
    for stream in (sys.stdout, sys.stderr):
        # A terminal without a letter such as µ shows a question mark.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    end_on_signals(lambda number, _: sys.exit(128 + number))
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    odd = next((text for text in arguments if not _is_unicode(text)), None)
    if odd is not None:
        # OpenCV aborts the process at such a name, and GDAL refuses it.
        _fail(f"{odd!a} is not valid Unicode; rename the file or folder, or set LANG to a locale of UTF-8")
    try:
        with _warnings_as_notes():
            status = app(args=arguments or list(without_arguments), standalone_mode=False)
    except UsageError as error:
        command = error.ctx.command_path if error.ctx else "thermorender"
        _fail(f"{error.format_message().rstrip('.')}; `{command} --help` lists what is allowed")
    except (ThermorenderError, OSError, MemoryError) as error:
        if "--debug" in sys.argv[1:]:
            raise
        _fail(sentence(error))
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    if status == 130:
        typer.echo(
            "stopped; flights, data sets and trainings continue with --resume, a comparison with the same command",
            err=True,
        )
    raise SystemExit(status or 0)


@contextmanager
def _warnings_as_notes() -> Iterator[None]:
    """Print the package's own warnings as notes, each text once, and others as before."""
    printed: set[str] = set()
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, ThermorenderWarning):
                # A library that changes filters makes Python forget what it showed.
                if str(message) not in printed:
                    typer.echo(f"note: {message}", err=True)
                printed.add(str(message))
            else:
                shown(message, category, *where, **more)

        warnings.showwarning = show
        yield


def end_on_signals(handler: Callable[[int, Any], Any]) -> None:
    """Call `handler` at SIGTERM and at the end of the terminal (SIGHUP), unless `nohup` has that ignored."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _is_unicode(text: str) -> bool:
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


def sentence(error: Exception) -> str:
    """The message of an error; one of the operating system gets advice."""
    if isinstance(error, OSError) and error.strerror:
        what = error.filename or "the current folder or the standard output"
        return f"{what} cannot be used: {error.strerror}; check that it is there, its permissions and the disk"
    return str(error) or "this machine does not have enough memory"


def _fail(message: str) -> NoReturn:
    typer.echo(f"error: {' '.join(message.split())}", err=True)
    raise SystemExit(2) from None
