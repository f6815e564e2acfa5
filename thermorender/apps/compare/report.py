"""The report of a comparison: one HTML file with embedded pictures and sortable tables, and tables for the terminal."""

import json
import re
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

from thermorender import formats
from thermorender.apps.compare import figures, findings, methods
from thermorender.apps.compare.ground_intervals import FEWEST
from thermorender.apps.compare.methods import CALIBRATED, REFITTED, THERMAL
from thermorender.apps.compare.registration import ALIKE
from thermorender.apps.compare.scores import RADIOMETRIC
from thermorender.apps.compare.tables import Table, interval, number
from thermorender.apps.compare.terms import NAMES
from thermorender.output.flight_pages.html import document, figure, text

Summary = dict[str, Any]

# Longer lists and tables are folded, except grave findings and errors.
_OPEN = 5
# Marks an interval that does not converge.
_MARK = "*"
_GROUPINGS = ("scene", "surface", "material", "range", "view angle", "edges")
_OTHERS = "thermal frames of other lands in the same hour and weather"
_KINDS = {
    methods.PHOTOGRAPH: "the map is applied to the photograph of the pose",
    methods.TRUE_MATERIALS: "the map is applied to the orthophoto and rendered with {materials}",
    methods.LEARNED_MATERIALS: "the map is applied to the orthophoto and rendered with learned materials",
    methods.CONSTANT: f"one temperature, the mean of {_OTHERS}",
    methods.FRAME_MEAN: "one temperature per frame, the mean of the reference on ground",
    methods.PER_MATERIAL: f"one temperature per material, from {_OTHERS}",
    methods.BALANCE: "the heat balance with properties from tables, under the scene's weather",
    methods.PRIVILEGED: "a privileged map, one that takes the material as input",
    methods.FOREIGN: "frames of another program",
}  # fmt: skip
_BOUNDS = {
    REFITTED: f"the map's bounds are 1.5 interquartile ranges beyond the quartiles of {_OTHERS}. This suits a map that "
              "was trained in one campaign, and reduces the contrast of one trained in many",
    CALIBRATED: f"a least-squares line from the map's intensities of other lands' photographs to {_OTHERS}",
}  # fmt: skip


def write_page(path: Path, summary: Summary, pictures: figures.Pictures) -> None:
    """Write the page of a comparison's summary with its pictures, and its figures as PDF and SVG beside it."""
    here = Path(__file__)
    style, script = (here.with_suffix(kind).read_text(encoding="utf-8") for kind in (".css", ".js"))
    beside, views = path.parent, pictures.views
    parts = [
        introduction(summary), _opening(summary, pictures.opening, beside), _errors(summary), _findings(summary),
        _about(summary), _details(summary), _pictures(views), _figures(summary, beside),
        _differences(summary, beside), _terms(summary, beside), _targets(summary), _structure(summary),
        _groups(summary), _training(summary), _scenes(summary),
        _section("legend" if any(scene["reference"] for scene in summary["scenes"]) else "legend without reference"),
        _section("data", views=_json(views), colours=_json(figures.colour_tables())),
    ]  # fmt: skip
    formats.write_text(path, document("Comparison of infrared frames", parts, style, script))


def introduction(summary: Summary) -> str:
    """Return the HTML of the introduction: what was compared with what."""
    scenes = summary["scenes"]
    counts = (_counted(len(scenes), "scene"), _counted(sum(each["poses"] for each in scenes), "pose"),
              _counted(len(summary["methods"]), "method"))  # fmt: skip
    opening = f"{', '.join(counts)}. All methods get the same poses, camera and photographs."
    if any(scene["reference"] for scene in scenes):
        computed = "computed" if any(scene["computed"] for scene in scenes) else "true"
        opening += (f" Errors are apparent temperature minus that of the reference, a render from the {computed} "
                    f"temperatures and {_materials(summary)}.")  # fmt: skip
    return _section("introduction", opening=text(opening))


def _opening(summary: Summary, opening: figures.Opening | None, beside: Path) -> str:
    """Return the row of pictures that opens the page: photograph, reference, and each translation with its error."""
    labels = opening.shown(summary) if opening else []
    if opening is None or not labels:
        return ""
    figures.publish(opening.printed(summary), beside, "pictures")
    found = []
    for title, image, error in opening.painted(labels):
        drawn = "".join(f"<img src='{figures.jpeg(each)}' alt=''>" for each in (image, error) if each is not None)
        own = summary["methods"].get(title, {})
        ground = own["errors"][RADIOMETRIC]["ground"] if own.get("errors") else {"mae_k": None}
        words = "" if ground["mae_k"] is None else f"<br>mean absolute error {ground['mae_k']:.2f} K"
        found.append(f"<figure>{drawn}<figcaption>{text(title)}{words}</figcaption></figure>")
    ends, limit = opening.scales(labels)
    tables = figures.colour_tables()
    bars = [_bar(tables["temperature"], f"{ends[0]:.1f}", f"{ends[1]:.1f} K", "apparent temperature")]
    if opening.truth is not None:
        bars.append(_bar(tables["error"], f"−{limit:.1f}", f"+{limit:.1f} K", "error, below each method"))
    return _section("opening", pictures="".join(found), bars="".join(bars), title=text(opening.title))


def _bar(table: Sequence[Sequence[int]], low: str, high: str, words: str) -> str:
    """Return a colour bar with the values of its ends."""
    stops = ",".join(f"rgb({','.join(map(str, table[k]))})" for k in (0, 64, 128, 192, 255))
    return f"<span>{words} {low} <i style='background:linear-gradient(to right,{stops})'></i> {high}</span>"


def _about(summary: Summary) -> str:
    """Return what the methods of this run are, and what a reader should know of them."""
    return _section("about", notes=_items(summary["notes"]),
                    methods=_items(f"{name}: {words}." for name, words in explained(summary)))  # fmt: skip


def explained(summary: Summary) -> list[tuple[str, str]]:
    """Return [(use of a map, label or bounds; its meaning)] of the methods of a comparison."""
    found: dict[str, str] = {}
    for kind, words in _KINDS.items():
        for label, own in summary["methods"].items():
            if own["kind"] == kind:
                use = methods.LABELS.get(kind)
                found[use.format("map") if use else label] = words.format(materials=_materials(summary))
    present = {own["bounds"] for own in summary["methods"].values()}
    found |= {name: words for name, words in _BOUNDS.items() if name in present}
    if any(own["true_objects"] for own in summary["methods"].values()):
        found["true objects"] = "the objects have their true temperatures instead of the map's"
    return list(found.items())


def terminal(summary: Summary) -> list[Table]:
    """Return the tables for the terminal: errors of methods, and differences where the truth is unknown."""
    rows = []
    for label, own in _scored(summary).items():
        ground = own["errors"][RADIOMETRIC]["ground"]
        ends = interval((ground.get("interval_95") or {}).get("mae_k")) + _MARK * bool(_few(own))
        rows.append((label, number(ground["me_k"], "+.3f", "none"), number(ground["mae_k"], none="none"), ends,
                     number(ground["sd_k"], none="none"), number(ground["rmse_k"], none="none"),
                     str(ground["pixels"])))  # fmt: skip
    head = ("method", "mean error [K]", "mean absolute [K]", "95 %", "standard deviation [K]", "RMSE [K]", "pixels")
    errors = Table(head, rows)
    # Differences from the first method of each scene; a single scene is not named.
    scenes = [scene for scene in summary["scenes"] if scene["differences"]]
    apart = Table(
        ("scene", "method", "against", "mean difference [K]", "mean absolute [K]", "RMS difference [K]", "pixels"),
        [(scene["name"] if len(scenes) > 1 else "", each["other"], each["one"], number(each["me_k"], "+.3f", "none"),
          number(each["mae_k"], none="none"), number(each["rmse_k"], none="none"), str(each["pixels"]))
         for scene in scenes for each in scene["differences"] if each["one"] == scene["differences"][0]["one"]],
    )  # fmt: skip
    return [each for each in (errors, apart) if each.rows]


def unconverged(summary: Summary) -> list[str]:
    """Return sentences on intervals that do not converge, which a star marks."""
    found: dict[str, list[str]] = {}
    for label, own in _scored(summary).items():
        why = _few(own)
        if why:
            found.setdefault(why, []).append(label)
    return [f"{_MARK} {'; '.join(labels)}: the intervals do not converge; {why}." for why, labels in found.items()]


def _few(own: Summary) -> str:
    """Return why a method's intervals on ground do not converge, or nothing."""
    blocks = own["errors"][RADIOMETRIC]["ground"].get("blocks")
    if blocks is None or blocks["converged"]:
        return ""
    if blocks["count"] < FEWEST:
        return (f"errors are correlated over {blocks['length_m']:.1f} m, so that the ground seen has the worth of "
                f"{blocks['count']:.1f} independent blocks; at least {FEWEST} are needed")  # fmt: skip
    return f"errors differ from pose to pose, and {blocks['poses']} poses were seen; at least {FEWEST} are needed"


def _findings(summary: Summary) -> str:
    lists = []
    for title, grave, lines in findings.grouped(summary["findings"]):
        rows = "".join(f"<li class={'grave' if grave else 'plain'}>{text(line)}</li>" for line in lines)
        lists.append(_folded(title, len(lines), f"<ul>{rows}</ul>", grave))
    lines = findings.headline(summary)
    rest = "".join(f"<p class=first>{text(line)}</p>" for line in lines[:1])
    if len(lines) > 1:
        rest += _folded("Unexplained errors of the other methods", len(lines) - 1, f"<ul>{_items(lines[1:])}</ul>")
    return _section("findings", lists="".join(lists), headline=rest)


def _scored(summary: Summary) -> dict[str, Summary]:
    """Return the methods with errors."""
    return {label: own for label, own in summary["methods"].items() if own["errors"]}


def _errors(summary: Summary) -> str:
    """Return the table of errors."""
    scored = _scored(summary)
    if not scored:
        return ""
    rows = []
    for label, own in scored.items():
        ground = own["errors"][RADIOMETRIC]["ground"]
        ends = ground.get("interval_95") or {"me_k": None, "mae_k": None}
        seconds = own["seconds_per_frame"]
        rows.append({
            "method": label,
            "mean error [K]": number(ground["me_k"], "+.3f"),
            "95 %": interval(ends["me_k"], "+.2f") + _MARK * bool(_few(own)),
            "mean absolute [K]": number(ground["mae_k"]),
            "95 % ": interval(ends["mae_k"]) + _MARK * bool(_few(own)),
            "standard deviation [K]": number(ground["sd_k"]),
            "without cause [K]": number(findings.unexplained(own)),
            "objects [K]": number(own["errors"][RADIOMETRIC].get("objects", {}).get("mae_k")),
            "ms per frame": number(None if seconds is None else 1e3 * seconds, ".1f"),
        })  # fmt: skip
    marked = {k for k, own in enumerate(scored.values()) if own["leaks"] or own["circular"]}
    return _section("errors", table=_wide(rows, marked).html(), loose=_items(unconverged(summary)))


def _details(summary: Summary) -> str:
    """Return what else is known of each error."""
    scored = _scored(summary)
    if not scored:
        return ""
    rows = []
    for label, own in scored.items():
        radiometric, ground = own["errors"][RADIOMETRIC], own["errors"][RADIOMETRIC]["ground"]
        rows.append({
            "method": label,
            "with objects [K]": number(radiometric.get("with objects", {}).get("mae_k")),
            "after sensor [K]": number(own["errors"]["sensor"].get("ground", {}).get("mae_k")),
            "s per scene": number(own["once_s"] or None, ".1f"),
            "scenes": str(own["scenes"]),
            "pixels": number(ground["pixels"], "d"),
            "effective pixels": number(ground.get("effective_pixels"), ".0f"),
            "correlated over [m]": number((ground.get("blocks") or {}).get("length_m"), ".1f"),
            "blocks": number((ground.get("blocks") or {}).get("count"), ".1f"),
            "own bounds [°C]": interval(own["range_c"], ".1f"),
            "knows": own["knows"],
        })  # fmt: skip
    informed = any(THERMAL in own["knows"] for own in scored.values())
    others = f"Methods that know {THERMAL} exist only for scenes with others in their hour and weather. "
    table = _wide(rows, ())
    return _section("details", table=_folded("Errors in detail", len(rows), table.html()),
                    others=others if informed else "")  # fmt: skip


def _wide(rows: Sequence[dict[str, str]], marked: Collection[int]) -> Table:
    """Return the table of rows {head: cell}; names may break lines."""
    head = tuple(rows[0])
    words = [head.index(name) for name in ("method", "knows") if name in head]
    return Table(head, [tuple(row.values()) for row in rows], marked, words)


def _pictures(views: Sequence[dict[str, Any]]) -> str:
    if not views:
        return ""
    poses = "".join(f"<option value={number}>{text(view['title'])}</option>" for number, view in enumerate(views))
    # Without a reference there are no errors to show.
    scored = any(each["reference"] for view in views for each in view["pictures"])
    return _section("frames", poses=poses, errors="<option value=error>errors</option>" if scored else "")


def _figures(summary: Summary, beside: Path) -> str:
    drawn = (
        ("error-and-time", figures.error_and_time(summary),
         "Error against run time of a frame, without training and without the time that a rendered scene needs once: "
         "as given, else on the machine named below. Frames of other programs without a given time are left out."),
        ("spectra", figures.spectra(summary),
         "Power spectra of the frames' central squares: a method below the reference blurs, one above it invents "
         "structure."),
        ("targets", figures.roc(summary),
         "Share of targets found after the sensor by a simple detector of spots that are warmer or colder than their "
         "surroundings. Its unit is each frame's own standard deviation: in a frame with little other contrast, a weak "
         "target is found easily."),
    )  # fmt: skip
    return "".join(_drawn(beside, *each) for each in drawn)


def _differences(summary: Summary, beside: Path) -> str:
    rows = [(scene["name"], each["one"], each["other"], number(each["me_k"], "+.3f"), number(each["mae_k"]),
             number(each["sd_k"])) for scene in summary["scenes"] for each in scene["differences"]]  # fmt: skip
    head = ("scene", "method", "against", "mean difference [K]", "mean absolute [K]", "standard deviation [K]")
    words = "Mean absolute difference of each pair of methods."
    return _listed("differences", "All pairs", Table(head, rows), lambda: {
        "figure": _drawn(beside, "differences", figures.differences(summary), words),
    })  # fmt: skip


def _terms(summary: Summary, beside: Path) -> str:
    terms = (*NAMES, "whole")
    rows = [(scene["name"], name, pair["from"], pair["to"], *(_both(pair["terms"][term]) for term in terms))
            for scene in summary["scenes"] for name, pair in scene["terms"].items()]  # fmt: skip
    head = ("scene", "map", "from", "to", *(f"{term} [K]" for term in terms))
    return _listed("terms", "By scene and map", Table(head, rows, words=(2, 3)), lambda: {
        "apart": f"{max(scene['terms_apart_mk'] for scene in summary['scenes']):.2g}",
        "figure": _drawn(beside, "terms", figures.terms(summary, NAMES), "Mean absolute size of each term."),
    })  # fmt: skip


def _targets(summary: Summary) -> str:
    every = {"reference": summary["targets"], **{label: own["targets"] for label, own in summary["methods"].items()}}
    rows = [(label, name, str(each["poses"]), number(each["true_contrast_k"], "+.2f"),
             number(each["contrast_k"], "+.2f"), number(each["contrast_error_k"], "+.2f"), f"{each['found']:.0%}",
             number(each["offset_px"], ".2f"))
            for label, own in every.items() for name, each in own["objects"].items()]  # fmt: skip
    head = ("method", "target", "poses", "true contrast [K]", "contrast [K]", "error [K]", "found", "offset [px]")
    return _listed("targets", "By method and target", Table(head, rows))


def _structure(summary: Summary) -> str:
    rows = [row for label, own in summary["methods"].items() if any((row := _structure_row(label, own))[1:])]
    if not rows:
        return ""
    own = [scene["steadiness_k"] for scene in summary["scenes"] if scene["steadiness_k"] is not None]
    mean = (sum(each * each for each in own) / len(own)) ** 0.5 if own else 0.0
    head = ("method", "shifted right [px]", "down [px]", "standard error [px]", "change between frames [K]", "contrast",
            "correlation")  # fmt: skip
    reference = f"For the reference, due to view and sampling: {mean:.3f} K. " if own else ""
    return _section("structure", table=Table(head, rows).html(), reference=reference)


def _structure_row(label: str, own: Summary) -> tuple[str, ...]:
    shift = own["structure"]["shift"] if own["kind"] == methods.FOREIGN else own["registered"]
    # Pictures that do not correlate have no shift.
    shift = None if shift is None or abs(shift["correlation"]) < ALIKE else shift
    gain = own["gain"] or {"gain": None, "correlation": None}
    error = None if shift is None or shift["error_px"] is None else max(shift["error_px"])
    return (label, number(shift and shift["right_px"], "+.2f"), number(shift and shift["down_px"], "+.2f"),
            number(error, ".2f"), number(own["steadiness_k"], ".3f"), number(gain["gain"], ".2f"),
            number(gain["correlation"], ".2f"))  # fmt: skip


def _groups(summary: Summary) -> str:
    scored = _scored(summary)
    parts = []
    for grouping in _GROUPINGS:
        of = {label: own["groups"].get("radiometric", {}).get(grouping, {}) for label, own in scored.items()}
        classes = tuple(dict.fromkeys(name for own in of.values() for name in own))
        if classes:
            rows = [
                (label, *(_both(own[name]) if name in own else "" for name in classes)) for label, own in of.items()
            ]
            title = "scene, ground only" if grouping == "scene" else f"{grouping}, with objects"
            parts.append(_section("group", title=title, table=Table(("method", *classes), rows, words=(0,)).html()))
    return _section("groups", tables="".join(parts)) if parts else ""


def _training(summary: Summary) -> str:
    maps: dict[str, Summary] = {}
    for own in summary["methods"].values():
        if own["training"] is not None:
            maps.setdefault(own["map"], own)
    rows: list[tuple[str, ...]] = []
    marked = set()
    for name, own in maps.items():
        training = own["training"]
        counts = ", ".join(f"{count} {part}" for part, count in (training["pairs"] or {}).items())
        if own["leaks"]:
            marked.add(len(rows))
        rows.append((name, training["method"], training["source"], counts, number(training["training_s"], ".0f"),
                     training["audited"], "; ".join(own["leaks"])))  # fmt: skip
    if not rows:
        return ""
    head = ("map", "method", "trained on", "pairs", "seconds", "audit", "leaks")
    return _section("training", table=Table(head, rows, marked, (2, 5, 6)).html())


def _scenes(summary: Summary) -> str:
    rows = []
    for scene in summary["scenes"]:
        campaign = scene["campaign"] or {"bounds_c": None, "lands": ""}
        reference = "computed by the heat balance" if scene["computed"] else "true temperatures"
        rows.append((scene["name"], scene["title"], scene["time"] or "", str(scene["poses"]),
                     reference if scene["reference"] else "none", interval(campaign["bounds_c"], ".1f"),
                     str(campaign["lands"])))  # fmt: skip
    head = ("scene", "title", "time", "poses", "reference", "refitted bounds [°C]", "from lands")
    settings, machine, versions = (", ".join(f"{key} {value}" for key, value in summary[name].items())
                                   for name in ("settings", "machine", "versions"))  # fmt: skip
    words = (f"Seed {summary['seed']}; settings: {settings or 'defaults'}. Machine: {machine}. Versions: {versions}. "
             f"{summary['seconds']:.0f} s in all.")  # fmt: skip
    plans = [(scene["name"], *row) for scene in summary["scenes"] for row in scene["planned"]]
    plan = Table(("scene", "item", "in", "why"), plans, words=(3,))
    return _section("scenes", table=Table(head, rows, words=(1,)).html(), words=text(words),
                    plan=_folded("What the render of the reference includes and leaves out", len(plans), plan.html()),
                    )  # fmt: skip


@cache
def _template() -> dict[str, Template]:
    """Return {section: template} of `report.html`."""
    page = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    parts = re.split(r"^<!-- (.*) -->\n", page, flags=re.MULTILINE)[1:]
    lines = [words.strip().replace(">\n<", "><").replace("\n", " ") for words in parts[1::2]]
    return {name: Template(words) for name, words in zip(parts[::2], lines, strict=True)}


def _section(name: str, **filled: str) -> str:
    """Return a section with its places filled by HTML."""
    return _template()[name].substitute(filled)


def _listed(name: str, title: str, table: Table, more: Any = dict) -> str:
    """Return a section with a folded table and what `more()` returns; nothing for an empty table."""
    if not table.rows:
        return ""
    return _section(name, table=_folded(title, len(table.rows), table.html()), **more())


def _folded(title: str, count: int, inner: str, opened: bool = False) -> str:
    """Return a list or table of `count` lines that opens by a click; a short one is open at the start."""
    state = " open" if opened or count <= _OPEN else ""
    return _section("folded", state=state, title=text(title), count=str(count), inner=inner)


def _drawn(beside: Path, name: str, drawing: Any, words: str) -> str:
    """Return a figure with its caption, written as PDF and SVG too; nothing where there is none."""
    if drawing is None:
        return ""
    return figure(figures.publish(drawing, beside, name), f"{words} Also in figures/{name}.pdf and .svg.")


def _both(found: Summary) -> str:
    return f"{number(found['me_k'], '+.2f')} ({number(found['mae_k'], '.2f')})"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _materials(summary: Summary) -> str:
    """Return what the materials are called: true ones, unless those of a scene are assumed."""
    return "the scene's materials" if any(each["assumed_materials"] for each in summary["scenes"]) else "true materials"


def _items(lines: Iterable[str]) -> str:
    return "".join(f"<li>{text(line)}</li>" for line in lines)


def _json(value: object) -> str:
    # Escaped, so that no content can close the script element.
    return json.dumps(value).replace("<", "\\u003c")
