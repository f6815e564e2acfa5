"""A learned map from a photograph to apparent temperature, for every method, and its file.

A map holds a *predictor*. From each pixel's inputs it predicts an intensity, linear in band radiance, where 0 and 1 are
two temperatures of the map. If air temperature is an input, it predicts kelvin above the air instead. The map also
records its training: data, band, camera, ground sampling distance, sky, hour and weather.

A map is one file, NumPy's .npz: arrays and a JSON text, no code.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from thermorender import files, formats
from thermorender.defaults import BAND_UM, CAMERA, TRAINED_MAPS
from thermorender.errors import ThermorenderError, shortened
from thermorender.learned import correlation
from thermorender.learned.fingerprints import Fingerprints
from thermorender.learned.training_level import TrainingLevel
from thermorender.physics.band import radiance_in_band, radiance_of
from thermorender.physics.planck import band_radiance, kelvin_per_radiance
from thermorender.schema import did_you_mean
from thermorender.units import ZERO_CELSIUS_K

FORMAT = 1
# An image may be this many times finer or coarser than the range trained on, without a warning.
TEXEL_MARGIN = 1.25
# An image may be this many times finer than the map: beyond, the map's neighbourhood is larger than most images.
MOST_SPACING = 64.0
# Default sky: a clear mid-latitude summer day in the band [K].
ASSUMED_SKY_K = 255.0
# Slopes are taken at no less than this share of the radiance at the range's warm end.
_LEAST_OF_COLD = 0.05
_HOTTEST_K = 1e4
# The largest network, pix2pixHD at full width, takes 365 MB in half precision.
_MOST_BYTES = 1 << 30
# Predictors: {name in the file: (module, class)}; a module is imported when a map that needs it is read.
PREDICTORS = {
    "correlation": ("thermorender.learned.correlation", "Correlation"),
    "palette": ("thermorender.learned.palette", "Palette"),
    "trees": ("thermorender.learned.trees", "Trees"),
    "linear": ("thermorender.learned.linear", "Linear"),
    "network": ("thermorender.learned.networks.predictor", "Network"),
}


@dataclass(frozen=True, eq=False)
class Inputs:
    """A picture and the extra inputs that a map may take.

    Attributes
    ----------
    rgb : (h, w, 3) uint8
        sRGB.
    texel_m : float or None
        Ground sampling distance [m]; None means the map's own.
    terrain : dict of str to (h, w) float32
        Relief, as by `thermorender.render.heat.relief`; NaN where there is no terrain.
    conditions : dict of str to float
        Hour and weather, as by `thermorender.render.heat.conditions`.
    depth : (h, w) float32 or None
        Distance from the camera, as a lidar measures it [m]; NaN where unknown.
    """

    rgb: np.ndarray
    texel_m: float | None = None
    terrain: Mapping[str, np.ndarray] = field(default_factory=dict)
    conditions: Mapping[str, float] = field(default_factory=dict)
    depth: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class TemperatureMap:
    """A trained map from a photograph to apparent temperature.

    Attributes
    ----------
    name : str
    method : str
        Method of `thermorender train`.
    predictor : object
        Has `predict(inputs, texel_m)`, (h, w) float64; `needs`, names of the required fields of Inputs; `above_air`,
        whether it predicts kelvin above the air instead of intensity; `header()` and `arrays()`, from which its class's
        `of(header, arrays)` makes it. A predictor that uses only a pixel's neighbourhood has `reach(spacing)`, its
        radius with taps `spacing` pixels apart; large pictures are then translated in strips. One that estimates the
        standard deviation of its error has `with_spread(inputs)`, which returns both.
    range_k : (2,) tuple of float
        Temperatures of intensity 0 and 1 [K].
    band_um : (2,) tuple of float
        Band of the training camera [µm].
    texel_m : float or None
        Ground sampling distance it is applied at [m]; None: unknown, and pictures are not resampled.
    texel_range_m : (2,) tuple of float or None
        Finest and coarsest ground sampling distance of the training [m]; None: unknown.
    camera : str
    sky_temperature : float
        Isotropic sky of the training pictures, their mean [K].
    source : str
    trained : dict or None
        Hour and weather of the training pictures, if all had the same: keys and values of a scene's [weather], a named
        day's. If None, the map can be moved to another hour only where the scene states them.
    error_k : float or None
        Root mean square error on pictures that it was not fitted to [K]; None: unknown.
    about : dict
        Data set and its split, conditions, settings, versions.
    fingerprints : Fingerprints or None
        Of its training pictures; None: what it was trained on is unknown.
    level : TrainingLevel or None
        Level and spread of its training pictures; None: unknown.
    """

    name: str
    method: str
    predictor: Any
    range_k: tuple[float, float]
    band_um: tuple[float, float]
    texel_m: float | None
    texel_range_m: tuple[float, float] | None
    camera: str
    sky_temperature: float
    source: str
    trained: dict[str, Any] | None = None
    error_k: float | None = None
    about: dict[str, Any] = field(default_factory=dict)
    fingerprints: Fingerprints | None = None
    level: TrainingLevel | None = None

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs besides rgb."""
        return self.predictor.needs

    def radiance(self, inputs: Inputs, band_um: tuple[float, float] | None = None) -> np.ndarray:
        """Return apparent band radiance, (h, w) float64 [W m⁻² sr⁻¹]; negative where no temperature exists.

        Parameters
        ----------
        inputs : Inputs
            An image at another ground sampling distance is resampled to the map's, and the result back.
        band_um : (2,) floats, optional
            Band of the radiance, such as a camera's [µm], by default the map's. The apparent temperature is kept.

        Raises
        ------
        ThermorenderError
            A required input is missing, or the image is too fine.
        """
        found = self._radiance_of(self._predicted(inputs)[0], inputs)
        return found if band_um is None else radiance_in_band(found, self.band_um, band_um)

    def band_note(self, band_um: tuple[float, float]) -> str | None:
        """Return a note where a camera's band [µm] is not the map's, else None."""
        if tuple(self.band_um) == tuple(band_um):
            return None
        return (
            f"learned map {self.name!r} gives apparent temperatures of {self.band_um[0]:g}–{self.band_um[1]:g} µm, "
            "another band"
        )

    def translated(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray | None]:
        """Return (apparent band radiance, standard deviation of its error), (h, w) float64 [W m⁻² sr⁻¹] and [K].

        The second is None where the method has no estimate per pixel. It was learned on the training pictures and is
        not valid for other colours, hours or weather.
        """
        found, spread = self._predicted(inputs)
        radiance = self._radiance_of(found, inputs)
        if spread is not None and not self.predictor.above_air:
            cold, warm = band_radiance(np.array(self.range_k), *self.band_um)
            # The range's cold end where no temperature exists.
            usable = np.maximum(radiance, min(cold, _LEAST_OF_COLD * warm))
            spread = spread * (warm - cold) * kelvin_per_radiance(usable, *self.band_um)
        return radiance, spread

    def _predicted(self, inputs: Inputs) -> tuple[Any, Any]:
        """The predictor's output, and its standard deviation or None."""
        if (
            self.texel_m is not None
            and inputs.texel_m is not None
            and not inputs.texel_m >= self.texel_m / MOST_SPACING
        ):
            raise ThermorenderError(
                f"a picture with {inputs.texel_m:.3g} m a pixel is too fine for learned map {self.name!r}, made for "
                f"{self.texel_m:.3g} m; give at least {self.texel_m / MOST_SPACING:.3g} m, or take it from farther away"
            )
        for name in self.needs:
            if getattr(inputs, name) is None or not len(getattr(inputs, name)):
                raise ThermorenderError(
                    f"learned map {self.name!r} needs {_WORDS[name]}, which a picture alone does not have; give it "
                    "with a scene that has [weather], or take a map that needs colour only"
                )
        if hasattr(self.predictor, "with_spread"):
            return self.predictor.with_spread(inputs)
        return self.predictor.predict(inputs, self.texel_m), None

    def _radiance_of(self, found: Any, inputs: Inputs) -> np.ndarray:
        """Band radiance of the predictor's output."""
        if self.predictor.above_air:
            return radiance_of(np.maximum(found + inputs.conditions["air_k"], 1.0), *self.band_um)
        cold, warm = band_radiance(np.array(self.range_k), *self.band_um)
        return cold + found * (warm - cold)

    @property
    def limits_k(self) -> tuple[float, float]:
        """Coldest and warmest apparent temperature that it is believed, (2,) [K].

        They are those of intensity 0 and 1. No surface is colder than its sky, so the first is at least the sky of the
        training, unless that is assumed.
        """
        low, high = self.range_k
        return (max(low, self.coldest_k), high) if self.coldest_k < high else (low, high)

    @property
    def coldest_k(self) -> float:
        """Temperature of the training's sky [K], below which no surface is; 0 where it is assumed."""
        return 0.0 if self.about.get("sky_assumed", True) else self.sky_temperature

    def limited(self, radiance: np.ndarray) -> np.ndarray:
        """Return apparent band radiances of a map of colour clipped to `limits_k`, (h, w) float64 [W m⁻² sr⁻¹]."""
        return np.clip(radiance, *band_radiance(np.array(self.limits_k), *self.band_um))

    def digest(self) -> str:
        """Return a checksum (hex) of everything that its temperatures depend on."""
        plain = [getattr(self, name) for name in ("range_k", "band_um", "texel_m", "sky_temperature")]
        state = hashlib.blake2b(json.dumps([plain, self.predictor.header()], sort_keys=True).encode(), digest_size=16)
        for name, values in sorted(self.predictor.arrays().items()):
            state.update(name.encode() + np.ascontiguousarray(values).tobytes())
        return state.hexdigest()

    def intensity(self, radiance: np.ndarray | float) -> np.ndarray:
        """Return intensities of band radiances [W m⁻² sr⁻¹]: 0 and 1 at the ends of the map's range."""
        cold, warm = band_radiance(np.array(self.range_k), *self.band_um)
        return (radiance - cold) / (warm - cold)

    def texel_warning(self, texel_m: float | None) -> str | None:
        """Return a warning if a ground sampling distance [m] is outside the range trained on, else None."""
        if texel_m is None or self.texel_range_m is None:
            return None
        low, high = self.texel_range_m
        if low / TEXEL_MARGIN <= texel_m <= high * TEXEL_MARGIN:
            return None
        return (
            f"learned map {self.name!r} was trained at {low:.3g}–{high:.3g} m a pixel; at {texel_m:.3g} m texture "
            "looks different"
        )

    def ranged(self, range_c: Sequence[float]) -> "TemperatureMap":
        """Return this map with other temperatures for intensity 0 and 1 (coldest, warmest) [°C].

        Raises
        ------
        ThermorenderError
            The first is not below the second, or the map predicts kelvin above the air.
        """
        low, high = (float(limit) for limit in range_c)
        if not -ZERO_CELSIUS_K < low < high:
            raise ThermorenderError(
                f"range_c=({low:g}, {high:g}) is not a range; give coldest and warmest in °C, coldest first"
            )
        if self.predictor.above_air:
            raise ThermorenderError(f"range_c=({low:g}, {high:g}) does not apply to learned map {self.name!r}, which "
                                    "predicts kelvin above the air; leave it out")  # fmt: skip
        # Whoever states a coldest surface states that its sky is no warmer.
        range_k = low + ZERO_CELSIUS_K, high + ZERO_CELSIUS_K
        return replace(self, range_k=range_k, sky_temperature=min(self.sky_temperature, range_k[0]))

    def __repr__(self) -> str:
        low, high = (limit - ZERO_CELSIUS_K for limit in self.range_k)
        return (
            f"TemperatureMap({self.name!r}, {self.method}, {low:.1f}…{high:.1f} °C, "
            f"{self.band_um[0]:g}–{self.band_um[1]:g} µm, texels of {_metres(self.texel_m)})"
        )

    def __str__(self) -> str:
        low, high = (limit - ZERO_CELSIUS_K for limit in self.range_k)
        trained = "–".join(f"{limit:.3g}" for limit in self.texel_range_m or ())
        lines = [
            f"{self.name}: {self.method} → apparent temperature, {self.band_um[0]:g}–{self.band_um[1]:g} µm",
            f"  range         {low:.1f}…{high:.1f} °C for intensity 0…1",
            f"  texel         {_metres(self.texel_m)}"
            + (f", trained at {trained}" if trained else ": pictures are not resampled"),
            f"  needs         {', '.join(_WORDS[name] for name in self.needs) or 'colour only'}",
            f"  source        {self.source}",
        ]
        return "\n".join(lines)


def _metres(texel_m: float | None) -> str:
    return "unknown size" if texel_m is None else f"{texel_m:.3g} m"


_WORDS = {"terrain": "the terrain's relief", "conditions": "hour and weather", "depth": "the depth of each pixel"}
_PLAIN = ("name", "method", "range_k", "band_um", "texel_m", "texel_range_m", "camera", "sky_temperature", "source",
          "trained", "error_k", "about")  # fmt: skip


def save_map(model: TemperatureMap, path: files.PathLike) -> None:
    """Write a TemperatureMap as one .npz file, with a digest of its contents."""
    predictor = model.predictor
    kind = next(kind for kind, (_, name) in PREDICTORS.items() if type(predictor).__name__ == name)
    header = {"format": FORMAT, "predictor": kind, **{name: getattr(model, name) for name in _PLAIN}}
    header["of_predictor"], arrays = predictor.header(), predictor.arrays()
    header["level"] = None if model.level is None else model.level.header()
    if model.fingerprints is not None:
        header["training_pictures"] = model.fingerprints.pictures
        arrays = {**arrays, "fingerprints": model.fingerprints.rows}
    header = json.loads(json.dumps(header))
    header["digest"] = _digest(header, arrays)
    with files.atomic(path) as part:
        np.savez_compressed(part, header=np.array(json.dumps(header)), **arrays)


def _digest(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Checksum (hex) of everything in a map's file."""
    state = hashlib.blake2b(json.dumps(header, sort_keys=True).encode(), digest_size=16)
    for name, values in sorted(arrays.items()):
        state.update(f"{name} {values.dtype} {values.shape} ".encode() + np.ascontiguousarray(values).tobytes())
    return state.hexdigest()


def load_map(path: files.PathLike) -> TemperatureMap:
    """Return the TemperatureMap of a file.

    Raises
    ------
    ThermorenderError
        The file is missing or not a map of this format, or a package that its method needs is not installed.
    """
    import importlib

    path = Path(path)
    try:
        with open(path, "rb") as file:
            arrays = _arrays(file)
        header = formats.finite_json(str(arrays.pop("header")))
        # Maps of earlier versions have no digest.
        stated = header.pop("digest", None)
        if stated is not None and stated != _digest(header, arrays):
            raise ValueError("its contents differ from its digest")
        if header.pop("format") != FORMAT:
            raise ValueError("its format has another number")
        pictures = header.pop("training_pictures", None)
        prints = None if pictures is None else Fingerprints(arrays.pop("fingerprints"), int(pictures))
        module, name = PREDICTORS[header.pop("predictor")]
        predictor = getattr(importlib.import_module(module), name).of(header.pop("of_predictor"), arrays)
        # Maps of earlier versions have no level.
        level = header.pop("level", None)
        header = {key: tuple(value) if isinstance(value, list) else value for key, value in header.items()}
        header["level"] = None if level is None else TrainingLevel.of(level)
        return _usable(TemperatureMap(predictor=predictor, fingerprints=prints, **header))
    except ThermorenderError:
        raise
    except ModuleNotFoundError as error:
        raise ThermorenderError(
            f"learned map {path} is a network and needs {error.name}; install it with: "
            "pip install 'thermorender[networks]'"
        ) from None
    except OSError as error:
        raise ThermorenderError(f"learned map {path} cannot be read: {error.strerror}; give a .npz of a map") from None
    # A damaged file can raise many kinds of errors in zipfile, zlib, json or NumPy.
    except (Exception, MemoryError) as error:
        why = shortened(" ".join(str(error).split())) or type(error).__name__
        raise ThermorenderError(
            f"{path} is not a learned map of format {FORMAT} ({why}); make one with `thermorender train`"
        ) from None


def _arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    """{name: array} of an open .npz; one that would unpack to too much is refused first."""
    with zipfile.ZipFile(file) as archive:
        size = sum(item.file_size for item in archive.infolist())
    if size > _MOST_BYTES:
        raise ValueError(f"it unpacks to {size / 1e6:.0f} MB, more than {_MOST_BYTES / 1e6:.0f} MB")
    file.seek(0)
    with np.load(file, allow_pickle=False) as kept:
        return dict(kept)


def _usable(model: TemperatureMap) -> TemperatureMap:
    """Return a TemperatureMap after checking its values."""
    _check_numbers(model)
    for name in ("name", "method", "camera", "source"):
        if not isinstance(getattr(model, name), str):
            raise ValueError(f"{name} is not a text")
    # Files are named after it.
    if not model.name.isprintable() or set(model.name) & set("/\\") or not model.name.strip(". "):
        raise ValueError(f"its name {model.name!r} cannot be a file's name")
    if not (model.trained is None or isinstance(model.trained, dict)) or not isinstance(model.about, dict):
        raise ValueError("trained or about is not a table")
    return model


def _check_numbers(model: TemperatureMap) -> None:
    """Raise ValueError if a range does not rise, or a number is not above 0."""
    for name in ("range_k", "band_um", "texel_range_m"):
        value = getattr(model, name)
        if name == "texel_range_m" and value is None and model.texel_m is None:
            continue
        if not (isinstance(value, tuple) and len(value) == 2 and all(map(_positive, value))):
            raise ValueError(f"{name} is not two numbers above 0")
        if value[0] > value[1] or (value[0] == value[1] and name != "texel_range_m"):
            raise ValueError(f"{name} does not rise")
    if model.range_k[1] > _HOTTEST_K:
        raise ValueError(f"range_k ends above {_HOTTEST_K:g} K")
    for name in ("texel_m", "sky_temperature"):
        if not _positive(getattr(model, name)) and not (name == "texel_m" and model.texel_m is None):
            raise ValueError(f"{name} is not a number above 0")
    if model.error_k is not None and not _positive(model.error_k) and model.error_k != 0:
        raise ValueError("error_k is not a number of 0 or more")


def _positive(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0.0 < value < np.inf


_FOK: dict[str, Any] = {
    "range_k": (ZERO_CELSIUS_K + 14.0, ZERO_CELSIUS_K + 24.0),
    "band_um": BAND_UM,
    # 120 m, the campaign's greatest height, times 17 µm over 13 mm.
    "texel_m": 120.0 * 17e-6 / 13e-3,
    # "From altitudes up to 120 metres": the lowest is not published; half is assumed.
    "texel_range_m": (60.0 * 17e-6 / 13e-3, 120.0 * 17e-6 / 13e-3),
    "camera": CAMERA,
    "sky_temperature": ASSUMED_SKY_K,
    "source": "Generation of artificial infrared camera images for visual navigation simulation, eq. 9",
}
MODELS = {
    "fok-1to1": TemperatureMap("fok-1to1", "correlation-1to1", correlation.PUBLISHED_1TO1, **_FOK),
    "fok-9to1": TemperatureMap("fok-9to1", "correlation-9to1", correlation.PUBLISHED_9TO1, **_FOK),
}
SHIPPED = {name: Path(__file__).with_name("maps") / f"{name}.npz" for name in TRAINED_MAPS}


def load_model(name: files.PathLike, range_c: Sequence[float] | None = None) -> TemperatureMap:
    """Return the learned map of a name or file, with the temperature range `range_c` [°C] if given.

    Raises
    ------
    ThermorenderError
        The name is unknown, the file is not a map, or the range does not rise.
    """
    if str(name).endswith(".npz"):
        model = load_map(name)
    elif name in MODELS:
        model = MODELS[name]
    elif name in SHIPPED:
        model = load_map(SHIPPED[name])
    else:
        known = (*MODELS, *SHIPPED)
        raise ThermorenderError(
            f"learned map {name!r} is unknown; {did_you_mean(name, known)}known are {', '.join(known)}, and files "
            "ending in .npz"
        )
    return model if range_c is None else model.ranged(range_c)
