"""Data-driven translation against the radiometric render of the same poses, in kelvin.

Three pictures are made of each pose. The *reference* is rendered from the scene's truth temperatures. The *2D*
arm applies a learned map to the rendered visible frame, as the published methods do. The *3D* arm applies the
same map to the orthophoto, turns its apparent into kinetic temperature, and renders that scene. Errors are
differences of apparent temperature from the reference, over pixels whose truth is known. A constant, the
reference's own mean, stands beside them as the floor any map must beat.
"""

from dataclasses import dataclass, field

import numpy as np

from thermorender import defaults
from thermorender import products as product_files
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.correlation import load_model
from thermorender.render.renderer import Renderer
from thermorender.scene.spec import TemperatureSpec
from thermorender.scene.surface import FALLBACK, FILLED, SURFACE
from thermorender.units import ZERO_CELSIUS_K
from thermorender.versions import versions


@dataclass
class ErrorSums:
    """Running sums of an error over many frames: mean, mean absolute and standard deviation [K]."""

    count: int = 0
    total: float = 0.0
    absolute: float = 0.0
    square: float = 0.0
    without_temperature: int = 0

    def add(self, error):
        """Add an array of errors [K]; NaN (no temperature has that radiance) is counted apart."""
        finite = error[np.isfinite(error)]
        self.count += finite.size
        self.without_temperature += error.size - finite.size
        self.total += float(finite.sum())
        self.absolute += float(np.abs(finite).sum())
        self.square += float((finite**2).sum())

    def summary(self):
        """Return {mean_c, mean_absolute_c, std_c, pixels, pixels_without_temperature}."""
        if not self.count:
            return {"mean_c": None, "mean_absolute_c": None, "std_c": None, "pixels": 0,
                    "pixels_without_temperature": self.without_temperature}  # fmt: skip
        mean = self.total / self.count
        return {
            "mean_c": mean,
            "mean_absolute_c": self.absolute / self.count,
            "std_c": float(np.sqrt(max(self.square / self.count - mean**2, 0.0))),
            "pixels": self.count,
            "pixels_without_temperature": self.without_temperature,
        }


@dataclass
class _Arm:
    """One model seen one way."""

    model: object
    way: str
    renderer: object = None
    errors: ErrorSums = field(default_factory=ErrorSums)

    @property
    def name(self):
        return f"{self.model.name} {self.way}"


def compare(scene, trajectory, folder, models, rate_hz=1.0, range_c=None, progress=None, **settings):
    """Compare learned maps with the radiometric render along a flight; return the summary that is also written.

    Parameters
    ----------
    scene : Scene
        With a truth temperature raster and an orthophoto.
    trajectory : Trajectory
    folder : path
        Receives `comparison.json` and one picture per pose and model.
    models : sequence of str
        Names of learned maps.
    rate_hz : float
        Poses per second of flight.
    range_c : (2,) floats, optional
        Temperatures of intensity 0 and 1 [°C] in place of the maps' own.
    progress : callable, optional
        Called with (what, share done).
    **settings
        Passed to Renderer.

    Returns
    -------
    dict
        Per arm: mean_c, mean_absolute_c, std_c (errors in °C, equal to K), pixels; and the settings.

    Raises
    ------
    ThermorenderError
        No truth, an unknown map, a folder that cannot be written.
    """
    if not models:
        raise ThermorenderError(f"models is empty; give at least one learned map, such as {defaults.TEMPERATURE_MAP}")
    maps = [load_model(name, range_c) for name in models]
    truth = scene.with_temperature(scene.truth_temperature_spec)
    times = trajectory.frame_times(rate_hz)
    poses = trajectory.sampled(times).poses()
    folder = product_files.make_folder(folder)
    reference = Renderer(truth, progress=progress, **settings)
    arms, reports = [], {}
    for model in maps:
        translated = scene.with_temperature(TemperatureSpec(source="learned", model=model.name, range_c=range_c))
        reports.update(translated.report)
        arms += [_Arm(model, "2D"), _Arm(model, "3D", Renderer(translated, like=reference, **settings))]
    constant = ErrorSums()
    for index, (time_s, pose) in enumerate(zip(times, poses, strict=True)):
        frame = reference.frame(pose, time_s, index)
        visible, covered = reference.visible(pose, time_s)
        flags = frame.truth["mask"]
        known = covered & ((flags & SURFACE) > 0) & ((flags & (FILLED | FALLBACK)) == 0)
        mean = float(frame.apparent_temperature[known].mean()) if known.any() else np.nan
        constant.add(mean - frame.apparent_temperature[known])
        pictures = {}
        for arm in arms:
            if arm.renderer:
                seen = arm.renderer.frame(pose, time_s, index).apparent_temperature
            else:
                seen = apparent_temperature(arm.model.radiance(arm.model.intensity(visible)), arm.model.band_um)
            error = np.where(known, seen - frame.apparent_temperature, np.nan)
            arm.errors.add(error[known])
            pictures[arm.name] = seen, error
        for model in maps:
            path = folder / f"pose_{index:04d}_{model.name}.png"
            _picture(path, visible, frame.apparent_temperature, model.name, pictures, time_s)
        if progress:
            progress("comparing", (index + 1) / len(times))
    summary = {
        "scene": scene.name,
        "scene_digest": truth.digest(),
        "poses": len(times),
        "rate_hz": rate_hz,
        "range_c": list(range_c) if range_c else None,
        "plan": reference.plan.as_dict(),
        "maps": reports,
        "errors": {**{arm.name: arm.errors.summary() for arm in arms}, "constant": constant.summary()},
        "versions": versions(),
    }
    product_files.write_json(folder / "comparison.json", summary)
    return summary


def _picture(path, visible, reference, name, pictures, time_s):
    """Visible, reference, both arms and their errors as one PNG with scales in °C."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(15, 8.6), layout="constrained")
    flat = reference[np.isfinite(reference)]
    low, high = np.percentile(flat, [1, 99]) - ZERO_CELSIUS_K
    axes[0, 0].imshow(visible)
    axes[0, 0].set_title(f"visible view, t = {time_s:.1f} s")
    shown = axes[1, 0].imshow(reference - ZERO_CELSIUS_K, cmap="inferno", vmin=low, vmax=high)
    axes[1, 0].set_title("reference: rendered from truth")
    figure.colorbar(shown, ax=axes[1, 0], label="apparent temperature [°C]", shrink=0.8)
    errors = np.concatenate([pictures[f"{name} {way}"][1].ravel() for way in ("2D", "3D")])
    errors = errors[np.isfinite(errors)]
    limit = float(np.percentile(np.abs(errors), 98)) if errors.size else 1.0
    for row, way in enumerate(("2D", "3D")):
        seen, error = pictures[f"{name} {way}"]
        what = "translation of the visible frame" if way == "2D" else "render of the translated orthophoto"
        shown = axes[row, 1].imshow(seen - ZERO_CELSIUS_K, cmap="inferno", vmin=low, vmax=high)
        axes[row, 1].set_title(f"{name} {way}: {what}")
        figure.colorbar(shown, ax=axes[row, 1], label="apparent temperature [°C]", shrink=0.8)
        shown = axes[row, 2].imshow(error, cmap="RdBu_r", vmin=-limit, vmax=limit)
        finite = error[np.isfinite(error)]
        figure.colorbar(shown, ax=axes[row, 2], label="error [°C]", shrink=0.8)
        if finite.size:
            axes[row, 2].set_title(f"error: mean {finite.mean():+.2f}, std {finite.std():.2f} °C")
    for axis in axes.ravel():
        axis.set_axis_off()
    with product_files.atomic(path) as part:
        figure.savefig(part, dpi=80)
    pyplot.close(figure)
