"""Figure of the landings."""

import numpy as np

from thermorender.apps.compare.figures import pyplot, save

# Upper end of the axis of landing errors [m].
_FARTHEST_M = 12.0


def figure(path, found):
    """Draw the share of runs that landed within a distance, and the landing error against the marker's contrast.

    Parameters
    ----------
    path : Path
        PNG.
    found : list of dict
        As `examples.landing.run.fly` returns it.
    """
    kinds = list(dict.fromkeys(each["frames"] for each in found))
    drawing, (share, contrast) = pyplot().subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    for number, kind in enumerate(kinds):
        own = [each for each in found if each["frames"] == kind]
        landed = [each for each in own if each["error_m"] is not None]
        error = np.sort([each["error_m"] for each in landed])
        style = {"color": f"C{number}", "ls": "--" if kind.startswith("B") else "-"}
        steps = np.concatenate([[0.0], error, [_FARTHEST_M]])
        reached = np.concatenate([[0.0], np.arange(1, len(error) + 1), [len(error)]]) / len(own)
        share.step(steps, reached, where="post", label=kind, **style)
        distance = np.minimum([each["error_m"] for each in landed], _FARTHEST_M)
        contrast.plot([each["contrast_k"] for each in landed], distance, "o" if kind == "A" else "x", ms=4,
                      color=style["color"], label=kind)  # fmt: skip
    share.set(xlim=(0.0, _FARTHEST_M), ylim=(0.0, 1.02), xlabel="distance of the touchdown from the marker [m]",
              ylabel="share of runs")  # fmt: skip
    contrast.set(xscale="log", ylim=(0.0, _FARTHEST_M * 1.02), xlabel="contrast of the marker to the ground [K]",
                 ylabel="distance of the touchdown [m]")  # fmt: skip
    ticks = [2, 5, 10, 20, 40]
    contrast.set_xticks(ticks, [str(tick) for tick in ticks])
    contrast.set_xticks([], minor=True)
    for panel in (share, contrast):
        panel.grid(True, lw=0.3, color="0.85")
    contrast.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(drawing, path)
