"""Stability cases hold, can fail, and are told on one page."""

import json

import numpy as np
import pytest

from thermorender.atmosphere import model, rays
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.physics import balance, exchange
from thermorender.render.mirrors import DeviceTables
from thermorender.sensor import detector, readout
from thermorender.validate import stability
from thermorender.validate.stability import cases, heat, sensor
from thermorender.validate.stability.cases import Found


def test_all_but_heat_hold_and_are_written(tmp_path, call):
    groups = ("light", "sensor", "air", "maps", "pixels")
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


def test_an_unknown_group_is_named():
    with pytest.raises(ThermorenderError, match="group 'heats' is unknown; give some of air, faults, heat, light"):
        stability.run(["heats"])
