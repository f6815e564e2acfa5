"""Files and folders that are written: whole or not at all, and refused before the work where they cannot be.

What is written has a temporary name of its own beside its place, and takes its name when it is complete. Neither a
failure nor an interruption leaves half of it, and processes that write the same file do not meet: the last one's is
there. Also here: text, JSON, arrays, pictures, rasters, and the cache, with a folder of its own for each kind of file.
"""

import errno
import json
import os
import re
import secrets
import shutil
import sys
import time
import zlib
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from thermorender.errors import ThermorenderError

# What is kept in the cache, each kind in a folder of its own: traced light, and LOWTRAN7 with what it computed.
CACHED = ("light", "lowtran")
# Where a dict on file keeps the checksum of its other values.
_SEAL = "checksum"
# That file systems allow to a name.
_MOST_BYTES = 255


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
        The folder is in use or cannot be made; nothing is left behind, and an old folder stays as it was.
    """
    given = path
    path = _resolved(path)
    _recover(path)
    _refuse_used_folder(given, overwrite)
    with _beside(path) as part, ExitStack() as held:
        # Made again where another process takes it for a leftover before it is held.
        while not part.exists():
            part.mkdir()
            with suppress(FileNotFoundError):
                held.enter_context(_asked(part, wait=True))
        made = os.stat(part)
        yield part
        # What is written into it later makes it anew where it was removed: that would be half of it.
        if not os.path.samestat(made, os.stat(part)):
            raise FileNotFoundError(errno.ENOENT, "its temporary folder was removed meanwhile")
        old = _of_kind(part, "old")
        try:
            if overwrite:
                with suppress(FileNotFoundError):
                    os.replace(path, old)
            elif os.name == "nt" and path.exists():
                # Others replace a folder that is empty, and no other, at once.
                path.rmdir()
            os.replace(part, path)
        except BaseException as error:
            _back_or_gone(old, path)
            if isinstance(error, OSError):
                # Another process may have been quicker.
                _refuse_used_folder(given, overwrite)
            raise
        _discard(old)


def _resolved(path):
    """A path with a name and a folder above it, which "." has not."""
    return Path(os.path.realpath(path))


def _of_kind(folder, kind):
    """The name of a temporary folder's "part", of the "old" one, whole, or of a "gone" one that is being removed."""
    return folder.with_name(re.sub(r"(\.[0-9a-f]{8})\.(part|old|gone)(\.[^.]*)?$", rf"\1.{kind}\3", folder.name))


def _back_or_gone(old, path):
    """Put an old folder, where there is one, back in its place, or remove it where something is there."""
    if path.exists():
        _discard(old)
    else:
        with suppress(FileNotFoundError):
            os.replace(old, path)


def _discard(old):
    """Remove an old folder, under a name by which what a kill leaves of it is not taken for the whole."""
    gone = _of_kind(old, "gone")
    # Another process may clean up meanwhile.
    with suppress(OSError):
        os.replace(old, gone)
        shutil.rmtree(gone, ignore_errors=True)


@contextmanager
def _beside(path):
    """Give a temporary path beside a place, in a folder made where missing; afterwards there is nothing under it."""
    made = _missing(path.parent)
    part = path.with_name(f".{_cut(path)}.{secrets.token_hex(4)}.part{path.suffix}")
    try:
        if made:
            path.parent.mkdir(parents=True, exist_ok=True)
        yield part
    except (OSError, RuntimeError) as error:
        # RuntimeError: that of the writers of images and videos.
        reason = getattr(error, "strerror", None) or str(error)
        raise ThermorenderError(
            f"{path} cannot be written: {reason}; check the folder, its permissions and the disk"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        _remove(part)
        _remove_empty(made)


def _cut(path):
    """The stem of a name, shorter where it has no room for what a temporary name adds; too long where the name is."""
    stem = path.stem
    room = _MOST_BYTES - len(f"..{'0' * 8}.part") - len(os.fsencode(path.suffix))
    if len(os.fsencode(stem)) > room and len(os.fsencode(path.name)) <= _MOST_BYTES:
        # Names with one beginning stay apart.
        end = f"-{zlib.crc32(os.fsencode(stem)):08x}"
        while len(os.fsencode(stem)) > room - len(end) > 0:
            stem = stem[:-1]
        stem += end
    return stem


def _recover(path):
    """Remove what killed processes left of a folder beside its place; bring an old one back that has no new one."""
    name = re.compile(rf"\.{re.escape(_cut(path))}\.[0-9a-f]{{8}}\.(part|old|gone){re.escape(path.suffix)}")
    with suppress(OSError):
        for each in list(path.parent.iterdir()):
            found = name.fullmatch(each.name)
            if not found or not each.is_dir():
                continue
            part, old = _of_kind(each, "part"), _of_kind(each, "old")
            if found[1] == "gone" or (found[1] == "old" and not part.exists()):
                # In place of an old one without its new one there was that, and whatever came of it.
                shutil.rmtree(each, ignore_errors=True)
                continue
            # Held while it is removed, lest its maker has it meanwhile.
            with suppress(OSError), _asked(part) as had:
                if had:
                    _back_or_gone(old, path)
                    shutil.rmtree(part, ignore_errors=True)


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
    """Keep other processes that ask for a folder out of it, where the system can; it ends with the process.

    Parameters
    ----------
    folder : path
    wait : bool
        Wait for another process that has it, instead of refusing.

    Raises
    ------
    ThermorenderError
        Another process has it.
    """
    with _asked(folder, wait) as had:
        if had is False:
            raise ThermorenderError(
                f"{folder} is being written by another process; wait until it ends, or give another folder"
            )
        yield


@contextmanager
def _asked(folder, wait=False):
    """Ask for a folder, as `in_use` does: give whether it is had until the end, or None where no system tells."""
    try:
        import fcntl
    except ImportError:
        # Windows.
        yield None
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            had = True
        except BlockingIOError:
            had = False
        except OSError:
            # A file system without locks.
            had = None
        # Not the one that is there any more, where it was removed before it was held.
        if not os.path.samestat(os.fstat(handle), os.stat(folder)):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(folder))
        yield had
    finally:
        os.close(handle)


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
    with _beside(_resolved(path)) as part:
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
    """Remove those folders that are empty, in the order given, but for one that another process is about to fill."""
    for folder in folders:
        with suppress(OSError), _asked(folder) as had:
            if had is False:
                return
            folder.rmdir()


def _remove(path):
    with suppress(OSError):
        path.unlink()


# --- text -------------------------------------------------------------------------------------------------------


def read_text(path, kind="UTF-8"):
    """Return the text of a UTF-8 file, without the byte order mark that spreadsheets put first.

    Parameters
    ----------
    path : path
    kind : str
        What programs call such a file, for the message.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        if "\0" in text:
            raise ThermorenderError(f"{path} is not UTF-8 text (it holds zero bytes); save it as {kind}")
        return text
    except UnicodeDecodeError as error:
        raise ThermorenderError(f"{path} is not UTF-8 text ({error.reason}); save it as {kind}") from error
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give a text file") from error


def write_text(path, text):
    """Write a text in UTF-8, with the line ends that it has."""
    with atomic(path) as part:
        part.write_bytes(text.encode())


def write_json(path, value):
    """Write a value as indented JSON."""
    write_text(path, json.dumps(value, indent=2) + "\n")


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


def checksum(path):
    """Return the BLAKE2b checksum of a file's bytes, 32 hexadecimal digits."""
    import hashlib

    state = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            state.update(block)
    return state.hexdigest()


def sealed(value):
    """Return a dict of plain values with the checksum of them all as JSON, for `unsealed`."""
    return value | {_SEAL: digest(json.dumps(value), {})}


def unsealed(value):
    """Return the dict that `sealed` was given.

    Raises
    ------
    ValueError
        It is none, or not as it was.
    """
    if not isinstance(value, dict):
        raise ValueError("no dict")
    rest = {name: each for name, each in value.items() if name != _SEAL}
    if value != sealed(rest):
        raise ValueError("its checksum is not that of its values")
    return rest


def append_json(path, *values):
    """Append values to a file of JSON lines, at once; they are on the disk when this returns."""
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write("".join(json.dumps(value) + "\n" for value in values))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ThermorenderError(
            f"{path} cannot be written: {error.strerror}; make room and continue with --resume"
        ) from None


def finite_json(text):
    """Return the value of a JSON text.

    Raises
    ------
    ValueError
        It is no JSON, or a number in it is not finite or takes more than 64 bits.
    """

    def number(kind, digits):
        value = kind(digits)
        if not abs(value) < (2**63 if kind is int else float("inf")):
            raise ValueError(f"it holds {digits[:20]}, which is not finite or takes more than 64 bits")
        return value

    kinds = {"parse_int": int, "parse_float": float, "parse_constant": float}
    return json.loads(text, **{name: partial(number, kind) for name, kind in kinds.items()})


def read_json_lines(path):
    """Return the values of a file of JSON lines, none where there is no file; a last line cut short is cut away.

    Raises
    ------
    ValueError
        A whole line that is no JSON.
    """
    text = read_text(path) if path.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        write_text(path, whole)
    return [json.loads(line) for line in whole.splitlines()]


# --- pictures and rasters: made in memory, since neither OpenCV nor GDAL tells that a disk is full ------------------


def write_image(path, image):
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG or TIFF by the path's suffix."""
    import cv2
    import numpy as np

    ordered = image[..., ::-1] if image.ndim == 3 else image
    with atomic(path) as part:
        encoded, data = cv2.imencode(Path(path).suffix, np.ascontiguousarray(ordered))
        if not encoded:
            raise OSError(f"no encoder took a {image.dtype} image")
        part.write_bytes(data)


def decoded(data, flags):
    """Return the picture in bytes as OpenCV has it with its `flags`, or None where there is none; no word is said."""
    import cv2
    import numpy as np

    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        # Of nothing at all, and of more pixels than it allows.
        return None
    finally:
        cv2.utils.logging.setLogLevel(before)


@contextmanager
def atomic_raster(path):
    """As `atomic`, for GDAL: give the name of a file in memory, which is written when the block ends without error."""
    from rasterio.io import MemoryFile

    with MemoryFile(ext=Path(path).suffix) as memory:
        yield memory.name
        with atomic(path) as part:
            part.write_bytes(memory.getbuffer())


# --- arrays of our own --------------------------------------------------------------------------------------------


def write_arrays(path, what, arrays):
    """Write {name: array} to be read by `read_arrays` alone; `what` tells of what they are the arrays."""
    import numpy as np

    with atomic(path) as part:
        np.savez(part, **arrays, checksum=digest(what, arrays))


def read_arrays(path, what):
    """Return the {name: array} that `write_arrays` wrote, or None where they are absent, damaged or of something else.

    A ZIP's own checksums do not tell of members that its table lacks.
    """
    import numpy as np

    # Damage shows as nearly any exception of zipfile's and NumPy's parsers. Opened here, because NumPy leaves a file
    # open that it cannot read.
    with suppress(Exception), open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
        if str(arrays.pop("checksum")) == digest(what, arrays):
            return arrays
    return None


def digest(what, arrays):
    """Return the checksum of named arrays; of their types and shapes too, as equal bytes may mean other numbers."""
    import hashlib

    import numpy as np

    state = hashlib.blake2b(repr(what).encode(), digest_size=16)
    for name, values in arrays.items():
        values = np.ascontiguousarray(values)
        state.update(f"{name} {values.dtype.str} {np.shape(arrays[name])}".encode())
        state.update(values.reshape(-1).view(np.uint8))
    return state.hexdigest()


# --- the cache --------------------------------------------------------------------------------------------------


def cache_folder(kind):
    """Return the folder of one kind of kept files, of `CACHED`: <cache>/kind.

    The cache is $THERMORENDER_CACHE, else the user's cache folder of this platform.
    """
    if kind not in CACHED:
        raise ValueError(f"kind={kind!r} is not kept; give one of {', '.join(CACHED)}")
    chosen = os.environ.get("THERMORENDER_CACHE")
    if chosen:
        base = Path(chosen).expanduser()
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "thermorender"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches" / "thermorender"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thermorender"
    return base / kind
