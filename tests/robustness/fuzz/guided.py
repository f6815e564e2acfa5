"""Readers fed by libFuzzer, whose changes follow the lines that earlier inputs reached: a mutator of others.

`python -m tests.robustness.fuzz.guided OUT COUNT [READER…]` needs `pip install atheris`. It begins with the undamaged
files of `corpus`, and gives `COUNT` inputs to each reader in a process of its own. `OUT/counts.json` has the outcomes,
and each fault's input is kept beside it. A process that ends or hangs is counted and begun again.
"""

import faulthandler
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from contextlib import suppress
from pathlib import Path

# Longest time of an input [s], after which foreign code is ended too, and its memory [bytes].
_MOST_S, _MOST_BYTES = 10, 2 << 30
# Status of a process whose input hangs.
_HUNG = 1
_NUMBERS = ("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-9999", "-1", "9" * 25, "\\xd9\\xa3", "24:00")
_WORD = re.compile(rb"[^\s,;:|<>=\"'{}\[\]()]+")


def main(out: Path, count: int, names: list[str]) -> int:
    """Return 1 if a reader neither refused nor accepted an input correctly, else 0."""
    from tests.robustness.fuzz.corpus import READERS

    out.mkdir(parents=True, exist_ok=True)
    record, bad = out / "counts.json", 0
    for name in names or READERS:
        found: Counter[str] = Counter()
        for seed in range(1, 50):
            rest = count - sum(found.values())
            if rest <= 0:
                break
            part = out / "part.json"
            part.unlink(missing_ok=True)
            # Each thread of a library would take 64 MiB of the address space that `_MOST_BYTES` limits.
            few = os.environ | {"MALLOC_ARENA_MAX": "2"}
            one = [sys.executable, "-m", __spec__.name, "--one", out, name, str(rest), str(seed)]
            ended = subprocess.run(one, env=few)
            found.update(json.loads(part.read_text()) if part.exists() else {})
            # An input that hangs in foreign code, or ends the process, ends libFuzzer too.
            found.update({} if ended.returncode == 0 else {"hung" if ended.returncode == _HUNG else "crashed": 1})
        counts = json.loads(record.read_text()) if record.exists() else {}
        record.write_text(json.dumps(counts | {name: dict(found)}, indent=1))
        print(name, dict(found), flush=True)
        bad += sum(found.values()) - found["refused"] - found["accepted"]
    return int(bad > 0)


def one(out: Path, name: str, count: int, seed: int) -> None:
    """Give inputs to one reader; libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=["thermorender"]):
        from tests.robustness.fuzz.corpus import READERS
        from tests.robustness.fuzz.run import _is_text, infinite, is_sentence
        from thermorender.errors import ThermorenderError

        reader = READERS[name]
        memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
        folder = Path(tempfile.mkdtemp(prefix="thermorender-fuzz-", dir=memory))
        reader.make(folder)
        path = folder / reader.file
        whole = path.read_bytes()
        text = _is_text(whole)
        with suppress(Exception):
            reader.read(path)
    seeds = folder / "seeds"
    seeds.mkdir()
    (seeds / "whole").write_bytes(whole)
    words = folder / "words"
    words.write_text("".join(f'"{number}"\n' for number in _NUMBERS))
    log = (out / "hung.log").open("a")
    counts: Counter[str] = Counter()
    seen: set[str] = set()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + _MOST_BYTES, resource.RLIM_INFINITY))
    warnings.simplefilter("ignore")

    def too_slow(signum, frame):
        raise TimeoutError

    def take(data: bytes) -> None:
        signal.signal(signal.SIGALRM, too_slow)
        path.write_bytes(data)
        what = ""
        signal.alarm(_MOST_S)
        faulthandler.dump_traceback_later(3 * _MOST_S, exit=True, file=log)
        try:
            what = next(infinite(reader.read(path)), "")
            kind = "not finite" if what else "accepted"
        except ThermorenderError as error:
            kind = "refused" if is_sentence(str(error)) else "no sentence"
            what = "" if kind == "refused" else str(error)
        except TimeoutError:
            kind, what = "slow", "slow"
        except (Exception, SystemExit) as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            kind, what = "foreign", f"{type(error).__name__} at {frame.filename}:{frame.lineno}: {error}"
        finally:
            signal.alarm(0)
            faulthandler.cancel_dump_traceback_later()
        counts[kind] += 1
        place = f"{kind} {what.partition(': ')[0]}"
        if what and place not in seen and len(seen) < 40:
            seen.add(place)
            stem = out / f"{name.replace(' ', '-')}-{kind.replace(' ', '-')}-{seed}-{len(seen)}"
            stem.with_suffix(".input").write_bytes(data)
            stem.with_suffix(".txt").write_text(what)
        if sum(counts.values()) % 200 == 0 or sum(counts.values()) >= count - 1:
            (out / "part.json").write_text(json.dumps(counts))

    def change(data: bytes, most: int, number: int) -> bytes:
        """Half of the changes of a text stay within one of its words, so that more than its form is reached."""
        rng = random.Random(number)
        at = [found.span() for found in _WORD.finditer(data)] if text and rng.random() < 0.5 else []
        if not at:
            return bytes(atheris.Mutate(data, most))
        first, last = rng.choice(at)
        word = atheris.Mutate(data[first:last], last - first + 16)
        return bytes((data[:first] + word + data[last:])[:most])

    atheris.Setup(
        [sys.argv[0], f"-runs={count}", f"-seed={seed}", f"-max_len={2 * len(whole) + 512}", f"-dict={words}",
         "-timeout=30", "-rss_limit_mb=0", "-close_fd_mask=3", "-len_control=0",
         f"-artifact_prefix={out}/{name.replace(' ', '-')}-", str(seeds)],
        take, custom_mutator=change, enable_python_coverage=True,
    )  # fmt: skip
    atheris.Fuzz()


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        one(Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))
    else:
        sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]))
