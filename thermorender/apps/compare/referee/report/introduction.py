"""The introduction of the report: what was compared, and the methods of this run in words."""

from collections.abc import Sequence
from typing import Any

from thermorender.apps.compare.referee.methods import CALIBRATED, OWN_MEAN, REFITTED
from thermorender.apps.compare.words import counted
from thermorender.output.flight_pages.html import text

Summary = dict[str, Any]

_OTHERS = "thermal frames of other lands in the same hour and weather"
_KINDS = {
    "B": "a map applied to the photograph",
    "C1": "the map applied to the orthophoto and rendered with {materials}",
    "C2": "the map applied to the orthophoto and rendered with learned materials",
    "D constant": f"one temperature, the mean of {_OTHERS}",
    OWN_MEAN: "one temperature per frame, the mean of the reference on ground",
    "E": f"one temperature per material, from {_OTHERS}",
    "F": "the heat balance with properties from tables, under the scene's weather",
    "P": "a privileged map, one that takes the material as input",
    "foreign": "frames of another program",
}
_BOUNDS = {
    REFITTED: f"the map's bounds are 1.5 interquartile ranges beyond the quartiles of {_OTHERS}. This suits a map that "
              "was trained in one campaign, and reduces the contrast of one trained in many",
    CALIBRATED: f"a least-squares line from the map's intensities of other lands' photographs to {_OTHERS}",
}  # fmt: skip


def introduction(summary: Summary) -> str:
    """Return the HTML of the introduction; it explains only methods and bounds of this run."""
    lines = [f"{name}: {words}." for name, words in explained(summary)]
    return (f"<p>{text(' '.join(_opening(summary)))}</p><ul>{_items(lines)}</ul>"
            f"<ul class=note>{_items(summary['notes'])}</ul>")  # fmt: skip


def explained(summary: Summary) -> list[tuple[str, str]]:
    """Return [(letter, label or bounds, its meaning)] of the methods of a comparison."""
    methods = summary["methods"]
    present = {own["letter"] for own in methods.values()} | set(methods)
    present |= {own["bounds"] for own in methods.values()}
    words = {**_KINDS, **_BOUNDS}
    words["C1"] = words["C1"].format(materials=_materials(summary))
    found = [(name, words[name]) for name in words if name in present]
    if any(own["true_objects"] for own in methods.values()):
        found.append(("true objects", "the objects have their true temperatures instead of the map's"))
    return found


def _opening(summary: Summary) -> list[str]:
    scenes = summary["scenes"]
    counts = (counted(len(scenes), "scene"), counted(sum(each["poses"] for each in scenes), "pose"),
              counted(len(summary["methods"]), "method"))  # fmt: skip
    found = [f"{', '.join(counts)}. All methods get the same poses, camera and photographs."]
    if any(scene["reference"] for scene in scenes):
        computed = any(scene["computed"] for scene in scenes)
        found.append("Errors are apparent temperature minus that of the reference, a render from the "
                     f"{'computed' if computed else 'true'} temperatures and {_materials(summary)}.")  # fmt: skip
    return found


def _materials(summary: Summary) -> str:
    """Return what the materials are called: true ones, unless those of a scene are assumed."""
    return "the scene's materials" if any(each["assumed_materials"] for each in summary["scenes"]) else "true materials"


def _items(lines: Sequence[str]) -> str:
    return "".join(f"<li>{text(line)}</li>" for line in lines)
