"""One page of all studies: verdicts and figures."""

import math
from pathlib import Path

from thermorender import formats
from thermorender.output.flight_pages.html import document, figure, table, text
from validation.verdicts import gathered

PAGE = "index.html"
HEADER = ("study", "cases", "hold", "largest error over tolerance", "longest case [s]")


def write_page(folder):
    """Write `index.html` of a folder's results; return them as `gathered` does.

    Parameters
    ----------
    folder : Path
        As in `verdicts.gathered`.
    """
    results = gathered(folder)
    head = ("study", "", *HEADER[1:])
    lines = [((study.name, study.title, *cells), verdicts is not None and not all(each.holds for each in verdicts))
             for (study, verdicts, _), (_, *cells) in zip(results, rows(results), strict=True)]  # fmt: skip
    words = (
        "Every case names the source of its expected value, such as a closed form, a measurement or path tracing, and "
        "its tolerance: a bound, an aim, or the renderer's own estimate of its error. A case holds if its error is not "
        "larger than the tolerance. Studies without an expected value have figures only."
    )
    parts = ["<h1>Validation</h1>", f"<p class=note>{text(words)}</p>", table(head, lines, (1,))]
    for study, verdicts, machine in results:
        if verdicts is not None:
            parts += _section(folder, study, verdicts, machine)
    formats.write_text(Path(folder) / PAGE, document("Validation of thermorender", parts))
    return results


def rows(results):
    """Return the summary as table rows of text under HEADER."""
    found = []
    for study, verdicts, _ in results:
        if not verdicts:
            found.append((study.name, "not run" if verdicts is None else "figures", "", "", ""))
            continue
        shares = [each.share for each in verdicts]
        worst = math.nan if any(math.isnan(share) for share in shares) else max(shares)
        seconds = [each.seconds for each in verdicts if each.seconds is not None]
        found.append((study.name, str(len(verdicts)), str(sum(each.holds for each in verdicts)), f"{worst:.2f}",
                      f"{max(seconds):.2g}" if seconds else ""))  # fmt: skip
    return found


def _section(folder, study, verdicts, machine):
    parts = [f"<h2 id='{text(study.name)}'>{text(study.title)}</h2>",
             f"<p class=note>python -m {text(study.module)}{text(_on(machine))}</p>"]  # fmt: skip
    if verdicts:
        head = ("case", "source", "expected [K]", "found [K]", "error [K]", "tolerance [K]", "verdict", "time [s]")
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
