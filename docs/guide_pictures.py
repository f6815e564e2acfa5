"""Draw the pictures of guides and examples: docs/figures/guide-….png, of what their own blocks and scripts make.

`python docs/guide_pictures.py` runs the blocks of each page in a temporary folder, then takes the pictures from there.
"""

import base64
import json
import os
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
import rasterio
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from PIL import Image

import thermorender as tr
from thermorender.frame import apparent_temperature
from thermorender.output.photograph import photograph

DOCS = Path(__file__).resolve().parent
WIDTH, GAP, COLOURS = 800, 12, 64
DOWN = (0, 0, 25, 0, -90)
# Kelvin per count of the TIFFs of `translate`, and of the product `radiometric`.
COUNT_K = 0.04
# Colours of a scale of temperatures.
STEPS = 24
CLASSES = {
    "conifer": "#2b5238", "broadleaf": "#5f9e4a", "grass_green": "#9ccb5c", "grass_dry": "#cdbb6b", "water": "#2f6fb0",
    "leaf_litter": "#8a5a34", "sand_quartz": "#f0dca6", "paint_metallic": "#b0b4ba", "other": "#7b4f8e",
}  # fmt: skip


def run(page, count):
    """Run the first blocks of a guide in the current folder; return the names of its Python."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    names = {"__name__": "__main__"}
    blocks = re.findall(r"^```(python|bash)\n(.*?)^```$", (DOCS / page).read_text("utf-8"), re.S | re.M)
    for language, code in blocks[:count]:
        if language == "bash":
            subprocess.run(["bash", "-ec", code], check=True, env=os.environ | {"PATH": path})
        else:
            exec(compile(code, page, "exec"), names)
    return names


def command(text):
    """Run a command of thermorender."""
    subprocess.run([sys.executable, "-m", "thermorender", *text.split()], check=True)


def write(name, *images, colours=COLOURS, method=Image.Quantize.MEDIANCUT):
    """Write images (H, W) or (H, W, 3) BGR side by side, with a palette of few colours."""
    height, width = images[0].shape[:2]
    size = (WIDTH - GAP * (len(images) - 1)) // len(images)
    rows = round(size * height / width)
    shown = []
    for image in images:
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        shown += [
            cv2.resize(colour, (size, rows), interpolation=cv2.INTER_AREA),
            np.full((rows, GAP, 3), 255, np.uint8),
        ]
    save(name, Image.fromarray(cv2.cvtColor(np.hstack(shown[:-1]), cv2.COLOR_BGR2RGB)), colours, method)


def save(name, picture, colours, method, kmeans=0):
    """Write a picture with a palette of few colours, made better by passes of k-means."""
    path = DOCS / "figures" / f"guide-{name}.png"
    picture.quantize(colours, method, kmeans, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path.name, path.stat().st_size)


def read(path):
    """Return an image as it is stored."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def painted(kelvin, low, high):
    """Return kelvin (H, W) as a BGR picture of the colours of `frame.show`, white where there are none."""
    share = np.clip((kelvin - low) / (high - low), 0.0, 1.0)
    colour = matplotlib.colormaps["inferno"](np.nan_to_num(share))[..., 2::-1]
    return (np.where(np.isnan(kelvin)[..., None], 1.0, colour) * 255).astype(np.uint8)


def panels(*shown, aside=0):
    """Return a figure of the page's width and its axes: images side by side, `aside` pixels free at the right.

    Each is (title, RGB image), or (title, kelvin (H, W), low, high, name of a colour map), which has a bar below.
    """
    size = (WIDTH - aside - GAP * (len(shown) - 1)) // len(shown)
    rows = size * shown[0][1].shape[0] / shown[0][1].shape[1]
    below = 46 if any(len(each) > 2 for each in shown) else 4
    height = round(22 + rows + below)
    figure, axes = plt.figure(figsize=(WIDTH / 100, height / 100), dpi=100), []
    for number, (title, image, *scale) in enumerate(shown):
        left, ends = number * (size + GAP) / WIDTH, {}
        if scale:
            table = matplotlib.colormaps[scale[2]].resampled(STEPS)
            ends = {"cmap": table, "vmin": scale[0], "vmax": scale[1], "interpolation_stage": "data"}
        axes.append(figure.add_axes([left, below / height, size / WIDTH, rows / height]))
        drawn = axes[-1].imshow(image, aspect="auto", **ends)
        axes[-1].set_title(title, fontsize=9, pad=5)
        axes[-1].set_axis_off()
        if scale:
            place = [left + 0.04 * size / WIDTH, 32 / height, 0.92 * size / WIDTH, 9 / height]
            bar = figure.colorbar(drawn, cax=figure.add_axes(place), orientation="horizontal")
            bar.locator = MaxNLocator(4, integer=True)
            bar.ax.tick_params(labelsize=8, length=2, pad=1)
            bar.set_label("K", fontsize=8, labelpad=0)
    return figure, axes


def legend(axis, colours):
    """Write the names of {name: colour} beside axes."""
    axis.legend(handles=[Patch(color=colour, label=name) for name, colour in colours.items()], fontsize=8,
                loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, handlelength=1.2)  # fmt: skip


def finish(name, figures, colours):
    """Write figures, one below the other, as the picture of a guide."""
    drawn = []
    for figure in figures:
        figure.canvas.draw()
        drawn.append(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
        plt.close(figure)
    save(name, Image.fromarray(np.concatenate(drawn)), colours, Image.Quantize.MAXCOVERAGE, kmeans=3)


def within(mask):
    """Return the slices (rows, columns) of the inner two thirds of what a mask (H, W) shows."""
    ends = [np.flatnonzero(mask.any(axis))[[0, -1]] for axis in (1, 0)]
    return tuple(slice(first + (last - first) // 6, last - (last - first) // 6) for first, last in ends)


def terrain():
    """The photograph and the thermal frame of an import."""
    run("guides/terrain.md", 2)
    write("terrain", read("out/mine/frame_000000_visible.png"), read("out/mine/frame_000000.png"))


def survey():
    """A frame of the survey, and the map of all frames with its standard deviation."""
    run("guides/survey.md", 2)
    maps = [read(f"out/map/{name}.tif") for name in ("apparent", "apparent_std")]
    limits = [np.nanpercentile(each, (1, 99)) for each in maps]
    write("survey", *(painted(each, *ends) for each, ends in zip(maps, limits, strict=True)))


def cameras():
    """One place, seen by two cameras of the page."""
    scene = run("guides/cameras.md", 2)["scene"]
    scenes = scene.with_camera("zenmuse-xt2-9mm"), scene
    write(
        "cameras", *(tr.Renderer(each, quality="fast").frame(each.pose(*DOWN)).display for each in scenes), colours=32
    )


def midwave():
    """The shipped heath at noon and at night, through one lens in both bands."""
    heath = tr.load_scene("heath").with_temperature("balance").with_air("weather")
    long = tr.load_camera("zenmuse-xt2")
    pose, rows = tr.pose(0, -40, 40, yaw_deg=160, pitch_deg=-30), []
    for name, time in (("noon", "2018-09-12T11:30:00Z"), ("midnight", "2018-09-12T23:30:00Z")):
        first = tr.Renderer(heath.with_weather(time=time).with_camera(long))
        second = tr.Renderer(first.scene.with_camera(replace(long, band_um=(3.7, 4.8))))
        kelvin = [each.frame(pose).apparent_temperature for each in (first, second)]
        low, high = np.percentile(kelvin, (0.5, 99.5))
        shown = zip(("7.5–13.5 µm", "3.7–4.8 µm"), kelvin, strict=True)
        rows.append(panels(*((f"{name}, {band}", each[::2, ::2], low, high, "inferno") for band, each in shown))[0])
    finish("midwave", rows, 48)


def python():
    """What a frame shows in a notebook."""
    html = run("guides/python.md", 3)["frame"]._repr_html_()
    data = base64.b64decode(re.search(r"base64,([^\"]+)", html)[1])
    write("python", cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), method=Image.Quantize.MAXCOVERAGE)


def compare():
    """A photograph of the shipped village, a map's translation, the reference and the error."""
    renderer, pose = tr.Renderer(tr.load_scene("village")), tr.pose(-70, -60, 38, look_at=(0, 5, 0))
    image, known = photograph(renderer, pose)
    cv2.imwrite("photograph.png", image[..., ::-1])
    command("translate fok-1to1 photograph.png -o out/translated")
    truth = renderer.frame(pose).apparent_temperature
    error = read("out/translated/photograph.tif") * COUNT_K - truth
    masked = [np.where(known, each, np.nan) for each in (truth + error, truth, error)]
    low, high = np.nanpercentile(masked[1], (1, 99))
    figure, _ = panels(
        ("photograph", np.where(known[..., None], image, 255)),
        ("fok-1to1 on the photograph", masked[0], low, high, "inferno"),
        ("reference", masked[1], low, high, "inferno"),
        ("error of the map", masked[2], -15.0, 15.0, "RdBu_r"),
    )
    finish("compare", [figure], 160)


def export():
    """The boxes of the labels over a frame, and the masks of the classes."""
    run("guides/export.md", 2)
    labels = json.loads(Path("labels.json").read_text("utf-8"))
    image = labels["images"][1]
    classes = json.loads(Path("out/masks/legend.json").read_text("utf-8"))["class"]
    shown = read(f"out/masks/{Path(image['file_name']).stem}_class.png")
    frame = read(f"out/flight/{image['file_name']}")
    seen = {name: CLASSES[name] for key, name in classes.items() if np.any(shown == int(key))}
    table = np.array([to_rgb(seen.get(classes.get(str(value)), "white")) for value in range(256)])
    figure, (left, right) = panels(
        ("boxes and apparent temperatures", np.dstack([frame] * 3)), ("classes", table[shown]), aside=115
    )
    legend(right, seen)
    for each in labels["annotations"]:
        if each["image_id"] == image["id"]:
            x, y, width, height = each["bbox"]
            left.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor="#ffa566", linewidth=1.2))
            under = each["object"] == "car"
            left.annotate(f"{each['object']} {each['apparent_k']:.0f} K", (x + width, y + height if under else y),
                          xytext=(5, 0), textcoords="offset points", color="#ffa566", fontsize=8,
                          va="center")  # fmt: skip
    finish("export", [figure], 128)


def learned_maps():
    """A photograph of the page's flight, the page's own map of it, and the thermal frame."""
    run("guides/learned-maps.md", 4)
    image = read("out/pictures/frame_000000_visible.png")[..., ::-1]
    known = image.any(-1)
    cut = within(known)
    files = "out/translated/frame_000000_visible.tif", "out/pictures/frame_000000_radiometric.tif"
    kelvin = [np.where(known, read(each) * COUNT_K, np.nan)[cut] for each in files]
    low, high = np.nanpercentile(kelvin[1], (1, 99))
    figure, _ = panels(
        ("photograph", np.where(known[..., None], image, 255)[cut]),
        ("translated by mine.npz", kelvin[0], low, high, "inferno"),
        ("radiometric frame", kelvin[1], low, high, "inferno"),
    )
    finish("learned-maps", [figure], 96)


def learned_materials():
    """The orthophoto and the materials that the shipped map sees in it."""
    run("guides/learned-materials.md", 1)
    with rasterio.open("small/orthophoto.tif") as file:
        image = np.moveaxis(file.read()[:3], 0, -1)
    with rasterio.open("out/materials/classes.tif") as file:
        classes, colours = file.read(1), file.colormap(1)
    with rasterio.open("out/materials/probabilities.tif") as file:
        names = dict(enumerate(file.descriptions, 1))
    share = np.bincount(classes.ravel(), minlength=256) / classes.size
    table = np.array([colours.get(value, (0, 0, 0))[:3] for value in range(256)], np.uint8)
    figure, axes = panels(("orthophoto", image), ("materials", table[classes]), aside=115)
    legend(axes[1], {names[value]: table[value] / 255.0 for value in np.argsort(-share) if share[value] >= 0.01})
    finish("learned-materials", [figure], 160)


def flight_logs():
    """The track and the footprints that the preview draws."""
    run("guides/flight-logs.md", 1)
    save("flight-logs", Image.open("out/preview/preview.png").convert("RGB"), 160, Image.Quantize.MAXCOVERAGE, kmeans=3)


def campaign():
    """The first and the last pair from above of the page's data set."""
    pairs = run("guides/campaign.md", 2)["pairs"]
    shown = []
    above = [entry for entry in pairs.entries if entry.labels["view"] == "nadir"]
    for entry in above[0], above[-1]:
        pair = pairs.pair(entry)
        kelvin = apparent_temperature(pair.radiance, pair.scale.band_um)
        shown += [
            (f"{entry.labels['season']}, {entry.labels['view']}", pair.visible),
            (f"at {entry.time[11:16]} UTC", kelvin, *np.percentile(kelvin, (1, 99)), "inferno"),
        ]
    finish("campaign", [panels(*shown)[0]], 96)


def examples():
    """The day of the second script."""
    made = runpy.run_path(str(DOCS.parent / "examples" / "02_day_over_your_terrain.py"))
    renderer, scene, hours = made["renderer"], made["scene"], ("03", "08", "13")
    frames = [
        tr.Renderer(scene.at(f"2018-07-28T{hour}:00Z"), quality="fast", like=renderer).frame(made["pose"])
        for hour in hours
    ]
    kelvin = [frame.apparent_temperature for frame in frames]
    write("day", *(painted(each, np.min(kelvin), np.max(kelvin)) for each in kelvin))


ALL = (
    terrain, survey, cameras, midwave, python, compare, export, learned_maps, learned_materials, flight_logs, campaign,
    examples,
)  # fmt: skip

if __name__ == "__main__":
    chosen = [globals()[name] for name in sys.argv[1:]] or ALL
    for draw in chosen:
        with TemporaryDirectory() as folder:
            os.chdir(folder)
            draw()
            os.chdir(DOCS)
