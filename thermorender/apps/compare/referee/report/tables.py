"""Tables of a comparison for the terminal: errors of each method, or differences where the truth is unknown."""

from typing import Any

from thermorender.apps.compare.referee import scores

Summary = dict[str, Any]
Rows = list[tuple[str, ...]]

ERRORS = ("method", "mean error [K]", "mean absolute [K]", "95 %", "standard deviation [K]", "RMSE [K]", "pixels")
DIFFERENCES = ("scene", "method", "against", "mean difference [K]", "mean absolute [K]", "RMS difference [K]",
               "pixels")  # fmt: skip


def of(summary: Summary) -> list[tuple[tuple[str, ...], Rows]]:
    """Return [(head, rows)] of the tables of a comparison that have rows."""
    return [(head, rows) for head, rows in ((ERRORS, errors(summary)), (DIFFERENCES, differences(summary))) if rows]


def errors(summary: Summary) -> Rows:
    """Return the rows of errors on ground, noise-free, under ERRORS."""
    found: Rows = []
    for label, own in summary["methods"].items():
        if own["errors"]:
            ground = own["errors"][scores.RADIOMETRIC]["ground"]
            ends = (ground.get("interval_95") or {}).get("mae_k")
            interval = "" if ends is None else f"{ends[0]:.2f}…{ends[1]:.2f}"
            found.append((label, _kelvin(ground["me_k"], "+.3f"), _kelvin(ground["mae_k"]), interval,
                          _kelvin(ground["sd_k"]), _kelvin(ground["rmse_k"]), str(ground["pixels"])))  # fmt: skip
    return found


def differences(summary: Summary) -> Rows:
    """Return the rows of differences from the first method of each scene without truth, under DIFFERENCES.

    A single scene is not named.
    """
    scenes = [scene for scene in summary["scenes"] if scene["differences"]]
    found: Rows = []
    for scene in scenes:
        first = scene["differences"][0]["one"]
        found += [
            (scene["name"] if len(scenes) > 1 else "", each["other"], first, _kelvin(each["me_k"], "+.3f"),
             _kelvin(each["mae_k"]), _kelvin(each["rmse_k"]), str(each["pixels"]))
            for each in scene["differences"] if each["one"] == first
        ]  # fmt: skip
    return found


def _kelvin(value: float | None, form: str = ".3f") -> str:
    return "none" if value is None else format(value, form)
