"""Figure of the study of budgets."""

import numpy as np

from thermorender.apps.compare.figures import pyplot, save


def figure(path, cases):
    """Draw the stated error against the true error, and the true error against height."""
    shown = [case for case in cases.values() if case["true_mk"] > 0.0]
    drawing, (errors, height) = pyplot().subplots(1, 2, figsize=(12, 5.2), layout="constrained")
    names = list(dict.fromkeys(case["scene"] for case in shown))
    for number, name in enumerate(names):
        own = [case for case in shown if case["scene"] == name]
        colour = pyplot().get_cmap("tab10")(number % 10)
        for drawn, mark in ((True, "."), (False, "o")):
            part = [case for case in own if case["drawn"] == drawn]
            true, stated = (np.array([case[key] for case in part]) for key in ("true_mk", "stated_mk"))
            label = name if not drawn else None
            errors.loglog(true, stated, mark, color=colour, label=label)
            height.loglog([case["height_m"] for case in part], true, mark, color=colour)
    if shown:
        ends = np.array([min(case["true_mk"] for case in shown), max(case["true_mk"] for case in shown)])
        for factor, style in ((1.0, "-"), (3.0, ":")):
            errors.loglog(ends, factor * ends, style, color="0.5", lw=1)
    errors.set(
        xlabel="true RMS error [mK]", ylabel="stated [mK]", title="stated error (lines: truth, three times the truth)"
    )
    height.set(
        xlabel="height above ground [m]", ylabel="true RMS error [mK]", title="circles: chosen views; dots: drawn"
    )
    errors.legend(fontsize=8)
    for panel in (errors, height):
        panel.grid(True, which="both", lw=0.3, color="0.85")
    save(drawing, path)
