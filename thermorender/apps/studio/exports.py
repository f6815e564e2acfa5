"""A view as a file, a table of its materials as CSV, and the view as lines of code."""

import csv
import io
import json
import shlex
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.studio.layers import LAYERS, Shot, statistics, unit_text
from thermorender.apps.studio.pictures import Picture, figure_of
from thermorender.apps.studio.view import View, numbers_text, on_terrain
from thermorender.errors import ThermorenderError
from thermorender.files import scratch_folder
from thermorender.units import utc_text
from thermorender.versions import versions

if TYPE_CHECKING:
    from thermorender.apps.studio.session import Session

# Files of what is shown, and files of the camera's frame.
KINDS = {
    "png": "PNG, the picture with its bar", "svg": "SVG, the picture with its bar", "csv": "CSV, values of the pixels",
    "table.csv": "CSV, table of materials", "exr": "EXR, values of the pixels",
    "frame.exr": "EXR, the frame: radiance and truth", "frame.png": "PNG, camera display",
    "frame.tif": "TIFF, apparent temperature [K]", "map.tif": "GeoTIFF, map of apparent temperature [K]",
    "frame.npz": "NPZ, arrays of the frame",
}  # fmt: skip


def exported(session: "Session", tab: str, kind: str, metres: float) -> tuple[bytes, str]:
    """Return (contents, name) of a file of what a tab shows, one of `KINDS`; `metres` are those of a map's pixels."""
    shot, picture = session.renders.shown(tab)
    if shot is None or picture is None or kind not in KINDS:
        raise ThermorenderError("there is no picture yet, or no such kind of file; wait for the picture, or reload")
    if kind.startswith(("frame.", "map.")) and shot.frame is None:
        raise ThermorenderError("a plan has no camera frame; show the camera's view, and export again")
    base = session.base.name
    beside = "-beside-" if picture.other and kind in ("png", "svg") else "-minus-" if picture.difference else ""
    against = f"{beside}{shot.view.against.replace(' ', '-')}" if beside else ""
    plan = "-plan" if shot.view.plan else ""
    name = f"{base}-{shot.view.layer}{against}{plan}-version-{picture.version}.{kind}"
    return session.renders.call(lambda: _made(session, shot, picture, kind, metres)), name


def _made(session: "Session", shot: Shot, picture: Picture, kind: str, metres: float) -> bytes:
    if kind in ("png", "svg"):
        return figure_of(picture, f"{session.base.name}, {picture.title}, {_state(picture)}", kind)
    if kind in ("csv", "exr"):
        values = picture.values
        if values is None:
            raise ThermorenderError(f"{picture.title} has no values; show a layer with a bar, or export the PNG")
        channel = LAYERS[shot.view.layer].channel + ("_difference" if picture.difference else "")
        return _pixels(values, _about(session, shot, picture), channel, kind)
    if kind == "table.csv":
        return table_of(shot, picture, session.areas()).encode()
    with scratch_folder() as scratch:
        assert shot.frame is not None
        path = scratch / f"frame.{kind.rpartition('.')[2]}"
        (shot.frame.orthorectified(metres) if kind == "map.tif" else shot.frame).save(path)
        return path.read_bytes()


def _state(picture: Picture) -> str:
    return f"version {picture.version}, {picture.words}"


def _about(session: "Session", shot: Shot, picture: Picture) -> dict[str, Any]:
    time = shot.renderer.scene.time
    return {
        "scene": session.base.name, "shown": picture.title, "unit": picture.unit, "state": _state(picture),
        "time_utc": "none" if time is None else utc_text(time), "time_on_tracks_s": f"{shot.view.time_s:g}",
        "pose": shot.view.pose.text(session.base), "quality": session.quality, "seed": session.renders.renderer.seed,
        **{name: str(each) for name, each in versions().items()},
    }  # fmt: skip


def _pixels(values: NDArray[np.float32], about: dict[str, Any], channel: str, kind: str) -> bytes:
    """Values of pixels (H, W) as an EXR or as a CSV with comments above."""
    if kind == "exr":
        import OpenEXR  # type: ignore[import-not-found, unused-ignore]

        memory = io.BytesIO()
        head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File({**head, "thermorender": json.dumps(about)}, {channel or "level": values}).write(memory)
        return memory.getvalue()
    file = io.StringIO()
    for key, each in about.items():
        file.write(f"# {key}: {each}\n")
    np.savetxt(file, values, fmt="%.6g", delimiter=",")
    return file.getvalue().encode()


def table_of(shot: Shot, picture: Picture, areas_m2: dict[str, float]) -> str:
    """Return a CSV of the materials in view: share of the pixels, mean and extremes of what is shown, and area."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    what = "difference_" if picture.difference else ""
    head = [f"{what}{each}_{unit_text(picture.unit)}" for each in ("mean", "least", "greatest")]
    writer.writerow(["material", "share_of_pixels", *head, "area_from_above_m2"])
    for row in statistics(shot, None if picture.unit == "level" else picture.values):
        area = areas_m2.get(row.name)
        numbers = ("" if value is None else f"{value:.6g}" for value in (row.mean, row.least, row.greatest))
        writer.writerow([row.name, f"{row.share:.6f}", *numbers, "" if area is None else f"{area:.6g}"])
    return file.getvalue()


def commands(session: "Session", view: View) -> tuple[str, str]:
    """Return (Python, command line) that render a view; unsaved edits of tables are named, not repeated."""
    scene, document, saved = session.base, session.document, session.files.saved
    pose, place = _local(session, view) or view.pose.text(scene), str(scene.spec.folder)
    numbers = pose.replace(",", ", ")
    edits: dict[Any, str] = {key: name for key, name in document.classes.items() if name != saved.classes.get(key)}
    objects = {key: each for key, each in document.objects.items() if each != saved.objects.get(key)}
    edits |= {key: name for key, (name, _) in objects.items() if name != saved.objects[key][0]}
    kelvin = {key: k for key, (_, k) in objects.items() if k != saved.objects[key][1]}
    unsaved = document.changed(saved) + (["painted areas"] if document.painted != saved.painted else [])
    python = [_not_here(unsaved) + f"import thermorender as tr\n\nscene = tr.load_scene({place!r})"]
    python += [f"scene = scene.at({utc_text(document.time)!r})"] if document.time is not None else []
    python += [f"scene = scene.with_material({edits!r})"] if edits else []
    python += [f"scene = scene.with_objects({kelvin!r})"] if kelvin else []
    place_of = "scene.pose" if _local(session, view) is None else "tr.pose"
    python += [f"renderer = tr.Renderer(scene, {session.quality!r})"]
    python += [f"frame = renderer.frame({place_of}({numbers}), {view.time_s:g})", 'frame.save("frame.exr")', ""]
    return "\n".join(python), _not_here(unsaved + [str(key) for key in {**edits, **kelvin}]) + command(session, view)


def _not_here(unsaved: list[str]) -> str:
    return f"# not saved yet, so not in these lines: {', '.join(unsaved)}\n" if unsaved else ""


def _local(session: "Session", view: View) -> str | None:
    """The pose of a view outside the terrain, with local up; None over the terrain."""
    pose = view.pose
    if on_terrain(session.base, pose.east, pose.north):
        return None
    return numbers_text(pose.east, pose.north, pose.up, pose.yaw_deg, pose.pitch_deg, pose.roll_deg)


def command(session: "Session", view: View) -> str:
    """Return the command line that renders a view of the saved scene."""
    scene, time, local = session.base, session.document.time, _local(session, view)
    options = [str(scene.spec.folder), "--quality", session.quality, f"--pose={local or view.pose.text(scene)}"]
    options += ["--local-up"] if local else []
    options += ["--time", utc_text(time)] if time is not None else []
    return shlex.join(["thermorender", "render", *options, "-o", "out"]) + "\n"
