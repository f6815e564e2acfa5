"""Table, figure and pictures of the study of the sensor."""

import numpy as np

from thermorender import formats
from thermorender.apps.compare.figures import pyplot, save

_LAG = ("tolerance of instants [mK]", "motion between renders [px]", "instants", "renders", "time [ms]",
        "smooth pixels [mK]", "all pixels [mK]", "estimate [mK]")  # fmt: skip


def table(path, result):
    """Write a result as Markdown."""
    chain = result["chain"]
    lines = [
        "# The sensor's error against run time",
        "",
        f"Camera {result['camera']} over {result['scene']}, 30 frames/s, rolling readout. From radiance to counts:",
        f"{chain['standing_ms']:.1f} ms for a static camera, {chain['standing_ratio']:.2f} times a",
        f"`scipy.ndimage.gaussian_filter` of σ = 1 px ({chain['gaussian_ms']:.1f} ms); {chain['subpixel_ms']:.1f} ms",
        f"for a drone's camera that moves 0.6 px per time constant, {chain['subpixel_ratio']:.2f} times.",
        "",
        "## Lag of a moving view",
        "",
        "RMS error of a frame without noise against 64 renders per time constant; smooth pixels change by less than",
        "1 K within a time constant. Times include the renders, except the frame's own. Bold: the setting of flights.",
    ]
    for name, records in result["lag"].items():
        share, motion = records[0]["smooth_share"], records[0]["motion_px"]
        lines += ["", f"### {name}: {motion:.1f} px per time constant, {share:.1%} of the pixels smooth", ""]
        lines += [f"| {' | '.join(_LAG)} |", "|" + "--:|" * len(_LAG)]
        for record in records:
            cells = [
                "one image" if record["lag_mk"] is None else f"{record['lag_mk']:g}",
                {None: "", 0.0: "each instant"}.get(record["render_px"], f"{record['render_px'] or 0:g}"),
                str(record["instants"]), str(record["renders"]), f"{record['ms']:.3g}", _text(record["smooth_mk"]),
                _text(record["all_mk"]), _text(record["estimate_mk"]),
            ]  # fmt: skip
            if (record["lag_mk"], record["render_px"]) == (10.0, 20.0):
                cells = [f"**{cell}**" for cell in cells]
            lines.append(f"| {' | '.join(cells)} |")
    lines += ["", "## Blur: kernel sizes of the lens", "",
              "RMS error of two views against the transfer function itself. Bold: the sizes used.", "",
              "| kernel on pixels | on 8×8 squares | time [ms] | error [mK] | of a scene's contrast |",
              "|--:|--:|--:|--:|--:|"]  # fmt: skip
    for record in result["blur"]:
        cells = [
            f"{record['fine']}×{record['fine']}" if record["fine"] > 1 else "no blur",
            f"{record['coarse']}×{record['coarse']}" if record["coarse"] else "",
            f"{record['ms']:.2f}", f"{record['error_mk']:.1f}",
            "" if record["predicted"] is None else f"{record['predicted']:.2%}",
        ]  # fmt: skip
        if (record["fine"], record["coarse"]) == (7, 5):
            cells = [f"**{cell}**" for cell in cells]
        lines.append(f"| {' | '.join(cells)} |")
    aliasing = result["aliasing"]
    lines += ["", "## Aliasing: blur after sampling instead of before", "",
              "A lens removes detail finer than pixels before they sample it, but the chain blurs the samples. RMS",
              "error over the middle of views against a blur on pixels a quarter as wide, with the transfer function",
              "itself and with the chain's kernels.", "",
              "| view | error [mK] | largest [mK] | of the chain [mK] |", "|---|--:|--:|--:|"]  # fmt: skip
    for record in aliasing["views"]:
        values = (record[key] for key in ("aliasing_mk", "worst_mk", "chain_mk"))
        lines.append(f"| {record['view']} | {' | '.join(f'{value:.1f}' for value in values)} |")
    lines += ["", "Squares on uniform ground, at 16 places within a pixel: mean rise of the brightest pixel, RMS error",
              "of this rise over the places, and largest error of any pixel.", "",
              "| side [px] | contrast [mK] | brightest pixel [mK] | error [mK] | largest [mK] |",
              "|--:|--:|--:|--:|--:|"]  # fmt: skip
    for record in aliasing["targets"]:
        values = (record[key] for key in ("contrast_mk", "peak_mk", "error_mk", "worst_mk"))
        lines.append(f"| {record['side_px']:g} | {' | '.join(f'{value:.0f}' for value in values)} |")
    formats.write_text(path, "\n".join(lines) + "\n")


def figure(path, result):
    """Draw error against run time of the lag, one panel per flight, and of the blur."""
    from matplotlib.ticker import NullFormatter

    flights = result["lag"]
    columns = -(-(len(flights) + 1) // 2)
    drawing, axes = pyplot().subplots(2, columns, figsize=(4.8 * columns, 8.0), layout="constrained", squeeze=False)
    *rest, last = axes.ravel()
    axes = [*rest[: len(flights)], last]
    for spare in rest[len(flights) :]:
        spare.axis("off")
    for axis, (name, records) in zip(axes, flights.items(), strict=False):
        for label, mark, chosen in (
            ("one image", "x", [r for r in records if r["lag_mk"] is None]),
            ("all rendered", "o-", [r for r in records if r["render_px"] == 0.0]),
            ("moved between", "s", [r for r in records if r["render_px"]]),
        ):
            for which, colour in (("smooth_mk", "C0"), ("all_mk", "C1")):
                points = [(r["ms"], r[which]) for r in chosen if r[which]]
                if points:
                    tag = {"smooth_mk": "smooth pixels", "all_mk": "all pixels"}[which]
                    axis.plot(*zip(*points, strict=True), mark, color=colour, ms=5, lw=1, label=f"{label}: {tag}")
            for record in chosen:
                if (record["lag_mk"], record["render_px"]) == (10.0, 20.0):
                    axis.plot(record["ms"], record["all_mk"], "*", color="C1", ms=14, mec="k", label="as flown")
        axis.set(title=f"{name}: {records[0]['motion_px']:.1f} px per time constant", xlabel="time of a frame [ms]")
        axis.axhline(20.0, color="0.6", lw=1, ls=":")
    axis = axes[-1]
    for label, mark, chosen in (
        ("pixels only", "o-", [r for r in result["blur"] if r["fine"] > 1 and not r["coarse"]]),
        ("with squares of 8×8", "s-", [r for r in result["blur"] if r["coarse"]]),
    ):
        axis.plot([r["ms"] for r in chosen], [r["error_mk"] for r in chosen], mark, ms=5, lw=1, label=label)
        for record in chosen:
            point = (record["ms"], record["error_mk"])
            axis.annotate(f"{record['fine']}×{record['fine']}", point, (4, 4), textcoords="offset points", fontsize=7)
    axis.set(title="blur of the lens", xlabel="time of the blur [ms]")
    for axis in axes:
        axis.set(xscale="log", yscale="log", ylabel="RMS error [mK]")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(True, which="both", lw=0.3, color="0.85")
        axis.legend(fontsize=6)
    save(drawing, path, dpi=72)


def pictures(path, images):
    """Draw images [(title, (H, W) array, unit), …], each with its own scale."""
    drawing, axes = pyplot().subplots(2, -(-len(images) // 2), figsize=(18, 7.4), layout="constrained")
    for axis, (title, image, unit) in zip(axes.ravel(), images, strict=False):
        low, high = np.percentile(image, (0.5, 99.5))
        drawn = axis.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        axis.set(title=f"{title} [{unit}]", xticks=[], yticks=[])
        drawing.colorbar(drawn, ax=axis, shrink=0.75)
    for axis in axes.ravel()[len(images) :]:
        axis.axis("off")
    save(drawing, path, dpi=45)


def _text(value):
    return "" if value is None else f"{value:.1f}"
