"""Files and folders that are written whole or not at all, and refused before the work where they cannot be.

What is written has a temporary name beside its place, and takes its name when it is complete. A failure or an
interruption leaves nothing behind. A killed process leaves the old file or the new one, and perhaps a temporary one.
Processes that write the same file do not meet: the last one's is there. Folders have locks.
"""

import errno
import os
import re
import secrets
import shutil
import time
import zlib
from contextlib import contextmanager, suppress
from pathlib import Path

from thermorender.errors import ThermorenderError

# That file systems allow to a name, and letters of it that a temporary name repeats: 200 bytes at most.
_MOST_BYTES, _REPEATED = 255, 50
# The lock inside a folder in use.
_LOCK = ".lock"


# --- whole or not at all ----------------------------------------------------------------------------------------


@contextmanager
def atomic(path):
    """Give a temporary path beside a file; it takes the file's name only if the block ends without error.

    It ends as `path` does, as many writers tell the format by that. Missing folders are made.

    Raises
    ------
    ThermorenderError
        The file cannot be written (missing permission, full disk); nothing is left behind.
    """
    path = Path(path)
    _refuse_other_than_file(path)
    with _beside(path) as part:
        yield part
        os.replace(part, path)


@contextmanager
def atomic_folder(path, overwrite=False):
    """Give a temporary folder; it takes the name `path` only if the block ends without error.

    Parameters
    ----------
    path : path
        Must not exist, or be empty.
    overwrite : bool
        Whether a folder that holds something may be there, which is then removed.

    Raises
    ------
    ThermorenderError
        The folder is in use, or cannot be made, or another process writes it; nothing is left behind, and an old folder
        stays as it was.
    """
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


def _exchange(part, path, old):
    """Give a folder's name to its temporary one, which then is the folder that was there; `old` is its name meanwhile.

    None refuses a folder that holds something.
    """
    if path.exists() and old is None:
        path.rmdir()
    elif path.exists():
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
def _beside(path):
    """Give a temporary path beside a place, in a folder made where missing; afterwards there is nothing under it."""
    part = path.with_name(f".{path.stem[:_REPEATED]}.{secrets.token_hex(4)}.part{path.suffix}")
    with _parents(path):
        try:
            yield part
        finally:
            shutil.rmtree(part, ignore_errors=True)
            _remove(part)


@contextmanager
def _parents(path):
    """Make the folders above a place for a block, and remove those still empty; say in a sentence what fails."""
    made = _missing(path.parent)
    try:
        if len(os.fsencode(path.name)) > _MOST_BYTES:
            raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
        if made:
            path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, RuntimeError) as error:
        # RuntimeError: that of the writers of images and videos.
        reason = getattr(error, "strerror", None) or str(error)
        raise ThermorenderError(
            f"{path} cannot be written: {reason}; check the folder, its permissions and the disk"
        ) from error
    finally:
        _remove_empty(made)


def _short(path):
    """The beginning of a name with the checksum of it all: short, and no other's."""
    return f"{path.name[:_REPEATED]}-{zlib.crc32(os.fsencode(path.name)):08x}"


def remove_parts(folder, name=r".+", older_s=0.0):
    """Remove the temporary files that killed processes left of files in a folder.

    Parameters
    ----------
    folder : Path
    name : str
        Regular expression of the files' names without suffix.
    older_s : float
        Only what was last written so long ago [s], where other processes may be writing now.
    """
    pattern = re.compile(rf"\.({name})\.[0-9a-f]{{8}}\.part(\.[^.]*)?")
    for path in folder.iterdir():
        with suppress(OSError):
            if pattern.fullmatch(path.name) and time.time() - path.stat().st_mtime >= older_s:
                path.unlink()


# --- folders for output, and checks before the work -------------------------------------------------------------


@contextmanager
def output_folder(path):
    """Give a folder for output, made where it is missing; if the block fails with nothing written, it goes again."""
    made = _missing(path)
    try:
        yield make_folder(path)
    finally:
        _remove_empty(made)


@contextmanager
def in_use(folder, wait=False):
    """Keep other processes that ask for a folder out of it; a lock in the folder, which ends with the process.

    Parameters
    ----------
    folder : path
    wait : bool
        Wait for another process that has it, instead of refusing.

    Raises
    ------
    ThermorenderError
        Another process has it, or it cannot be written to.
    """
    with _locked(Path(folder) / _LOCK, folder, wait):
        yield


@contextmanager
def _locked(path, folder, wait=False):
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
        # While it is held: whoever waits for it sees that it is gone, and makes its own. Not that of another process,
        # in a folder that has taken the place of this one.
        with suppress(OSError):
            if os.path.samestat(held, os.stat(path)):
                path.unlink()
        lock.release()


def make_folder(path):
    """Create a folder for output, or raise a sentence saying why it cannot be written to."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ThermorenderError(
            f"output folder {path} cannot be made: {error.strerror}; give a folder that can be written"
        ) from None
    # Tried, since permissions do not tell all: of a file system that is read-only, or of one that takes no files.
    # Named as other temporary files are, by which it is removed where a process is killed here.
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


def check_output_file(path, suffixes=()):
    """Refuse, before the work for it, a file that cannot be written; leave nothing behind.

    Parameters
    ----------
    path : path
    suffixes : sequence of str
        What its name may end in, such as ".toml"; anything where empty.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise ThermorenderError(f"{path} is no name for this file; give one that ends in {' or '.join(suffixes)}")
    _refuse_other_than_file(path)
    with _beside(path) as part:
        part.touch()


def check_output_folder(path):
    """Refuse, before the work for it, a folder that cannot be made or written to; leave nothing behind."""
    with output_folder(path):
        pass


def check_new_folder(path):
    """Refuse, before the work for it, a folder that is in use or cannot be made; leave nothing behind."""
    _refuse_used_folder(path)
    with _beside(Path(os.path.realpath(path))) as part:
        part.mkdir()


def _refuse_other_than_file(path):
    if os.path.lexists(path) and not path.is_file():
        raise ThermorenderError(f"{path} is a folder or no ordinary file; give the name of a file")


def _refuse_used_folder(path, overwrite=False):
    path = Path(path)
    if os.path.lexists(path) and not os.path.isdir(path):
        raise ThermorenderError(f"{path} is a file; give the path of a folder to make")
    if os.path.ismount(path):
        raise ThermorenderError(f"{path} is where a file system is mounted; give a folder below it")
    if os.path.isdir(path) and not overwrite and any(path.iterdir()):
        raise ThermorenderError(f"{path} exists and is not empty; give a new folder")


def _missing(path):
    """Which of a folder and those above it do not exist, the deepest first."""
    path = Path(path)
    return [folder for folder in (path, *path.parents) if not os.path.lexists(folder)]


def _remove_empty(folders):
    """Remove those folders that are empty, in the order given."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _remove(path):
    with suppress(OSError):
        path.unlink()


def on_disk(*paths):
    """Wait until files are on the disk, and their names in the folders that hold them.

    Raises
    ------
    ThermorenderError
        The disk is full after all, or broken.
    """
    for path in (*paths, *{Path(path).parent for path in paths}):
        try:
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        except OSError as error:
            # Windows opens no folder, and syncs nothing that was opened to be read; some file systems sync no folder.
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                raise ThermorenderError(
                    f"{path} did not reach the disk: {error.strerror}; check the disk and continue with --resume"
                ) from error
