"""The files of a reconstruction: maps, poses, offsets, the camera's own errors, a record, a page and a scene."""

import csv
import io
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender import formats, load_camera
from thermorender.apps.survey.inverse.adjustment import lens_of as lens_terms
from thermorender.apps.survey.inverse.poses import deviation
from thermorender.apps.survey.inverse.reconstruct import Reconstruction
from thermorender.apps.survey.inverse.solve import vignetting
from thermorender.apps.survey.inverse.weights import Lattice
from thermorender.defaults import CAMERA
from thermorender.frame.picture import png
from thermorender.frame.tiff import write_kelvin
from thermorender.output.flight_pages.html import document, figure, table, text
from thermorender.scene.meshes import mesh
from thermorender.schema import read_toml, toml_text
from thermorender.trajectory.readers import enu_from_ned_at
from thermorender.trajectory.rotations import BODY_FROM_CAMERA, angles_from_rotation
from thermorender.versions import versions

Floats = NDArray[np.float64]
# Pixels along the longer side of a picture.
_SIDE = 700
# Focal length, principal point from the middle and distortion, as `adjustment.lens_of` has them.
_LENS = "focal_px", "right_px", "down_px", "k1", "k2"


def write(found: Reconstruction, folder: Path) -> None:
    """Write the files of a Reconstruction, without its page, into a folder."""
    for name, values, title in (
        ("apparent", found.apparent, "apparent temperature"),
        ("apparent_std", found.apparent_std, "standard deviation without the common level"),
        ("kinetic", found.kinetic, "kinetic temperature"),
        ("kinetic_std", found.kinetic_std, "standard deviation without the common level"),
        ("residual", found.residual, "root mean square of the residuals"),
    ):
        _write(folder / f"{name}.tif", values, found.lattice, title)
    _write(folder / "views.tif", np.where(found.views > 0, found.views, np.nan), found.lattice, "frames", "1")
    _table(folder / "poses.csv", _poses(found))
    _table(folder / "offsets.csv", _offsets(found))
    lens = found.state.pattern + lens_of(found)
    write_kelvin(folder / "lens.tif", lens.astype(np.float32), name="vignetting and fixed pattern")
    formats.write_json(folder / "reconstruction.json", record(found))
    _scene(found, folder / "scene")


def lens_of(found: Reconstruction) -> Floats:
    """Return the vignetting of a Reconstruction, (H, W) [linear kelvin], with mean 0."""
    return np.asarray((found.state.vignette @ vignetting(found.camera)).reshape(found.state.pattern.shape))


def record(found: Reconstruction) -> dict[str, Any]:
    """Return what a Reconstruction assumed and found, as JSON."""
    std = found.apparent_std[np.isfinite(found.apparent_std)]
    moved = np.array([deviation(*pair) for pair in zip(found.state.poses, found.survey.measured, strict=True)])
    texel = found.lattice.texel_m
    return {
        "scene": found.renderer.scene.name, "frames": len(found.survey.names), "camera": found.camera.name,
        "settings": asdict(found.settings), "texel_m": texel, "texels": list(found.apparent.shape),
        "texels_shown": int((found.views > 0).sum()),
        "noise_k": found.state.noise_k, "error_over_draws": found.spread.scale,
        "position_error_m": found.spread.edge_texels * texel, "misfit": found.spread.misfit,
        "std_median_k": float(np.median(std)) if std.size else None,
        "level_k": found.level_k, "level_std_k": found.level_std_k, "level_of": _level_of(found),
        "references": [{"name": name, "residual_k": value} for name, value in found.references],
        "offsets_std_k": float(found.state.offsets.std()), "tilts_rms_k": found.state.tilt_k,
        "lens": dict(zip(_LENS, lens_terms(found.camera).tolist(), strict=True)),
        "shutter_jump_k": found.shutters.fall_k, "vignetting_k": float(np.ptp(lens_of(found))),
        "poses_moved_m": float(np.linalg.norm(moved[:, :3], axis=1).mean()),
        "poses_turned_deg": float(np.degrees(np.linalg.norm(moved[:, 3:], axis=1)).mean()),
        "notes": list(found.notes), "versions": versions(),
    }  # fmt: skip


def _level_of(found: Reconstruction) -> str:
    """What sets the common level."""
    if found.references:
        return "references"
    return "the frames after a shutter" if found.shutters.after.size else "the camera's accuracy"


def _write(path: Path, values: Floats, lattice: Lattice, name: str, unit: str = "K") -> None:
    grid = lattice.grid
    write_kelvin(path, values.astype(np.float32), grid.crs, grid.transform, name, unit)


def _table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    lines = io.StringIO()
    writer = csv.DictWriter(lines, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    formats.write_text(path, lines.getvalue())


def _poses(found: Reconstruction) -> list[dict[str, Any]]:
    """Rows as `pose_files.read_poses` reads them, with the correction of each frame."""
    poses = found.state.poses
    ned = enu_from_ned_at(poses[:, :3, 3], found.renderer.scene.frame).inv() * Rotation.from_matrix(poses[:, :3, :3])
    angles = angles_from_rotation(ned * Rotation.from_matrix(BODY_FROM_CAMERA).inv())
    rows = []
    for number, name in enumerate(found.survey.names):
        step = deviation(poses[number], found.survey.measured[number])
        place = dict(zip(("east_m", "north_m", "up_m"), poses[number, :3, 3], strict=True))
        turn = dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles[number], strict=True))
        rows.append({
            "frame": name, "time": found.survey.times[number], "time_s": number,
            **_rounded(place, 4), **_rounded(turn, 6),
            "moved_m": round(float(np.linalg.norm(step[:3])), 4),
            "turned_deg": round(float(np.degrees(np.linalg.norm(step[3:]))), 5),
        })  # fmt: skip
    return rows


def _rounded(values: dict[str, float], digits: int) -> dict[str, float]:
    return {name: round(float(value), digits) for name, value in values.items()}


def _offsets(found: Reconstruction) -> list[dict[str, Any]]:
    return [
        {"frame": name, "time": time}
        | _rounded({"offset_k": offset, "tilt_right_k": right, "tilt_down_k": down}, 5)
        | {"residual_k": round(float(rest), 4) if np.isfinite(rest) else "", "drift_k": round(float(drift), 5),
           "after_shutter": int(number in found.shutters.after)}
        for number, (name, time, offset, (right, down), rest, drift) in enumerate(zip(
            found.survey.names,
            found.survey.times,
            found.state.offsets,
            found.state.tilts,
            found.spread.frames,
            found.shutters.drift,
            strict=True,
        ))
    ]  # fmt: skip


def _scene(found: Reconstruction, folder: Path) -> None:
    """Write a scene folder with the kinetic temperatures; where there are none, those of the scene itself."""
    scene = found.renderer.scene
    source = scene.spec.folder
    folder.mkdir(exist_ok=True)
    tables = read_toml(source / "scene.toml")
    for each in sorted(files_of_scene(source, tables)):
        path = folder / each.relative_to(source)
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(each, path)
    whole = Lattice.of(scene, found.settings.texel_m)
    values = whole.of_scene(scene.surfaces[0].temperature)
    window = np.s_[found.lattice.row : found.lattice.row + found.lattice.shape[0],
                   found.lattice.column : found.lattice.column + found.lattice.shape[1]]  # fmt: skip
    # The common level of the prior is not that of the frames.
    known = np.isfinite(found.kinetic)
    values += float(np.mean((found.kinetic - values[window])[known])) if known.any() else 0.0
    values[window] = np.where(known, found.kinetic, values[window])
    _write(folder / "reconstructed.tif", values, whole, "kinetic temperature")
    error = float(np.sqrt(np.nanmean(found.kinetic_std**2) + found.level_std_k**2)) if known.any() else None
    tables["temperature"] = {"source": "raster", "raster": "reconstructed.tif"}
    if error is not None:
        tables["temperature"] |= {"map_error_k": round(min(error, 50.0), 3)}
    model = str(tables.get("camera", {}).get("model", CAMERA))
    if found.camera != load_camera(source / model if model.endswith(".toml") else model):
        # The poses belong to the camera and lens that the frames were read with.
        absent = "name", *found.camera.absent
        keys = {each.name: getattr(found.camera, each.name) for each in fields(found.camera) if each.name not in absent}
        formats.write_text(folder / "camera.toml", toml_text(keys, f"{found.camera.name}, as the frames were read."))
        tables["camera"] = {"model": "camera.toml"}
    if "weather" in tables:
        tables["temperature"] |= {"trained": dict(tables["weather"])}
    formats.write_text(folder / "scene.toml", toml_text(tables, "Temperatures reconstructed from frames."))


def files_of_scene(source: Path, tables: dict[str, Any]) -> set[Path]:
    """Return the files that a scene's tables name, those that these need, and the scene's own materials.

    A raster has files of the same stem beside it; a mesh names its libraries and textures.
    """
    found = {each for each in (source / "materials").rglob("*") if each.is_file()}
    for named in (source / name for name in _names(tables)):
        if named.is_file() and named.suffix.lower() in mesh.FORMATS:
            found |= mesh.files_of(named, source)
        elif named.is_file():
            beside = [each for each in named.parent.iterdir() if each.is_file() and each.name != "scene.toml"]
            found |= {each for each in beside if each.name.split(".")[0] == named.name.split(".")[0]}
    return found


def _names(value: Any) -> Iterable[str]:
    """All texts in the tables of a scene file, of which those that name files are copied."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _names(each)
    elif isinstance(value, list):
        for each in value:
            yield from _names(each)


def write_page(found: Reconstruction, folder: Path) -> Path:
    """Write `report.html` of a Reconstruction into a folder and return its path."""
    facts = record(found)
    name = text(facts["scene"])
    lines = [
        f"{facts['frames']} frames of {facts['camera']}, texels of {facts['texel_m']:.3g} m, "
        f"{facts['texels_shown']} of them shown",
        f"standard deviation of a texel {facts['std_median_k']:.3f} K in the median, without the common level",
        f"common level ± {facts['level_std_k']:.2f} K, from {facts['level_of']}",
        f"noise of a pixel {facts['noise_k']:.3f} K; error of the positions {facts['position_error_m']:.3f} m",
        f"offsets of the frames ± {facts['offsets_std_k']:.3f} K, tilts ± {facts['tilts_rms_k']:.3f} K; vignetting and "
        f"shading {facts['vignetting_k']:.2f} K",
        f"poses moved by {facts['poses_moved_m']:.2f} m and turned by {facts['poses_turned_deg']:.2f}° on average",
    ]
    unknown = "".join(f"<li>{text(note)}</li>" for note in found.notes)
    parts = [
        f"<h1>Temperatures of {name} from frames</h1>", f"<pre>{text(chr(10).join(lines))}</pre>",
        f"<h2>Assumptions, and what is unknown</h2><ul>{unknown or '<li>nothing to note</li>'}</ul>",
        "<h2>Maps</h2>",
        *(
            _picture(values, title, words, of, found.lattice.texel_m) for values, title, words, of in (
                (found.prior, "apparent temperature before", "The scene's own temperatures, the prior.", "[K]"),
                (found.apparent, "apparent temperature after", "The reconstruction.", "[K]"),
                (found.kinetic, "kinetic temperature", "With the scene's emissivity and reflected light removed; empty "
                 "where that is not possible.", "[K]"),
                (found.apparent_std, "standard deviation", "Of each texel, without the common level.", "[K]"),
                (found.residual, "residual", "Root mean square of the residuals of the pixels on each texel. Large "
                 "values away from edges are things that moved, reflect or changed.", "[K]"),
                (np.where(found.views > 0, found.views, np.nan), "frames", "Frames that show each texel.", "count"),
            )
        ),
        "<h2>Camera</h2>",
        _picture(lens_of(found) + found.state.pattern, "lens", "Vignetting and fixed pattern, common to all frames."),
        *_references(found), "<h2>Frames</h2>", _frames(found),
    ]  # fmt: skip
    path = folder / "report.html"
    formats.write_text(path, document(f"Reconstruction of {facts['scene']}", parts))
    return path


def _picture(
    values: NDArray[np.float64], title: str, words: str, of: str = "[K]", texel_m: float | None = None
) -> str:  # fmt: skip
    step = max(1, int(np.ceil(max(values.shape) / _SIDE)))
    side = None if texel_m is None else step * texel_m
    return figure(png(values[::step, ::step].astype(np.float32), title, of, side), words)


def _references(found: Reconstruction) -> list[str]:
    if not found.references:
        return []
    rows = [((name, f"{value:+.3f}"), False) for name, value in found.references]
    return ["<h2>References</h2>", table(("reference", "residual [K]"), rows)]


def _frames(found: Reconstruction) -> str:
    rows = []
    for number, name in enumerate(found.survey.names):
        step = deviation(found.state.poses[number], found.survey.measured[number])
        moved, turned = np.linalg.norm(step[:3]), np.degrees(np.linalg.norm(step[3:]))
        error = found.settings.pose_error
        far = moved > 3.0 * np.sqrt(3.0) * error.position_m or turned > 3.0 * np.sqrt(3.0) * error.angle_deg
        rest = found.spread.frames[number]
        cells = (
            name, found.survey.times[number], f"{found.state.offsets[number]:+.3f}",
            f"{rest:.3f}" if np.isfinite(rest) else "", f"{moved:.2f}", f"{turned:.2f}",
        )  # fmt: skip
        rows.append((cells, bool(far)))
    head = ("frame", "time", "offset [K]", "residual [K]", "moved [m]", "turned [deg]")
    return "<p class=note>Red: moved beyond three standard deviations.</p>" + table(head, rows)
