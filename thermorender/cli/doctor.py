"""The verb `doctor`: versions, back ends that render, threads, GPU, how to fix what fails, and the self-test."""

import os
import platform
import shutil
import subprocess
from typing import Annotated

import typer

from thermorender.cli.terminal import progress, table
from thermorender.errors import ThermorenderError
from thermorender.versions import version_of, versions

# Packages of extras, with the extra and what needs it.
OPTIONAL = (
    ("lightgbm", "maps", "training of maps of trees"),
    ("torch", "networks", "learned maps that are networks"),
    ("pyulog", "logs", "PX4 logs in ULog"),
    ("pymavlink", "logs", "ArduPilot logs"),
    ("laspy", "clouds", "point clouds"),
    ("pillow-jpls", "thermal-files", "CSQ files of FLIR"),
    ("infiray-irg", "thermal-files", "IRG files of InfiRay"),
)
VARIANTS = ("scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_mono")


def doctor(
    install: Annotated[
        bool, typer.Option("--install", help="Install missing system libraries with apt: LLVM, libatomic.")
    ] = False,
    self_test: Annotated[
        bool, typer.Option("--self-test", help="Compare the installed package with closed forms, in kelvin.")
    ] = False,
) -> None:
    """Print what works on this machine and how to fix what does not."""
    from thermorender.render.variant import install_libraries

    if install:
        typer.echo(install_libraries())
    rows, healthy = examine()
    table(("", "", "how to fix it"), rows)
    if not healthy:
        raise ThermorenderError("no back end renders on this machine; fix the rows above")
    if self_test:
        _self_test()


def _self_test() -> None:
    from thermorender.render.self_test import HEADER, run

    with progress() as report:
        checks = run(report)
    typer.echo("")
    table(HEADER, [check.row for check in checks])
    failed = sum(not check.passed for check in checks)
    typer.echo(f"{len(checks) - failed} of {len(checks)} checks passed")
    if failed:
        raise typer.Exit(1)


def examine() -> tuple[list[tuple[str, str, str]], bool]:
    """Return (rows, healthy): rows of (what, state, how to fix it) and whether frames can be rendered here.

    Each variant renders one ray in a separate process, because a wrong LLVM library aborts the process.
    """
    from thermorender.render.variant import OLDEST_LLVM, lacks_atomic, llvm_libraries, usable_llvm, works

    rows = [(name, version, "") for name, version in versions().items()]
    for name, extra, user in OPTIONAL:
        lacking = version_of(name) == "not installed"
        fix = f"{user} need it: `pip install 'thermorender[{extra}]'`" if lacking else ""
        rows.append((name, version_of(name), fix))
    rows.append(("machine", f"{platform.system()} {platform.machine()}, {len(_cores())} cores usable", ""))
    found = [f"{version or 'unknown'}: {path}" for path, version in sorted(llvm_libraries().items(), key=str)]
    chosen = usable_llvm()
    rows += [("LLVM library", library, "") for library in found or ["none found"]]
    remedies = "`thermorender doctor --install` or `apt-get install libllvm19`"
    fix = "" if chosen else f"needs version {OLDEST_LLVM} or newer: {remedies}"
    rows.append(("LLVM in use", str(chosen[0]) if chosen else "none", fix))
    if lacks_atomic():
        rows.append(
            (
                "libatomic",
                "not found",
                "Dr.Jit needs it: `thermorender doctor --install` or `apt-get install libatomic1`",
            )
        )
    gpu = _gpu()
    rows.append(("GPU", gpu or "none", ""))
    able = []
    for variant in VARIANTS:
        if variant.startswith("cuda") and not gpu:
            rows.append((variant, "not tried: no GPU", ""))
            continue
        good, reason = works(variant)
        able += [variant] if good else []
        rows.append((variant, "works" if good else f"fails: {reason}", "" if good else _advice(variant)))
    return rows, any(variant in able for variant in ("llvm_ad_mono", "cuda_ad_mono"))


def _advice(variant: str) -> str:
    if variant.startswith("llvm"):
        return "install an LLVM runtime of version 16 or newer: `thermorender doctor --install`"
    if variant.startswith("cuda"):
        return "update the NVIDIA driver, or render with --device cpu"
    return "reinstall Mitsuba: `pip install --force-reinstall mitsuba`"


def _cores() -> list[int]:
    return list(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))


def _gpu() -> str:
    """Name and driver of the first NVIDIA GPU, or an empty string."""
    tool = shutil.which("nvidia-smi")
    if not tool:
        return ""
    run = subprocess.run(
        [tool, "--query-gpu=name,driver_version", "--format=csv,noheader"], capture_output=True, text=True, timeout=60
    )
    return run.stdout.strip().splitlines()[0] if run.returncode == 0 and run.stdout.strip() else ""
