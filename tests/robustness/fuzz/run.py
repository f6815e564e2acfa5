"""Readers fed with damaged files: each must refuse in one sentence, or accept a finite and usable file.

A reader has a small undamaged file, which is changed at random: bytes, cuts and repeats; in texts also numbers and
lines, in archives of arrays the arrays. The seed, the reader's name and the input's number determine each input, so
any of them can be reproduced. A separate process reads them, with limits to memory and time, so one that crashes or
hangs is counted and skipped. Some accepted files are also used: they are rendered, and the frame must be finite.
"""

import io
import multiprocessing
import os
import re
import resource
import signal
import tempfile
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path

import numpy as np

from tests.robustness.fuzz.corpus import READERS
from tests.robustness.fuzz.uses import USES
from thermorender.errors import ThermorenderError

# Limits for reading one input [s, bytes], and for rendering one, where the first compiles kernels.
READING, RENDERING = (5, 1 << 30), (60, 1 << 32)
# Replacements for numbers of a text.
_NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-0.0", "-1", "9" * 25, "1e999", "0x10", "1_000", "",
    "true", '"x"', "[]", "1.5.2", "٣", "−5", "1,5",
)  # fmt: skip
_AT_LEAST = 20
_PNG = b"\x89PNG\r\n\x1a\n"
HEADER = (
    "reader", "refused", "accepted", "foreign errors", "not finite", "too slow", "crashed", "rendered", "refused then",
)  # fmt: skip
_KINDS = ("refused", "accepted", "foreign", "infinite", "slow", "crashed")
# Their names where an accepted file is used.
_USED = {"refused": "unfit", "accepted": "rendered"}
_FINE = {*_USED, *_USED.values()}


@dataclass(frozen=True)
class End:
    """The outcome of an input.

    Attributes
    ----------
    reader, number : str, int
        These reproduce the input.
    kind : str
        refused or accepted; unfit or rendered if it was used; faults: foreign, infinite, slow or crashed.
    what : str
        For a fault, the error or the place of the value.
    """

    reader: str
    number: int
    kind: str
    what: str


def run(
    count: int, names: Iterable[str] = (), seed: int = 0, progress: Callable | None = None, rendered: int = 100
):  # fmt: skip
    """Return ({reader: {kind: inputs}}, [End, …]) of `count` damaged files for each of some readers, or of all.

    Each input has one of the kinds refused, accepted, foreign, infinite, slow, crashed. Accepted ones may also be
    rendered or unfit: refused only when used.

    Parameters
    ----------
    count : int
    names : sequence of str
        Some of `corpus.READERS`; none: all.
    seed : int
    progress : callable, optional
        Called with (what, share done).
    rendered : int
        Number of accepted inputs of each reader that are rendered.
    """
    names = list(names) or list(READERS)
    for name in names:
        if name not in READERS:
            raise ThermorenderError(f"reader {name!r} is unknown; give some of {', '.join(READERS)}")
    counts, faults = {}, []
    for number, name in enumerate(names):
        if progress:
            progress(name, number / len(names))
        ends = ends_of(name, READERS[name].read, range(count), seed, READING)
        counts[name] = Counter(end.kind for end in ends)
        rest = [end.number for end in ends if end.kind == "accepted"] if name in USES else []
        while rest and counts[name]["rendered"] < rendered:
            # A process compiles kernels first, so it is not started for a few.
            some = max(rendered - counts[name]["rendered"], _AT_LEAST)
            used, rest = ends_of(name, USES[name], rest[:some], seed, RENDERING), rest[some:]
            found = [replace(end, kind=_USED.get(end.kind, end.kind)) for end in used]
            counts[name].update(end.kind for end in found)
            ends += found
        faults += [end for end in ends if end.kind not in _FINE]
    return counts, faults


def rows(counts):
    """Return the rows of a table, as `HEADER` names them."""
    kinds = (*_KINDS, "rendered", "unfit")
    return [(name, *(str(of.get(kind, 0)) for kind in kinds)) for name, of in counts.items()]


def damaged(whole: bytes, reader: str, number: int, seed: int = 0) -> bytes:
    """Return input `number` of a reader: the undamaged file's bytes with up to four changes."""
    rng = np.random.default_rng([seed, zlib.crc32(reader.encode()), number])
    for _ in range(1 + rng.integers(4)):
        if _is_text(whole):
            deep = _OF_TEXT
        elif whole.startswith(_PNG):
            deep = _OF_CHUNKS
        else:
            deep = _OF_ARRAYS if zipfile.is_zipfile(io.BytesIO(whole)) else _OF_BYTES
        whole = rng.choice(deep if rng.random() < 0.75 else _OF_BYTES)(whole, rng)
    return whole


def ends_of(name, job, numbers, seed, limits):
    """Outcomes of inputs of a reader in a job: [End, …]."""
    # The parent process has no threads: LightGBM's would be missing in a copy of a process that has used them.
    context = multiprocessing.get_context("forkserver")
    numbers, ends, (most_s, _) = list(numbers), [], limits
    with tempfile.TemporaryDirectory(prefix="thermorender-fuzz-") as folder:
        path = Path(folder) / READERS[name].file
        READERS[name].make(Path(folder))
        whole = path.read_bytes()
        while len(ends) < len(numbers):
            here, there = context.Pipe(duplex=False)
            rest = numbers[len(ends) :]
            worker = context.Process(target=_work, args=(there, name, job, path, whole, rest, seed, limits))
            worker.start()
            there.close()
            for number in rest:
                try:
                    # Twice the limit: foreign code that hangs is not interrupted by a signal.
                    if not here.poll(2 * most_s + 10):
                        raise EOFError
                    kind, what = here.recv()
                except (EOFError, OSError):
                    # It may be about to end.
                    worker.join(1.0)
                    hung = worker.is_alive()
                    worker.kill()
                    worker.join()
                    kind, what = ("slow", "") if hung else ("crashed", f"status {worker.exitcode}")
                ends.append(End(name, number, kind, what))
                if kind in ("slow", "crashed") and not worker.is_alive():
                    break
            worker.join()
    return ends


def _work(pipe, name, job, path, whole, numbers, seed, limits):
    """Do the job on inputs and send the outcome of each."""
    most_s, most_bytes = limits
    # Imports, and values computed once from the undamaged file, are not counted.
    path.write_bytes(whole)
    with suppress(Exception):
        job(path)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + most_bytes, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # Libraries in C print their own messages about damage.
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    signal.signal(signal.SIGALRM, _too_slow)
    # A warning is not a fault here, whatever the caller's filters are.
    warnings.simplefilter("ignore")
    for number in numbers:
        path.write_bytes(damaged(whole, name, number, seed))
        signal.alarm(most_s)
        try:
            wrong = next(infinite(job(path)), None)
            sent = ("infinite", wrong) if wrong else ("accepted", "")
        except ThermorenderError as error:
            sent = ("refused", "") if is_sentence(str(error)) else ("foreign", f"words: {str(error)[:200]!r}")
        except TimeoutError:
            sent = "slow", ""
        except (Exception, SystemExit) as error:
            sent = "foreign", f"{type(error).__name__}: {str(error)[:200]}"
        finally:
            signal.alarm(0)
        pipe.send(sent)


def _too_slow(signum, frame):
    raise TimeoutError


def is_sentence(words):
    return bool(words.strip()) and "\n" not in words


def infinite(value, where="", depth=0):
    """Yield the places where values are not finite."""
    if depth > 8:
        return
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "fc" and not np.isfinite(value).all():
            yield where or "array"
    elif isinstance(value, (float, np.floating)):
        if not np.isfinite(value):
            yield where or "number"
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from infinite(getattr(value, field.name, None), f"{where}.{field.name}", depth + 1)
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from infinite(item, f"{where}.{key}", depth + 1)
    elif isinstance(value, (list, tuple)):
        for number, item in enumerate(value):
            yield from infinite(item, f"{where}[{number}]", depth + 1)


def check(name, path):
    """Read a file: an accepted file must be finite, and a refused one refused in a sentence."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            found, words = READERS[name].read(path), None
        except ThermorenderError as error:
            found, words = None, str(error)
    assert words is None or is_sentence(words), words
    assert not list(infinite(found))


# --- changes ----------------------------------------------------------------------------------------------------


def _is_text(whole):
    try:
        whole.decode()
    except UnicodeDecodeError:
        return False
    return b"\0" not in whole


def _flip(whole, rng):
    if not whole:
        return b"\0"
    changed = bytearray(whole)
    for _ in range(1 + rng.integers(8)):
        changed[rng.integers(len(changed))] ^= 1 << rng.integers(8)
    return bytes(changed)


def _cut(whole, rng):
    return whole[: rng.integers(len(whole) + 1)]


def _span(whole, rng):
    first = int(rng.integers(len(whole) + 1))
    return first, min(first + 1 + int(rng.geometric(0.02)), len(whole))


def _leave_out(whole, rng):
    first, last = _span(whole, rng)
    return whole[:first] + whole[last:]


def _repeat(whole, rng):
    first, last = _span(whole, rng)
    return whole[:last] + whole[first:last] * int(1 + rng.integers(4)) + whole[last:]


def _overwrite(whole, rng):
    first, last = _span(whole, rng)
    fill = rng.choice([b"\0", b"\xff", b"\x7f", b"\x80", b"\n"])
    return whole[:first] + bytes(fill) * (last - first) + whole[last:]


def _number(whole, rng):
    """Replace one of a text's numbers."""
    places = list(re.finditer(rb"[-+]?\d[\d.eE+-]*", whole))
    if not places:
        return _flip(whole, rng)
    place = places[rng.integers(len(places))]
    return whole[: place.start()] + _NUMBERS[rng.integers(len(_NUMBERS))].encode() + whole[place.end() :]


def _lines(whole, rng):
    """Remove, double, exchange or cut lines of a text."""
    lines = whole.split(b"\n")
    one, other = rng.integers(len(lines), size=2)
    kind = rng.integers(4)
    if kind == 0:
        del lines[one]
    elif kind == 1:
        lines.insert(other, lines[one])
    elif kind == 2:
        lines[one], lines[other] = lines[other], lines[one]
    else:
        lines[one] = lines[one][: rng.integers(len(lines[one]) + 1)]
    return b"\n".join(lines)


def _cell(whole, rng):
    """Add, remove or replace a separator."""
    marks = [at for at, byte in enumerate(whole) if byte in b',;=:[]{}"']
    if not marks:
        return _flip(whole, rng)
    at = marks[rng.integers(len(marks))]
    other = rng.choice([b"", b",", b",,", b";", b"=", b"[", b"]", b'"', b"\t"])
    return whole[:at] + bytes(other) + whole[at + 1 :]


def _chunk(whole, rng):
    """Change one chunk of a PNG and compute its checksum again; pixels are mostly unpacked first."""
    chunks, place = [], len(_PNG)
    while place < len(whole):
        size = int.from_bytes(whole[place : place + 4], "big")
        chunks.append((whole[place + 4 : place + 8], whole[place + 8 : place + 8 + size]))
        place += 12 + size
    if not chunks:
        return _flip(whole, rng)
    at, change = rng.integers(len(chunks)), _OF_BYTES[rng.integers(len(_OF_BYTES))]
    kind, data = chunks[at]
    if kind == b"IDAT" and rng.random() < 0.8:
        # If it is damaged already, as much as can be unpacked.
        with suppress(zlib.error):
            chunks[at] = kind, zlib.compress(change(zlib.decompressobj().decompress(data, 1 << 20), rng))
    else:
        chunks[at] = kind, change(data, rng)
    return _PNG + b"".join(
        len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big") for kind, data in chunks
    )


def _array(whole, rng):
    """Change one array of an .npz: other values, another shape or type, or remove it."""
    try:
        with np.load(io.BytesIO(whole)) as kept:
            arrays = dict(kept)
    except Exception:
        arrays = {}
    if not arrays:
        return _flip(whole, rng)
    names = sorted(arrays)
    name = names[rng.integers(len(names))]
    array, kind = arrays[name], rng.integers(5)
    if kind == 0:
        del arrays[name]
    elif kind == 1 or not array.size:
        arrays[name] = array[: len(array) // 2] if array.ndim else np.stack([array, array])
    elif kind == 2 and array.dtype.kind in "fiu":
        arrays[name] = array.astype(rng.choice(["float64", "int8", "U7", "complex64", "bool"]))
    elif array.dtype.kind in "fiu":
        changed = array.reshape(-1).astype(float)
        changed[rng.integers(array.size)] = rng.choice([np.nan, np.inf, -1.0, 0.0, 1e30, 1e308, 1e-320])
        with np.errstate(all="ignore"):
            arrays[name] = changed.reshape(array.shape).astype(array.dtype)
    else:
        # A header in JSON.
        arrays[name] = np.array(_number(str(array).encode(), rng).decode(errors="replace"))
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


_OF_BYTES = (_flip, _cut, _leave_out, _repeat, _overwrite)
_OF_ARRAYS = (_array,)
_OF_CHUNKS = (_chunk,)
_OF_TEXT = (_number, _number, _number, _lines, _lines, _cell, _flip)
