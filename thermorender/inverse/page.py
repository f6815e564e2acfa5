"""The report of a reconstruction: one HTML page with maps before and after, residuals, and what is unknown."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.frame.picture import png
from thermorender.inverse.poses import deviation
from thermorender.inverse.products import lens_of, record
from thermorender.inverse.reconstruct import Reconstruction
from thermorender.output.flight_pages.html import document, figure, table, text

# Pixels along the longer side of a picture.
_SIDE = 700


def write_page(found: Reconstruction, folder: Path) -> Path:
    """Write `report.html` of a Reconstruction into a folder and return its path."""
    facts = record(found)
    name = text(facts["scene"])
    lines = [
        f"{facts['frames']} frames of {facts['camera']}, texels of {facts['texel_m']:g} m, "
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
        _picture(found.prior, "apparent temperature before", "The scene's own temperatures, the prior."),
        _picture(found.apparent, "apparent temperature after", "The reconstruction."),
        _picture(found.kinetic, "kinetic temperature", "With the scene's emissivity and reflected light removed; empty "
                 "where that is not possible."),
        _picture(found.apparent_std, "standard deviation", "Of each texel, without the common level."),
        _picture(found.residual, "residual", "Root mean square of the residuals of the pixels on each texel. Large "
                 "values away from edges are things that moved, reflect or changed."),
        _picture(np.where(found.views > 0, found.views, np.nan), "frames", "Frames that show each texel.", "count"),
        "<h2>Camera</h2>",
        _picture(lens_of(found) + found.state.pattern, "lens", "Vignetting and fixed pattern, common to all frames."),
        *_references(found), "<h2>Frames</h2>", _frames(found),
    ]  # fmt: skip
    path = folder / "report.html"
    formats.write_text(path, document(f"Reconstruction of {facts['scene']}", parts))
    return path


def _picture(values: NDArray[np.float64], title: str, words: str, of: str = "[K]") -> str:
    step = max(1, int(np.ceil(max(values.shape) / _SIDE)))
    return figure(png(values[::step, ::step].astype(np.float32), title, of), words)


def _references(found: Reconstruction) -> list[str]:
    if not found.references:
        return []
    rows = [((name, f"{value:+.3f}"), False) for name, value in found.references]
    return ["<h2>References</h2>", table(("reference", "residual [K]"), rows)]


def _frames(found: Reconstruction) -> str:
    rows = []
    for number, name in enumerate(found.survey.names):
        step = deviation(found.state.poses[number], found.survey.poses[number])
        moved, turned = np.linalg.norm(step[:3]), np.degrees(np.linalg.norm(step[3:]))
        error = found.settings.pose_error
        far = moved > 3.0 * np.sqrt(3.0) * error.position_m or turned > 3.0 * np.sqrt(3.0) * error.angle_deg
        cells = name, found.survey.times[number], f"{found.state.offsets[number]:+.3f}", f"{moved:.2f}", f"{turned:.2f}"
        rows.append((cells, bool(far)))
    head = ("frame", "time", "offset [K]", "moved [m]", "turned [deg]")
    return "<p class=note>Red: moved beyond three standard deviations.</p>" + table(head, rows)
