"""Figure of the statistics of footage."""

import numpy as np

from thermorender import files


def figure(path, sides, title):
    """Draw the statistics of each side, {side: values}."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(13, 9), layout="constrained")
    (spectrum, lines), (parts, field) = drawing.subplots(2, 2)
    drawing.suptitle(title)
    names = list(next(iter(sides.values()))["noise_mk"])
    for number, (side, own) in enumerate(sides.items()):
        colour = f"C{number}"
        spectrum.loglog(own["frequency"], own["power"], color=colour, label=f"{side}, {own['frames']} frames")
        if own["fixed_power"]:
            kept = np.array(own["fixed_power"])
            spectrum.loglog(own["frequency"], np.where(kept > 0.0, kept, np.nan), "--", color=colour, lw=1)
        for axis, style in (("rows", "-"), ("columns", ":")):
            lines.semilogy(own[axis]["frequency"], own[axis]["power"], style, color=colour, label=f"{side}, {axis}")
        values = [own["noise_mk"][name] or (np.nan, 0.0) for name in names]
        position = np.arange(len(names)) + 0.27 * (number - 1)
        parts.bar(position, [v for v, _ in values], 0.25, yerr=[e for _, e in values], color=colour, label=side)
        field.plot(own["field"]["radius"], own["field"]["noise_mk"], "o-", color=colour, label=side)
    spectrum.set(xlabel="frequency [cycles per pixel]", ylabel="power [K²]",
                 title="all directions off the axes; dashed: fixed pattern")  # fmt: skip
    lines.set(xlabel="frequency [cycles per pixel]", ylabel="power [K²]", xlim=(0.0, 0.5),
              title="along the axes: whole rows and columns")  # fmt: skip
    parts.set(ylabel="standard deviation [mK]", title="parts of the noise, at 300 K without the lens")
    parts.set_xticks(range(len(names)), [name.replace("_", "\n") for name in names])
    field.set(xlabel="distance from the centre over that of the corner", ylabel="noise in flat areas [mK]",
              title="noise over the field, at 300 K without the lens", ylim=(0.0, None))  # fmt: skip
    for axes in (spectrum, lines, parts, field):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=90, metadata={"Software": None})
