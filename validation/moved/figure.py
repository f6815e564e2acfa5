"""Figure of the study of moved maps."""

import numpy as np

from thermorender.apps.compare.figures import pyplot, save

_COLOURS = {"moved": "C3", "unmoved": "0.6", "offset": "C1", "balance": "C0"}


def figure(path, result):
    """Draw the mean absolute error of each method and the stated standard deviation, per map and case."""
    every, cases = result["all"], list(result["cases"])
    maps = list(dict.fromkeys(key.split(": ")[0] for key in every))
    drawing, axes = pyplot().subplots(len(maps), 1, figsize=(8.5, 3.2 * len(maps)), layout="constrained", squeeze=False)
    place = np.arange(len(cases))
    for axis, name in zip(axes[:, 0], maps, strict=True):
        found = [every[f"{name}: {case}"] for case in cases]
        for number, (method, colour) in enumerate(_COLOURS.items()):
            height = [one["mae_k"][method] for one in found]
            axis.bar(place + 0.2 * (number - 1.5), height, 0.18, color=colour, label=method)
        # The mean absolute value of a normal variable is √(2/π) times its standard deviation.
        stated = [np.sqrt(2.0 / np.pi) * one["stated_k"] for one in found]
        axis.plot(place - 0.3, stated, "k_", ms=14, mew=2, label="stated for moved")
        labels = [f"{case}\n{one['within_1_sigma']:.0%} · {one['within_2_sigma']:.0%}"
                  for case, one in zip(cases, found, strict=True)]  # fmt: skip
        axis.set_xticks(place, labels, fontsize=8)
        title = f"{name}: share of errors within 1 σ · 2 σ below"
        axis.set(yscale="log", ylabel="mean absolute error [K]", title=title)
        axis.grid(True, axis="y", which="both", lw=0.3, color="0.85")
        axis.set_ylim(top=2.5 * axis.get_ylim()[1])
        axis.set_axisbelow(True)
    axes[0, 0].legend(fontsize=8, ncols=5, loc="upper left")
    save(drawing, path, dpi=90)
