"""Frames of a real flight held out of a reconstruction, and predicted by its map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio

from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.survey.inverse.frames import Survey, frame_files, read_frames
from thermorender.apps.survey.inverse.linear import LinearKelvin
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.inverse.poses import PoseError, registered
from thermorender.apps.survey.inverse.products import lens_of
from thermorender.apps.survey.inverse.reconstruct import reconstruct
from thermorender.apps.survey.inverse.solve import Settings, tilting
from thermorender.apps.survey.inverse.weights import Viewer, binned, binned_camera, taps_of
from thermorender.scene.load import load_scene
from thermorender.sensor.camera import load_camera
from validation.inverse import rivals

# Of the flight's 64 frames, those with these remainders by `EVERY` are held out, one split each.
SPLITS, EVERY = (0, 3, 5), 9
# Photogrammetric poses are this well known.
ERROR = PoseError(0.15, 0.15)


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


def split(scene, camera, survey: Survey, which: int, texel_m: float = 0.12, rounds: int = 4) -> dict:
    """Return the root mean squares of held-out frames, registered and levelled, by method, and of each frame [K]."""
    held = np.arange(len(survey.names)) % EVERY == which
    part = Survey(*(tuple(np.array(values)[~held]) for values in (survey.names, survey.times)),
                  survey.kelvin[~held], survey.poses[~held])  # fmt: skip
    # The flight has no weather, so the prior is one temperature.
    settings = Settings(texel_m=texel_m, rounds=rounds, pose_error=ERROR, class_k=10.0, offset_k=3.0)
    found = reconstruct(scene, part, camera, settings)
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
    number = np.array([int(name[-4:]) for name in survey.names])
    for image, pose, at in zip(survey.kelvin[held], survey.poses[held], number[held], strict=True):
        # Frames before and after a held-out frame know its tilt.
        tilts = [np.interp(at, number[~held], each) for each in found.state.tilts.T]
        for name, (values, shade) in maps.items():
            tilt = (tilts @ tilting(camera)).reshape(own.shape) if name == "reconstruction" else nothing
            result[name].append(_miss(viewer, values, linear.of(image) - shade - tilt, pose))
    total = {name: float(np.sqrt(np.nanmean(np.square(each)))) for name, each in result.items()}
    return total | {"frames": dict(zip(np.array(survey.names)[held].tolist(), result["reconstruction"], strict=True))}


def _miss(viewer: Viewer, values, image, pose) -> float:
    """Root mean square of a frame minus its prediction, after registration, without its level [K]."""
    filled = np.where(np.isfinite(values), values, np.nanmedian(values))
    pose = registered(viewer, filled, image.astype(np.float32), pose, pose, ERROR, search=False)
    sight = viewer.sight(pose)
    seen = viewer.imaged(sight, filled, taps_of(), image)
    known = sight.seen(np.isfinite(values).astype(float), taps_of()) > 0.999
    miss = (image.ravel()[sight.pixel] - seen)[known]
    return float(np.std(miss[np.isfinite(miss)])) if miss.size else float("nan")
