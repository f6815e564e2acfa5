"""Figure of the study of clusters."""

from thermorender.apps.compare.figures import pyplot, save


def figure(path, record):
    """Draw efficiency against block size for each disk, and the shares of scheduler, disk and warm-up."""
    drawing, (left, right) = pyplot().subplots(1, 2, figsize=(10, 4), layout="constrained")
    for name, cases in record["simulated"].items():
        left.plot([case["block"] for case in cases], [case["efficiency"] for case in cases], "o-", ms=3, label=name)
    disk, cases = next(iter(record["simulated"].items()))
    for key, label in (("warm_up", "warm-up, of the workers' time"), ("disk", "disk busy"),
                       ("scheduler", "scheduler busy")):  # fmt: skip
        right.plot([case["block"] for case in cases], [case[key] for case in cases], "o-", ms=3, label=label)
    left.set(xscale="log", ylim=(0, 1), xlabel="frames of a block", ylabel="rendering over all workers' time")
    right.set(xscale="log", yscale="log", xlabel="frames of a block", ylabel=f"share ({disk})")
    for panel in (left, right):
        panel.grid(True, which="both", lw=0.3, color="0.85")
        panel.legend(fontsize=8)
    save(drawing, path)
