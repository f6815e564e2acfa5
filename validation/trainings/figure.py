"""Figures of trainings: curves of validation error, and translations after some of the epochs."""

from pathlib import Path

import numpy as np

from thermorender import files
from thermorender.apps.training.networks.runs import SAMPLES, read_log

# Number of epochs in a strip, spaced by the logarithm of their crops.
_EPOCHS = 4


def curves(path, result):
    """Draw validation error against core hours of every training, with a mark at its best.

    Extrapolations are thin and dash-dotted, and end in a hollow mark.

    Parameters
    ----------
    path : path
    result : dict
        As `validation.trainings.study.run` returns it.
    """
    from thermorender.apps.compare.figures import pyplot, save

    figure, axis = pyplot().subplots(figsize=(10, 5.5), layout="constrained")
    for number, each in enumerate(result["runs"]):
        _, seconds, errors = zip(*each["curve"], strict=True)
        style = {"color": f"C{number % 10}", "ls": ("-", "--", ":")[number // 10 % 3]}
        axis.plot(np.array(seconds) / 3600.0, errors, lw=1.2, label=each["name"], **style)
        axis.plot(each["best_core_s"] / 3600.0, each["best_mae_k"], "o", ms=5, color=style["color"])
        if each["extrapolated"]:
            ends = np.array([each["core_s"], each["extrapolated"]["core_s"]]) / 3600.0
            axis.plot(ends, [each["best_mae_k"], each["extrapolated"]["mae_k"]], "-.", lw=0.7, color=style["color"],
                      marker="o", mfc="none", markevery=[1])  # fmt: skip
    if any(each["extrapolated"] for each in result["runs"]):
        axis.plot([], [], "-.", lw=0.7, color="grey", marker="o", mfc="none", label="extrapolated, not measured")
    axis.set(xscale="log", xlabel="training [hours of one core]", ylabel="mean absolute error on validation crops [K]")
    axis.set_ylim(0.0, 1.6 * max(each["curve"][-1][2] for each in result["runs"]))
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=7, bbox_to_anchor=(1.01, 1.0), loc="upper left")
    save(figure, path)


def strip(path, folder):
    """Draw the first sample of some epochs of a training: photograph, truth, translation and error.

    Parameters
    ----------
    path : path
        PNG to write.
    folder : path
        Folder of the training.
    """
    import cv2

    from thermorender.apps.compare.figures import pyplot, save

    error = {line["crops"]: line["validation_mae_k"] for line in read_log(folder)}
    pictures = {int(each.stem): each for each in sorted((Path(folder) / SAMPLES).glob("*.png"))
                if int(each.stem) in error}  # fmt: skip
    crops = np.array(sorted(pictures))
    wanted = np.geomspace(crops[0], crops[-1], _EPOCHS)
    chosen = list(dict.fromkeys(int(crops[np.abs(np.log(crops / each)).argmin()]) for each in wanted))
    size = 9.0, 2.5 * len(chosen)
    figure, axes = pyplot().subplots(len(chosen), 1, figsize=size, layout="constrained", squeeze=False)
    for axis, crop in zip(axes[:, 0], chosen, strict=True):
        image = cv2.imread(str(pictures[crop]))[..., ::-1]
        # A sample has four columns of squares.
        axis.imshow(image[: image.shape[1] // 4])
        axis.set_title(f"after {crop} crops, {error[crop]:.2f} K: photograph, truth, translation, error ±10 K")
        axis.set_axis_off()
    save(figure, path)


def write(folder, result, folders):
    """Write curves.png, and strip_NAME.png of each training with samples."""
    folder = files.make_folder(folder)
    curves(folder / "curves.png", result)
    for each in folders:
        name = Path(each).resolve().name.removesuffix(".run")
        if (Path(each) / SAMPLES).is_dir():
            strip(folder / f"strip_{name}.png", each)
