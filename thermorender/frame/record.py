"""The record of a frame: what it is and how it was made, as plain values for JSON."""

from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.units import utc_text
from thermorender.versions import versions

if TYPE_CHECKING:
    from thermorender.frame.frame import Frame

# Units of the images of a frame, by the names that files give them.
UNITS = {
    "radiance": "W m-2 sr-1",
    "apparent_temperature": "K",
    "thermography_temperature": "K",
    "error": "mK at 300 K",
    "truth.kinetic_temperature": "K",
    "truth.depth": "m along the optical axis",
    "truth.position": "m, local East-North-Up",
}

# Keys of the camera that describe its image, as its TOML file names them.
_LENS = ("width", "height", "pixel_pitch_um", "focal_length_mm", "f_number", "principal_offset_px", "distortion",
         "band_um")  # fmt: skip


def record(frame: "Frame") -> dict[str, Any]:
    """Return a frame's line in `frames.jsonl`: time, pose, seed, plan, budget and targets, as plain values."""
    return {
        "index": frame.index,
        "time_s": frame.time_s,
        "time": None if frame.time is None else utc_text(frame.time),
        "world_from_camera": np.round(frame.pose, 9).tolist(),
        "seed": frame.seed,
        "camera": frame.camera.name,
        "plan": frame.plan,
        "budget_mk": frame.budget_mk and {cause: round(value, 2) for cause, value in frame.budget_mk.items()},
        "budget_frame": frame.budget_frame,
        "targets": frame.targets,
    }


def header(frame: "Frame", **more: Any) -> dict[str, Any]:
    """Return the record of a frame with its lens, the place of its scene, versions, device, more entries and units."""
    return {
        **record(frame), "lens": {name: getattr(frame.camera, name) for name in _LENS}, "place": _place(frame),
        "versions": versions(), "device": frame.device, **more, "units": UNITS,
    }  # fmt: skip


def truth_header(frame: "Frame") -> dict[str, Any]:
    """Return what the images of the truth need: names of materials and objects by number, and labels of objects."""
    return {"materials": list(frame.materials), "objects": list(frame.objects), "labels": frame.labels}


def _place(frame: "Frame") -> dict[str, Any] | None:
    """The origin of the local frame in WGS 84 and the scene's map; None without a place."""
    if frame.place is None:
        return None
    origin = frame.place.frame
    return {
        "latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg, "height_m": origin.height_m,
        "crs": frame.place.crs.to_string(),
    }  # fmt: skip
