"""Arrays: air, absorption data, learned maps, checkpoints."""

from functools import partial
from importlib import resources

import numpy as np

from tests.robustness.fuzz.corpus.registry import reader

_PACKAGE = resources.files("thermorender")


def _write_air(path):
    from thermorender.atmosphere.model import Atmosphere

    Atmosphere.standard("us-1976").in_band(9.0, 10.0).save(path)


@reader("atmosphere", "air.npz", _write_air)
def _air(path):
    from thermorender.atmosphere.model import Atmosphere

    air = Atmosphere.load(path)
    return air.transmittance(0.0, 50.0, 100.0), air.path_radiance(0.0, 50.0, 100.0)


def _of_map(path):
    from thermorender.learned.temperature_map import load_map

    return load_map(path)


for _name in ("correlation+", "palette", "trees"):
    reader(f"map {_name}", "map.npz", _PACKAGE / "learned" / "maps" / f"procedural-{_name}.npz")(_of_map)


@reader("emissivity map", "map.npz", _PACKAGE / "learned" / "emissivity" / "procedural.npz")
def _emissivity_map(path):
    from thermorender.learned.emissivity.mapping import load_map

    return load_map(path)


def _write_absorption(path):
    generator = np.random.default_rng(0)
    np.savez(
        path.with_name("absorption.npz"), gas=np.array(["water", "dioxide"]), weight=np.full((2, 4), 0.25),
        lower_um=np.array([9.0, 9.5]), upper_um=np.array([9.5, 10.0]), pressure_hpa=np.array([100.0, 500.0, 1100.0]),
        temperature=np.array([200.0, 320.0]), cross_section_cm2=10.0 ** generator.uniform(-25, -21, (2, 2, 4, 3, 2)),
    )  # fmt: skip
    path.with_name("gases.csv").write_text("altitude_m,pressure_hpa,temperature_k,water_ppm,dioxide_ppm\n" + "".join(
        f"{500 * k},{1013.25 * (1 - 0.0065 * 500 * k / 288.15) ** 5.2559:.2f},{288.15 - 3.25 * k:.2f},"
        f"{9000 - 600 * k},410\n" for k in range(12)
    ))  # fmt: skip


def _of_absorption(path):
    from thermorender.atmosphere.absorption import from_absorption

    air = from_absorption(path.with_name("absorption.npz"), path.with_name("gases.csv"))
    return air, air.transmittance(0.0, 50.0, 100.0), air.path_radiance(0.0, 50.0, 100.0)


reader("absorption data", "absorption.npz", _write_absorption)(_of_absorption)
reader("gas profile", "gases.csv", _write_absorption)(_of_absorption)


def _write_network(method, path):
    from tests.robustness.maps import trained
    from thermorender.learned.temperature_map import save_map

    save_map(trained(method), path)


for _name in ("compact", "unet-gan-keras"):
    reader(f"map {_name}", "map.npz", partial(_write_network, _name))(_of_map)


def _write_checkpoint(path):
    from tests.robustness.crash_targets import write_checkpoint

    write_checkpoint(path)


@reader("checkpoint", "last.safetensors", _write_checkpoint)
def _checkpoint(path):
    from tests.robustness.crash_targets import nets
    from thermorender.apps.training.networks import checkpoint

    return checkpoint.load(path, nets()), [
        value.numpy() for net in nets().values() for value in net.state_dict().values()
    ]  # fmt: skip
