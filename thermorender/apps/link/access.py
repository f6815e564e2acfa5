"""Access to a server: the address it listens on, and a token in a file that only its owner can read."""

import os
import platform
import re
import secrets
import socket
from contextlib import suppress
from os import PathLike
from pathlib import Path

from thermorender.apps.link.wire import TOKEN_BYTES
from thermorender.cache import cache_folder
from thermorender.errors import ThermorenderError


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address of this machine; port 0 chooses a free one."""
    if not host:
        raise ThermorenderError("host is empty; give 0.0.0.0 for all addresses of this machine, or leave it out")
    try:
        host.encode("idna")  # of a name that cannot be one, an open socket would be left
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=256)
    except (OSError, UnicodeError) as error:
        why = str(getattr(error, "strerror", "not a name of a machine")).partition(" (")[0]
        raise ThermorenderError(
            f"address {host} port {port} cannot be listened on ({why}); give an "
            "address of this machine as host, another port, or stop the server that uses it"
        ) from None


def token_file(address: str, port: int) -> Path:
    """Return where this machine's server at an address, in digits, and port keeps its token, unless given another file.

    Machines may share the cache folder, so that their names belong to the file's.
    """
    name = re.sub("[^A-Za-z0-9.-]", "_", f"{platform.node()}-{address}-{port}")
    return cache_folder("link") / f"{name}.token"


def found_token_file(address: str, port: int) -> Path:
    """Return the token file of this machine's server that a client has reached at an address.

    It is that of the address, or of a server that listens on all addresses, whichever is newer.
    """
    files = [token_file(each, port) for each in (address, "::" if ":" in address else "0.0.0.0")]
    return max((each for each in files if each.is_file()), key=lambda each: each.stat().st_mtime_ns, default=files[0])


def new_token(path: str | PathLike[str]) -> str:
    """Return a new token, written to a file of mode 0600."""
    path, token = Path(path), secrets.token_hex(TOKEN_BYTES // 2)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        # Created with its final mode, so that no other user can open it in between.
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(token + "\n")
        os.replace(part, path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise ThermorenderError(
            f"token file {path} cannot be written ({error.strerror}); give a file in a folder of yours"
        ) from None
    return token


def drop_token(path: str | PathLike[str], token: str) -> None:
    """Remove a token's file, unless it holds the token of another server by now."""
    with suppress(OSError, ThermorenderError):
        if read_token(path) == token:
            Path(path).unlink()


def read_token(path: str | PathLike[str]) -> str:
    """Return the token of a file."""
    try:
        with open(path, "rb") as file:
            text = file.read(TOKEN_BYTES + 2).decode("ascii", "replace").strip()
    except OSError as error:
        raise ThermorenderError(
            f"token file {path} cannot be read ({error.strerror}); start `thermorender serve SCENE`, or give the file "
            "that the server printed"
        ) from None
    return checked_token(text, f"token file {path}")


def checked_token(text: str, where: str = "token") -> str:
    """Return a token; raise unless it has the form of one."""
    if not isinstance(text, str) or not re.fullmatch(rf"[0-9a-f]{{{TOKEN_BYTES}}}", text):
        raise ThermorenderError(f"{where} does not hold {TOKEN_BYTES} hexadecimal digits; copy the server's token file")
    return text
