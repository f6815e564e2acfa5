"""Atomic writes of files and folders, and checks before the work that an output can be written.

Output goes to a temporary name in the same folder and is renamed when complete. A failure or an interruption leaves
nothing behind. A killed process leaves the old file or the new one, and perhaps a temporary one. When several processes
write the same file, the last one wins. Folders have locks.
"""

import errno
import os
import re
import secrets
import shutil
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from thermorender.errors import ThermorenderError

# Longest file name that file systems allow [bytes]; letters of it that a temporary name repeats, 200 bytes at most.
_MOST_BYTES, _REPEATED = 255, 50
# The lock inside a folder in use.
_LOCK = ".lock"

PathLike = str | os.PathLike[str]


# --- atomic writes ----------------------------------------------------------------------------------------------


@contextmanager
def atomic(path: PathLike) -> Iterator[Path]:
    """Yield a temporary path with the suffix of `path`; rename it to `path` if the block ends without error.

    Missing folders are made.
    """
    path = Path(path)
    _refuse_other_than_file(path)
    with _beside(path) as part:
        yield part
        os.replace(part, path)


@contextmanager
def reported(path: PathLike) -> Iterator[None]:
    """Raise the errors of a block that writes `path` as one sentence."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        # Writers of images and videos raise RuntimeError.
        reason = getattr(error, "strerror", None) or str(error)
        raise ThermorenderError(
            f"{path} cannot be written: {reason}; check the folder, its permissions and the disk"
        ) from error


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a temporary folder; ThermorenderError where it cannot be written."""
    with reported(gettempdir()), TemporaryDirectory(prefix="thermorender-") as folder:
        yield Path(folder)


def write_aside(path: PathLike, data: bytes) -> Path:
    """Write bytes to a temporary file in the folder of `path`, which must exist, and return it for `put_in_place`."""
    part = _part(Path(path))
    try:
        with reported(path):
            part.write_bytes(data)
    except BaseException:
        _remove(part)
        raise
    return part


def put_in_place(part: Path, path: PathLike) -> None:
    """Rename a file of `write_aside` to `path`; raise ThermorenderError if that fails."""
    with reported(path):
        os.replace(part, path)


@contextmanager
def atomic_folder(path: PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder; rename it to `path`, which is empty or missing, or replaced with `overwrite`."""
    given, path = path, Path(os.path.realpath(path))
    _refuse_used_folder(given, overwrite)
    part, old, lock = (path.with_name(f".{_short(path)}.{kind}") for kind in ("part", "old", "lock"))
    with _parents(path), _locked(lock, given):
        # A process that was killed left these. Between its two renames only the old folder is whole.
        if old.exists() and not path.exists():
            os.replace(old, path)
        for left in (part, old):
            shutil.rmtree(left, ignore_errors=True)
        _refuse_used_folder(given, overwrite)
        try:
            part.mkdir()
            yield part
            _exchange(part, path, old if overwrite else None)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _exchange(part: Path, path: Path, old: Path | None) -> None:
    """Swap the folders `part` and `path`, through the name `old`; where that is None, `path` must be empty."""
    if path.exists():
        if old is None:
            path.rmdir()
        else:
            os.replace(path, old)
    try:
        os.replace(part, path)
    except BaseException:
        if old is not None and old.exists():
            os.replace(old, path)
        raise
    if old is not None and old.exists():
        os.replace(old, part)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, made if missing; remove it afterwards."""
    part = _part(path)
    with _parents(path):
        try:
            yield part
        finally:
            shutil.rmtree(part, ignore_errors=True)
            _remove(part)


def _part(path: Path) -> Path:
    """A temporary name beside `path`, which `remove_parts` knows."""
    return path.with_name(f".{path.stem[:_REPEATED]}.{secrets.token_hex(4)}.part{path.suffix}")


@contextmanager
def _parents(path: Path) -> Iterator[None]:
    """Make the folders above `path` for a block, then remove those still empty; raise OS errors as one sentence."""
    made = _missing(path.parent)
    try:
        with reported(path):
            if len(os.fsencode(path.name)) > _MOST_BYTES:
                raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
            if made:
                path.parent.mkdir(parents=True, exist_ok=True)
            yield
    finally:
        _remove_empty(made)


def _short(path: Path) -> str:
    """The beginning of a file's name with the checksum of the whole: short and unique."""
    return f"{path.name[:_REPEATED]}-{zlib.crc32(os.fsencode(path.name)):08x}"


def remove_parts(folder: Path, name: str = r".+", older_s: float = 0.0) -> None:
    """Remove the temporary files that killed processes left in a folder, and none younger than `older_s` [s].

    `name` is a regular expression of the files' names without suffix.
    """
    pattern = _part_name(name)
    for path in folder.iterdir():
        with suppress(OSError):
            if pattern.fullmatch(path.name) and time.time() - path.stat().st_mtime >= older_s:
                path.unlink()


def only_left_behind(folder: Path) -> bool:
    """Return whether all that a folder holds is the lock and the temporary files of a killed process."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return bool(names) and all(name == _LOCK or _part_name().fullmatch(name) for name in names)


def _part_name(name: str = r".+") -> re.Pattern[str]:
    """The names of temporary files of files whose names match a regular expression."""
    return re.compile(rf"\.({name})\.[0-9a-f]{{8}}\.part(\.[^.]*)?")


# --- folders for output, and checks before the work -------------------------------------------------------------


@contextmanager
def output_folder(path: PathLike) -> Iterator[Path]:
    """Yield a folder for output, made if missing; remove it again if it is still empty after the block."""
    made = _missing(path)
    try:
        yield make_folder(path)
    finally:
        _remove_empty(made)


@contextmanager
def in_use(folder: PathLike, wait: bool = False) -> Iterator[None]:
    """Lock a folder against other processes until this one ends; `wait` for another that holds the lock, or raise."""
    with _locked(Path(folder) / _LOCK, folder, wait):
        yield


@contextmanager
def _locked(path: Path, folder: PathLike, wait: bool = False) -> Iterator[None]:
    """Hold the lock of a folder, `path`, which is removed at the end."""
    from filelock import FileLock, Timeout

    lock = FileLock(path, timeout=-1 if wait else 0, thread_local=False)
    try:
        lock.acquire()
        held = os.stat(path)
    except Timeout:
        raise ThermorenderError(
            f"{folder} is being written by another process; wait until it ends, or give another folder"
        ) from None
    except OSError as error:
        raise ThermorenderError(f"{folder} cannot be locked: {error.strerror}; give another folder") from None
    try:
        yield
    finally:
        # Removed while held: a waiting process sees that it is gone and makes its own. A lock of another process, in a
        # folder that replaced this one, stays.
        with suppress(OSError):
            if os.path.samestat(held, os.stat(path)):
                path.unlink()
        lock.release()


def make_folder(path: PathLike) -> Path:
    """Create a folder for output and return it; raise ThermorenderError if it cannot be written to."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ThermorenderError(
            f"output folder {path} cannot be made: {error.strerror}; give a folder that can be written"
        ) from None
    # A trial file also finds read-only file systems and those without files. `remove_parts` knows its name.
    trial = path / f".trial.{secrets.token_hex(4)}.part"
    try:
        trial.touch()
    except OSError as error:
        raise ThermorenderError(
            f"output folder {path} cannot be written to: {error.strerror}; give another folder"
        ) from None
    finally:
        _remove(trial)
    return path


def check_output_file(path: PathLike, suffixes: Sequence[str] = ()) -> None:
    """Refuse a file that cannot be written or lacks one of `suffixes`, such as ".toml"; leave nothing behind."""
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise ThermorenderError(f"{path} has the wrong suffix; give one that ends in {' or '.join(suffixes)}")
    _refuse_other_than_file(path)
    with _beside(path) as part:
        part.touch()


def check_output_folder(path: PathLike) -> None:
    """Raise ThermorenderError if a folder cannot be made or written to; leave nothing behind."""
    with output_folder(path):
        pass


def check_new_folder(path: PathLike) -> None:
    """Raise ThermorenderError if a folder is not empty or cannot be made; leave nothing behind."""
    _refuse_used_folder(path)
    with _beside(Path(os.path.realpath(path))) as part:
        part.mkdir()


def _refuse_other_than_file(path: Path) -> None:
    if os.path.lexists(path) and not path.is_file():
        raise ThermorenderError(f"{path} is not an ordinary file; give the name of a file")


def _refuse_used_folder(path: PathLike, overwrite: bool = False) -> None:
    path = Path(path)
    if os.path.lexists(path) and not os.path.isdir(path):
        raise ThermorenderError(f"{path} is a file; give the path of a folder to make")
    if os.path.ismount(path):
        raise ThermorenderError(f"{path} is a mount point; give a folder below it")
    if os.path.isdir(path) and not overwrite and any(path.iterdir()):
        raise ThermorenderError(f"{path} exists and is not empty; give a new folder")


def _missing(path: PathLike) -> list[Path]:
    """Which of a folder and its parents do not exist, the deepest first."""
    path = Path(path)
    return [folder for folder in (path, *path.parents) if not os.path.lexists(folder)]


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove the empty ones of some folders, in this order."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()


def on_disk(*paths: PathLike) -> None:
    """Wait until files and the entries of their folders are on the disk (fsync)."""
    for path in (*paths, *{Path(path).parent for path in paths}):
        try:
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        except OSError as error:
            # Windows cannot open folders nor sync files opened for reading; some file systems cannot sync folders.
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                raise ThermorenderError(
                    f"{path} did not reach the disk: {error.strerror}; check the disk and continue with resume"
                ) from error
