"""Figure of the study of growth."""

from thermorender.apps.compare.figures import pyplot, save


def figure(path, cases):
    """Draw bake time, frame time and memory along each varied axis."""
    kinds = (("bake_s", "bake, 16 rays per face [s]", 1.0), ("frame_ms", "frame at 45° [ms]", 1.0),
             ("peak_mib", "peak memory [GiB]", 1.0 / 1024))  # fmt: skip
    varied = list(dict.fromkeys(case["varied"] for case in cases.values()))
    drawing, panels = pyplot().subplots(len(kinds), len(varied), figsize=(11, 8), layout="constrained", squeeze=False)
    for column, axis in zip(panels.T, varied, strict=True):
        own = sorted((case for case in cases.values() if case["varied"] == axis), key=lambda case: case[axis])
        for panel, (key, label, unit) in zip(column, kinds, strict=True):
            known = [case for case in own if case[key] is not None]
            if not known:
                continue
            panel.plot([case[axis] for case in known], [case[key] * unit for case in known], "o-", ms=4)
            panel.set(xscale="log", yscale="log", xlabel=axis + (" along a side" if axis == "texels" else ""),
                      ylabel=label)  # fmt: skip
            panel.grid(True, which="both", lw=0.3, color="0.85")
    save(drawing, path)
