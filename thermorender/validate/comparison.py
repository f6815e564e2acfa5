"""Data-driven translation against the radiometric render of the same poses, in kelvin.

Three pictures are made of each pose. The *reference* is rendered from the scene's truth temperatures. In the *2D*
domain a learned map is applied to the rendered visible frame, as the published methods do. In the *3D* domain it is
applied to the orthophoto, its apparent temperatures are turned into kinetic ones, and that scene is rendered. A map in
one domain is a *method*; one that is told relief, hour or weather has the 3D domain only. Errors are differences of
apparent temperature from the reference, over pixels whose truth is known. A constant, the reference's own mean, stands
beside them as the floor any map must beat.
"""

from dataclasses import dataclass, field

import numpy as np

from thermorender import defaults, files
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.output.record import weather_of
from thermorender.render.renderer import Renderer
from thermorender.scene.spec import TemperatureSpec
from thermorender.scene.surface import FALLBACK, FILLED, SURFACE
from thermorender.units import utc_text
from thermorender.validate.figures.comparison import picture
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
class _Method:
    """A learned map in one domain, "2D" or "3D"."""

    model: object
    domain: str
    renderer: object = None
    errors: ErrorSums = field(default_factory=ErrorSums)

    @property
    def name(self):
        return f"{self.model.name} {self.domain}"


def compare(scene, trajectory, folder, models, rate_hz=1.0, range_c=None, progress=None, **settings):
    """Compare learned maps with the radiometric render along a flight; return the summary that is also written.

    Parameters
    ----------
    scene : Scene
        With a truth temperature raster, or the temperatures of a heat balance for truth, and an orthophoto.
    trajectory : Trajectory
    folder : path
        Receives `comparison.json` and one picture per pose and model.
    models : sequence of str
        Names of learned maps, or their files.
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
        Per method: mean_c, mean_absolute_c, std_c (errors in °C, equal to K), pixels; and the settings.

    Raises
    ------
    ThermorenderError
        No truth, an unknown map, two of one name, a folder that cannot be written.
    """
    if not models:
        raise ThermorenderError(f"models is empty; give at least one learned map, such as {defaults.TEMPERATURE_MAP}")
    maps = {name: load_model(name, range_c) for name in models}
    called = [model.name for model in maps.values()]
    for name in called:
        if called.count(name) > 1:
            raise ThermorenderError(f"two of the models are called {name!r}; give maps of different names")
    truth = scene.with_temperature(scene.truth_temperature_spec)
    times = trajectory.frame_times(rate_hz)
    poses = trajectory.sampled(times).poses()
    folder = files.make_folder(folder)
    reference = Renderer(truth, progress=progress, **settings)
    methods, reports = [], {}
    for name, model in maps.items():
        translated = scene.with_temperature(TemperatureSpec(source="learned", model=str(name), range_c=range_c))
        renderer = Renderer(translated, like=reference, **settings)
        reports.update(renderer.scene.report)
        # A picture alone is not enough for a map that is told more.
        methods += [_Method(model, "2D")] if not model.needs else []
        methods.append(_Method(model, "3D", renderer))
    constant = ErrorSums()
    for index, (time_s, pose) in enumerate(zip(times, poses, strict=True)):
        frame = reference.frame(pose, time_s, index)
        visible, covered = reference.visible(pose, time_s=time_s)
        flags = frame.truth["mask"]
        known = covered & ((flags & SURFACE) > 0) & ((flags & (FILLED | FALLBACK)) == 0)
        mean = float(frame.apparent_temperature[known].mean()) if known.any() else np.nan
        constant.add(mean - frame.apparent_temperature[known])
        pictures = {}
        for method in methods:
            if method.renderer:
                seen = method.renderer.frame(pose, time_s, index).apparent_temperature
            else:
                model = method.model
                seen = apparent_temperature(model.radiance(Inputs(visible)), model.band_um)
            error = np.where(known, seen - frame.apparent_temperature, np.nan)
            method.errors.add(error[known])
            pictures[method.name] = seen, error
        for model in maps.values():
            path = folder / f"pose_{index:04d}_{model.name}.png"
            picture(path, visible, frame.apparent_temperature, model.name, pictures, time_s)
        if progress:
            progress("comparing", (index + 1) / len(times))
    summary = {
        "scene": scene.name,
        "time": None if reference.scene.time is None else utc_text(reference.scene.time),
        **weather_of(reference.scene),
        "scene_digest": reference.scene.digest(),
        "poses": len(times),
        "rate_hz": rate_hz,
        "range_c": list(range_c) if range_c else None,
        "plan": reference.plan.as_dict(),
        "maps": reports,
        "errors": {**{method.name: method.errors.summary() for method in methods}, "constant": constant.summary()},
        "versions": versions(),
    }
    files.write_json(folder / "comparison.json", summary)
    return summary
