"""What a user installs: the wheel with its data, the doctor, make-scene and the demo."""

import filecmp
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

import thermorender as tr
from scenes import write_terrain
from thermorender import defaults
from thermorender.apps.compare import verbs
from thermorender.cli import app as cli
from thermorender.cli import doctor
from thermorender.cli import render as flights
from thermorender.errors import ThermorenderError
from thermorender.render import variant
from thermorender.sensor.camera import model_path

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Folder with the unpacked wheel, as pip would put it into site-packages."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-deps", "--no-build-isolation"]
    built = subprocess.run([*command, "-w", folder, ROOT], capture_output=True, text=True, cwd=folder)
    assert built.returncode == 0, built.stdout + built.stderr
    (file,) = folder.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def run(site, *arguments):
    """Standard output of a fresh Python process outside the checkout, with the wheel first on its path."""
    command, environment = [sys.executable, *arguments], dict(os.environ) | {"PYTHONPATH": str(site)}
    done = subprocess.run(command, env=environment, cwd=site.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def shipping():
    """{path in the wheel: file of the checkout} of everything that must be in the wheel."""
    shipped = {Path("thermorender", "_data", kind): ROOT / kind for kind in ("scenes", "materials")}
    shipped[Path("thermorender")] = ROOT / "thermorender"
    return {
        (into / path.relative_to(source)): path
        for into, source in shipped.items()
        for path in source.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_build_configuration_lists_everything_that_ships():
    """As the builder would take them, without building: the slow tests build the wheel."""
    from hatchling.builders.wheel import WheelBuilder

    files = WheelBuilder(str(ROOT)).recurse_included_files()
    assert {Path(file.distribution_path): Path(file.path) for file in files} == shipping()


@pytest.mark.slow
def test_wheel_holds_everything_that_ships_and_nothing_else(wheel):
    wanted = shipping()
    there = {path.relative_to(wheel) for path in wheel.rglob("*") if path.is_file()}
    (about,) = wheel.glob("*.dist-info")
    assert {path for path in there if about.name not in path.parts} == set(wanted)
    for into, source in wanted.items():
        assert filecmp.cmp(wheel / into, source, shallow=False), into
    assert "thermorender = thermorender.cli.app:main" in (about / "entry_points.txt").read_text()
    assert (about / "licenses" / "LICENSE").is_file()


@pytest.mark.slow
def test_wheel_works_away_from_its_checkout(wheel):
    code = "import thermorender as tr, sys; s = tr.load_scene('heath/survey'); print(tr.__file__); print(s.spec.folder)"
    places = run(wheel, "-c", code).splitlines()
    assert all(Path(place).is_relative_to(wheel) for place in places), places
    assert "sand_quartz" in run(wheel, "-m", "thermorender", "materials", "list")
    assert "spectral nodes" in run(wheel, "-m", "thermorender", "plan", "heath/survey", "--air", "tropical")


# --- doctor -----------------------------------------------------------------------------------------------


def test_doctor_finds_this_machine_usable():
    done = CliRunner().invoke(cli.app, ["doctor"])
    assert done.exit_code == 0, done.output
    rows, healthy = doctor.examine()
    state = {name: text for name, text, _ in rows}
    assert healthy and state["scalar_rgb"] == "works" and "works" in (state["llvm_ad_mono"], state["cuda_ad_mono"])
    assert state["mitsuba"] == __import__("mitsuba").__version__ and "cores usable" in state["machine"]
    assert all(name in done.output for name in state)


def test_doctor_names_missing_packages_of_extras(monkeypatch):
    monkeypatch.setattr(doctor, "version_of", lambda name: "not installed" if name == "torch" else "1.0")
    rows, healthy = doctor.examine()
    fix = {name: fix for name, _, fix in rows}
    assert healthy and "thermorender[networks]" in fix["torch"] and not fix["lightgbm"]


def test_doctor_names_failures_and_their_fixes(monkeypatch, tmp_path):
    monkeypatch.setattr(variant, "works", lambda name: (False, "the process was killed by signal 6"))
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'Test GPU, 1.2'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    rows, healthy = doctor.examine()
    assert not healthy
    found = {name: (state, fix) for name, state, fix in rows}
    assert found["GPU"][0] == "Test GPU, 1.2"
    for name, fix in (("scalar_rgb", "reinstall Mitsuba"), ("llvm_ad_mono", "version 16"), ("cuda_ad_mono", "driver")):
        assert found[name][0] == "fails: the process was killed by signal 6" and fix in found[name][1]
    with pytest.raises(ThermorenderError, match="no back end renders on this machine; fix the rows above"):
        CliRunner().invoke(cli.app, ["doctor"], catch_exceptions=False)


def test_doctor_on_a_machine_without_llvm(monkeypatch, tmp_path):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(variant, "llvm_libraries", dict)
    assert variant.works("llvm_ad_mono") == (False, "no LLVM library of version 16 or newer")
    rows = {name: (state, fix) for name, state, fix in doctor.examine()[0]}
    assert rows["LLVM library"][0] == "none found" and "thermorender doctor --install" in rows["LLVM in use"][1]
    # First apt runs and fails, as without a network; then there is no apt.
    (tmp_path / "apt-get").write_text(f"#!/bin/sh\necho $@ >> {tmp_path}/asked\nexit 100\n")
    (tmp_path / "apt-get").chmod(0o755)
    monkeypatch.setattr(variant.os, "geteuid", lambda: 0, raising=False)
    monkeypatch.setattr(variant.shutil, "which", lambda name: str(tmp_path / name))
    with pytest.raises(ThermorenderError, match="apt-get could not install an LLVM runtime; install one with"):
        variant.install_libraries()
    asked = (tmp_path / "asked").read_text().splitlines()
    assert asked[0] == "update -q" and "libllvm19" in asked[1] and len(asked) == 11
    monkeypatch.setattr(variant.shutil, "which", lambda name: None)
    with pytest.raises(ThermorenderError, match="this machine has no LLVM library of version 16 or newer"):
        variant.install_libraries()


def test_a_machine_without_libatomic_is_named(monkeypatch):
    monkeypatch.setattr(variant, "_ATOMIC", "libno_such_atomic.so.1")
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    with pytest.raises(ThermorenderError, match=r"no libno_such_atomic\.so\.1, which Dr\.Jit needs; install it with"):
        variant.activate()
    rows = {name: fix for name, _, fix in doctor.examine()[0]}
    assert "apt-get install libatomic1" in rows["libatomic"]


def test_doctor_installs_libatomic(monkeypatch, tmp_path):
    (tmp_path / "apt-get").write_text(f'#!/bin/sh\ncase "$*" in *install*libatomic1) touch {tmp_path}/there;; esac\n')
    (tmp_path / "apt-get").chmod(0o755)
    monkeypatch.setattr(variant, "lacks_atomic", lambda: not (tmp_path / "there").exists())
    monkeypatch.setattr(variant.shutil, "which", lambda name: str(tmp_path / name))
    monkeypatch.setattr(variant.os, "geteuid", lambda: 0, raising=False)
    assert variant.install_libraries().startswith("installed libatomic1; LLVM")


def test_install_keeps_an_existing_llvm():
    assert variant.usable_llvm()[0].exists()
    done = CliRunner().invoke(cli.app, ["doctor", "--install"])
    assert done.exit_code == 0 and "is present" in done.output


def test_variant_that_cannot_start_reports_its_last_line():
    good, reason = variant.works("no_such_variant")
    assert not good and "no_such_variant" in reason


# --- make-scene and demo ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_make_scene_writes_a_scene_that_loads(tmp_path):
    def make(name, *more):
        arguments = ["make-scene", "village", "--draped", "-o", str(tmp_path / name)]
        return CliRunner().invoke(cli.app, [*arguments, "--size-m", "60", "--texel-m", "0.5", "--post-m", "1", *more])

    done = make("one", "--seed", "3")
    assert done.exit_code == 0 and done.output.strip().endswith(str(tmp_path / "one"))
    scene = tr.load_scene(tmp_path / "one")
    assert scene.surfaces[0].material.shape == (120, 120) and len(scene.spec.objects) > 0
    assert make("again", "--seed", "3").exit_code == make("other", "--seed", "4").exit_code == 0
    same = filecmp.cmpfiles(tmp_path / "one", tmp_path / "again", ["temperature.tif", "scene.toml"], shallow=False)
    assert same[0] == ["temperature.tif", "scene.toml"]
    assert not filecmp.cmp(tmp_path / "one" / "temperature.tif", tmp_path / "other" / "temperature.tif", shallow=False)


def test_make_scene_refuses_unknown_kinds(tmp_path):
    done = CliRunner().invoke(cli.app, ["make-scene", "moon", "-o", str(tmp_path / "m")])
    assert isinstance(done.exception, ThermorenderError) and "'moon'" in str(done.exception)
    assert "heath, village, ridge" in str(done.exception) and not (tmp_path / "m").exists()


def test_demo_on_a_tiny_scene(tmp_path, monkeypatch):
    small = re.sub("(?m)^(width|height) = .*", r"\1 = 48", model_path("zenmuse-xt2").read_text(encoding="utf-8"))
    folder = write_terrain(tmp_path / "tiny", extra='[camera]\nmodel = "small.toml"')
    (folder / "small.toml").write_text(small, encoding="utf-8")
    (folder / "flight.csv").write_text(
        "time_s,east_m,north_m,above_ground_m,gimbal_pitch_deg\n0,0,0,20,-90\n0.5,1,0,20,-90\n"
    )
    monkeypatch.setattr(defaults, "SCENE", str(folder))
    done = CliRunner().invoke(cli.app, ["demo", "-o", str(tmp_path / "demo")], catch_exceptions=False)
    assert done.exit_code == 0 and "report.html" in done.output, done.output
    assert (tmp_path / "demo" / "flight" / "flight.mp4").stat().st_size > 1000
    found = json.loads((tmp_path / "demo" / "comparison" / "comparison.json").read_text())
    assert {own["kind"] for own in found["methods"].values()} == {"photograph", "true-materials", "frame-mean"}
    with pytest.raises(ThermorenderError, match="already holds a demo; give another folder with -o, or remove it"):
        CliRunner().invoke(cli.app, ["demo", "-o", str(tmp_path / "demo")], catch_exceptions=False)


@pytest.mark.slow
def test_demo_flies_and_compares(tmp_path, monkeypatch):
    """The real demo, except that the flight is cut to its first frames and pixels have few samples."""
    fly, compare = flights.fly, verbs.compare
    little = {"quality": "fast", "rays": 2}
    monkeypatch.setattr(flights, "fly", lambda *a, **k: fly(*a, **k, **little, stop_s=0.3))
    monkeypatch.setattr(verbs, "compare", lambda *a, **k: compare(*a, **(k | {"rate_hz": 0.05}), **little))
    done = CliRunner().invoke(cli.app, ["demo", "-o", str(tmp_path / "demo")], catch_exceptions=False)
    assert done.exit_code == 0 and "flight.mp4" in done.output, done.output
    flight = json.loads((tmp_path / "demo" / "flight" / "flight.json").read_text())
    assert flight["frames"] == 2
    assert (tmp_path / "demo" / "flight" / "flight.mp4").stat().st_size > 1000
    assert (tmp_path / "demo" / "comparison" / "comparison.json").is_file()
    with pytest.raises(ThermorenderError, match="already holds a demo; give another folder with -o, or remove it"):
        CliRunner().invoke(cli.app, ["demo", "-o", str(tmp_path / "demo")], catch_exceptions=False)
