"""Small training tasks, networks, data sets and rigs for tests of learned maps."""

import numpy as np

from thermorender.apps.training.dataset import Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.apps.training.registration.rig import Rig
from thermorender.apps.training.task import Example, Task
from thermorender.learned.networks.recipes import recipe_of
from thermorender.learned.temperature_map import Inputs, TemperatureMap

# Thermal values are hundredths of a kelvin; intensities have a range of 280 K to 300 K.
TEMPERATURE = np.arange(40000) / 100.0
INTENSITY = (TEMPERATURE - 280.0) / 20.0
# Width of the test networks.
WIDTH = 4
# A training that takes a few seconds.
SMALL = {"width": 4, "batch": 4, "crops": 48, "every": 12}
SHAPE = (40, 48)
PARTS = ("train", "train", "validation", "test")
# Thermal values are linear in colour: value = 9000 + 8 red − 4 green + 3 blue.
WEIGHT = np.array([8.0, -4.0, 3.0])
# 9000 counts are some 40 W m⁻² sr⁻¹.
SCALE = ThermalScale("radiance", 0.004, 4.0)
TRUE = Rig((300, 400), (96, 128), scale=2.2, rotation_deg=1.7, shift_px=(9.0, -6.0), k1=-0.06)


def picture(seed, height=96, width=128):
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 256, (8, 9, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def kelvin(rgb):
    """The true temperature of the test pictures: linear in colour, 281 K to 299 K."""
    return 290.0 + (rgb @ np.array([8.0, -5.0, 4.0]) - 900.0) / 250.0


def example(seed, valid=None, conditional=False, **sides):
    rgb = picture(seed, **sides)
    terrain = {"slope": np.full(rgb.shape[:2], 0.1 * seed, np.float32)} if conditional else {}
    conditions = {"air_k": 285.0 + seed % 3, "wind_m_s": 2.0} if conditional else {}
    values = np.rint(100.0 * kelvin(rgb)).astype(np.uint16)
    valid = np.ones(values.shape, bool) if valid is None else valid
    return Example(Inputs(rgb, 0.2, terrain, conditions), values, valid)


def task_of(method, examples, run=None, seed=3, progress=lambda what, share: None, resume=False, **options):
    recipe = recipe_of(*method.split(":"))
    small = {"side": 96} if recipe.whole else {}
    return Task(examples, INTENSITY, TEMPERATURE, seed, progress, recipe.all_options | small | options, 0.2, (0.2, 0.2),
                run=run, resume=resume)  # fmt: skip


def examples(count=20, conditional=False):
    return [example(seed, conditional=conditional) for seed in range(count)]


def network(name, width=WIDTH, published=False, encoding=None, seed=0):
    """A Network with random weights."""
    import torch

    from thermorender.learned.networks.building import net_of
    from thermorender.learned.networks.encoding import Encoding
    from thermorender.learned.networks.predictor import Network, state_of

    torch.manual_seed(seed)
    encoding = encoding or Encoding(offset=0.5, scale=0.5)
    method, *architecture = name.split(":")
    net = net_of(recipe_of(method, *architecture), encoding, width)
    return Network(method, width, encoding, (0.1, 0.4), state_of(net), False, published, {}, *architecture)


def map_of(predictor):
    return TemperatureMap("n", predictor.method, predictor, (280.0, 300.0), (7.5, 13.5), 0.2, (0.1, 0.4), "boson-640",
                          260.0, "x")  # fmt: skip


def colours(seed):
    """A picture of smooth, saturated colours, (h, w, 3) uint8."""
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 256, (8, 9, 3), np.uint8)
    return cv2.resize(coarse, SHAPE[::-1], interpolation=cv2.INTER_LINEAR)


def counts(rgb):
    return 9000.0 + rgb @ WEIGHT


def write(folder, scale=SCALE, parts=PARTS, extra=False, change=lambda values, number: values, truth=None, **card):
    """A data set with thermal values linear in colour; `extra` adds a flat relief, hour and weather."""
    card = {"name": "linear", "origin": "made", "licence": "CC0", **({"terrain": ["slope"]} if extra else {}), **card}
    pairs = []
    for number, part in enumerate(parts):
        rgb = colours(number)
        valid = np.ones(SHAPE, bool)
        valid[:2] = False
        values = change(np.rint(counts(rgb)), number).astype(np.uint8 if scale.unit == "intensity" else np.uint16)
        planes = {"slope": np.zeros(SHAPE, np.float32), **(truth(number) if truth else {})} if extra or truth else None
        known = {"air_k": 280.0 + number, "solar_hour": 6.0 + number} if extra else {}
        entry = Entry(f"s{number}-0", part, f"s{number}-0", f"s{number}", 0, SHAPE, 0.2, None, None, 240.0, known)
        pairs.append((entry, packed(rgb, values, valid, planes)))
    Writer(folder, card, scale).shard("all", pairs)
    return read_dataset(folder)


def land(rng, shape):
    """Patches on variation at all scales, like an orthophoto, (h, w) float32 within 0…1."""
    import cv2

    height, width = shape
    image = np.zeros(shape, np.float32)
    for cells in (4, 8, 16, 32, 64):
        noise = rng.standard_normal((cells, cells)).astype(np.float32)
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC) / np.sqrt(cells)
    for _ in range(50):
        middle, size = rng.uniform(0, width, 2).tolist(), rng.uniform(15, 50, 2).tolist()
        corners = cv2.boxPoints((middle, size, rng.uniform(0, 180)))
        cv2.fillPoly(image, [corners.astype(np.int32)], float(rng.standard_normal()))
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    return (image - image.min()) / np.ptp(image)


def pair(seed, rig=TRUE, moved=(0.0, 0.0)):
    """(visible, thermal) of a land: warm places are bright in some parts and dark in others."""
    import cv2

    rng = np.random.default_rng(seed)
    ground = land(rng, rig.visible_shape)
    visible = np.stack([ground, ground**1.5, 0.5 * ground + 0.2], axis=-1)
    warmth = np.sin(6.0 * ground) + 0.25 * land(rng, rig.visible_shape)
    height, width = rig.thermal_shape
    total = np.zeros((height, width))
    # A detector's pixel averages over its area.
    for right in (1 / 6, 3 / 6, 5 / 6):
        for down in (1 / 6, 3 / 6, 5 / 6):
            column, row = np.meshgrid(np.arange(width) + right, np.arange(height) + down)
            x, y = position(rig, column + moved[0], row + moved[1])
            total += cv2.remap(warmth, np.float32(x - 0.5), np.float32(y - 0.5), cv2.INTER_LINEAR) / 9.0
    thermal = cv2.GaussianBlur(total, (0, 0), 0.7) + 0.04 * rng.standard_normal(total.shape)
    return np.uint8(255 * visible), np.float32(290.0 + 5.0 * thermal)


def position(rig, column, row):
    """The module's model written out independently, with complex numbers."""
    point = (column - rig.thermal_shape[1] / 2) + 1j * (row - rig.thermal_shape[0] / 2)
    point = rig.scale * np.exp(1j * np.radians(rig.rotation_deg)) * point + complex(*rig.shift_px)
    half = abs(complex(*rig.visible_shape)) / 2
    point = point * (1 + rig.k1 * abs(point / half) ** 2)
    return point.real + rig.visible_shape[1] / 2, point.imag * rig.aspect + rig.visible_shape[0] / 2
