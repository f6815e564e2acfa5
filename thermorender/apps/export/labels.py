"""Labels for machine learning from the truth of frames: COCO detection JSON, and masks of materials and objects."""

import json
import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.export.exr_frames import exr_frames
from thermorender.errors import ThermorenderError
from thermorender.materials.mixture import largest_part

# The surrounding of an object: pixels without an object, farther from it than the first and up to the second [px].
# A pixel beside its silhouette may hold a part of it.
_SURROUNDING_PX = (1, 5)
# Classes of the masks, in addition to "other".
_MOST_CLASSES = 10
# Keys of an object's labels that its annotation has too.
_EXTENTS = ("occluded", "truncated", "full_box")
_NUMBERED = re.compile(r"[ _-]*\d+$")


def coco(folder: str | PathLike[str], path: str | PathLike[str]) -> dict[str, int]:
    """Write COCO detection JSON of the objects that a folder's frames show.

    Parameters
    ----------
    folder : path
        Of `render`, `fly` or `day`, with EXR files that hold the truth.
    path : path
        JSON to write.

    Returns
    -------
    dict
        Numbers of images, annotations and categories.

    Notes
    -----
    A category is an object's name without the number at its end: car_0 and car_1 are both car. Each annotation has the
    keys of COCO (bbox and area of the visible pixels, segmentation as uncompressed RLE) and, of this package: object,
    track_id (the same in all frames), occluded, truncated and full_box as of `Frame.labels`, range_m to the object's
    middle, apparent_k (mean of its pixels) and contrast_k (that minus the mean of its surrounding, pixels without an
    object 2–5 px away; null without such pixels). An object in no pixel's middle has no annotation. A table of copies
    or crowns is a crowd (iscrowd 1), whose occluded, truncated, full_box and range_m are null.

    Raises
    ------
    ThermorenderError
        A folder without frames or without truth, or a file that cannot be written.
    """
    files.check_output_file(Path(path), (".json",))
    images, annotations, kinds = list[dict[str, Any]](), list[dict[str, Any]](), dict[str, int]()
    for number, channels, about in exr_frames(folder, ("truth.object", "apparent_temperature"), ("objects", "labels")):
        shown, kelvin = channels["truth.object"], channels["apparent_temperature"]
        height, width = shown.shape
        for name in about["objects"]:
            kinds.setdefault(_kind(name), len(kinds) + 1)
        image = {"id": number + 1, "file_name": _picture(Path(folder), number), "width": width, "height": height}
        images.append(image | {"time_s": about["time_s"], "date_captured": about["time"]})
        for track in np.unique(shown[shown > 0]).tolist():
            name = about["objects"][track - 1]
            mask = shown == track
            crowd = int(name not in about["targets"])
            extents = dict.fromkeys(_EXTENTS) if crowd else {key: about["labels"][name][key] for key in _EXTENTS}
            annotations.append({
                "id": len(annotations) + 1, "image_id": image["id"], "category_id": kinds[_kind(name)],
                "iscrowd": crowd, "bbox": _box(mask), "area": int(mask.sum()), "segmentation": run_lengths(mask),
                "object": name, "track_id": track, **extents,
                "range_m": None if crowd else about["targets"][name]["range_m"],
                **_contrast(kelvin, mask, shown),
            })  # fmt: skip
    categories = [{"id": number, "name": kind} for kind, number in kinds.items()]
    info = {"description": "frames of thermorender", "units": "pixels; m; K of apparent temperature"}
    whole = {"info": info, "images": images, "annotations": annotations, "categories": categories}
    formats.write_text(path, json.dumps(whole) + "\n")
    return {name: len(whole[name]) for name in ("images", "annotations", "categories")}


def masks(folder: str | PathLike[str], output: str | PathLike[str]) -> int:
    """Write masks of the frames of a folder as PNG, with a legend, and return the number of frames.

    Parameters
    ----------
    folder : path
        As of `coco`.
    output : path
        Gets frame_NNNNNN_material.png (uint8, 255 for none), frame_NNNNNN_object.png (uint16, 0 for none),
        frame_NNNNNN_class.png (uint8, 255 for none), and legend.json with {number: name} of each. A class is the
        material with the largest share of a mixture: the ten that most pixels of all frames show, and "other".

    Raises
    ------
    ThermorenderError
        A folder without frames or without truth, or more objects than a PNG can number.
    """
    import cv2

    count, shown = 0, np.zeros(256, int)
    with files.output_folder(output) as out:
        for number, channels, about in exr_frames(folder, ("truth.material", "truth.object"), ("materials", "objects")):
            if len(about["objects"]) > 65535:
                raise ThermorenderError(
                    f"{folder} shows a scene of {len(about['objects'])} objects; a PNG numbers up to 65535, so read "
                    "truth.object of the EXR files"
                )
            for name, kind in (("material", np.uint8), ("object", np.uint16)):
                formats.write_image(out / f"frame_{number:06d}_{name}.png", channels[f"truth.{name}"].astype(kind))
            shown += np.bincount(channels["truth.material"].astype(np.uint8).ravel(), minlength=256)
            materials, objects = about["materials"], about["objects"]
            count += 1
        names, class_of = _classes(materials, shown)
        for number in range(count):
            material = cv2.imread(str(out / f"frame_{number:06d}_material.png"), cv2.IMREAD_UNCHANGED)
            formats.write_image(out / f"frame_{number:06d}_class.png", class_of[material])
        legend = {
            "material": dict(enumerate(materials)) | {255: "none"},
            "class": dict(enumerate(names)) | {255: "none"},
            "object": {0: "none"} | dict(enumerate(objects, start=1)),
        }
        formats.write_json(out / "legend.json", legend)
    return count


def _classes(materials: Sequence[str], pixels: NDArray[np.integer]) -> tuple[list[str], NDArray[np.uint8]]:
    """(names of the classes, class of each material's number (256,), 255 for none), by the pixels (256,) of each."""
    parts = [largest_part(name) for name in materials]
    total = {part: sum(int(pixels[n]) for n, own in enumerate(parts) if own == part) for part in parts}
    names = sorted((part for part in total if total[part]), key=lambda part: -total[part])
    if len(names) > _MOST_CLASSES:
        names = [*names[:_MOST_CLASSES], "other"]
    class_of = np.full(256, 255, np.uint8)
    for number, part in enumerate(parts):
        if total[part]:
            class_of[number] = names.index(part) if part in names else len(names) - 1
    return names, class_of


def run_lengths(mask: NDArray[np.bool_]) -> dict[str, list[int]]:
    """Return COCO's uncompressed run lengths of a mask (H, W): down the columns, first pixels outside of it."""
    flat = mask.ravel(order="F")
    ends = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1, [flat.size]])
    counts = np.diff(ends).tolist()
    return {"size": list(mask.shape), "counts": [0, *counts] if flat[0] else counts}


def _kind(name: str) -> str:
    """An object's name without the number at its end."""
    return _NUMBERED.sub("", name) or name


def _picture(folder: Path, number: int) -> str:
    """Name of the frame's file to look at: the display, else the counts, else the EXR."""
    names = [f"frame_{number:06d}{end}" for end in (".png", "_counts.png", ".exr")]
    return next(name for name in names if (folder / name).exists())


def _box(mask: NDArray[np.bool_]) -> list[int]:
    """[left, top, width, height] of a mask [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [int(v) for v in (columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1)]


def _contrast(kelvin: NDArray[Any], mask: NDArray[np.bool_], shown: NDArray[Any]) -> dict[str, float | None]:
    """Mean apparent temperature of a mask, and its difference from the surrounding [K]."""
    import cv2

    left, top, width, height = _box(mask)
    inner, outer = _SURROUNDING_PX
    part = slice(max(top - outer, 0), top + height + outer), slice(max(left - outer, 0), left + width + outer)
    near, far = (
        cv2.dilate(mask[part].astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        for reach in (inner, outer)
    )
    around = far & ~near & (shown[part] == 0)
    own = float(kelvin[mask].mean(dtype=np.float64))
    other = float(kelvin[part][around].mean(dtype=np.float64)) if around.any() else None
    return {"apparent_k": round(own, 3), "contrast_k": None if other is None else round(own - other, 3)}
