"""Draw the figures of the concepts: `python docs/figures/draw.py` writes the SVGs beside this file."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Arc, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

HERE = Path(__file__).resolve().parent
INK, WARM, COOL, GREY = "#1f2933", "#c2410c", "#1d4ed8", "#9aa5b1"
plt.rcParams.update({
    "font.family": "DejaVu Sans", "font.size": 11, "svg.fonttype": "path", "svg.hashsalt": "thermorender",
})  # fmt: skip


def arrow(axes, start, end, colour=INK, width=1.8, text=None, offset=(0.0, 0.0)):
    """Draw an arrow with a label at its tip."""
    style = {"arrowstyle": "-|>", "mutation_scale": 15, "color": colour, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, **style))
    if text:
        axes.text(end[0] + offset[0], end[1] + offset[1], text, color=colour, ha="center", va="center")


def canvas(width, height):
    """A white figure with sizes in inches and equal axes in the same units, without frame."""
    figure, axes = plt.subplots(figsize=(width, height))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.axis("off")
    figure.subplots_adjust(0, 0, 1, 1)
    return figure, axes


def pipeline():
    """From what a user describes to counts."""
    figure, axes = canvas(10.0, 3.1)

    def box(x, y, title, text, colour, width=1.75, height=0.95):
        patch = FancyBboxPatch(
            (x, y), width, height, boxstyle="round,pad=0.02,rounding_size=0.1", facecolor=colour + "14",
            edgecolor=colour, linewidth=1.4,
        )  # fmt: skip
        axes.add_patch(patch)
        axes.text(x + width / 2, y + height - 0.26, title, ha="center", va="center", weight="bold", color=colour)
        axes.text(x + width / 2, y + 0.34, text, ha="center", va="center", fontsize=9, color=INK, linespacing=1.25)

    box(0.1, 1.95, "terrain, objects", "mesh, orthophoto,\ntracks", COOL)
    box(0.1, 0.25, "weather, air", "heat balance,\nsky, sun", COOL)
    box(2.3, 1.1, "texels", "temperature [K],\nemissivity", COOL)
    box(4.4, 1.1, "bake", "light between surfaces,\nonce per scene", WARM, 1.85)
    box(6.6, 1.95, "camera, pose", "field of view,\ntime", COOL, 1.6)
    box(6.6, 0.25, "frame", "radiance per pixel,\nonce per pose", WARM, 1.6)
    box(8.55, 0.25, "sensor", "optics, noise,\ncounts", WARM, 1.35)
    arrow(axes, (1.9, 2.3), (2.62, 2.1))
    arrow(axes, (1.9, 0.85), (2.62, 1.05))
    arrow(axes, (4.1, 1.57), (4.35, 1.57))
    arrow(axes, (6.3, 1.4), (6.7, 1.27))
    arrow(axes, (7.4, 1.9), (7.4, 1.27))
    arrow(axes, (8.25, 0.72), (8.5, 0.72))
    return figure


def world():
    """The local frame with a camera: heading seen from above, pitch seen from the side."""
    figure, axes = canvas(9.0, 3.9)
    # From above.
    axes.text(0.25, 3.65, "from above", weight="bold", color=INK, va="center")
    origin = np.array([1.0, 0.6])
    arrow(axes, origin, origin + (2.6, 0), text="east", offset=(0.35, 0))
    arrow(axes, origin, origin + (0, 2.4), text="north", offset=(0, 0.2))
    axes.plot(*origin, "o", color=INK, markersize=5)
    axes.text(origin[0] - 0.1, origin[1] - 0.25, "origin, up towards you", fontsize=9, color=INK)
    camera = np.array([2.2, 1.35])
    axes.plot([camera[0]] * 2, [camera[1], camera[1] + 1.5], linestyle="--", color=GREY, linewidth=1.2)
    yaw = np.radians(50.0)
    ahead = 1.6 * np.array([np.sin(yaw), np.cos(yaw)])
    arrow(axes, camera, camera + ahead, WARM, 2.2)
    axes.text(*(camera + ahead + (0.12, 0.12)), "heading", color=WARM)
    axes.add_patch(Arc(camera, 1.7, 1.7, theta1=90 - 50, theta2=90, color=WARM, linewidth=1.4))
    axes.text(*(camera + (0.42, 1.02)), "yaw", color=WARM, ha="center")
    axes.add_patch(Rectangle(camera - 0.1, 0.2, 0.2, angle=0, facecolor=WARM, edgecolor=WARM))
    # From the side.
    axes.text(5.0, 3.65, "from the side", weight="bold", color=INK, va="center")
    x = np.linspace(5.0, 8.7, 200)
    ground = 0.55 + 0.16 * np.sin(1.7 * (x - 5.0)) + 0.05 * np.sin(5.0 * x)
    axes.fill_between(x, 0.1, ground, color="#d9e2ec")
    axes.plot(x, ground, color=INK, linewidth=1.4)
    eye = np.array([5.9, 2.45])
    axes.plot([eye[0], eye[0] + 1.9], [eye[1]] * 2, linestyle="--", color=GREY, linewidth=1.2)
    axes.text(eye[0] + 1.95, eye[1], "horizon", color=INK, va="center", fontsize=9)
    pitch = np.radians(-38.0)
    arrow(axes, eye, eye + 2.3 * np.array([np.cos(pitch), np.sin(pitch)]), WARM, 2.2)
    axes.add_patch(Arc(eye, 2.4, 2.4, theta1=-38, theta2=0, color=WARM, linewidth=1.4))
    axes.text(eye[0] + 1.32, eye[1] - 0.3, "pitch < 0", color=WARM, va="center")
    axes.text(eye[0] + 1.15, eye[1] - 1.55, "optical axis", color=WARM, va="center", ha="right", fontsize=9)
    below = float(np.interp(eye[0], x, ground))
    axes.add_patch(FancyArrowPatch(
        (eye[0], below), eye - (0, 0.08), arrowstyle="<|-|>", mutation_scale=12, color=COOL, shrinkA=0, shrinkB=0,
    ))  # fmt: skip
    axes.text(eye[0] - 0.12, 1.5, "height\nabove\nground", color=COOL, ha="right", va="center", fontsize=9)
    axes.add_patch(Rectangle(eye - 0.1, 0.2, 0.2, facecolor=WARM, edgecolor=WARM))
    return figure


def camera():
    """Camera axes, and pixels of an image."""
    figure, axes = canvas(9.0, 3.6)
    axes.text(0.25, 3.35, "camera axes", weight="bold", color=INK, va="center")
    eye = np.array([1.3, 2.1])
    corners = eye + np.array([[2.0, 0.55], [2.75, 0.95], [2.75, -0.45], [2.0, -0.85]])
    axes.add_patch(Polygon(corners, closed=True, facecolor="#c2410c18", edgecolor=GREY, linewidth=1.3))
    for corner in corners:
        axes.plot(*np.stack([eye, corner]).T, color=GREY, linewidth=0.9)
    arrow(axes, eye, eye + (3.35, 0.07), WARM, 2.2, "z forward", (0.5, 0.0))
    # Towards the reader: x × y = z.
    arrow(axes, eye, eye - (0.62, 0.52), COOL, 2.0, "x right", (-0.05, -0.2))
    arrow(axes, eye, eye + (0, -1.15), COOL, 2.0, "y down", (0, -0.2))
    axes.plot(*eye, "o", color=INK, markersize=6)
    axes.text(5.3, 3.35, "image (H, W)", weight="bold", color=INK, va="center")
    left, top, side = 6.0, 2.75, 0.52
    for row in range(4):
        for column in range(5):
            here = (row, column) == (1, 2)
            axes.add_patch(Rectangle(
                (left + column * side, top - (row + 1) * side), side, side, facecolor="#c2410c30" if here else "white",
                edgecolor=GREY,
            ))  # fmt: skip
    for column in range(6):
        axes.text(left + column * side, top + 0.12, str(column), ha="center", fontsize=9, color=INK)
    for row in range(5):
        axes.text(left - 0.14, top - row * side, str(row), va="center", ha="right", fontsize=9, color=INK)
    axes.plot(left + 2.5 * side, top - 1.5 * side, "o", color=WARM, markersize=5)
    axes.text(left + 5 * side / 2, top - 4 * side - 0.28, "row 1, column 2: centre at (2.5, 1.5) px", ha="center",
              fontsize=10, color=WARM)  # fmt: skip
    return figure


def main():
    """Write all figures."""
    for draw in (pipeline, world, camera):
        figure = draw()
        figure.savefig(HERE / f"{draw.__name__}.svg", metadata={"Date": None}, facecolor="white")
        plt.close(figure)


if __name__ == "__main__":
    main()
