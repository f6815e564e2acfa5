"""`thermorender doctor --self-test`: its closed forms hold, and a wrong value fails."""

import numpy as np
import pytest
from typer.testing import CliRunner

from thermorender.cli import app as cli
from thermorender.cli import doctor
from thermorender.render import self_test


def without_rendering(monkeypatch):
    monkeypatch.setattr(self_test, "_rendered", lambda device: iter(()))
    monkeypatch.setattr(doctor, "examine", lambda: ([("scalar_rgb", "works", "")], True))


@pytest.mark.slow
def test_the_installed_package_agrees_with_its_closed_forms():
    steps = []
    checks = self_test.run(lambda what, share: steps.append(what))
    assert [check.name for check in checks if not check.passed] == []
    kinds = {check.name.split(",")[0] for check in checks}
    assert {"Planck's law", "its inverse", "isothermal enclosure", "plate under a uniform sky"} <= kinds
    assert {"mean of a spherical cavity", "counts to radiance to counts"} <= kinds
    assert steps == ["Planck's law", "counts", "rendered scenes"]


def test_the_verb_prints_rows_in_kelvin_and_exits_with_0(monkeypatch):
    without_rendering(monkeypatch)
    done = CliRunner().invoke(cli.app, ["doctor", "--self-test"])
    assert done.exit_code == 0, done.output
    assert "expected [K]  found [K]" in done.output and "17 of 17 checks passed" in done.output
    assert "FAILED" not in done.output


@pytest.mark.parametrize(
    ("name", "failed"), [("band_radiance", "Planck's law"), ("brightness_temperature", "its inverse")]
)
def test_a_relative_error_of_a_millionth_fails_with_status_1(name, failed, monkeypatch):
    without_rendering(monkeypatch)
    right = getattr(self_test, name)
    monkeypatch.setattr(self_test, name, lambda value, *band: right(value, *band) * (1.0 + 1e-6))
    done = CliRunner().invoke(cli.app, ["doctor", "--self-test"])
    assert done.exit_code == 1
    rows = [line for line in done.output.splitlines() if line.endswith("FAILED")]
    assert rows and all(row.startswith(failed) for row in rows)
    assert f"{17 - len(rows)} of 17 checks passed" in done.output


def test_a_read_out_one_count_off_fails(monkeypatch):
    without_rendering(monkeypatch)
    right = self_test.digitised
    monkeypatch.setattr(self_test, "digitised", lambda signal, camera: np.maximum(right(signal, camera), 1))
    failed = {check.name.split(",")[0] for check in self_test.run() if not check.passed}
    assert failed == {"counts to radiance to counts"}


def test_a_missing_value_fails(monkeypatch):
    without_rendering(monkeypatch)
    right = self_test.brightness_temperature

    def holed(radiance, *band):
        found = np.array(right(radiance, *band))
        found.flat[0] = np.nan
        return found

    monkeypatch.setattr(self_test, "brightness_temperature", holed)
    passed = {check.name.split(",")[0] for check in self_test.run() if check.passed}
    assert passed == {"Planck's law"}
