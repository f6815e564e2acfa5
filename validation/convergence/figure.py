"""Table and figures of the study of convergence."""

import numpy as np

from thermorender import formats
from thermorender.apps.compare.figures import pyplot, save

_COLUMNS = ("engine", "setting", "frame [s]", "error [mK]", "range [mK]", "after lens [mK]", "sampling [mK]",
            "budget [mK]", "bake [s]")  # fmt: skip


def pareto(points):
    """Return the indices of the Pareto front of (seconds, error) pairs, fastest first."""
    best, front = np.inf, []
    for index in sorted(range(len(points)), key=lambda index: tuple(points[index])):
        if points[index][1] < best:
            best = points[index][1]
            front.append(index)
    return front


def table(path, cases, settings):
    """Write the cases as Markdown, the fastest of each view first; the Pareto front is in bold."""
    (width, height), paths = settings["window"], settings["reference_paths"]
    lines = [
        "# Error against run time",
        "",
        f"Seconds of a whole frame without noise. RMS error over the pixels of its central {width}×{height} that show",
        f"a surface, against two independent path-traced renders of {paths} paths per pixel, free of their noise, with",
        "a range of two standard errors. Settings of thermorender: rays per pixel · texture taps per ray · error above",
        "which a pixel at an edge gets more rays (inf: never). Sampling: error against the same renderer with 256 rays",
        "per pixel. Budget: the frame's own error estimate. Bold: no other setting is both faster and more accurate.",
    ]
    scenes = {record["scene"]: None for record in cases.values() if "view" in record}
    for scene in scenes:
        for view in {record["view"]: None for record in cases.values() if record["scene"] == scene}:
            lines += ["", f"## {scene}, {view}", "", f"| {' | '.join(_COLUMNS)} |", "|---|---" + "|--:" * 7 + "|"]
            chosen = sorted(
                (record for record in cases.values() if record["scene"] == scene and record["view"] == view),
                key=lambda record: record["seconds"],
            )
            front = set(pareto([(record["seconds"], record["error_mk"]) for record in chosen]))
            for number, record in enumerate(chosen):
                low, high = record["error_range_mk"]
                cells = [
                    record["engine"], ("bake: " if record["group"] == "bake rays" else "") + record["setting"],
                    f"{record['seconds']:.3g}", f"{record['error_mk']:.1f}", f"{low:.1f}–{high:.1f}",
                    f"{record['optics_error_mk']:.1f}",
                    *(_text(record.get(key)) for key in ("sampling_mk", "budget_mk", "bake_s")),
                ]  # fmt: skip
                if number in front:
                    cells[:2] = (f"**{cell}**" for cell in cells[:2])
                lines.append(f"| {' | '.join(cells)} |")
    lines += ["", "## Isothermal spherical cavities of 300 K under a sky of 250 K, against the closed form", "",
              "| cavity | mean error [mK] | RMS error [mK] |", "|---|--:|--:|"]  # fmt: skip
    lines += [
        f"| {record['setting']} | {record['mean_mk']:+.2f} | {record['error_mk']:.2f} |"
        for record in cases.values()
        if record["scene"] == "cavity"
    ]
    formats.write_text(path, "\n".join(lines) + "\n")


def _text(value):
    return "" if value is None else f"{value:.1f}"


def figure(path, cases, scene):
    """Draw a scene's cases per view: error against time per frame, as rendered and after optics, and bake time."""
    chosen = [record for record in cases.values() if record["scene"] == scene.name and "view" in record]
    views = list({record["view"]: None for record in chosen})
    size = 15, 4.6 * len(views)
    drawing, axes = pyplot().subplots(len(views), 3, figsize=size, layout="constrained", squeeze=False)
    camera = scene.camera
    netd = camera.netd_mk * (4 * camera.f_number**2 + 1) / (4 * camera.netd_f_number**2 + 1)
    for row, view in zip(axes, views, strict=True):
        here = [record for record in chosen if record["view"] == view]
        frames = [record for record in here if record["group"] in ("sampling", "stock")]
        for axis, name, what in zip(row, ("error", "optics_error"), ("as rendered", "after the lens"), strict=False):
            _scatter(axis, frames, name)
            axis.set(xlabel="seconds per frame [s]", title=f"{scene.name}, {view}: {what}")
        bakes = [record for record in here if record["group"] in ("bake rays", "nodes")]
        _bakes(row[2], bakes)
        row[2].set(xlabel="seconds of the bake, once [s]", title=f"{scene.name}, {view}: bake, at quality high")
        row[2].set_visible(bool(bakes))
        for axis in row[: 2 + bool(bakes)]:
            axis.axhline(netd, color="0.6", lw=1, ls=":")
            axis.set(xscale="log", yscale="log", ylabel="RMS error [mK]")
            axis.grid(True, which="both", lw=0.3, color="0.85")
            axis.text(0.99, netd, f"camera noise {netd:.0f} mK", color="0.4", ha="right", va="bottom", fontsize=8,
                      transform=axis.get_yaxis_transform())  # fmt: skip
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=8)
    save(drawing, path)


def _scatter(axis, records, name):
    """Draw error against seconds per frame by engine, the Pareto front, and the default."""
    for number, engine in enumerate({record["engine"]: None for record in records}):
        own = [record for record in records if record["engine"] == engine]
        x, y = np.array([(record["seconds"], _shown(record, name)) for record in own]).T
        stock = own[0]["group"] == "stock"
        axis.plot(x, y, "o-" if stock else "o", color=f"C{number}", ms=5, lw=1, label=engine)
        if stock:
            for record, point in zip(own, zip(x, y, strict=True), strict=True):
                axis.annotate(record["setting"].split()[0], point, (4, 4), textcoords="offset points", fontsize=7)
        for record, point in zip(own, zip(x, y, strict=True), strict=True):
            if "(" in record["setting"]:
                label = record["setting"].split("(")[1].rstrip(")")
                axis.annotate(label, point, (-4, -11), textcoords="offset points", fontsize=8, ha="right")
            if record.get("default"):
                axis.plot(*point, "*", color=f"C{number}", ms=15, mec="k", zorder=5, label="default")
    points = [(record["seconds"], _shown(record, name)) for record in records]
    if points:
        front = [points[index] for index in pareto(points)]
        axis.step(*np.array(front).T, where="post", color="k", lw=0.8, ls="--", label="Pareto front")


def _bakes(axis, records):
    for group, marker in (("bake rays", "o-"), ("nodes", "s--")):
        own = sorted((record for record in records if record["group"] == group), key=lambda record: record["bake_s"])
        if own:
            x, y = np.array([(record["bake_s"], _shown(record, "error")) for record in own]).T
            label = {"bake rays": "rays per face", "nodes": "tolerance of nodes"}[group]
            axis.plot(x, y, marker, ms=5, lw=1, label=label)
            for record, point in zip(own, zip(x, y, strict=True), strict=True):
                axis.annotate(record["setting"], point, (4, 4), textcoords="offset points", fontsize=7)


def _shown(record, name):
    """Return a case's error [mK], or the upper end of its range if that contains zero, for a logarithmic axis."""
    low, high = record[f"{name}_range_mk"]
    return record[f"{name}_mk"] if low > 0.0 else max(high, 1e-3)
