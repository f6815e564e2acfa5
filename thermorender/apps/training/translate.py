"""Translation of pictures and videos into apparent temperature by a learned map, from colour alone.

A picture gives a 16-bit TIFF of apparent temperature and an 8-bit picture on the scale of the map; a video gives a
video, and optionally both files per frame. `translate.json` holds the settings, `translated.jsonl` the finished files.

Temperatures are clipped to the map's range, never below the sky of its training. A MapAnchor brings them to another
hour and weather.
"""

import json
import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.learned.anchor import MapAnchor
from thermorender.learned.temperature_map import MOST_SPACING, Inputs, TemperatureMap
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.progress import Progress
from thermorender.sensor.display import DisplaySettings
from thermorender.sensor.palettes import palette as known_palette
from thermorender.sensor.radiometric_files import TLINEAR_STEP_K, write_tlinear_counts
from thermorender.units import ZERO_CELSIUS_K
from thermorender.versions import versions

PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
# Suffixes of videos, with the codec for writing.
VIDEOS = {".mp4": "mp4v", ".avi": "MJPG"}
# Of a JPEG that holds several pictures, as drones write them, the first is read.
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")
# 16 and 32-bit grey, which photographs do not have.
_DEEP_GREY = ("I", "I;16", "I;16B", "I;16L", "F")
# Pixels with less alpha count as empty.
_LEAST_ALPHA = 128
# Most pixels of the strips that pictures are translated in.
_STRIP = 1 << 21
# Share of frames that a video may lack of its header's number, which some writers only estimate.
_MISSING_FRAMES = 0.01
# Share of a result that may be far outside the map's range, or colder than its sky, without a warning.
_MOST_OUTSIDE = 0.01
# Shares of a result's pixels in the record.
_SHARES = ("share_outside_0_1", "share_extrapolated", "share_colder_than_sky")
RECORD, DONE = "translate.json", "translated.jsonl"


class UnreadableError(ThermorenderError):
    """A file cannot be translated; others can."""


@dataclass(frozen=True, eq=False)
class Translation:
    """Settings of a translation."""

    model: TemperatureMap
    texel_m: float | None = None  # Ground sampling distance of the pictures [m]; None means the map's own
    palette: str = "white-hot"  # Palette of the 8-bit pictures
    anchor: MapAnchor | None = None  # Level and span for another hour and weather

    def __post_init__(self) -> None:
        model = self.model
        if model.needs:
            # This raises the error that names the missing inputs.
            model.radiance(Inputs(np.zeros((1, 1, 3), np.uint8)))
        if self.texel_m is None or model.texel_m is None:
            pass
        elif not 1.0 / MOST_SPACING <= self.texel_m / model.texel_m <= MOST_SPACING:
            raise ThermorenderError(
                f"texel_m={self.texel_m:g} is too far from the {model.texel_m:.3g} m of learned map {model.name!r}; "
                f"give {model.texel_m / MOST_SPACING:.3g}…{model.texel_m * MOST_SPACING:.3g} m"
            )
        known_palette(self.palette)

    @cached_property
    def display(self) -> DisplaySettings:
        """The DisplaySettings of the 8-bit pictures."""
        return DisplaySettings("linear", self.palette)

    def translated(self, rgb: np.ndarray, known: np.ndarray | None = None) -> tuple[np.ndarray, dict[str, float]]:
        """Return (apparent temperature (h, w) uint16 of `TLINEAR_STEP_K` kelvin, facts) of a picture.

        Counts are 0 where not `known`, (h, w) bool. Facts are shares of the known pixels before they are clipped, 0 if
        there are none, and the distance of the picture's colours from those of training. Far outside is more than the
        range's width beyond an end, or without a temperature.
        """
        height, width = rgb.shape[:2]
        predictor = self.model.predictor
        # Other predictors may use the whole picture.
        local = hasattr(predictor, "reach")
        reach = predictor.reach(self._spacing) if local else 0
        rows = max(_STRIP // width, 4 * reach, 1) if local else height
        found, pixels = np.empty((height, width), np.uint16), np.zeros(len(_SHARES) + 1)
        for start in range(0, height, rows):
            stop = min(start + rows, height)
            top = max(start - reach, 0)
            radiance = self.model.radiance(Inputs(rgb[top : stop + reach], self.texel_m))[start - top :][: stop - start]
            here = np.isfinite(radiance) if known is None else np.isfinite(radiance) & known[start:stop]
            found[start:stop] = np.where(here, self._counts(radiance), 0)
            pixels += self._outside(radiance if known is None else radiance[known[start:stop]])
        facts = dict(zip(_SHARES, (pixels[1:] / max(pixels[0], 1.0)).tolist(), strict=True))
        level = self.model.level
        return found, facts if level is None else facts | {"colour_distance": level.distance(rgb)}

    def picture(self, counts: np.ndarray) -> np.ndarray:
        """Return counts as an 8-bit picture, the map's range from black to white: (h, w) grey or (h, w, 3) RGB."""
        low, high = (self.anchor or MapAnchor()).kelvin(np.array(self.model.range_k)) / TLINEAR_STEP_K
        # An anchor may have a span of 0.
        return self.display.shown(counts, np.array([low, max(high, low + 1.0)]))

    def _counts(self, radiance: np.ndarray) -> np.ndarray:
        """Counts of the map's radiances, clipped and anchored."""
        limited = self.model.limited(radiance)
        if self.anchor is None:
            return np.searchsorted(_steps(*self.model.band_um), limited)
        kelvin = self.anchor.kelvin(brightness_temperature(limited, *self.model.band_um))
        return np.rint(np.clip(kelvin / TLINEAR_STEP_K, 0.0, 65535.0))

    def _outside(self, radiance: np.ndarray) -> np.ndarray:
        """Number of pixels, and numbers of those that `_SHARES` names."""
        low, high = self.model.range_k
        ends = np.maximum([low, high, 2.0 * low - high, 2.0 * high - low, self.model.coldest_k], 0.0)
        cold, warm, coldest, warmest, sky = band_radiance(ends, *self.model.band_um)
        far = ~((radiance > coldest) & (radiance <= warmest))
        return np.array([radiance.size, ((radiance < cold) | (radiance > warm)).sum(), far.sum(),
                         (radiance < sky).sum()])  # fmt: skip

    @cached_property
    def _spacing(self) -> float:
        """Spacing of the map's taps [pixels]."""
        return 1.0 if self.texel_m is None or self.model.texel_m is None else self.model.texel_m / self.texel_m


@lru_cache(4)
def _steps(lower_um: float, upper_um: float) -> np.ndarray:
    """Radiances at the limits between counts, (65535,) [W m⁻² sr⁻¹]."""
    return band_radiance((np.arange(65535) + 0.5) * TLINEAR_STEP_K, lower_um, upper_um)


def translate(
    model: TemperatureMap, paths: Sequence[files.PathLike], output: files.PathLike, texel_m: float | None = None,
    palette: str = "white-hot", frames: bool = False, resume: bool = False,
    progress: Progress | None = None, anchor: MapAnchor | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Translate pictures and videos, or folders of them, into a folder; an unreadable one does not stop the others.

    `frames` also writes video frames; `resume` skips finished files of the same settings; `anchor` moves the map to
    another hour and weather. Returns counts "done" and "passed over", "failed" {path: sentence}, and "notes" and
    "warnings", sentences.
    """
    report = progress or (lambda what, share: None)
    how = Translation(model, texel_m, palette, anchor)
    sources = sources_of(paths)
    outputs = {source: _outputs(source, Path(output), frames) for source in sources}
    _refuse_clashes(outputs, resume)
    settings = {
        "model": _record_of(model), "texel_m": texel_m, "palette": palette, "frames": frames,
        "kelvin_per_count": TLINEAR_STEP_K, "anchor": None if anchor is None else asdict(anchor),
    }  # fmt: skip
    done, passed = 0, 0
    facts_of: dict[str, dict[str, Any]] = {}
    failed: dict[Path, str] = {}
    with files.output_folder(output) as folder, files.in_use(folder):
        before = _begin(folder, settings, resume)
        for number, source in enumerate(sources):
            name, checksum = str(source.resolve()), _checksum(source)
            if before.get(name) == (checksum, _sizes(outputs[source])):
                passed += 1
                continue
            if name in before:
                _forget(folder / DONE, name)

            def report_share(share: float, number: int = number) -> None:
                report("translating", (number + share) / len(sources))

            report_share(0.0)
            try:
                if source.suffix.lower() in VIDEOS:
                    facts = _video(how, source, outputs[source], report_share)
                else:
                    facts = _picture(how, source, outputs[source])
            except UnreadableError as error:
                failed[source] = str(error)
                continue
            facts_of[source.name] = facts
            written = _sizes(outputs[source])
            files.on_disk(*outputs[source])
            formats.append_json(folder / DONE, {"source": name, "checksum": checksum, "files": written, **facts})
            done += 1
    warnings = [model.texel_warning(texel_m), _extrapolation(model, facts_of), _too_cold(model, facts_of)]
    notes = [_sampling(model, texel_m), _colours(facts_of)]
    return {"done": done, "passed over": passed, "failed": failed,
            **{name: [each for each in sentences if each] for name, sentences in (("notes", notes),
                                                                                  ("warnings", warnings))}}  # fmt: skip


def _extrapolation(model: TemperatureMap, facts: Mapping[str, Mapping[str, Any]]) -> str | None:
    """A warning if a share of some result is far outside a map's range."""
    found = _most(facts, "share_extrapolated")
    if not found:
        return None
    low, high = (limit - ZERO_CELSIUS_K for limit in model.range_k)
    return (
        f"{found} far outside {low:.1f}…{high:.1f} °C, the range of learned map {model.name!r}; the map does not know "
        "these colours"
    )


def _too_cold(model: TemperatureMap, facts: Mapping[str, Mapping[str, Any]]) -> str | None:
    """A warning if a share of some result was colder than the sky of the training."""
    found = _most(facts, "share_colder_than_sky")
    if not found:
        return None
    return (
        f"{found} colder than {model.coldest_k - ZERO_CELSIUS_K:.1f} °C, the sky of its training, which no surface "
        "under it is; they are set to that"
    )


def _most(facts: Mapping[str, Mapping[str, Any]], name: str) -> str | None:
    """Words for the results with more than `_MOST_OUTSIDE` of a share; None if there are none."""
    found = {result: own[name] for result, own in facts.items() if own[name] > _MOST_OUTSIDE}
    if not found:
        return None
    most = max(found, key=lambda each: found[each])
    return (
        f"{len(found)} of {len(facts)} results have more than {_MOST_OUTSIDE:.0%} of their pixels, {most} has "
        f"{found[most]:.0%},"
    )


def _colours(facts: Mapping[str, Mapping[str, Any]]) -> str | None:
    """A sentence on how far the colours of results are from those of training; None where these are unknown."""
    away = {name: own["colour_distance"] for name, own in facts.items() if "colour_distance" in own}
    if not away:
        return None
    farthest, middle = max(away, key=lambda each: away[each]), float(np.median(list(away.values())))
    most = f", {away[farthest]:.1f} in {farthest}" if len(away) > 1 else ""
    return (
        f"colours are {middle:.1f} standard deviations of the training from its mean{most}; those of its own pictures "
        "are 1"
    )


def _sampling(model: TemperatureMap, texel_m: float | None) -> str | None:
    """A sentence where pictures are not resampled because a ground sampling distance is unknown."""
    if model.texel_m is None:
        return f"the ground sampling distance of learned map {model.name!r} is unknown: pictures are not resampled"
    if texel_m is None:
        return f"the ground sampling distance of the pictures is not stated: the map's {model.texel_m:.3g} m is assumed"
    return None


def read_picture(path: files.PathLike) -> tuple[np.ndarray, np.ndarray | None]:
    """Return (sRGB (h, w, 3) uint8, non-empty (h, w) bool or None for all) of a picture, rotated by its EXIF tag.

    Grey, palettes, CMYK (without its profile) and 16-bit colour become 8-bit RGB. UnreadableError: damaged, of another
    format, 16-bit grey, or too large.
    """
    from PIL import Image, ImageOps

    try:
        # Pillow warns about large pictures and harmless oddities.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=_FORMATS) as file:
                mode = file.mode
                formats.refuse_overstated(file, os.stat(path).st_size)
                if mode not in _DEEP_GREY:
                    image = ImageOps.exif_transpose(file)
                    if "A" in image.getbands() or "transparency" in image.info:
                        rgba = np.asarray(image.convert("RGBA"))
                        known = rgba[..., 3] >= _LEAST_ALPHA
                        return np.ascontiguousarray(rgba[..., :3]), None if known.all() else known
                    return np.asarray(image.convert("RGB")), None
    except Image.DecompressionBombError:
        raise UnreadableError(
            f"{path} has more than {2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} million pixels; cut it into pieces"
        ) from None
    # Each format raises its own kinds of errors for a damaged file.
    except Exception as error:
        raise UnreadableError(
            f"{path} cannot be read as a picture ({' '.join(str(error).split()) or type(error).__name__}); give a "
            "whole JPEG, PNG, TIFF, BMP or WebP"
        ) from None
    raise UnreadableError(
        f"{path} is grey in 16 bits or more ({mode}), as thermal cameras write; give the photograph, in colour or in "
        "8 bits"
    )


# --- one file ---------------------------------------------------------------------------------------------------


def _picture(how: Translation, source: Path, outputs: Sequence[Path]) -> dict[str, Any]:
    """Translate a picture; return facts for the record."""
    rgb, known = read_picture(source)
    counts, facts = how.translated(rgb, known)
    _refuse_empty(source, counts, known is None or bool(known.any()))
    tiff, png = outputs
    _write_counts(how, counts, tiff, png)
    return {"shape": list(counts.shape), **facts}


def first_frame(source: Path) -> np.ndarray:
    """Return the first frame of a video, (h, w, 3) uint8; UnreadableError where there is none."""
    reader = _reader(source)
    whole, image = reader.read()
    reader.release()
    if not whole:
        raise UnreadableError(f"{source} cannot be read as a video; give a whole MP4 or AVI")
    return np.ascontiguousarray(image[..., ::-1], np.uint8)


def _reader(source: Path) -> Any:
    """A video's reader of OpenCV."""
    import cv2

    try:
        str(source).encode()
    except UnicodeEncodeError:
        # OpenCV would abort the process.
        raise UnreadableError(f"{str(source)!a} is not valid Unicode; rename the video") from None
    return cv2.VideoCapture(str(source))


def _video(
    how: Translation, source: Path, outputs: Sequence[Path], report_share: Callable[[float], object]
) -> dict[str, Any]:
    """Translate a video frame by frame; outputs are its file and, if frames are requested, their folder."""
    import cv2

    reader = _reader(source)
    with ExitStack() as stack:
        stack.callback(reader.release)
        declared = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
        rate_hz = reader.get(cv2.CAP_PROP_FPS)
        whole, image = reader.read()
        if not whole or not 0.0 < rate_hz < math.inf:
            raise UnreadableError(f"{source} cannot be read as a video; give a whole MP4 or AVI")
        part = stack.enter_context(files.atomic(outputs[0]))
        folder = stack.enter_context(files.atomic_folder(outputs[1], overwrite=True)) if outputs[1:] else None
        writer: cv2.VideoWriter | None = None
        number, sums = 0, Counter[str]()
        while whole:
            counts, facts = how.translated(np.ascontiguousarray(image[..., ::-1], np.uint8))
            _refuse_empty(source, counts, True)
            shown = how.picture(counts)
            if writer is None:
                codec = cv2.VideoWriter.fourcc(*VIDEOS[outputs[0].suffix])
                writer = cv2.VideoWriter(str(part), codec, rate_hz, counts.shape[::-1])
                stack.callback(writer.release)
                if not writer.isOpened():
                    raise OSError(f"OpenCV has no encoder for {outputs[0].suffix}")
            writer.write(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR if shown.ndim == 2 else cv2.COLOR_RGB2BGR))
            if folder:
                _write_counts(how, counts, folder / f"{number:06d}.tif", folder / f"{number:06d}.png")
            number += 1
            sums.update(facts)
            report_share(number / max(declared, number))
            whole, image = reader.read()
        assert writer is not None
        writer.release()
        _refuse_cut(part, number)
        if number < declared - max(1.0, _MISSING_FRAMES * declared):
            raise UnreadableError(f"{source} breaks off after {number} of {declared} frames; give the whole video")
    return {"shape": list(counts.shape), "frames": number, "rate_hz": rate_hz,
            **{name: total / number for name, total in sums.items()}}  # fmt: skip


def _refuse_cut(path: Path, frames: int) -> None:
    """Raise OSError if a video lacks frames that were written: OpenCV does not report a full disk."""
    import cv2

    reader, found = cv2.VideoCapture(str(path)), 0
    while reader.grab():
        found += 1
    reader.release()
    if found != frames:
        raise OSError(f"{found} of {frames} frames reached the disk")


def _refuse_empty(source: Path, counts: np.ndarray, shows: bool) -> None:
    """Refuse a picture that shows something and gets no temperature."""
    if shows and not counts.any():
        raise UnreadableError(f"{source} gets no temperature anywhere from this map; take another map")


def _write_counts(how: Translation, counts: np.ndarray, tiff: Path, png: Path) -> None:
    """Write counts as a TIFF of temperatures and as an 8-bit picture."""
    with formats.atomic_raster(tiff) as part:
        write_tlinear_counts(part, counts)
    formats.write_image(png, how.picture(counts))


# --- files and record -------------------------------------------------------------------------------------------


def sources_of(paths: Sequence[files.PathLike]) -> list[Path]:
    """Return the pictures and videos of paths and folders, each once; raise ThermorenderError if there are none."""
    known = (*PICTURES, *VIDEOS)
    found = []
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(each for each in path.iterdir() if each.suffix.lower() in known and each.is_file())
            if not inside:
                raise ThermorenderError(f"{path} holds no picture or video ({', '.join(known)}); give another folder")
            found += inside
        elif not path.is_file():
            raise ThermorenderError(f"{path} does not exist; give pictures, videos or folders of them")
        elif path.suffix.lower() not in known:
            raise ThermorenderError(f"{path} is of unknown kind; give one of {', '.join(known)}")
        else:
            found.append(path)
    return list({path.resolve(): path for path in found}.values())


def _outputs(source: Path, folder: Path, frames: bool) -> tuple[Path, ...]:
    """Files or folders that a source is translated to."""
    if source.suffix.lower() in VIDEOS:
        video = folder / f"{source.stem}{source.suffix.lower()}"
        return (video, folder / f"{source.stem}_frames") if frames else (video,)
    return folder / f"{source.stem}.tif", folder / f"{source.stem}.png"


def _refuse_clashes(outputs: Mapping[Path, Sequence[Path]], resume: bool) -> None:
    """Raise ThermorenderError if two sources have the same output, or an output exists."""
    owner: dict[Path, Path] = {}
    sources = {source.resolve() for source in outputs}
    for source, written in outputs.items():
        for path in written:
            if path in owner:
                raise ThermorenderError(
                    f"{owner[path]} and {source} would both be written as {path.name}; translate them into different "
                    "folders"
                )
            owner[path] = source
            if path.resolve() in sources or (path.exists() and not resume):
                raise ThermorenderError(f"{path} exists; give another folder, or --resume to continue")


def _begin(folder: Path, settings: dict[str, Any], resume: bool) -> dict[str, tuple[Any, Any]]:
    """Write the record, or compare it with the existing one; return {path: (checksum, `_sizes`)} of finished files."""
    path = folder / RECORD
    if resume:
        files.remove_parts(folder)
    # Types as after reading it back.
    settings = json.loads(json.dumps(settings))
    if not path.exists():
        formats.write_json(path, settings | {"versions": versions()})
        return {}
    if not resume:
        raise ThermorenderError(f"{folder} holds translations; give another folder, or --resume to continue")
    try:
        before = json.loads(formats.read_text(path))
        other = next((key for key in settings if before.get(key) != settings[key]), None)
    except (ValueError, AttributeError):
        raise ThermorenderError(f"{path} is not a record of translations; give another folder") from None
    if other:
        raise ThermorenderError(
            f"{path} was made with another {other}; continue with the same settings, or give another folder"
        )
    path = folder / DONE
    try:
        return {line["source"]: (line["checksum"], line["files"]) for line in formats.read_json_lines(path)}
    except (ValueError, KeyError, TypeError):
        raise ThermorenderError(f"{path} is not a list of translations; give another folder") from None


def _forget(path: Path, source: str) -> None:
    """Remove a source from the list of finished files."""
    kept = [line for line in formats.read_json_lines(path) if line["source"] != source]
    formats.write_text(path, "".join(json.dumps(line) + "\n" for line in kept))


def _checksum(source: Path) -> str | None:
    """Checksum of a file, None where it cannot be read."""
    try:
        return formats.checksum(source)
    except OSError:
        # Reading the file will report the error.
        return None


def _sizes(outputs: Sequence[Path]) -> dict[str, Any]:
    """{name: bytes} of existing files; for a folder [number of files, bytes]."""
    return {path.name: _held(path) if path.is_dir() else path.stat().st_size for path in outputs if path.exists()}


def _held(folder: Path) -> list[int]:
    """[number of files, bytes] of a folder."""
    sizes = [path.stat().st_size for path in folder.iterdir()]
    return [len(sizes), sum(sizes)]


def _record_of(model: TemperatureMap) -> dict[str, Any]:
    """A map's entry in the record: plain values, and a digest of everything it computes with."""
    plain = ("name", "method", "range_k", "band_um", "texel_m", "camera", "sky_temperature", "source")
    return {name: getattr(model, name) for name in plain} | {"digest": model.digest()}
