"""The figure of the study: planted against named kinds, and planted against found sizes."""

import numpy as np

from thermorender import files
from validation.referee import study

_UNITS = {
    "offset": "K", "contrast": "gain − 1", "shift": "px", "blur": "px", "material": "K", "emissivity": "", "zoom": "",
    "drift": "K, standard deviation", "clipping": "share",
}  # fmt: skip


def draw(path, result):
    """Write the figure of a result of `study.run` as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    found = result["confusion"]
    columns = ["nothing", *study.KINDS_NAMED]
    table = np.array([[row.get(name, 0) for name in columns] for row in found.values()])
    share = table / np.array([row["comparisons"] for row in found.values()])[:, None]
    drawing = pyplot.figure(figsize=(10.5, 11.0), layout="constrained")
    upper, lower = drawing.subfigures(2, 1, height_ratios=(1.15, 1.0))
    axis = upper.subplots()
    axis.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (k, j), count in np.ndenumerate(table):
        if count:
            axis.text(j, k, str(count), ha="center", va="center", color="white" if share[k, j] > 0.5 else "black")
    axis.set_xticks(range(len(columns)), columns, rotation=20)
    axis.set_yticks(range(len(found)), [f"{name} ({row['comparisons']})" for name, row in found.items()])
    axis.set(xlabel="named", ylabel="planted (comparisons)")
    axes = lower.subplots(3, 3)
    pairs = study.sizes(result["comparisons"])
    for place, (kind, unit) in zip(axes.ravel(), _UNITS.items(), strict=True):
        place.set_title(kind + (f" [{unit}]" if unit else ""), fontsize=10)
        if kind in pairs:
            x, y = pairs[kind].T
            ends = [min(x.min(), y.min()), max(x.max(), y.max())]
            place.plot(ends, ends, color="grey", lw=0.8)
            place.plot(x, y, "o", ms=4, mfc="none", color="#0072B2")
        place.tick_params(labelsize=8)
    lower.supxlabel("planted", fontsize=10)
    lower.supylabel("found", fontsize=10)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=100, format="png")
    pyplot.close(drawing)
