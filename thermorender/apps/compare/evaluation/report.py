"""Tables of an evaluation: a Markdown page, and rows for the terminal."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from thermorender import formats
from thermorender.apps.compare.evaluation.structure import SHIFT_PX

# Mean error, mean absolute error and standard deviation [K], and training, of the published methods: "Generation of
# artificial infrared camera images for visual navigation simulation", tables 7 and 2.
PUBLISHED: dict[str, dict[str, Any]] = {
    "correlation 1-to-1": {"me_k": -0.46, "mae_k": 1.84, "sd_k": 2.23, "training": "less than a minute on a PC"},
    "correlation 9-to-1": {"me_k": -0.4, "mae_k": 1.78, "sd_k": 2.16, "training": "less than a minute on a PC"},
    "pix2pix": {"me_k": -0.086, "mae_k": 0.73, "sd_k": 0.99, "training": "200 epochs of 175 s"},
    "pix2pix, batch 25": {"me_k": 0.20, "mae_k": 1.6, "sd_k": 2.1, "training": "300 epochs of 115 s"},
    "pix2pixHD": {"me_k": 0.11, "mae_k": 0.69, "sd_k": 0.96, "training": "200 epochs of 790 s"},
}
CAVEAT = (
    "The published values are for 502 test crops of another campaign, which was split after cutting four crops from "
    "each picture. Their temperatures are arbitrary, as the publication says: intensity 0 and 1 were set to 14 and "
    "24 °C."
)
FLOOR = (
    "Floor: the mean difference of two independent draws of the hidden state, divided by √2. For Gaussian draws it is "
    "the mean absolute error of the best possible map."
)
SEEDS = (
    "Intervals include the scatter between lands, and between seeds where several maps of a method are given; for a "
    "single map, lands only."
)
LAPLACE = "For errors with a Laplace distribution, 75.7 % are within one standard deviation and 94.1 % within two."
HEADER = ("method", "knows besides the picture", "pairs", "ME [K]", "MAE [K]", "95 % of MAE", "SD [K]", "RMSE [K]",
          "PSNR [dB]", "SSIM")  # fmt: skip
_TITLES = {
    "hour": "Local solar hour", "kind": "Kind of land", "view": "View", "weather": "Weather", "season": "Season",
    "material": "Material", "surface": "Man-made and natural", "edges": "Edges",
}  # fmt: skip


def rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the methods as table rows of text under `HEADER`."""
    return [
        (label, found["knows"] or "–", str(found["pairs"]), _signed(found["me_k"]), _number(found["mae_k"]),
         _interval(found["interval_95"]["mae_k"]), _number(found["sd_k"]), _number(found["rmse_k"]),
         _number(found["psnr_db"], 1), _number(found["ssim"], 3))
        if found["mae_k"] is not None
        else (label, found["knows"] or "–", str(found["pairs"]), "not available", *[""] * 6)
        for label, found in result["methods"].items()
    ]  # fmt: skip


STRUCTURE = ("method", "correlation", "95 %", "slope", "95 %", "MAE without means [K]", "95 %",
             f"MAE growth by {SHIFT_PX} px [K]", "95 %", "correlation after it")  # fmt: skip
ABOUT_STRUCTURE = (
    "Correlation with the truth within a picture, and slope against it (1 for the right contrast, 0 for a constant): "
    "medians over pictures. MAE without means: after each picture's mean error is subtracted. The last columns are a "
    f"control: the true pictures are shifted by {SHIFT_PX} px, and the MAE changes by so much on the same pixels. A "
    "method that reproduces structure loses by the shift; where the change is near 0, the MAE does not show whether "
    "it does."
)


def structure_rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the methods' scores of structure as table rows of text under `STRUCTURE`."""
    found: list[tuple[str, ...]] = []
    for label, each in result["methods"].items():
        own, ends = each["structure"], each["structure"]["interval_95"]
        if own["mae_without_mean_k"] is not None:
            found.append((
                label, _number(own["correlation"]), _interval(ends["correlation"]), _number(own["slope"]),
                _interval(ends["slope"]), _number(own["mae_without_mean_k"]), _interval(ends["mae_without_mean_k"]),
                _signed(own["shift_more_k"]), _interval(ends["shift_more_k"]), _number(own["correlation_shifted"]),
            ))  # fmt: skip
    return found


def published_rows() -> list[tuple[str, ...]]:
    """Return the published methods as table rows of text under `HEADER`."""
    return [
        (f"published: {name}", "–", "502", f"{own['me_k']:+g}", f"{own['mae_k']:g}", "", f"{own['sd_k']:g}", *[""] * 3)
        for name, own in PUBLISHED.items()
    ]


def lines_before(result: dict[str, Any]) -> list[str]:
    """Return the lines to read before the numbers: notes, what the maps were trained on, and the audit of the split."""
    audit = result["audit"]["lines"] if result["audit"] else ["the parts were not audited for leaks"]
    maps = [each["line"] for each in result["training_pictures"].values()]
    return [*(f"note: {note}" for note in result["notes"]), *maps, *(f"split: {line}" for line in audit)]


def cost_rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return (method, s per megapixel, training s, peak memory MiB, MAE) of the maps, fastest first."""
    maps = {label: found for label, found in result["methods"].items() if found.get("seconds_per_mpixel") is not None}
    order = sorted(maps, key=lambda label: maps[label]["seconds_per_mpixel"])
    return [
        (label, f"{maps[label]['seconds_per_mpixel']:.3g}", _number(maps[label]["training_s"], 1),
         _number(maps[label]["peak_memory_mib"], 0), _number(maps[label]["mae_k"]))
        for label in order
    ]  # fmt: skip


def write(path: Path, result: dict[str, Any]) -> None:
    """Write a result as a Markdown page."""
    low, high = result["bounds_k"]
    sources = ", ".join(f"{number} {name}" for name, number in result["parts"].items())
    lines = [
        f"# Evaluation on {result['dataset']['title'] or result['dataset']['folder']}", "",
        f"{result['pairs']} pairs of part {result['part']} ({result['split']} split: {sources}"
        f"{'' if result['limit'] is None else '; a subset, by --limit'}), "
        f"{result['training_pairs']} training pairs read for the constant and the means. Errors are predicted minus "
        "true apparent temperature; ME mean, MAE mean absolute, SD standard deviation, over all pixels. "
        f"Intervals: 95 %, percentile bootstrap over {result['drawn']}, seed {result['seed']}. PSNR and SSIM: 8 bits "
        f"between {low:.2f} and {high:.2f} K, PSNR of the mean square over all pixels.", "",
        *(f"- {line}" for line in lines_before(result)), "",
        *_table(HEADER, [*rows(result), *published_rows()], 2), "",
        CAVEAT, "", FLOOR, "",
        "## Structure", "", *_table(STRUCTURE, structure_rows(result)), "", ABOUT_STRUCTURE, "",
        "## Cost", "",
        *_table(("map", "inference [s/megapixel]", "training [s]", "peak memory [MiB]", "MAE [K]"), cost_rows(result)),
        "", "Peak memory is that of the whole process. Published training: "
        + "; ".join(f"{name} {own['training']}" for name, own in PUBLISHED.items()) + ".",
    ]  # fmt: skip
    lines += [*_differences(result), *_doubts(result)]
    methods = {label: found for label, found in result["methods"].items() if found["mae_k"] is not None}
    for grouping, title in _TITLES.items():
        names = sorted({name for found in methods.values() for name in found["groups"].get(grouping, {})})
        if not names:
            continue
        body = []
        for name in names:
            own = [found["groups"].get(grouping, {}).get(name) for found in methods.values()]
            most = max(each["pixels"] for each in own if each)
            body.append((name, f"{most / 1e6:.3g}", *map(_both, own)))
        lines += ["", f"## {title}", "", *_table((title.lower(), "megapixels", *methods), body)]
    lines += ["", "Cells of the groups: MAE (ME) [K]."]
    formats.write_text(path, "\n".join(lines) + "\n")


def _differences(result: dict[str, Any]) -> list[str]:
    """Return lines with the maps' errors minus the first map's, picture by picture."""
    compared = result["differences"]
    body = [(_seeds(each["maps"]), _signed(each["more_k"]),
             "" if each["interval_95"] is None else "{:+.2f}…{:+.2f}".format(*each["interval_95"]))
            for each in compared["maps"]]  # fmt: skip
    if not body:
        return []
    title = f"## MAE minus that of {_seeds(compared['than'])}, on the same pictures"
    return ["", title, "", *_table(("map", "difference [K]", "95 %"), body), "", SEEDS]


def _seeds(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} of other seeds"


def _doubts(result: dict[str, Any]) -> list[str]:
    """Return lines that compare the maps' predicted standard deviations and flags with their errors."""
    covered = {label: found["covered"] for label, found in result["methods"].items() if found.get("covered")}
    flagged = {label: found["unseen"] for label, found in result["methods"].items() if found.get("unseen")}
    lines = []
    if covered:
        body = [(label, f"{each['within_1']:.1%}", f"{each['within_2']:.1%}", _number(each["predicted_rms_k"]),
                 _number(each["rmse_k"])) for label, each in covered.items()]  # fmt: skip
        header = ("map", "within 1 σ", "within 2 σ", "predicted σ, RMS [K]", "RMSE [K]")
        lines += ["", "## Predicted standard deviation", "", *_table(header, body), "", LAPLACE]
    if flagged:
        rare = [(label, f"{each['share']:.2%}", _number(each["mae_k"]), _number(each["elsewhere_k"]))
                for label, each in flagged.items()]  # fmt: skip
        header_rare = ("map", "pixels", "MAE there [K]", "elsewhere [K]")
        lines += ["", "## Colours absent from training", "", *_table(header_rare, rare)]
    return lines


def _table(header: Sequence[str], body: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """Return the lines of a Markdown table whose first `left` columns are aligned left."""
    return [
        f"| {' | '.join(header)} |", "|---" * left + "|--:" * (len(header) - left) + "|",
        *(f"| {' | '.join(line)} |" for line in body),
    ]  # fmt: skip


def _both(found: dict[str, Any] | None) -> str:
    return "" if not found or found["mae_k"] is None else f"{found['mae_k']:.2f} ({found['me_k']:+.2f})"


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.2f}"


def _interval(ends: Sequence[float] | None) -> str:
    return "" if ends is None else f"{ends[0]:.2f}…{ends[1]:.2f}"
