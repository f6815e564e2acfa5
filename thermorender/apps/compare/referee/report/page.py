"""The report: one HTML file with embedded pictures and sortable tables."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thermorender import formats
from thermorender.apps.compare.referee import findings
from thermorender.apps.compare.referee.methods import THERMAL
from thermorender.apps.compare.referee.report import figures
from thermorender.apps.compare.referee.report.introduction import introduction
from thermorender.apps.compare.referee.structure import ALIKE
from thermorender.apps.compare.referee.terms import NAMES
from thermorender.output.flight_pages.html import document, figure, table, text

Summary = dict[str, Any]

# Longer lists and tables are folded, except grave findings and errors.
_OPEN = 5


def write_page(path: Path, summary: Summary, views: Sequence[dict[str, Any]]) -> None:
    """Write the page of a comparison's summary.

    Parameters
    ----------
    path : path
    summary : dict
        As `compare` returns it.
    views : list of dict
        As in `Pictures.views`.
    """
    here = Path(__file__)
    style, script = (here.with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    parts = [
        "<h1>2D translation against the radiometric render</h1>", introduction(summary), _findings(summary),
        _errors(summary), _pictures(views), _figures(summary), _differences(summary), _terms(summary),
        _targets(summary), _structure(summary), _groups(summary), _training(summary), _scenes(summary),
        _legend(summary),
        f"<script type='application/json' id=views>{_json(views)}</script>",
        f"<script type='application/json' id=colours>{_json(figures.colour_tables())}</script>",
    ]  # fmt: skip
    formats.write_text(path, document("Comparison of infrared frames", parts, style, script))


def _findings(summary: Summary) -> str:
    parts = []
    for title, grave, lines in findings.grouped(summary["findings"]):
        rows = "".join(f"<li class={'grave' if grave else 'plain'}>{text(line)}</li>" for line in lines)
        parts.append(_folded(title, len(lines), f"<ul>{rows}</ul>", grave))
    rest = findings.nothing(summary)
    return f"<h2>Findings</h2>{''.join(parts)}{f'<p>{text(rest)}</p>' if rest else ''}"


def _errors(summary: Summary) -> str:
    scored = {label: own for label, own in summary["methods"].items() if own["errors"]}
    if not scored:
        return ""
    rows = []
    for label, own in scored.items():
        radiometric, sensor = own["errors"]["radiometric"], own["errors"]["sensor"]
        ground = radiometric["ground"]
        ends = ground.get("interval_95") or {"me_k": None, "mae_k": None}
        seconds, limits = own["seconds_per_frame"], own["range_c"]
        cells = {
            "method": label,
            "mean error [K]": _number(ground["me_k"], "+.3f"),
            "95 %": _range(ends["me_k"], "+.2f"),
            "mean absolute [K]": _number(ground["mae_k"]),
            "95 % ": _range(ends["mae_k"]),
            "standard deviation [K]": _number(ground["sd_k"]),
            "objects [K]": _number(radiometric.get("objects", {}).get("mae_k")),
            "with objects [K]": _number(radiometric.get("with objects", {}).get("mae_k")),
            "after sensor [K]": _number(sensor.get("ground", {}).get("mae_k")),
            "ms per frame": _number(None if seconds is None else 1e3 * seconds, ".1f"),
            "s per scene": _number(own["once_s"] or None, ".1f"),
            "scenes": str(own["scenes"]),
            "pixels": _number(ground["pixels"], "d"),
            "effective pixels": _number(ground.get("effective_pixels"), ".0f"),
            "own bounds [°C]": "" if limits is None else f"{limits[0]:.1f}…{limits[1]:.1f}",
            "knows": own["knows"],
        }
        rows.append((tuple(cells.values()), bool(own["leaks"] or own["circular"])))
    head = tuple(cells)
    words = (
        "Mean error, mean absolute error and standard deviation as in published studies, noise-free and on ground "
        "only; then the mean absolute error on objects, with objects, and after the same sensor with the same noise. "
    )
    if any(THERMAL in own["knows"] for own in scored.values()):
        words += f"Methods that know {THERMAL} exist only for scenes with others in their hour and weather. "
    words += "Seconds per scene are the time for its temperatures and its light."
    inner = table(head, rows, words=(head.index("method"), head.index("knows")))
    return f"<h2>Errors on ground</h2><p class=note>{words}</p><div class=wide>{inner}</div>"


def _pictures(views: Sequence[dict[str, Any]]) -> str:
    if not views:
        return ""
    options = "".join(f"<option value={number}>{text(view['title'])}</option>" for number, view in enumerate(views))
    # Without a reference there are no errors to show.
    scored = any(each["reference"] for view in views for each in view["pictures"])
    errors = "<option value=error>errors</option>" if scored else ""
    return ("<h2>Frames</h2><p class=note>Point at a picture to read kelvin. These pictures have half the camera's "
            "resolution; full ones are in the folder pictures. Grey: no terrain, or terrain of unknown colour or "
            "temperature.</p><div id=controls><label>pose <select id=pose>"
            f"{options}</select></label><label>show <select id=mode><option value=frame>frames, common scale</option>"
            f"<option value=own>frames, own scales</option>{errors}"
            "</select></label><span><span id=low></span> <span id=scale></span> <span id=high></span></span>"
            "<output id=kelvin></output></div><div class=viewer></div>")  # fmt: skip


def _figures(summary: Summary) -> str:
    drawn = (
        (figures.against_time(summary),
         "Error against run time of a frame on the machine named below, without training and without the time that a "
         "rendered scene needs once."),
        (figures.spectra(summary), "Power spectra of the frames' central squares: a method below the reference blurs, "
                                   "one above it invents structure."),
        (figures.roc(summary), "Share of targets found after the sensor by a simple detector of spots that are warmer "
                               "or colder than their surroundings. Its unit is each frame's own standard deviation: in "
                               "a frame with little other contrast, a weak target is found easily."),
    )  # fmt: skip
    return "".join(figure(content, words) for content, words in drawn if content)


def _differences(summary: Summary) -> str:
    rows = [((scene["name"], each["one"], each["other"], _number(each["me_k"], "+.3f"), _number(each["mae_k"]),
              _number(each["sd_k"])), False)
            for scene in summary["scenes"] for each in scene["differences"]]  # fmt: skip
    if not rows:
        return ""
    head = ("scene", "method", "against", "mean difference [K]", "mean absolute [K]", "standard deviation [K]")
    drawn = figures.differences(summary)
    return ("<h2>Differences between methods</h2><p class=note>The true temperature is unknown here: these are "
            "differences, not errors.</p>"
            + (figure(drawn, "Mean absolute difference of each pair of methods.") if drawn else "")
            + _folded("All pairs", len(rows), table(head, rows)))  # fmt: skip


def _terms(summary: Summary) -> str:
    rows = []
    for scene in summary["scenes"]:
        for name, pair in scene["terms"].items():
            parts = pair["terms"]
            rows.append(((scene["name"], name, pair["from"], pair["to"],
                          *(f"{_number(parts[term]['me_k'], '+.2f')} ({_number(parts[term]['mae_k'], '.2f')})"
                            for term in (*NAMES, "whole"))), False))  # fmt: skip
    if not rows:
        return ""
    apart = max(scene["terms_apart_mk"] for scene in summary["scenes"])
    head = ("scene", "map", "from", "to", *(f"{term} [K]" for term in (*NAMES, "whole")))
    words = (
        "Mean (and mean absolute) terms of the difference between B and C after the sensor: geometry (how the map saw "
        "the ground), emission, reflection, air, sensor. They add up to the whole at every pixel, here to "
        f"{apart:.2g} mK."
    )
    drawn = figures.terms(summary, NAMES)
    return (f"<h2>Why B and C differ</h2><p class=note>{words}</p>"
            + (figure(drawn, "Mean absolute size of each term.") if drawn else "")
            + _folded("By scene and map", len(rows), table(head, rows)))  # fmt: skip


def _targets(summary: Summary) -> str:
    rows = []
    every = {"reference": summary["targets"], **{label: own["targets"] for label, own in summary["methods"].items()}}
    for label, own in every.items():
        for name, each in own["objects"].items():
            rows.append(((label, name, str(each["poses"]), _number(each["true_contrast_k"], "+.2f"),
                          _number(each["contrast_k"], "+.2f"), _number(each["contrast_error_k"], "+.2f"),
                          f"{each['found']:.0%}", _number(each["offset_px"], ".2f")), False))  # fmt: skip
    if not rows:
        return ""
    head = ("method", "target", "poses", "true contrast [K]", "contrast [K]", "error [K]", "found", "offset [px]")
    return "<h2>Targets</h2>" + _folded("By method and target", len(rows), table(head, rows))


def _structure(summary: Summary) -> str:
    rows = []
    for label, own in summary["methods"].items():
        shift = own["structure"]["shift"] if own["letter"] == "foreign" else own["registered"]
        # Pictures that do not correlate have no shift.
        shift = None if shift is None or abs(shift["correlation"]) < ALIKE else shift
        steady, gain = own["steadiness_k"], own["gain"] or {"gain": None, "correlation": None}
        if shift is None and steady is None and gain["gain"] is None:
            continue
        error = None if shift is None or shift["error_px"] is None else max(shift["error_px"])
        rows.append(((label, _number(shift and shift["right_px"], "+.2f"), _number(shift and shift["down_px"], "+.2f"),
                      _number(error, ".2f"), _number(steady, ".3f"), _number(gain["gain"], ".2f"),
                      _number(gain["correlation"], ".2f")), False))  # fmt: skip
    if not rows:
        return ""
    own = [scene["steadiness_k"] for scene in summary["scenes"] if scene["steadiness_k"] is not None]
    words = "Change between frames: root mean square change of ground points that are followed from frame to frame."
    if own:
        mean = (sum(each * each for each in own) / len(own)) ** 0.5
        words += f" For the reference, due to view and sampling: {mean:.3f} K."
    words += " A frame without contrast does not change."
    words += " Shifts are those of B against C1 of the same map, and of foreign frames against the reference."
    words += " Contrast is the slope of a method on the reference within a pose's ground, with their correlation."
    head = ("method", "shifted right [px]", "down [px]", "standard error [px]", "change between frames [K]", "contrast",
            "correlation")  # fmt: skip
    return f"<h2>Registration, stability and contrast</h2><p class=note>{text(words)}</p>" + table(head, rows)


def _groups(summary: Summary) -> str:
    scored = {label: own for label, own in summary["methods"].items() if own["errors"]}
    parts = []
    for grouping in ("scene", "surface", "material", "range", "view angle", "edges"):
        classes = list(dict.fromkeys(name for own in scored.values()
                                     for name in own["groups"].get("radiometric", {}).get(grouping, {})))  # fmt: skip
        if not classes:
            continue
        rows = []
        for label, own in scored.items():
            found = own["groups"]["radiometric"].get(grouping, {})
            rows.append(((label, *(f"{_number(found[name]['me_k'], '+.2f')} ({_number(found[name]['mae_k'], '.2f')})"
                                   if name in found else "" for name in classes)), False))  # fmt: skip
        of = "scene, ground only" if grouping == "scene" else f"{grouping}, with objects"
        parts.append(f"<h3>By {of}</h3><div class=pairs>{table(('method', *classes), rows, words=(0,))}</div>")
    words = "<p class=note>Mean (and mean absolute) error [K], noise-free.</p>"
    return f"<h2>Errors by group</h2>{words}{''.join(parts)}" if parts else ""


def _training(summary: Summary) -> str:
    rows, seen = [], set()
    for own in summary["methods"].values():
        training = own["training"]
        if training is None or own["map"] in seen:
            continue
        seen.add(own["map"])
        counts = ", ".join(f"{count} {part}" for part, count in (training["pairs"] or {}).items())
        cells = (own["map"], training["method"], training["source"], counts, _number(training["training_s"], ".0f"),
                 training["audited"], "; ".join(own["leaks"]))  # fmt: skip
        rows.append((cells, bool(own["leaks"])))
    if not rows:
        return ""
    head = ("map", "method", "trained on", "pairs", "seconds", "audit", "leaks")
    return "<h2>Training of the maps</h2>" + table(head, rows, words=(2, 5, 6))


def _scenes(summary: Summary) -> str:
    rows = []
    for scene in summary["scenes"]:
        campaign = scene["campaign"]
        bounds = "" if campaign is None else f"{campaign['bounds_c'][0]:.1f}…{campaign['bounds_c'][1]:.1f}"
        rows.append(((scene["name"], scene["title"], scene["time"] or "", str(scene["poses"]),
                      _reference(scene), bounds,
                      str(campaign["lands"]) if campaign else ""), False))  # fmt: skip
    head = ("scene", "title", "time", "poses", "reference", "refitted bounds [°C]", "from lands")
    machine = ", ".join(f"{key} {value}" for key, value in summary["machine"].items())
    versions = ", ".join(f"{key} {value}" for key, value in summary["versions"].items())
    settings = ", ".join(f"{key} {value}" for key, value in summary["settings"].items()) or "defaults"
    words = (f"Seed {summary['seed']}; settings: {settings}. Machine: {machine}. Versions: {versions}. "
             f"{summary['seconds']:.0f} s in all.")  # fmt: skip
    return "<h2>Scenes</h2>" + table(head, rows, words=(1,)) + f"<p class=note>{text(words)}</p>"


def _reference(scene: Summary) -> str:
    if not scene["reference"]:
        return "none"
    return "computed by the heat balance" if scene["computed"] else "true temperatures"


def _legend(summary: Summary) -> str:
    words = (
        "Errors by pose, surface, material and scene can be computed from pixels.csv in the folder of this page; all "
        "other values are in comparison.json. 1 K is a difference of 1 °C. The effective number of pixels is the "
        "number of independent pixels with the same standard error of the mean. A method in red was trained on the "
        "test scene, or made the reference."
    )
    if not any(scene["reference"] for scene in summary["scenes"]):
        words = "All values are in comparison.json in the folder of this page. 1 K is a difference of 1 °C."
    return f"<h2>How to read this</h2><p>{words}</p>"


def _folded(title: str, count: int, inner: str, opened: bool = False) -> str:
    """Return a list or table of `count` lines that opens by a click; a short one is open at the start."""
    state = " open" * (opened or count <= _OPEN)
    return f"<details{state}><summary>{text(title)} ({count})</summary>{inner}</details>"


def _number(value: float | None, form: str = ".3f") -> str:
    return "" if value is None else format(int(value) if form == "d" else value, form)


def _range(ends: Sequence[float] | None, form: str = ".2f") -> str:
    return "" if ends is None else "…".join(format(end, form) for end in ends)


def _json(value: object) -> str:
    # Escaped, so that no content can close the script element.
    return json.dumps(value).replace("<", "\\u003c")
