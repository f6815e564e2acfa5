"""Draw the pictures of guides and examples: docs/figures/guide-….png, of what their own blocks and scripts make.

`python docs/guide_pictures.py` runs the blocks of each page in a temporary folder, then takes the pictures from there.
"""

import base64
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import matplotlib
import numpy as np
from PIL import Image

import thermorender as tr

DOCS = Path(__file__).resolve().parent
WIDTH, GAP, COLOURS = 800, 12, 64
DOWN = (0, 0, 25, 0, -90)


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
    picture = Image.fromarray(cv2.cvtColor(np.hstack(shown[:-1]), cv2.COLOR_BGR2RGB))
    path = DOCS / "figures" / f"guide-{name}.png"
    picture.quantize(colours, method, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path.name, path.stat().st_size)


def read(path):
    """Return an image as it is stored."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def painted(kelvin, low, high):
    """Return kelvin (H, W) as a BGR picture of the colours of `frame.show`, white where there are none."""
    share = np.clip((kelvin - low) / (high - low), 0.0, 1.0)
    colour = matplotlib.colormaps["inferno"](np.nan_to_num(share))[..., 2::-1]
    return (np.where(np.isnan(kelvin)[..., None], 1.0, colour) * 255).astype(np.uint8)


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


def python():
    """What a frame shows in a notebook."""
    html = run("guides/python.md", 3)["frame"]._repr_html_()
    data = base64.b64decode(re.search(r"base64,([^\"]+)", html)[1])
    write("python", cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), method=Image.Quantize.MAXCOVERAGE)


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


if __name__ == "__main__":
    chosen = [globals()[name] for name in sys.argv[1:]] or [terrain, survey, cameras, python, examples]
    for draw in chosen:
        with TemporaryDirectory() as folder:
            os.chdir(folder)
            draw()
            os.chdir(DOCS)
