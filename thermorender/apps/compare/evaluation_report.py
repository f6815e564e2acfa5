"""Tables of an evaluation: a Markdown page, and rows for the terminal."""

from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any

from thermorender import formats
from thermorender.apps.compare.structure import SHIFT_PX
from thermorender.apps.compare.tables import Table, interval, number

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
STRUCTURE = ("method", "correlation", "95 %", "slope", "95 %", "MAE without means [K]", "95 %",
             f"MAE growth by {SHIFT_PX} px [K]", "95 %", "correlation after it")  # fmt: skip
ABOUT_STRUCTURE = (
    "Correlation with the truth within a picture, and slope against it (1 for the right contrast, 0 for a constant): "
    "medians over pictures. MAE without means: after each picture's mean error is subtracted. The last columns are a "
    f"control: the true pictures are shifted by {SHIFT_PX} px, and the MAE changes by so much on the same pixels. A "
    "method that reproduces structure loses by the shift; where the change is near 0, the MAE does not show whether "
    "it does."
)
PAGE = """# Evaluation on $title

$about Errors are predicted minus true apparent temperature; ME mean, MAE mean absolute, SD standard deviation, over \
all pixels. Intervals: 95 %, percentile bootstrap over $drawn, seed $seed. PSNR and SSIM: 8 bits between $low and \
$high K, PSNR of the mean square over all pixels.

$before

$methods

$caveat

$floor

## Structure

$structure

$about_structure

## Cost

$cost

Peak memory is that of the whole process. Published training: $published.
$more
Cells of the groups: MAE (ME) [K].
"""


def methods(result: dict[str, Any]) -> Table:
    """Return the table of the methods, and of the published ones."""
    rows = []
    for label, found in result["methods"].items():
        first = label, found["knows"] or "–", str(found["pairs"])
        if found["mae_k"] is None:
            rows.append((*first, "not available", *[""] * 6))
        else:
            rows.append((*first, number(found["me_k"], "+.2f"), number(found["mae_k"], ".2f"),
                         interval(found["interval_95"]["mae_k"]), number(found["sd_k"], ".2f"),
                         number(found["rmse_k"], ".2f"), number(found["psnr_db"], ".1f"),
                         number(found["ssim"], ".3f")))  # fmt: skip
    published = [
        (f"published: {name}", "–", "502", f"{own['me_k']:+g}", f"{own['mae_k']:g}", "", f"{own['sd_k']:g}", *[""] * 3)
        for name, own in PUBLISHED.items()
    ]
    return Table(HEADER, [*rows, *published])


def structures(result: dict[str, Any]) -> Table:
    """Return the table of the methods' scores of structure."""
    rows = []
    for label, each in result["methods"].items():
        own, ends = each["structure"], each["structure"]["interval_95"]
        if own["mae_without_mean_k"] is not None:
            rows.append((
                label, number(own["correlation"], ".2f"), interval(ends["correlation"]), number(own["slope"], ".2f"),
                interval(ends["slope"]), number(own["mae_without_mean_k"], ".2f"), interval(ends["mae_without_mean_k"]),
                number(own["shift_more_k"], "+.2f"), interval(ends["shift_more_k"]),
                number(own["correlation_shifted"], ".2f"),
            ))  # fmt: skip
    return Table(STRUCTURE, rows)


def lines_before(result: dict[str, Any]) -> list[str]:
    """Return the lines to read before the numbers: notes, what the maps were trained on, and the audit of the split."""
    audit = result["audit"]["lines"] if result["audit"] else ["the parts were not audited for leaks"]
    maps = [each["line"] for each in result["training_pictures"].values()]
    return [*(f"note: {note}" for note in result["notes"]), *maps, *(f"split: {line}" for line in audit)]


def write(path: Path, result: dict[str, Any]) -> None:
    """Write a result as a Markdown page."""
    low, high = result["bounds_k"]
    sources = ", ".join(f"{count} {name}" for name, count in result["parts"].items())
    about = (
        f"{result['pairs']} pairs of part {result['part']} ({result['split']} split: {sources}"
        f"{'' if result['limit'] is None else '; a subset, by --limit'}), "
        f"{result['training_pairs']} training pairs read for the constant and the means."
    )
    sections = [_differences(result), *_doubts(result), *_groups(result)]
    formats.write_text(path, Template(PAGE).substitute(
        title=result["dataset"]["title"] or result["dataset"]["folder"], about=about, drawn=result["drawn"],
        seed=result["seed"], low=f"{low:.2f}", high=f"{high:.2f}",
        before="\n".join(f"- {line}" for line in lines_before(result)), methods=methods(result).markdown(2),
        caveat=CAVEAT, floor=FLOOR, structure=structures(result).markdown(), about_structure=ABOUT_STRUCTURE,
        cost=_cost(result).markdown(),
        published="; ".join(f"{name} {own['training']}" for name, own in PUBLISHED.items()),
        more="".join(f"\n{section}\n" for section in sections if section),
    ))  # fmt: skip


def _cost(result: dict[str, Any]) -> Table:
    """Return the cost and the error of the maps, fastest first."""
    maps = [(label, own) for label, own in result["methods"].items() if own.get("seconds_per_mpixel") is not None]
    return Table(
        ("map", "inference [s/megapixel]", "training [s]", "peak memory [MiB]", "MAE [K]"),
        [(label, f"{own['seconds_per_mpixel']:.3g}", number(own["training_s"], ".1f"),
          number(own["peak_memory_mib"], ".0f"), number(own["mae_k"], ".2f"))
         for label, own in sorted(maps, key=lambda each: each[1]["seconds_per_mpixel"])],
    )  # fmt: skip


def _titled(title: str, table: Table, words: str = "") -> str:
    """Return a section with a table and words below, or nothing for an empty table."""
    return "\n\n".join([f"## {title}", table.markdown(), *([words] if words else [])]) if table.rows else ""


def _differences(result: dict[str, Any]) -> str:
    """Return the section of the maps' errors minus the first map's, picture by picture."""
    compared = result["differences"]
    rows = [(_seeds(each["maps"]), number(each["more_k"], "+.2f"), interval(each["interval_95"], "+.2f"))
            for each in compared["maps"]]  # fmt: skip
    title = f"MAE minus that of {_seeds(compared['than'])}, on the same pictures"
    return _titled(title, Table(("map", "difference [K]", "95 %"), rows), SEEDS)


def _seeds(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} of other seeds"


def _doubts(result: dict[str, Any]) -> list[str]:
    """Return the sections that compare the maps' predicted standard deviations and flags with their errors."""
    covered = {label: found["covered"] for label, found in result["methods"].items() if found.get("covered")}
    flagged = {label: found["unseen"] for label, found in result["methods"].items() if found.get("unseen")}
    spread = Table(
        ("map", "within 1 σ", "within 2 σ", "predicted σ, RMS [K]", "RMSE [K]"),
        [(label, f"{each['within_1']:.1%}", f"{each['within_2']:.1%}", number(each["predicted_rms_k"], ".2f"),
          number(each["rmse_k"], ".2f")) for label, each in covered.items()],
    )  # fmt: skip
    rare = Table(
        ("map", "pixels", "MAE there [K]", "elsewhere [K]"),
        [(label, f"{each['share']:.2%}", number(each["mae_k"], ".2f"), number(each["elsewhere_k"], ".2f"))
         for label, each in flagged.items()],
    )  # fmt: skip
    return [_titled("Predicted standard deviation", spread, LAPLACE), _titled("Colours absent from training", rare)]


def _groups(result: dict[str, Any]) -> list[str]:
    """Return a section of errors for each grouping that has classes."""
    methods = {label: found["groups"] for label, found in result["methods"].items() if found["mae_k"] is not None}
    sections = []
    for grouping, title in _TITLES.items():
        rows = []
        for name in sorted({name for groups in methods.values() for name in groups.get(grouping, {})}):
            own = [groups.get(grouping, {}).get(name) for groups in methods.values()]
            most = max(each["pixels"] for each in own if each)
            rows.append((name, f"{most / 1e6:.3g}", *map(_both, own)))
        sections.append(_titled(title, Table((title.lower(), "megapixels", *methods), rows)))
    return sections


def _both(found: dict[str, Any] | None) -> str:
    return "" if not found or found["mae_k"] is None else f"{found['mae_k']:.2f} ({found['me_k']:+.2f})"
