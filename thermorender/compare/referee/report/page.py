"""The report: one HTML page that stands alone, its pictures inside, its tables sorted by a click."""

import json
from pathlib import Path

from thermorender import formats
from thermorender.compare.html import document, figure, table, text
from thermorender.compare.referee import findings
from thermorender.compare.referee.report import figures
from thermorender.compare.referee.terms import NAMES

# Longer lists and tables are folded, but for what is grave and for errors.
_OPEN = 5


def write_page(path, summary, views):
    """Write the page of a comparison's summary.

    Parameters
    ----------
    path : path
    summary : dict
        As `compare` returns.
    views : list of dict
        As `Pictures.views`.
    """
    here = Path(__file__)
    style, script = (here.with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    parts = [
        "<h1>2D translation against the radiometric render</h1>", _head(summary), _findings(summary), _errors(summary),
        _pictures(views), _figures(summary), _differences(summary), _terms(summary), _targets(summary),
        _structure(summary), _groups(summary), _training(summary), _scenes(summary), _legend(),
        f"<script type='application/json' id=views>{_json(views)}</script>",
        f"<script type='application/json' id=colours>{_json(figures.colour_tables())}</script>",
    ]  # fmt: skip
    formats.write_text(path, document("Comparison of infrared frames", parts, style, script))


def _head(summary):
    scenes, poses = summary["scenes"], sum(each["poses"] for each in summary["scenes"])
    first = (
        f"{len(scenes)} scene{'s' * (len(scenes) > 1)}, {poses} poses, {len(summary['methods'])} methods. All see the "
        "same poses with the same camera, and photographs of the same light; errors are differences of apparent "
        "temperature from the reference, a render from the true temperatures and materials. By letter: B a map applied "
        "to the photograph, C applied to the orthophoto and rendered (C1 true materials, C2 learned ones), D a "
        "constant, E a mean per material, F the heat balance, O an oracle. A map of intensities stands here with the "
        "bounds it brings, refitted (1.5 interquartile ranges of thermal frames of other lands in the same hour and "
        "weather) and calibrated (a straight line, by least squares, from what it says of their photographs to those "
        "frames). "
        "Refitted bounds suit a map trained in one campaign; of one trained in many they leave a fraction of the "
        "contrast."
    )
    return f"<p>{text(first)}</p><ul class=note>{''.join(f'<li>{text(note)}</li>' for note in summary['notes'])}</ul>"


def _findings(summary):
    parts = []
    for title, grave, lines in findings.grouped(summary["findings"]):
        rows = "".join(f"<li class={'grave' if grave else 'plain'}>{text(line)}</li>" for line in lines)
        parts.append(_folded(title, len(lines), f"<ul>{rows}</ul>", grave))
    return f"<h2>What was found</h2>{''.join(parts) or '<p>Nothing stands out.</p>'}"


def _errors(summary):
    scored = {label: own for label, own in summary["methods"].items() if own["errors"]}
    if not scored:
        return ""
    rows = []
    for label, own in scored.items():
        ground = own["errors"]["radiometric"]["ground"]
        ends = ground.get("interval_95") or {"me_k": None, "mae_k": None}
        part = lambda stage, name, own=own: own["errors"][stage].get(name, {}).get("mae_k")  # noqa: E731
        seconds, limits = own["seconds_per_frame"], own["range_c"]
        cells = {
            "method": label,
            "mean error [°C]": _number(ground["me_k"], "+.3f"),
            "95 %": _range(ends["me_k"], "+.2f"),
            "mean absolute error [°C]": _number(ground["mae_k"]),
            "95 % ": _range(ends["mae_k"]),
            "standard deviation [°C]": _number(ground["sd_k"]),
            "objects": _number(part("radiometric", "objects")),
            "with objects": _number(part("radiometric", "with objects")),
            "behind the sensor": _number(part("sensor", "ground")),
            "ms per frame": _number(None if seconds is None else 1e3 * seconds, ".1f"),
            "s per scene": _number(own["once_s"] or None, ".1f"),
            "scenes": str(own["scenes"]),
            "pixels": _number(ground["pixels"], "d"),
            "effective": _number(ground.get("effective_pixels"), ".0f"),
            "own bounds [°C]": "" if limits is None else f"{limits[0]:.1f}…{limits[1]:.1f}",
            "knows": own["knows"],
        }
        rows.append((tuple(cells.values()), bool(own["leaks"] or own["circular"])))
    head = tuple(cells)
    words = (
        "Mean error, mean absolute error and standard deviation as published studies give them, noise-free, on ground "
        "alone; then the mean absolute error with objects, on objects, and behind the same sensor with the same noise. "
        "What thermal frames of other lands tell is had only of scenes with others in their hour and weather. Seconds "
        "per scene are those of making its temperatures and solving its light."
    )
    return f"<h2>Errors on ground</h2><p class=note>{words}</p>" + table(head, rows)


def _pictures(views):
    if not views:
        return ""
    options = "".join(f"<option value={number}>{text(view['title'])}</option>" for number, view in enumerate(views))
    return ("<h2>Frames</h2><p class=note>Point at a picture: it tells kelvin. At half the camera's resolution here; "
            "whole ones lie in the folder pictures.</p><div id=controls><label>pose <select id=pose>" + options +
            "</select></label><label>show <select id=mode><option value=frame>frames</option><option value=error>errors"
            "</option></select></label><span><span id=low></span> <span id=scale></span> <span id=high></span></span>"
            "<output id=kelvin></output></div><div class=viewer></div>")  # fmt: skip


def _figures(summary):
    drawn = (
        (figures.against_time(summary),
         "Error against run time of a frame, on the machine named below; training is not in it, nor what a rendered "
         "scene needs once."),
        (figures.spectra(summary), "Power spectra of the frames' middles: below the reference a method blurs, above it "
                                   "it invents structure."),
        (figures.roc(summary), "Whether a plain detector of spots warmer or colder than around them finds the targets "
                               "behind the sensor. It measures by each picture's own scatter: in one that shows little "
                               "else a target is found easily, whatever its contrast."),
    )  # fmt: skip
    return "".join(figure(content, words) for content, words in drawn if content)


def _differences(summary):
    rows = [((scene["name"], each["one"], each["other"], _number(each["me_k"], "+.3f"), _number(each["mae_k"]),
              _number(each["sd_k"])), False)
            for scene in summary["scenes"] for each in scene["differences"]]  # fmt: skip
    if not rows:
        return ""
    head = ("scene", "method", "against", "mean difference [K]", "mean absolute [K]", "standard deviation [K]")
    drawn = figures.differences(summary)
    return ("<h2>Differences between methods</h2><p class=note>No true temperature is known here: these are no errors."
            "</p>" + (figure(drawn, "Mean absolute difference between every two methods.") if drawn else "")
            + _folded("Every two of them", len(rows), table(head, rows)))  # fmt: skip


def _terms(summary):
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
        "Mean (and mean absolute) terms of the way from B to C, behind the sensor, each changing one thing: how the "
        "map saw the ground, what emits, what is reflected, the air, the sensor. Steps of one way, they add up to the "
        f"whole at every pixel, here to {apart:.2g} mK."
    )
    drawn = figures.terms(summary, NAMES)
    return (f"<h2>Why B and C differ</h2><p class=note>{words}</p>"
            + (figure(drawn, "Mean absolute size of each term.") if drawn else "")
            + _folded("By scene and map", len(rows), table(head, rows)))  # fmt: skip


def _targets(summary):
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


def _structure(summary):
    rows = []
    for label, own in summary["methods"].items():
        shift = own["structure"]["shift"] if own["letter"] == "foreign" else own["registered"]
        # What does not look alike has no shift.
        shift = None if shift is None or abs(shift["correlation"]) < findings.ALIKE else shift
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
    words = "Ground points followed from frame to frame: root mean square of how a method changes its mind about them."
    if own:
        mean = (sum(each * each for each in own) / len(own)) ** 0.5
        words += f" The reference itself, by view and sampling: {mean:.3f} K."
    words += " What shows no contrast does not change."
    words += " Shifts are those of B against C1 of the same map, and of foreign frames against the reference."
    words += " Contrast is the slope of a method on the reference within a pose's ground, beside their correlation."
    head = ("method", "shifted right [px]", "down [px]", "standard error [px]", "change between frames [K]", "contrast",
            "correlation")  # fmt: skip
    return f"<h2>Registration, steadiness and contrast</h2><p class=note>{text(words)}</p>" + table(head, rows)


def _groups(summary):
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
        of = "scene, ground alone" if grouping == "scene" else f"{grouping}, with objects"
        parts.append(f"<h3>By {of}</h3>" + table(("method", *classes), rows))
    words = "<p class=note>Mean (and mean absolute) error [K], noise-free.</p>"
    return f"<h2>Where methods err</h2>{words}{''.join(parts)}" if parts else ""


def _training(summary):
    rows, seen = [], set()
    for own in summary["methods"].values():
        if own["training"] is None or own["map"] in seen:
            continue
        seen.add(own["map"])
        told = own["training"]
        pairs = told["pairs"] or {}
        counts = ", ".join(f"{count} {part}" for part, count in pairs.items())
        rows.append(((own["map"], told["method"], told["source"], counts, _number(told["training_s"], ".0f"),
                      told["audited"], "; ".join(own["leaks"])), bool(own["leaks"])))  # fmt: skip
    if not rows:
        return ""
    head = ("map", "method", "trained on", "pairs", "seconds", "audit", "leaks")
    return "<h2>What was trained on what</h2>" + table(head, rows, words=(2, 5, 6))


def _scenes(summary):
    rows = []
    for scene in summary["scenes"]:
        campaign = scene["campaign"]
        bounds = "" if campaign is None else f"{campaign['bounds_c'][0]:.1f}…{campaign['bounds_c'][1]:.1f}"
        rows.append(((scene["name"], scene["title"], scene["time"] or "", str(scene["poses"]),
                      "true temperatures" if scene["reference"] else "none", bounds,
                      str(campaign["lands"]) if campaign else ""), False))  # fmt: skip
    head = ("scene", "title", "time", "poses", "reference", "refitted bounds [°C]", "from lands")
    machine = ", ".join(f"{key} {value}" for key, value in summary["machine"].items())
    versions = ", ".join(f"{key} {value}" for key, value in summary["versions"].items())
    settings = ", ".join(f"{key} {value}" for key, value in summary["settings"].items()) or "defaults"
    words = (f"Seed {summary['seed']}; settings: {settings}. Machine: {machine}. Versions: {versions}. "
             f"{summary['seconds']:.0f} s in all.")  # fmt: skip
    return "<h2>Scenes</h2>" + table(head, rows, words=(1,)) + f"<p class=note>{text(words)}</p>"


def _legend():
    words = (
        "Errors of poses, surfaces, materials and scenes, and their means, can be formed anew from pixels.csv beside "
        "this page; everything else stands in comparison.json. 1 K is 1 °C of difference. The effective number of "
        "pixels is that of independent ones that would tell the mean as well. A method in red has seen the test, or "
        "made the reference."
    )
    return f"<h2>How to read this</h2><p>{words}</p>"


def _folded(title, count, inner, opened=False):
    """A list or table of so many lines that opens by a click, and is open from the start where they are few."""
    opened = " open" * (opened or count <= _OPEN)
    return f"<details{opened}><summary>{text(title)} ({count})</summary>{inner}</details>"


def _number(value, form=".3f"):
    return "" if value is None else format(int(value) if form == "d" else value, form)


def _range(ends, form=".2f"):
    return "" if ends is None else "…".join(format(end, form) for end in ends)


def _json(value):
    # Nothing in it may look like a tag.
    return json.dumps(value).replace("<", "\\u003c")
