"""Stability cases hold, can fail, and are told on one page."""

import importlib
import json

import numpy as np
import pytest

from thermorender import units
from thermorender.atmosphere import model, rays
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.physics import balance, exchange, planck
from thermorender.physics.geodesy import LocalFrame
from thermorender.render import truth
from thermorender.render.geometry import Geometry
from thermorender.render.light import radiosity
from thermorender.render.mirrors import DeviceTables
from thermorender.scene import terrain
from thermorender.scene.parts import mesh
from thermorender.sensor import detector, exposure, readout
from thermorender.validate import stability
from thermorender.validate.stability import cases, heat, light, sensor
from thermorender.validate.stability.cases import Found


def test_all_but_heat_hold_and_are_written(tmp_path, call):
    groups = ("light", "sensor", "air", "maps", "pixels", "precision", "geometry", "motion", "solver")
    status, output, _ = call("validate", "stability", *groups, "-o", tmp_path)
    assert status == 0 and "0 of " in output and "FAILS" not in output
    result = json.loads((tmp_path / "stability.json").read_text("utf-8"))
    assert result["failed"] == 0 and {case["group"] for case in result["cases"]} == set(groups)
    page = (tmp_path / "stability.md").read_text("utf-8")
    assert page.count("holds |") == len(result["cases"]) and "## sensor" in page


@pytest.fixture
def anew():
    """Days that are kept for several cases are marched again, now and afterwards."""
    kept = (heat.everything, heat.fine, heat.stepped, heat.answer_error)
    for each in kept:
        each.cache_clear()
    yield
    for each in kept:
        each.cache_clear()


def own_cases(*words, group="heat"):
    """The cases of a group whose name holds one of some words, as {name: what `judged` tells}."""
    return {
        name: stability.judged(job)
        for own, name, job in cases.CASES
        if own == group and any(word in name for word in words)
    }


def test_heat_holds(anew):
    found = own_cases("")
    assert len(found) > 40 and [name for name, each in found.items() if not each["passed"]] == []


def backward_euler(patch):
    """Both stages as one implicit step each, of first order."""
    patch.setattr(balance, "_GAMMA", 1.0)


def unstable(patch):
    """A diagonal below a quarter, with which the two stages amplify what is stiff."""
    patch.setattr(balance, "_GAMMA", 0.2)


def shackled(patch):
    """Newton in strides so short that the root is out of reach."""
    patch.setattr(balance, "_LARGEST_STEP_K", 0.1)


def lost_ice(patch):
    """Ice that melts for a tenth of its heat."""
    melted = balance._melted

    def cheap(xp, layers, liquid, ground):
        warm, wet, total = melted(xp, layers, liquid, ground)
        return warm, [0.9 * each for each in wet], total

    patch.setattr(balance, "_melted", cheap)


def no_floor(patch):
    """Air that takes nothing when it is calm."""
    patch.setattr(exchange, "_CALMEST_M_S", 0.0)


@pytest.mark.parametrize(
    ("broken", "case"),
    [
        (backward_euler, "steps of 15 min, wind"), (unstable, "one hour after"), (shackled, "in balance"),
        (lost_ice, "energy of a day"), (no_floor, "calm, dry ground"),
    ],
)  # fmt: skip
def test_broken_heat_is_seen(monkeypatch, anew, broken, case):
    broken(monkeypatch)
    with np.errstate(all="ignore"):
        found = own_cases(case)
    assert found and not all(each["passed"] for each in found.values())


def seen_through_clouds(patch):
    """What lies above their base is answered as clear air."""
    patch.setattr(Atmosphere, "refuse_above_clouds", lambda *_: None)


def dark_air(patch):
    """Air between mirrors takes light and gives none."""
    patch.setattr(DeviceTables, "through_air", lambda self, light, *_: [0.99 * each for each in light])


def thin_air(patch):
    """A thousandth of the absorbers is lost."""
    amounts = model.amounts
    patch.setattr(model, "amounts", lambda *arguments: 0.999 * amounts(*arguments))


def parallel_rays(patch):
    """An observer's horizon lies on the level, whatever his height."""
    patch.setattr(rays, "horizon_cos_zenith", lambda at: np.zeros(np.shape(at)))


@pytest.mark.parametrize(
    ("broken", "case"),
    [(seen_through_clouds, "a cloud is refused"), (dark_air, "depth 0.1 per metre"), (thin_air, "optical depth 1"),
     (thin_air, "straight down from"), (parallel_rays, "from the horizon to")],
)  # fmt: skip
def test_broken_air_is_seen(monkeypatch, broken, case):
    broken(monkeypatch)
    found = own_cases(case, group="air")
    assert found and not all(each["passed"] for each in found.values())


def touching(patch):
    """Rays that begin in a face's plane are taken to end there."""
    patch.setattr(Geometry, "seen", lambda self, ray: self.cast(ray, coherent=True))


def fronts(patch):
    """Backs are shown as if they were fronts."""
    patch.setattr(truth, "BEHIND", 0)


def clipped(patch):
    """A texture's edge goes on and on."""
    patch.setattr(mesh, "_repeated", lambda uv, colour, path: (np.clip(uv, 0.0, 1.0), colour))


def flat_earth(patch):
    """Up is the height above the ellipsoid, wherever."""
    local = LocalFrame.enu_from_geodetic

    def level(self, latitude_deg, longitude_deg, height_m):
        found = local(self, latitude_deg, longitude_deg, height_m)
        found[..., 2] = np.asarray(height_m) - self.height_m
        return found

    patch.setattr(LocalFrame, "enu_from_geodetic", level)


def stepped_fill(patch):
    """Islands get the height of the nearest post."""
    from scipy import interpolate

    patch.setattr(interpolate, "LinearNDInterpolator", interpolate.NearestNDInterpolator)


def untold_fill(patch):
    """What was filled is not flagged."""
    filled = terrain.filled
    patch.setattr(terrain, "filled", lambda height: (filled(height)[0], np.zeros(height.shape, bool)))


def anywhere(patch):
    """Vertices may lie as far away as a map's coordinates are large."""
    patch.setattr(mesh, "FARTHEST_M", 2e7)


@pytest.mark.parametrize(
    ("broken", "case"),
    [(touching, "on the ground, looking down"), (touching, "in their plane"), (fronts, "normals that look down"),
     (fronts, "camera in a box"), (clipped, "map coordinates"), (flat_earth, "land of 100 km"),
     (stepped_fill, "on a slope, filled"), (untold_fill, "on a slope, filled"), (anywhere, "a mesh at easting")],
)  # fmt: skip
def test_broken_geometry_is_seen(monkeypatch, broken, case):
    broken(monkeypatch)
    with np.errstate(all="ignore"):
        found = own_cases(case, group="geometry")
    assert found and not all(each["passed"] for each in found.values())


def silent_zero(patch):
    """What is far in Wien's limit shines not at all."""
    patch.setattr(planck, "_COLDEST", 1e-2)


def short_of_wien(patch):
    """Faint radiances are inverted without the lower powers of x."""
    patch.setattr(planck, "_WIEN", np.polynomial.Polynomial([0.0, 0.0, 0.0, 1.0]))


def no_end(patch):
    """Light that never leaves is solved for all the same."""
    patch.setattr(radiosity, "_MOST_REFLECTED", 2.0)


def heaped(patch):
    """A mix is as the first of its parts."""
    patch.setattr(light, "mix", lambda parts: parts[0][0])


@pytest.mark.parametrize(
    ("broken", "case"),
    [(silent_zero, "Planck's law and back, 2 K, 7.5"), (short_of_wien, "radiance of 1e-320"),
     (no_end, "emissivity 0 is refused"), (heaped, "a quarter a mirror's")],
)  # fmt: skip
def test_broken_light_is_seen(monkeypatch, broken, case):
    broken(monkeypatch)
    with np.errstate(all="ignore"):
        found = own_cases(case, group="light")
    assert found and not all(each["passed"] for each in found.values())


def bare_residual(patch):
    """The bound forgets that light goes to and fro."""
    solve = radiosity.solve

    def stated(transport, emitted, reflectance, environment, tolerance):
        found, bound = solve(transport, emitted, reflectance, environment, tolerance)
        return found, bound * (1.0 - reflectance.max())

    patch.setattr(radiosity, "solve", stated)


def hasty(patch):
    """One step of GMRES, and whatever that leaves is claimed as solved."""
    patch.setattr(radiosity, "gmres", lambda operator, rho, source, wanted: source)
    solve = radiosity.solve
    patch.setattr(radiosity, "solve", lambda *given: (solve(*given[:4], 1e9)[0], np.array([given[4]])))


@pytest.mark.parametrize(
    ("broken", "case"),
    [(bare_residual, "its error by its bound"), (hasty, "its error by its bound"), (hasty, "picokelvin"),
     (no_end, "a system of emissivity 0")],
)  # fmt: skip
def test_a_broken_solver_is_seen(monkeypatch, broken, case):
    broken(monkeypatch)
    with np.errstate(all="ignore"):
        found = own_cases(case, group="solver")
    assert found and not all(each["passed"] for each in found.values())


def forgetful(patch):
    """Pixels start at rest an eighth of their memory ago."""
    patch.setattr(exposure, "MEMORY", 1.0)


def linear_lag(patch):
    """The response as one explicit step, as of the sensor."""
    forward_euler(patch)
    patch.setattr(exposure, "response_weights", detector.response_weights)


@pytest.mark.parametrize(
    ("broken", "case"),
    [(forgetful, "turns once a second, a pixel of 10 ms"), (forgetful, "crosses"), (linear_lag, "blinks")],
)  # fmt: skip
def test_broken_motion_is_seen(monkeypatch, broken, case):
    broken(monkeypatch)
    with np.errstate(all="ignore"):
        found = own_cases(case, group="motion")
    assert found and not all(each["passed"] for each in found.values())


def any_kelvin(patch):
    """No temperature is too cold."""
    patch.setattr(units, "LOWEST_KELVIN", -1e9)


@pytest.mark.parametrize("case", ["typed as temperature.value", "typed as sky", "typed as object", "a raster of -273"])
def test_celsius_taken_for_kelvin_is_seen(monkeypatch, case):
    any_kelvin(monkeypatch)
    found = own_cases(case, group="pixels")
    assert found and not any(each["passed"] for each in found.values())


def wrapped(patch):
    """Counts beyond the range that begin anew."""

    def digitised(signal, camera):
        low, step = readout._scale(camera)
        return np.rint((signal.astype(float) - low) / step).astype(np.int64).astype(np.uint16) & (2**camera.bits - 1)

    patch.setattr(readout, "digitised", digitised)


def forward_euler(patch):
    """The response as one explicit step."""

    def weights(span_s, time_constant_s):
        x = np.asarray(span_s, np.float64) / max(time_constant_s, 1e-12)
        return 1.0 - x, x, 0.0 * x

    patch.setattr(detector, "response_weights", weights)
    patch.setattr(sensor, "response_weights", weights)


def unflagged(patch):
    """Saturation that is seen at the cold end alone."""
    patch.setattr(sensor, "saturated", lambda counts, camera: counts == 0)


@pytest.mark.parametrize(
    ("broken", "case"),
    [(wrapped, "never fall"), (wrapped, "end of the range"), (unflagged, "flagged"), (forward_euler, "step of 10 K"),
     (forward_euler, "heat of a step")],
)  # fmt: skip
def test_a_broken_sensor_is_seen(monkeypatch, broken, case):
    jobs = [job for group, name, job in cases.CASES if group == "sensor" and case in name]
    assert jobs and all(stability.judged(job)["passed"] for job in jobs)
    broken(monkeypatch)
    with np.errstate(all="ignore"):
        assert not all(stability.judged(job)["passed"] for job in jobs)


def raises():
    raise ZeroDivisionError("by nothing")


@pytest.mark.parametrize(
    ("job", "passed"),
    [(lambda: Found(300.0005, 300.0, 1e-3), True), (lambda: Found(300.002, 300.0, 1e-3), False),
     (lambda: Found(np.nan, 300.0, 1e-3), False), (lambda: Found(300.0, 300.0, np.inf), False), (raises, False)],
)  # fmt: skip
def test_verdicts(job, passed, tmp_path, monkeypatch, call):
    monkeypatch.setattr(cases, "CASES", [("light", "made up", job)])
    monkeypatch.setattr(stability, "CASES", cases.CASES)
    status, output, _ = call("validate", "stability", "-o", tmp_path)
    assert status == (0 if passed else 1) and ("FAILS" in output) != passed
    json.loads((tmp_path / "stability.json").read_text("utf-8"))
    if job is raises:
        assert "ZeroDivisionError: by nothing" in output


@pytest.mark.parametrize(
    ("place", "name", "words"),
    [("render.geometry", "Channels", "places on the map"), ("render.light.texels", "light", "light between"),
     ("sensor.detector", "advanced", "of 16.7 ms")],
)  # fmt: skip
def test_half_precision_is_told_by_the_cases_of_precision(place, name, words, monkeypatch):
    module = importlib.import_module(f"thermorender.{place}")
    whole = getattr(module, name)

    def halved(*given):
        real = [isinstance(each, np.ndarray) and each.dtype.kind == "f" for each in given]
        parts = zip(given, real, strict=True)
        halves = [each.astype(np.float16).astype(each.dtype) if half else each for each, half in parts]
        return whole(*halves)

    assert all(found["passed"] for found in own_cases(words, group="precision").values())
    monkeypatch.setattr(module, name, halved)
    assert not any(found["passed"] for found in own_cases(words, group="precision").values())


def test_an_unknown_group_is_named():
    with pytest.raises(ThermorenderError, match="group 'heats' is unknown; give some of air, faults, geometry, heat"):
        stability.run(["heats"])
