"""One page of every study: what holds, what does not, and the figures."""

import math
from pathlib import Path

from thermorender import formats
from thermorender.compare.html import document, figure, table, text
from validation.verdicts import gathered

PAGE = "index.html"
HEADER = ("study", "cases", "hold", "largest error by what is allowed", "longest case [s]")


def write_page(folder):
    """Write `index.html` of a folder's results; return what `gathered` found.

    Parameters
    ----------
    folder : Path
        As of `verdicts.gathered`.
    """
    told = gathered(folder)
    head = ("study", "", *HEADER[1:])
    lines = [((study.name, study.title, *cells), verdicts is not None and not all(each.holds for each in verdicts))
             for (study, verdicts, _), (_, *cells) in zip(told, rows(told), strict=True)]  # fmt: skip
    words = (
        "Every case says what it is held against, such as a closed form, a measurement or path tracing, and how much "
        "is allowed: a bound, an aim, or what the renderer states of its own error. It holds where the error is no "
        "more than that. Studies without an expected value have figures only."
    )
    parts = ["<h1>Validation</h1>", f"<p class=note>{text(words)}</p>", table(head, lines, (1,))]
    for study, verdicts, machine in told:
        if verdicts is not None:
            parts += _section(folder, study, verdicts, machine)
    formats.write_text(Path(folder) / PAGE, document("Validation of thermorender", parts))
    return told


def rows(told):
    """Return the summary as table rows of text under HEADER."""
    made = []
    for study, verdicts, _ in told:
        if not verdicts:
            made.append((study.name, "not run" if verdicts is None else "figures", "", "", ""))
            continue
        shares = [each.share for each in verdicts]
        worst = math.nan if any(math.isnan(share) for share in shares) else max(shares)
        seconds = [each.seconds for each in verdicts if each.seconds is not None]
        made.append((study.name, str(len(verdicts)), str(sum(each.holds for each in verdicts)), f"{worst:.2f}",
                     f"{max(seconds):.2g}" if seconds else ""))  # fmt: skip
    return made


def _section(folder, study, verdicts, machine):
    parts = [f"<h2 id='{text(study.name)}'>{text(study.title)}</h2>",
             f"<p class=note>python -m {text(study.module)}{text(_on(machine))}</p>"]  # fmt: skip
    if verdicts:
        head = ("case", "held against", "expected [K]", "found [K]", "error [K]", "allowed [K]", "verdict", "time [s]")
        lines = [((each.scene, each.source, f"{each.expected_k:.6g}", f"{each.found_k:.6g}",
                   f"{abs(each.found_k - each.expected_k):.2g}", f"{each.tolerance_k:.2g}",
                   "holds" if each.holds else "does not hold", "" if each.seconds is None else f"{each.seconds:.3g}"),
                  not each.holds) for each in sorted(verdicts, key=lambda each: each.holds)]  # fmt: skip
        parts.append(table(head, lines, (0, 1)))
    for pattern in study.figures:
        for path in sorted(Path(folder).glob(pattern)):
            parts.append(figure(path.read_bytes(), path.stem.replace("_", " ")))
    return parts


def _on(machine):
    if not machine:
        return ""
    return f" · {machine.get('processor')}, {machine.get('cores')} cores"
