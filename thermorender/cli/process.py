"""How a command line runs: signals, errors as one sentence, and exit status."""

import signal
import sys

import typer

from thermorender.errors import ThermorenderError

# What typer raises for a wrong command line: its own copy of click's exception, or click's, by version.
UsageError = typer.BadParameter.__base__


def run(app, without_arguments=("--help",)):
    """Run an application of typer and exit: a user's mistake is one sentence and status 2; a stop cleans up first.

    Parameters
    ----------
    app : typer.Typer
    without_arguments : sequence of str
        Arguments that an empty command line stands for.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    odd = next((text for text in arguments if not _is_unicode(text)), None)
    if odd is not None:
        # OpenCV ends the process with such a name, and GDAL takes none.
        _fail(f"{ascii(odd)} is not valid Unicode; rename the file or folder, or set LANG to a locale of UTF-8")
    try:
        status = app(args=arguments or list(without_arguments), standalone_mode=False)
    except UsageError as error:
        command = error.ctx.command_path if error.ctx else "thermorender"
        _fail(f"{error.format_message().rstrip('.')}; `{command} --help` tells what is allowed")
    except (ThermorenderError, OSError, MemoryError) as error:
        if "--debug" in sys.argv[1:]:
            raise
        _fail(_sentence(error))
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    if status == 130:
        typer.echo("stopped; flights, data sets and trainings go on with --resume", err=True)
    raise SystemExit(status or 0)


def _is_unicode(text):
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


def _sentence(error):
    """What is told of an error; one of the system that nothing below has put into words names no mend by itself."""
    if isinstance(error, OSError) and error.strerror:
        what = error.filename or "the current folder or what is printed to"
        return f"{what} cannot be used: {error.strerror}; check that it is there, its permissions and the disk"
    return str(error) or "the memory of this machine is not enough"


def _fail(message):
    typer.echo(f"error: {' '.join(message.split())}", err=True)
    raise SystemExit(2) from None
