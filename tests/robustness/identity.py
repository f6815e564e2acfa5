"""Compares two checkouts to the bit: `python -m tests.robustness.identity OLD NEW -o out/identity.json`.

Each checkout renders the same drawn cases in its own processes of one thread, with its own cache. Digests of all
products are compared; status 1 if any differs. Finished cases stay beside the output until the checkout or this file
changes. Only public names, verbs and the link's bytes are used, since modules and internal names may move.
"""

import argparse
import contextlib
import dataclasses
import hashlib
import io
import itertools
import json
import os
import random
import re
import runpy
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SEED = 20
# Left out of JSON: versions, measured seconds, and checksums of files that have their own digest here.
_LEFT_OUT = {"versions", "profile", "seconds", "files", "checksum"}
# {land: arguments of make-scene}
LANDS = {
    "heath": "heath --draped", "village": "village --draped", "walls": "village",
    "snow": "ridge --draped --snow-depth-m 0.2 --air-low-c=-8 --air-high-c=-2",
}  # fmt: skip
_MATERIALS = '[emissivity]\nsource = "learned"\nmodel = "procedural"\nfallback = "soil_loam"\n'
_YARD = """[terrain]\nmesh = "yard.obj"\n[temperature]\nsource = "constant"\nvalue = 295.0
[emissivity]\nsource = "constant"\nvalue = 0.6\n[sky]\ntemperature = 230.0\n"""
# {object: shape, size [m], position [m], temperature [K], material, more keys}
_OBJECTS = {
    "mover": ("box", [2.0, 4.0, 1.5], [0.0, 0.0, 0.0], 305.0, "paint_metallic", 'track = "track.csv"'),
    "fire": ("disc", [1.5, 1.5, 0.1], [3.0, -2.0, 0.1], 900.0, "soil_dark", ""),
    "rod": ("box", [0.02, 12.0, 0.02], [-4.0, 3.0, 1.0], 420.0, "iron_weathered", "yaw_deg = 33.0"),
    "ball": ("sphere", [3.0, 3.0, 3.0], [6.0, 6.0, 0.0], 310.0, "brick_clay", ""),
    "pool": ("box", [8.0, 8.0, 0.2], [-3.0, -6.0, 0.4], 288.0, "water_fresnel", ""),
    "sheet": ("box", [4.0, 0.2, 3.0], [-3.0, 0.0, 0.0], 300.0, "aluminium_polished", ""),
    "trees": (None, None, [0.0, 0.0, 0.0], 291.0, "broadleaf", 'file = "leaf.obj"\ninstances = "places.csv"'),
    "wood": (None, None, [0.0, 0.0, 0.0], '"balance"', "broadleaf", 'file = "leaf.obj"\ninstances = "places.csv"'),
}
_BALANCE = {"temperature": '[temperature]\nsource = "balance"\n', "truth": ""}
# {scene: (land, {table: text in its place}, objects)}
SCENES = {
    **{land: (land, {}, "") for land in LANDS},
    "objects": ("heath", {}, "mover fire rod ball"),
    "copies": ("heath", {}, "trees rod ball"),
    "mirrors": ("village", {"sky": ""}, "pool sheet fire"),
    "balance": ("heath", {**_BALANCE, "sky": ""}, "ball"),
    "wood": ("heath", _BALANCE, "wood"),
    "learned": ("village", {"emissivity": _MATERIALS, "emissivity.classes": ""}, "fire"),
    "yard": (None, {}, "ball"),
}
SHIPPED = ("heath-400", "village-320", "ridge-1600")
BALANCED, FLAT = {"balance", "wood"}, SCENES.keys() - {"walls", "yard"}
_FILES = {
    "yard.obj": "".join(f"v {x} {y} {z}\n" for z in (0, 4) for x, y in ((-6, -6), (6, -6), (6, 6), (-6, 6)))
    + "f 1 2 3 4\nf 2 1 5 6\nf 3 2 6 7\nf 4 3 7 8\n",
    "leaf.obj": "v -1 0 0\nv 1 0 0\nv 1 0 3\nv -1 0 3\nv 0 -1 0\nv 0 1 0\nv 0 1 3\nv 0 -1 3\nf 1 2 3 4\nf 5 6 7 8\n",
    "places.csv": "east_m,north_m,yaw_deg,scale\n0,3,30,1\n5,-4,200,1.3\n-8,2,75,0.7\n",
    "track.csv": "time_s,east_m,north_m,yaw_deg,temperature_k\n0,-6,-3,80,300\n12,9,4,60,330\n",
    "log.csv": "time_s,east_m,north_m,above_ground_m,yaw_deg,gimbal_pitch_deg\n"
    + "".join(f"{t},{2 * t - 4},{2 * t - 3},{14 - t},{40 + 9 * t},{-60 + 4 * t}\n" for t in range(5)),
}  # fmt: skip
# {camera: (model, changes)}
CAMERAS = {
    "boson": ("boson-640", {}),
    "tau": ("tau2-640", {"width": 33, "height": 47}),
    "xt2": ("zenmuse-xt2", {}),
    "wide": ("zenmuse-xt2-9mm", {"distortion": (-0.2, 0.05, 1e-3, -1e-3, 0.0), "principal_offset_px": (2.5, -1.5)}),
    "ideal": ("ideal", {"width": 64, "height": 64}),
    "low": ("tau2-640", {"gain": "low", "tlinear_mk": 400.0}),
    "band": ("boson-640", {"band_um": (8.0, 12.0), "bits": 16, "row_time_us": 0.0, "ffc_interval_s": 0.2}),
    "small": ("boson-640", {"width": 24, "height": 20}),
}
SETTINGS = (
    {"quality": "fast", "rays": 4},
    {"quality": "standard", "rays": 8, "seed": 7},
    {"quality": "fast", "samples": 1, "taps": 1, "edge_mk": 500.0, "rays": 2, "tolerance_mk": 50.0},
)
# {pose: (metres above the ground, pitch, roll [deg])}; "off" looks in from beyond the terrain.
POSES = {
    "nadir": (25.0, -90.0, 0.0), "oblique": (18.0, -40.0, 0.0), "grazing": (7.0, -6.0, 0.0), "up": (6.0, 35.0, 0.0),
    "rolled": (14.0, -55.0, 20.0), "off": (30.0, 0.0, 0.0),
}  # fmt: skip
_VIEW = {"settings": SETTINGS[0], "place": [1.0, -9.0], "pose": "oblique", "yaw": 5.0, "time": 0, "index": 4}
# Command lines; {out} is a new folder, and all files in it are compared.
_COMMANDS = {
    "fly": """fly {scene} -o {out}/flight --trajectory {scene}/log.csv --rate-hz 4 --start-s 1 --stop-s 1.5
        --quality fast --rays 4 --audit 2 --display plateau --palette ironbow --agc-memory-s 1 --seed 3
        --thermography emissivity=0.95,air_c=9
        --products exr,truth,error,counts,counts-tiff,radiometric,display,video,visible,report
        ; export coco {out}/flight -o {out}/labels.json ; export masks {out}/flight -o {out}/masks""",
    "render": """render {scene} -o {out}/render --pose 2,-14,12 --look-at 0,0,0 --air midlatitude-summer --display local
        --rays 4 --seed 5 --products exr,truth,error,counts,display,visible""",
    "translate": "translate fok-1to1 {scene}/orthophoto.tif -o {out}/translated",
    "day": "day {scene} -o {out}/day --pose 2,-14,12,0,-50,0 --step-min 720 --quality fast --rays 4",
    "reference": """render {small} -o {out}/render --pose 2,-4,12,0,-70,0 --engine reference --paths 4
        --products exr,truth,counts""",
}
# Cases drawn by hand: {kind: names of scenes}
_FIXED = {
    "land": LANDS, "flight": ("objects", "balance"), "queries": ("objects", "walls", "copies", "mirrors"),
    "link": ("objects", "village"), "fly": ("objects", "copies", "balance", "yard", "mirrors"),
    "render": ("objects", "mirrors", "learned"), "translate": ("village",), "day": ("balance", "wood"),
    "reference": ("objects", "yard"),
}  # fmt: skip
_MAPS = ("fok-1to1", "fok-9to1", "procedural-palette", "procedural-trees", "procedural-correlation+")


def drawn(count):
    """Return [(name, kind, scene, details)] of a number of cases; the first ones are the same for every number."""
    some, scenes = random.Random(SEED), (*SCENES, *SHIPPED)
    cases = [
        (f"{kind} {name}", kind, name, {"lines": _COMMANDS.get(kind)})
        for kind, names in _FIXED.items() for name in names
    ]  # fmt: skip
    for model in _MAPS:
        edits = [("with_temperature", [model], {})]
        cases.append((f"map {model}", "edit", "village", {**_VIEW, "edits": edits, "how": "like"}))
    for number in itertools.count():
        if len(cases) >= count:
            return cases[:count]
        scene, kind = scenes[number % len(scenes)], "edit" if number % 3 == 2 else "frame"
        details = {
            "settings": some.choice(SETTINGS), "camera": some.choice([*CAMERAS]), "pose": some.choice([*POSES]),
            "place": [round(some.uniform(-12.0, 12.0), 2), round(some.uniform(-12.0, 12.0), 2)],
            "yaw": round(some.uniform(0.0, 360.0), 1), "time": some.randrange(4), "index": some.randrange(99),
            "edits": _edits(some, scene, 0 if kind == "frame" and some.random() < 0.5 else some.choice((1, 1, 2))),
        }  # fmt: skip
        how = some.choice(("solved", "preview", "like", "solved-preview")) if kind == "edit" else details["camera"]
        words = [how, details["pose"], *(edit[0] for edit in details["edits"])]
        cases.append((f"{kind} {number:03d} {scene} {' '.join(words)}", kind, scene, {**details, "how": how}))


def _edits(some, scene, count):
    """A number of edits that a scene allows: [(method, arguments, keys)]."""
    kelvin, area = round(some.uniform(270.0, 320.0), 1), [[-9, -9], [9, -7], [4, 8]]
    found = [
        ("with_air", [some.choice(("tropical", "us-1976", "subarctic-winter"))], {}),
        ("with_air", ["midlatitude-summer", "rural-23km"], {}),
        ("with_sky", [kelvin - 60.0], {}),
        ("with_sky", [kelvin - 70.0, kelvin], {}),
        ("with_camera", [some.choice(("xt2", "tau", "band"))], {}),
    ]
    if scene in BALANCED:
        found += [("with_weather", [], {"wind_m_s": 8.0}), ("with_weather", [], {"cloud": 0.8})] * 2
    elif scene != "walls":
        found += [("with_temperature", [kelvin], {})] + [("with_temperature", ["balance"], {})] * (scene in LANDS)
    if scene in FLAT - {"learned"}:
        found += [("with_material_in", [area, some.choice(("roof_slate", "sand_quartz"))], {})] * 2
    if scene in ("heath", "balance", "objects", "wood", "heath-400"):
        found += [("with_material", [{"grass_green": some.choice(("sand_quartz", "asphalt"))}], {})] * 2
    if scene in ("objects", "copies", "yard"):
        found += [("with_objects", [{"ball": kelvin}], {}), ("with_material", [{"ball": 0.5}], {})] * 2
    return some.sample(found, count)


class Checkout:
    """The package of this process's checkout, with its scenes and renderers in a folder."""

    def __init__(self, folder):
        import thermorender

        self.tr, self.folder, self.renderers, self.now = thermorender, folder, {}, None

    def verb(self, line, **names):
        """Run a command line in this process, with these names filled in."""
        before, sys.argv = sys.argv, ["thermorender", *(word.format(**names) for word in line.split())]
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
                runpy.run_module("thermorender", run_name="__main__")
        except SystemExit as stop:
            if stop.code:
                raise ValueError(said.getvalue().strip()) from None
        finally:
            sys.argv = before

    def camera(self, name):
        """Return a camera of few pixels with the field of view of its model."""
        model, changes = self.tr.load_camera(CAMERAS[name][0]), CAMERAS[name][1]
        focal_mm = model.focal_length_mm * changes.get("width", 96) / model.width
        return dataclasses.replace(model, **{"width": 96, "height": 80, "focal_length_mm": focal_mm, **changes})

    def path(self, name, camera="boson"):
        """Return the folder of a scene, made once, or the name of a shipped one."""
        if name in SHIPPED:
            return name.split("-")[0] + "/survey"
        folder, (land, tables, objects) = self.folder / "scenes" / f"{name}-{camera}", SCENES[name]
        if not folder.exists():
            part, text = self.fresh("scene"), _YARD
            if land:
                shutil.copytree(self.land(land), part)
                text = (part / "scene.toml").read_text(encoding="utf-8")
            for table, body in {"camera": "", **tables}.items():
                text = re.sub(rf"(?m)^\[{table}\]\n([^\[\n].*\n)*", lambda _, body=body: body, text)
            text += '\n[camera]\nmodel = "camera.toml"\n'
            for each in objects.split():
                shape, size, position, kelvin, material, more = _OBJECTS[each]
                more += f'\nshape = "{shape}"\nsize = {size}' if shape else ""
                text += f'[[object]]\nname = "{each}"\nposition = {position}\ntemperature = {kelvin}\n'
                text += f'material = "{material}"\n{more}\n'
            part.mkdir(parents=True, exist_ok=True)
            values = {key: value for key, value in vars(self.camera(camera)).items() if key != "name"}
            own = {"scene.toml": text, "camera.toml": "".join(f"{k} = {json.dumps(v)}\n" for k, v in values.items())}
            for file, content in {**own, **_FILES}.items():
                (part / file).write_text(content, encoding="utf-8")
            folder.parent.mkdir(exist_ok=True)
            part.replace(folder)
        return folder

    def land(self, name):
        """Return the folder of a procedural land, made once."""
        folder = self.folder / "lands" / name
        if not folder.exists():
            self.verb(
                f"make-scene {LANDS[name]} -o {{folder}} --size-m 64 --texel-m 1 --post-m 2 --seed 3", folder=folder
            )
        return folder

    def renderer(self, name, settings=SETTINGS[0]):
        """Return the Renderer of a scene with the camera "boson"; those of the scene in hand are kept."""
        if name != self.now:
            self.renderers, self.now = {}, name
        key = json.dumps(settings)
        if key not in self.renderers:
            scene = self.tr.load_scene(self.path(name)).with_camera(self.camera("boson"))
            self.renderers[key] = self.tr.Renderer(scene, **settings)
        return self.renderers[key]

    def fresh(self, name):
        """Return an absent path for output."""
        folder = self.folder / f"temporary.{os.getpid()}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder / name

    def pose(self, scene, details):
        """Return the pose that a case describes."""
        east, north = details["place"]
        up, pitch, roll = POSES[details["pose"]]
        ground = float(scene.pose(east, north, 1.0)[2, 3]) - 1.0
        if details["pose"] == "off":
            return self.tr.pose(90.0, 40.0, ground + up, look_at=(east, north, ground))
        return self.tr.pose(east, north, ground + up, details["yaw"], pitch, roll)

    def edited(self, scene, details):
        """Return a scene with the edits of a case."""
        for method, arguments, keys in details["edits"]:
            arguments = [self.camera(*arguments)] if method == "with_camera" else arguments
            scene = getattr(scene, method)(*arguments, **keys)
        return scene

    def view(self, renderer, details):
        """Return the products of a frame, of its scene and of its light."""
        pose, scene = self.pose(renderer.scene, details), renderer.scene
        about = {"digest": scene.digest(), "plan": renderer.plan.as_dict(), "sun": scene.sun, "time": scene.time}
        about["errors_mk"] = renderer.baked.errors_mk
        found = renderer.frame(pose, details["time"], details["index"])
        return self.frame(found, error=details["index"] % 4 == 0) | {"scene": about}

    def frame(self, found, begin="", error=False):
        """Return the products of a frame."""
        path = self.fresh("frame.npz")
        found.save(path)
        with np.load(path) as saved:
            products = {name: saved[name] for name in saved.files if name != "record"}
            products["record"] = json.loads(str(saved["record"]))
        products |= {"display": found.display, "numbers": {"budget_mk": found.budget_mk, "targets": found.targets}}
        products |= {"error_mk": found.error_mk} if error else {}
        return {begin + name: value for name, value in products.items()}


def land(own, name, details):
    """Files of a procedural land."""
    return _files(own.land(name))


def frame(own, name, details):
    """A frame of a scene, or of an edited scene as if it were loaded so."""
    known = own.renderer(name, details["settings"])
    scene = own.edited(known.scene, details).with_camera(own.camera(details["camera"]))
    like = None if details["edits"] else known
    return own.view(own.tr.Renderer(scene, **details["settings"], like=like), details)


def edit(own, name, details):
    """A frame of an edited scene, from the light of the scene before."""
    known, how = own.renderer(name, details["settings"]), details["how"]
    scene = own.edited(known.scene, details)
    if how == "like" or not scene.temperature_state.solved:
        return own.view(own.tr.Renderer(scene, **details["settings"], like=known), details)
    made = known.solved_for(scene) if how == "solved" else known.preview_for(scene)
    if how == "solved-preview":
        made = made.solved_for(made.scene)
    return own.view(own.tr.Renderer.of(made.baked, seed=11) if how == "solved" else made, details)


def flight(own, name, details):
    """Frames of a flight one by one, and files of a flight without command line."""
    known, out = own.renderer(name), own.fresh("plain")
    path, found = own.tr.load_trajectory(own.path(name) / "log.csv", known.scene), {}
    options = own.tr.FlightOptions(rate_hz=2.0, stop_s=0.5, products=("exr", "counts"), exr_compression="zip")
    own.tr.fly(known, path, out, options)
    found = _files(out)
    for number, one in enumerate(known.frames(path, rate_hz=5.0, start_s=0.2, stop_s=0.6, audit=2)):
        found |= own.frame(one, f"{number}/")
    return found


def command(own, name, details):
    """Files of command lines."""
    scene, small = own.path(name), own.path(name, "small")
    out = own.fresh("out")
    for line in details["lines"].split(" ; "):
        own.verb(line, scene=scene, small=small, out=out)
    return _files(out)


def queries(own, name, details):
    """What a Renderer tells about a view beside its frame."""
    known = own.renderer(name)
    pose, rays = own.pose(known.scene, _VIEW), np.array([[0.1, 0.2, -1.0], [0.7, 0.1, -0.4], [0.0, 0.0, 1.0]])
    single, edited = known.frame(pose), known.preview_for(known.scene.with_sky(200.0))
    found = {
        "texels": known.texels(pose), "sky": known.sky(pose), "depth": known.depth(pose),
        "parts": [vars(one) for one in known.parts_at(pose, [[4, 4], [40, 50], [70, 20]])],
        "leaving": known.radiance(pose, through_air=False), "objects": known.objects_seen(pose)[0],
        "sampled_as": edited.frame(pose, sampled_as=single).radiance,
    }  # fmt: skip
    found |= {"map": single.orthorectified(1.0).kelvin} if single.place else {}
    found |= dict(zip(("visible", "valid"), known.visible(pose), strict=True))
    return found | dict(zip(("distance", "texel"), known.hits(np.tile(pose[:3, 3], (3, 1)), rays), strict=True))


def link(own, name, details):
    """Bytes of the answers to a session of each method, without the seconds that they took."""
    token, scene = own.fresh("token"), own.renderer(name).scene
    command = [sys.executable, __file__, "--verb", "serve", own.path(name), "--port", 0, "--token-file", token]
    command = [*map(str, command), "--quality", "fast", "--rays", "4", "--map", "fok-1to1"]
    server, answers = subprocess.Popen(command, stdout=subprocess.PIPE, text=True), []

    def ask(kind, session, payload):
        to.write(struct.pack("<4sHHIIQ", b"TRLK", 1, kind, len(payload), session, len(answers) + 1) + payload)
        to.flush()
        _, _, answer, length, _, _ = struct.unpack("<4sHHIIQ", to.read(24))
        data = to.read(length)
        # A reply holds two measured times.
        answers.append(data[:32] + bytes(8) + data[40:] if answer == 6 else data)

    try:
        port = int(re.search(r"port (\d+)", server.stdout.readline())[1])
        with socket.create_connection(("127.0.0.1", port), 120.0) as connection, connection.makefile("rwb") as to:
            ask(1, 0, token.read_text().strip().encode())
            for session, method, model, products in ((1, b"A", b"", 0x1FF), (2, b"B", b"fok-1to1", 0x83)):
                ask(3, session, struct.pack("<64s64scBBBIQd6d", b"", model, method, 0, 0, 0, 0, 9, 0.0, *[0.0] * 6))
                for second in (0.0, 0.1, 0.2):
                    pose = [second, 1.0, -9.0, scene.pose(1.0, -9.0, 20.0)[2, 3], 0.0, 1.0, 0.0, 0.0]
                    ask(5, session, struct.pack("<dIIIIIId8d", second, products, 0, 1, 0, 0, 0, 0.0, *pose))
    finally:
        server.send_signal(signal.SIGTERM)
        server.communicate(timeout=60)
    return {"welcome": json.loads(answers[0])} | {f"answer {n}": data for n, data in enumerate(answers[1:])}


KINDS = {"land": land, "frame": frame, "edit": edit, "flight": flight, "queries": queries, "link": link}


def _files(folder):
    """{path: bytes, or content of JSON} of a folder."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        text = path.read_text(encoding="utf-8") if path.suffix in (".json", ".jsonl") else ""
        lines = [json.loads(line) for line in ([text] if path.suffix == ".json" else text.splitlines())]
        found[path.relative_to(folder).as_posix()] = lines or path.read_bytes()
    return found


def _plain(value):
    """A value for JSON, without what `_LEFT_OUT` names."""
    if dataclasses.is_dataclass(value):
        value = vars(value)
    if isinstance(value, dict):
        return {str(name): _plain(one) for name, one in value.items() if name not in _LEFT_OUT}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def _array(value):
    """A product as an array: itself, the bytes of a file, or the text of JSON."""
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value)
    text = value if isinstance(value, bytes) else json.dumps(_plain(value), sort_keys=True, indent=1).encode()
    return np.frombuffer(text, np.uint8)


def render(folder, options):
    """Render the cases of one of several workers with the package of this process; keep digests and arrays."""
    own, kept = Checkout(folder), folder / f"digests.{options.turn}.json"
    done = json.loads(kept.read_text()) if kept.exists() else {}
    cases = [case for case in drawn(options.cases) if re.search(options.only, case[0])]
    # Cases of a scene share its light.
    scenes = sorted({scene for _, _, scene, _ in cases})
    cases = [case for scene in scenes[options.turn :: options.workers] for case in cases if case[2] == scene]
    for number, (name, kind, scene, details) in enumerate(cases):
        if name in done:
            continue
        start = time.process_time()
        try:
            products = KINDS.get(kind, command)(own, scene, details)
        except Exception as error:  # its words are compared
            products = {"error": f"{type(error).__name__}: {error}".replace(str(folder), "")}
            print(f"  {products['error']}")
        arrays = {product: _array(value) for product, value in products.items()}
        np.savez_compressed(folder / f"{name}.npz", **arrays)
        done[name] = {
            product: hashlib.sha256(f"{array.dtype} {array.shape} ".encode() + array.tobytes()).hexdigest()
            for product, array in sorted(arrays.items())
        }
        kept.with_suffix(".part").write_text(json.dumps(done, indent=1))
        kept.with_suffix(".part").replace(kept)
        print(f"  {number + 1}/{len(cases)} {time.process_time() - start:.1f} s of one core: {name}", flush=True)


def rendered(tree, folder, options):
    """Render the cases with a checkout in other processes; return {case: {product: digest}}."""
    state = hashlib.sha256(Path(__file__).read_bytes())
    for path in sorted(path for part in ("thermorender", "scenes", "materials") for path in (tree / part).rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            state.update(path.relative_to(tree).as_posix().encode() + path.read_bytes())
    # Both checkouts work under one path, since digests of scenes with files hold it.
    work = folder.with_suffix(".work")
    shutil.rmtree(work, ignore_errors=True)
    if (folder / "checkout").exists() and (folder / "checkout").read_text() == state.hexdigest():
        folder.replace(work)
    shutil.rmtree(folder, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    (work / "checkout").write_text(state.hexdigest())
    more = {"PYTHONPATH": str(tree), "PYTHONSAFEPATH": "1", "THERMORENDER_CACHE": str(work / "cache")}
    more |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, __file__, "--render", work, "--cases", options.cases, "--workers", options.workers]
    command, place = [*map(str, command), "--only", options.only], {"cwd": tree, "env": os.environ | more}
    try:
        if options.workers > 1:
            subprocess.run([*command, "--only", "^land", "--workers", "1"], **place, check=True)
        running = [subprocess.Popen([*command, "--turn", str(turn)], **place) for turn in range(options.workers)]
        ends = [process.wait() for process in running]
    finally:
        work.replace(folder)
    if any(ends):
        sys.exit(f"{tree}: a process ended early; finished cases are kept, and the same command continues")
    return {name: of for path in folder.glob("digests.*.json") for name, of in json.loads(path.read_text()).items()}


def difference(old, new):
    """Return in words how a product differs: its largest difference in its own unit, or its first other keys."""
    if old is None or new is None:
        return "only in " + ("NEW" if old is None else "OLD")
    if old.dtype == np.uint8 and old.ndim == 1:
        try:
            values = [dict(_leaves(json.loads(bytes(one)), "")) for one in (old, new)]
        except ValueError:
            return f"{old.size} bytes became {new.size}"
        keys = [key for key in sorted(values[0].keys() | values[1].keys()) if values[0].get(key) != values[1].get(key)]
        return "; ".join(f"{key}: {values[0].get(key)} became {values[1].get(key)}" for key in keys[:4])
    if old.dtype != new.dtype or old.shape != new.shape:
        return f"{old.dtype} {old.shape} became {new.dtype} {new.shape}"
    with np.errstate(invalid="ignore"):
        apart = np.where(old == new, 0.0, np.abs(old.astype(np.float64) - new.astype(np.float64)))
    apart[np.isnan(old.astype(np.float64)) & np.isnan(new.astype(np.float64))] = 0.0
    return f"largest difference {np.nanmax(apart):.3g} at {np.count_nonzero(apart)} of {apart.size}"


def _leaves(value, path):
    """Yield (path, value) of the plain values of JSON."""
    if isinstance(value, (dict, list)):
        for name, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(one, f"{path}/{name}")
    else:
        yield path, value


def compare(folders, found):
    """Return [{case, product, difference}] of two checkouts."""
    differing = []
    for case in found[0]:
        digests = [one.get(case, {}) for one in found]
        names = [n for n in sorted(digests[0].keys() | digests[1].keys()) if digests[0].get(n) != digests[1].get(n)]
        if names:
            with np.load(folders[0] / f"{case}.npz") as old, np.load(folders[1] / f"{case}.npz") as new:
                for name in names:
                    pair = old.get(name), new.get(name)
                    differing.append({"case": case, "product": name, "difference": difference(*pair)})
    return differing


def main():
    """Render with both checkouts and compare; or do the part of one process."""
    if sys.argv[1] in ("--verb", "--render"):
        import drjit

        # Sums over threads may depend on their number.
        drjit.set_thread_count(1)
    if sys.argv[1] == "--verb":
        sys.argv[:2] = ["thermorender"]
        runpy.run_module("thermorender", run_name="__main__")
        return
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.identity", description=__doc__.splitlines()[0])
    parser.add_argument("trees", nargs="*", type=Path, metavar="OLD NEW", help="Two checkouts.")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/identity.json"))
    parser.add_argument("--cases", type=int, default=180, help="Number of cases.")
    parser.add_argument("--only", default="", help="Only cases whose names match this regular expression.")
    parser.add_argument("--workers", type=int, default=1, help="Processes per checkout.")
    parser.add_argument("--render", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--turn", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.render:
        render(options.render, options)
        return
    if len(options.trees) != 2:
        parser.error("give two checkouts, OLD and NEW")
    # So that finished cases are kept.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    folders, found = [options.output.resolve().with_suffix(f".{side}") for side in ("old", "new")], []
    names = [case[0] for case in drawn(options.cases) if re.search(options.only, case[0])]
    for tree, folder in zip(options.trees, folders, strict=True):
        print(f"{tree}:", flush=True)
        own = rendered(tree.resolve(), folder, options)
        found.append({name: own[name] for name in names})
    differing = compare(folders, found)
    report = {"cases": len(names), "differing": differing, "old": found[0], "new": found[1]}
    options.output.write_text(json.dumps(report, indent=1), encoding="utf-8")
    for one in differing:
        print(f"{one['case']}: {one['product']}: {one['difference']}")
    count = sum(map(len, found[0].values()))
    print(f"{len(differing)} of {count} products of {len(names)} cases differ; digests and words in {options.output}")
    sys.exit(bool(differing))


if __name__ == "__main__":
    main()
