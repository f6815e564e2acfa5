"""The pages of a flight in one file each: `preview.html` before it, `index.html` after it with `contact.png`."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.output.flight_pages.cost import Cost
from thermorender.output.flight_pages.flight_figures import Curve, Picture, curves, flight_map, jpeg, sheet
from thermorender.output.flight_pages.html import document, figure, table, text
from thermorender.output.flight_pages.prospect import Prospect

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer

_STYLE = "pre { background: var(--soft); padding: .6rem .8rem; white-space: pre-wrap; } video { max-width: 100%; }"


@dataclass(frozen=True)
class Pictured:
    """A frame on the sheet: apparent temperatures (h, w) [K], where a surface is seen (h, w), and {object: pixels}."""

    kelvin: NDArray[np.float32]
    surface: NDArray[np.bool_]
    pixels: Mapping[str, int]


def write_preview(folder: Path, renderer: "Renderer", seen: Prospect, cost: Cost) -> list[Path]:
    """Write `preview.png` and `preview.html` into a folder and return their paths."""
    drawn = flight_map(renderer, seen, renderer.scene.targets)
    panels = [
        Curve("height above the\nground [m]", {"height": seen.above_ground_m}),
        Curve("pixel on the\nground [m]", {"pixel": seen.pixel_m}),
        Curve(f"motion within\n{1e3 * seen.memory_s:g} ms [px]", {"motion": seen.motion_px}),
    ]
    warning = [f"<p class=grave>{text(cost.warning)}</p>"] if cost.warning else []
    parts = [
        f"<h1>Preview of a flight over {text(renderer.scene.name)}</h1>", _summary([*seen.lines(), *cost.lines()]),
        *warning, figure(jpeg(drawn), "Track over the orthophoto, and what evenly chosen frames see of the ground."),
        figure(jpeg(curves(seen.time_s, panels)), "Medians over each frame; motion is its 98th percentile."),
    ]  # fmt: skip
    page = document(f"Preview: {renderer.scene.name}", parts, _STYLE)
    picture, html = folder / "preview.png", folder / "preview.html"
    formats.write_image(picture, drawn)
    formats.write_text(html, page)
    return [picture, html]


def write_page(
    folder: Path, renderer: "Renderer", settings: Mapping[str, Any], seen: Prospect, pictured: Mapping[int, Pictured]
) -> None:
    """Write `contact.png` and `index.html` of a finished flight from its settings and the records of its frames.
    `pictured` is {number of a frame: Pictured} of the frames on the sheet."""
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text(encoding="utf-8").splitlines()]
    labels = [f"{index} · {lines[index]['time_s']:.2f} s" for index in pictured]
    title = f"{settings['scene']}, {settings['camera']}: {len(pictured)} of {len(lines)} frames"
    shown = pictured.values()
    contact = sheet([each.kelvin for each in shown], [each.surface for each in shown], labels, title)
    formats.write_image(folder / "contact.png", contact)
    drawn = flight_map(renderer, seen, renderer.scene.targets)
    when = f", from {settings['time']}" if settings["time"] else ""
    about = f"{settings['camera']}, {len(lines)} frames at {settings['rate_hz']:g} Hz{when}; seed {settings['seed']}"
    parts = [
        f"<h1>Flight over {text(settings['scene'])}</h1>", f"<p class=note>{text(about)}</p>", _links(folder),
        _summary(seen.lines()), figure(jpeg(drawn), "Track, and what evenly chosen frames see of the ground."),
        figure(jpeg(contact), "Evenly chosen frames, without noise. The colours span the surfaces that they show."),
        figure(jpeg(_over_time(lines)), "Apparent temperature: median, and from the least to the greatest pixel; "
               "error budget at 300 K."),
        *_targets(lines, pictured), *_frames(lines, pictured),
    ]  # fmt: skip
    formats.write_text(folder / "index.html", document(f"Flight over {settings['scene']}", parts, _STYLE))


def _summary(lines: Sequence[str]) -> str:
    return f"<pre>{text(chr(10).join(lines))}</pre>"


def _links(folder: Path) -> str:
    names = ("flight.mp4", "contact.png", "frames.jsonl", "flight.json")
    links = [f"<a href='{name}'>{name}</a>" for name in names if (folder / name).exists()]
    return f"<p>{' · '.join(links)}</p>"


def _over_time(lines: Sequence[Mapping[str, Any]]) -> Picture:
    time_s = np.array([line["time_s"] for line in lines])
    low, middle, high = np.array([line["apparent_k"] for line in lines], np.float64).T
    budgets = [line["budget_mk"] or {} for line in lines]
    names = [name for name in budgets[0] if name != "image"]
    causes = {name: np.array([each.get(name, np.nan) for each in budgets]) for name in names}
    panels = [
        Curve("apparent\ntemperature [K]", {"median": middle}, (low, high), celsius=True),
        Curve("error budget\n[mK]", causes),
    ]
    ranges = {
        name: np.array(
            [line["targets"][name]["range_m"] if line["targets"][name]["visible"] else np.nan for line in lines]
        )
        for name in lines[0]["targets"]
    }
    ranges = {name: values for name, values in ranges.items() if np.isfinite(values).any()}
    if ranges:
        panels.append(Curve("range of visible\ntargets [m]", ranges))
    return curves(time_s, panels)


def _targets(lines: Sequence[Mapping[str, Any]], pictured: Mapping[int, Pictured]) -> list[str]:
    """A table of the objects: in how many frames each is visible, from which range, on how many pixels."""
    rows = []
    for name in lines[0]["targets"]:
        each = [line["targets"][name] for line in lines]
        ranges = [one["range_m"] for one in each if one["visible"]]
        pixels = [count for one in pictured.values() if (count := one.pixels.get(name, 0))]
        on = f"{min(pixels)}–{max(pixels)}" if pixels else "0"
        far = f"{min(ranges):.1f}–{max(ranges):.1f}" if ranges else "–"
        rows.append(((name, sum(one["in_view"] for one in each), len(ranges), far, on), not ranges and not pixels))
    if not rows:
        return []
    head = (
        "target",
        "frames with its middle in view",
        "frames with its middle visible",
        "range then [m]",
        "pixels on it, frames of the sheet",
    )
    words = "Visible: nothing hides its middle. Where something does, other parts may show. Red: never seen."
    return ["<h2>Targets</h2>", table(head, rows), f"<p class=note>{words}</p>"]


def _frames(lines: Sequence[Mapping[str, Any]], pictured: Mapping[int, Pictured]) -> list[str]:
    """A table of the frames on the sheet, with links to their files."""
    rows = []
    for index in pictured:
        line = lines[index]
        low, middle, high = line["apparent_k"]
        east, north, up = (row[3] for row in line["world_from_camera"][:3])
        links = " ".join(f"<a href='{text(name)}'>{text(_short(name))}</a>" for name in line["files"])
        total = (line["budget_mk"] or {}).get("total")
        cells = (
            index, f"{line['time_s']:.3f}", f"{east:.1f}", f"{north:.1f}", f"{up:.1f}", f"{low:.2f}", f"{middle:.2f}",
            f"{high:.2f}", "–" if total is None else f"{total:.0f}", "yes" if line["shows_terrain"] else "no",
        )  # fmt: skip
        rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}<td class=words>{links}</td></tr>")
    head = ("frame", "time [s]", "east [m]", "north [m]", "up [m]", "min [K]", "median [K]", "max [K]", "budget [mK]",
            "terrain")  # fmt: skip
    titles = "".join(f"<th>{name}</th>" for name in head) + "<th class=words>files</th>"
    return ["<h2>Frames of the sheet</h2>",
            f"<table><thead><tr>{titles}</tr></thead><tbody>{''.join(rows)}</tbody></table>"]  # fmt: skip


def _short(name: str) -> str:
    """The end of the name of a frame's file: exr for frame_000012.exr, counts.png for frame_000012_counts.png."""
    return name[len("frame_000000") :].lstrip("._")
