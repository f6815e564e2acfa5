"""The Mitsuba variant of this process, and the system libraries that it needs: libatomic, and LLVM on the CPU.

Dr.Jit compiles its CPU kernels through an LLVM shared library found at run time. Versions below 16 are unusable: 14 is
refused, 15 aborts the process during code generation. The library is therefore chosen by its file name beforehand.
"""

import ctypes.util
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

from thermorender.errors import ThermorenderError

OLDEST_LLVM = 16
DEVICES = {"cpu": "llvm_ad_mono", "cuda": "cuda_ad_mono"}

_SEARCH = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)
_INSTALL_HINT = (
    "install one with `apt-get install libllvm19` (Debian 12, Ubuntu 24.04 or newer; elsewhere any LLVM runtime "
    "of version 16 or newer) or set DRJIT_LIBLLVM_PATH to its shared library"
)


# Dr.Jit is linked against it, and Debian's smallest images lack it.
_ATOMIC = "libatomic.so.1"


def lacks_atomic() -> bool:
    """Return whether this Linux machine lacks libatomic, without which Dr.Jit cannot be imported."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        ctypes.CDLL(_ATOMIC)
    except OSError:
        return True
    return False


def llvm_version(path: str | Path) -> int | None:
    """Return the major version in the resolved file name of an LLVM shared library, or None."""
    name = Path(path).resolve().name
    match = re.search(r"libLLVM(?:-(\d+)|(?:\.so|)\.(\d+)\.\d|(?:\.so)\.(\d+)$)", name)
    return int(next(group for group in match.groups() if group)) if match else None


def llvm_libraries() -> dict[Path, int | None]:
    """Return every LLVM shared library found on this machine as {resolved path: major version or None}."""
    found = []
    for pattern in _SEARCH:
        found += sorted(Path("/").glob(pattern.lstrip("/")))
    listed = ctypes.util.find_library("LLVM")
    if listed and Path(listed).exists():
        found.append(Path(listed))
    return {path.resolve(): llvm_version(path) for path in found}


def usable_llvm() -> tuple[Path, int | None] | None:
    """Return (path, version) of the newest usable LLVM library, or None; DRJIT_LIBLLVM_PATH comes first."""
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        version = llvm_version(chosen)
        if not Path(chosen).exists():
            raise ThermorenderError(f"DRJIT_LIBLLVM_PATH={chosen} does not exist; {_INSTALL_HINT}")
        if version is not None and version < OLDEST_LLVM:
            raise ThermorenderError(
                f"DRJIT_LIBLLVM_PATH={chosen} is LLVM {version}, which is below {OLDEST_LLVM}; {_INSTALL_HINT}"
            )
        return Path(chosen), version
    usable = [(version, path) for path, version in llvm_libraries().items() if version and version >= OLDEST_LLVM]
    if not usable:
        return None
    version, path = max(usable)
    return path, version


def activate(device: str = "auto") -> Any:
    """Activate the Mitsuba variant for `device` and return the module; "auto" uses the GPU if Dr.Jit finds one."""
    if device not in ("auto", *DEVICES):
        raise ThermorenderError(f"device={device!r} is unknown; give one of auto, {', '.join(DEVICES)}")
    llvm = usable_llvm()
    if llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(llvm[0])
    if "drjit" not in sys.modules and lacks_atomic():
        raise ThermorenderError(
            f"this machine has no {_ATOMIC}, which Dr.Jit needs; install it with `thermorender doctor --install` or "
            "`apt-get install libatomic1`"
        )
    import drjit as dr
    import mitsuba as mi

    active = mi.variant()
    if device == "auto":
        device = next((name for name, variant in DEVICES.items() if variant == active), None) or (
            "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "cpu"
        )
    if active == DEVICES[device]:
        return mi
    if active in DEVICES.values():
        running = next(name for name, variant in DEVICES.items() if variant == active)
        raise ThermorenderError(
            f"device={device!r} is not allowed while this process renders on {running!r}, whose scenes would break; "
            f"give device={running!r}, or start another process"
        )
    if device == "cuda" and not dr.has_backend(dr.JitBackend.CUDA):
        raise ThermorenderError("device='cuda' finds no usable NVIDIA GPU; give device='cpu' or install its driver")
    if device == "cpu" and not llvm:
        raise ThermorenderError(f"this machine has no LLVM library of version {OLDEST_LLVM} or newer; {_INSTALL_HINT}")
    switch(mi, DEVICES[device])
    return mi


def switch(mi: Any, variant: str) -> None:
    """Activate a variant of Mitsuba, without Dr.Jit's warning about the repeated compilation of integrators (0.1 s)."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The AST-transforming decorator", RuntimeWarning)
        mi.set_variant(variant)


def active_device() -> dict[str, str]:
    """Return {"variant": name, "llvm" or "cuda": its version}, since other compilers may round differently; {} without
    one."""
    mi = sys.modules.get("mitsuba")
    if mi is None or mi.variant() is None:
        return {}
    import drjit as dr

    library = "cuda" if mi.variant().startswith("cuda") else "llvm"
    version = getattr(dr.detail, f"{library}_version")()
    return {"variant": mi.variant(), library: ".".join(map(str, version))}


def works(variant: str) -> tuple[bool, str]:
    """Return (True, "") or (False, reason) after casting one ray in a separate process, which a wrong LLVM library
    aborts."""
    environment = dict(os.environ)
    if variant.startswith("llvm"):
        llvm = usable_llvm()
        if not llvm:
            return False, f"no LLVM library of version {OLDEST_LLVM} or newer"
        environment["DRJIT_LIBLLVM_PATH"] = str(llvm[0])
    code = (
        "import sys, mitsuba as mi\n"
        f"mi.set_variant({variant!r})\n"
        "scene = mi.load_dict({'type': 'scene', 'shape': {'type': 'sphere'}})\n"
        "hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 5), mi.Vector3f(0, 0, -1)))\n"
        "sys.exit(0 if abs(float(hit.t if isinstance(hit.t, float) else hit.t[0]) - 4) < 1e-4 else 3)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300)
    if run.returncode == 0:
        return True, ""
    if run.returncode < 0:
        return False, f"the process was killed by signal {-run.returncode}"
    lines = [line for line in run.stderr.strip().splitlines() if line.strip()]
    return False, lines[-1].strip() if lines else f"exit status {run.returncode}"


def install_libraries() -> str:
    """Install libatomic and an LLVM runtime with apt if they are missing; return a sentence about the result."""
    llvm, atomic = usable_llvm(), lacks_atomic()
    if llvm and not atomic:
        return f"LLVM {llvm[1]} is present: {llvm[0]}"
    lacking = f"LLVM library of version {OLDEST_LLVM} or newer; {_INSTALL_HINT}"
    if atomic:
        lacking = f"{_ATOMIC}; install it with `apt-get install libatomic1`"
    apt, sudo = shutil.which("apt-get"), shutil.which("sudo")
    root = getattr(os, "geteuid", lambda: 1)() == 0
    if not apt or not (root or sudo):
        raise ThermorenderError(f"this machine has no {lacking}")
    prefix = [] if root else [str(sudo), "-n"]
    subprocess.run([*prefix, apt, "update", "-q"], capture_output=True)
    if atomic:
        subprocess.run(
            [*prefix, apt, "install", "-y", "-q", "--no-install-recommends", "libatomic1"], capture_output=True
        )
        if lacks_atomic():
            raise ThermorenderError(f"apt-get could not install libatomic1; this machine has no {lacking}")
    if llvm:
        return f"installed libatomic1; LLVM {llvm[1]} is present: {llvm[0]}"
    for version in (19, 18, 20, 17, 16):
        for package in (f"libllvm{version}", f"libllvm{version}t64"):
            command = [*prefix, apt, "install", "-y", "-q", "--no-install-recommends", package]
            if subprocess.run(command, capture_output=True).returncode == 0 and (llvm := usable_llvm()):
                return f"installed {package}: {llvm[0]}"
    raise ThermorenderError(f"apt-get could not install an LLVM runtime; {_INSTALL_HINT}")
