"""Figure of the study of air."""

from thermorender.apps.compare.figures import pyplot, save


def figure(path, result):
    """Draw the error against the frame's time relative to that without air."""
    drawing, axis = pyplot().subplots(figsize=(7.5, 4.6), layout="constrained")
    views = dict.fromkeys((case["height_m"], case["view"]) for case in result["cases"])
    for number, (height_m, view) in enumerate(views):
        own = [case for case in result["cases"] if (case["height_m"], case["view"]) == (height_m, view)]
        x = [case["over_vacuum"] for case in own]
        label = f"{view}, {height_m:g} m"
        axis.plot(x, [case["error_mk"] for case in own], "o-", color=f"C{number}", label=label)
        for case in own:
            axis.annotate(str(case["channels"]), (case["over_vacuum"], case["error_mk"]), (4, 4),
                          textcoords="offset points", fontsize=8)  # fmt: skip
    axis.axvline(1.5, color="0.6", lw=1, ls=":")
    axis.set(yscale="log", xlabel="time of a frame with air over that without [1]",
             ylabel="RMS error of channels and nodes [mK]",
             title=f"{result['scene']}, {', '.join(result['air'])}: channels at each point")  # fmt: skip
    axis.grid(True, which="both", lw=0.3, color="0.85")
    axis.legend(fontsize=8)
    save(drawing, path, dpi=90)
