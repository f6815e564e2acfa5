"""Frames of a real flight held out of a reconstruction, and predicted by its map."""

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio

from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.survey.inverse.frames import Survey, frame_files, places_of, read_frames
from thermorender.apps.survey.inverse.linear import LinearKelvin
from thermorender.apps.survey.inverse.own_ground import between, level_scene, stated_camera
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.inverse.poses import PoseError, deviation, registered
from thermorender.apps.survey.inverse.products import lens_of
from thermorender.apps.survey.inverse.reconstruct import reconstruct
from thermorender.apps.survey.inverse.run import aligned
from thermorender.apps.survey.inverse.solve import Settings, tilting
from thermorender.apps.survey.inverse.weights import Viewer, binned, binned_camera, moved, taps_of
from thermorender.scene.load import load_scene
from thermorender.sensor.camera import load_camera
from validation.inverse import rivals

# Of the flight's 64 frames, those with these remainders by `EVERY` are held out, one split each.
SPLITS, EVERY = (0, 3, 5), 9
# Photogrammetric poses are this well known, those of a drone with RTK, and a pose by that of the frame before.
ERROR, RTK, _NEAR = PoseError(0.15, 0.15), PoseError(0.1, 0.7), PoseError(0.5, 0.5)


def read_flight(folder: Path, made: Path) -> tuple:
    """Return (scene, camera, Survey) of the flight's frames, by means of 2 × 2 pixels.

    The lens is that of camera_model.xml, whose p1 and p2 stand for our p2 and p1.
    """
    if not made.exists():
        # The file holds overviews as further pictures.
        heights = made.with_name("elevation.tif")
        with rasterio.open(f"GTIFF_DIR:1:{folder / 'elevation_coarse.tif'}") as file:
            # Its own definition of the system has no inverse.
            profile, values = file.profile | {"crs": "EPSG:2056"}, file.read(1)
        with rasterio.open(heights, "w", **profile) as file:
            file.write(values, 1)
        import_terrain(heights, None, made)
    scene = load_scene(made)
    base = load_camera("zenmuse-xt2")
    camera = replace(
        base, name="flight", width=640, height=512, focal_length_mm=741.153 * base.pixel_pitch_um * 1e-3,
        principal_offset_px=(10.090, 8.539), distortion=(-0.02603, 0.23459, 0.003852, 0.008663, 0.18332),
    )  # fmt: skip
    places = read_poses(folder / "poses.csv")
    survey = read_frames(frame_files([folder / f"{name}.tif" for name in places]), places, scene, (0.001, 273.15))
    small = np.stack([binned(image, 2) for image in survey.kelvin]).astype(np.float32)
    camera = binned_camera(camera, 2)
    return scene.with_camera(camera), camera, replace(survey, kelvin=small)


def split(scene, camera, survey: Survey, which: int, error=ERROR, texel_m: float = 0.12, alone: bool = False) -> dict:
    """Return the root mean squares of held-out frames, registered and levelled, by method, and of each frame [K].

    The other frames are aligned and solved as the command does: `alone` with the lens and the relief that they show,
    otherwise with the lens of the camera and the ground of the scene.
    """
    held = np.arange(len(survey.names)) % EVERY == which
    part = Survey(*(tuple(np.array(values)[~held]) for values in (survey.names, survey.times)),
                  survey.kelvin[~held], survey.poses[~held])  # fmt: skip
    with tempfile.TemporaryDirectory() as out:
        part, own_scene, camera = aligned(part, scene, camera, error, alone, alone, Path(out))
        settings = Settings(texel_m=texel_m, pose_error=error)
        found = reconstruct(own_scene.with_camera(camera), part, camera, settings)
    linear = LinearKelvin(camera.band_um, round(float(np.nanmedian(part.kelvin)), 1))
    viewer = Viewer(found.renderer, camera, found.lattice)
    images = np.stack([linear.of(image) for image in part.kelvin]).astype(np.float32)
    devignetted, lens = rivals.devignetted(viewer, images, part.poses)
    own = lens_of(found) + found.state.pattern
    nothing = np.zeros(own.shape)
    maps = {
        "plain mean": (rivals.plain_mean(viewer, images, part.poses), nothing),
        "best view": (rivals.best_view(viewer, images, part.poses), nothing),
        "devignetting and offsets": (devignetted, lens),
        "reconstruction": (np.where(found.views > 0, found.state.map, np.nan), own),
    }
    result: dict = {name: [] for name in maps}
    # Their numbers tell frames that were left out of the flight before.
    number = np.array([int(re.findall(r"\d{4}", name)[-1]) for name in survey.names])
    kept = np.flatnonzero(~held)
    poses = survey.poses if scene.frame is None else between(survey.poses, scene.frame, own_scene.frame)
    for at in np.flatnonzero(held):
        # Frames before and after a held-out frame know its tilt, and the nearest how far its measured pose is off.
        tilts = [np.interp(number[at], number[kept], each) for each in found.state.tilts.T]
        nearest = int(np.argmin(np.abs(number[kept] - number[at])))
        pose = moved(poses[at], deviation(part.poses[nearest], part.measured[nearest]))
        for name, (values, shade) in maps.items():
            tilt = (tilts @ tilting(camera)).reshape(own.shape) if name == "reconstruction" else nothing
            image = linear.of(survey.kelvin[at]) - shade - tilt
            result[name].append(_miss(viewer, values, image, pose, alone))
    total = {name: float(np.sqrt(np.nanmean(np.square(each)))) for name, each in result.items()}
    return total | {"frames": dict(zip(np.array(survey.names)[held].tolist(), result["reconstruction"], strict=True))}


def read_alone(folder: Path, made: Path) -> tuple:
    """Return (scene of level ground, camera of the frames' tags, Survey) of a folder of radiometric JPEGs."""
    files = frame_files([folder])
    places = places_of(files)
    scene = level_scene(list(places.values()), None, made)
    survey = read_frames(files, places, scene)
    return scene, stated_camera(files[0], survey.kelvin.shape[1:])[0], survey


def _miss(viewer: Viewer, values, image, pose, search: bool) -> float:
    """Root mean square of a frame minus its prediction, after registration, without its level [K]."""
    filled = np.where(np.isfinite(values), values, np.nanmedian(values))
    pose = registered(viewer, filled, image.astype(np.float32), pose, pose, _NEAR if search else ERROR, search)
    sight = viewer.sight(pose)
    seen = viewer.imaged(sight, filled, taps_of(), image)
    known = sight.seen(np.isfinite(values).astype(float), taps_of()) > 0.999
    miss = (image.ravel()[sight.pixel] - seen)[known]
    return float(np.std(miss[np.isfinite(miss)])) if miss.size else float("nan")
