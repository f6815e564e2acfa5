"""Figure of error against run time by height."""

from thermorender.apps.compare.figures import pyplot, save


def figure(path, cases):
    """Draw the error after the optics against the time of a frame, a panel per scene and a line per height."""
    cases = [case for case in cases.values() if "height_m" in case]
    scenes = list(dict.fromkeys(case["scene"] for case in cases))
    drawing, panels = pyplot().subplots(1, len(scenes), figsize=(4.0 * len(scenes), 3.8), layout="constrained",
                                        squeeze=False, sharex=True, sharey=True)  # fmt: skip
    heights = sorted({case["height_m"] for case in cases})
    for panel, scene in zip(panels[0], scenes, strict=True):
        for number, height in enumerate(heights):
            for air, style in (("no air", "o-"), ("air", "s--")):
                own = [c for c in cases if (c["scene"], c["height_m"], c["air"]) == (scene, height, air)]
                if own:
                    panel.plot([c["frame_ms"] for c in own], [max(c["optics_error_mk"], 0.1) for c in own], style,
                               color=f"C{number}", ms=4, label=f"{height:g} m, {air}")  # fmt: skip
        panel.set(title=scene, xscale="log", yscale="log", xlabel="radiance of a frame [ms]")
        panel.grid(True, which="both", lw=0.3, color="0.85")
    panels[0, 0].set_ylabel("sampling error after the optics [mK]")
    panels[0, -1].legend(fontsize=6)
    save(drawing, path)
