"""The light of a scene, solved and stored per texel and face: arrays alone, which any process can use."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.render.dynamic import StaticLight
from thermorender.render.light.radiosity import Transport
from thermorender.render.plan import Plan
from thermorender.scene.scene import Scene
from thermorender.scene.temperature_state import Available


@dataclass(frozen=True, eq=False)
class BakedLight:
    """A scene with its light."""

    scene: Scene
    plan: Plan
    transport: Transport | None  # rays between the faces; None where reflection is left out
    # (F, N) mean radiance that each face receives at each spectral node, from which an edit's solution begins
    # [W m⁻² sr⁻¹]; None where reflection is left out, and in a preview
    incident: NDArray[np.float32] | None
    texels: tuple[NDArray[np.float32], ...]  # (T,) radiance that leaves each texel, by channel [W m⁻² sr⁻¹]
    faces: NDArray[np.float32] | None  # (F, K) correction of each face, added to its texels [W m⁻² sr⁻¹]
    face_error: NDArray[np.float32] | None  # (F,) mean square error of the light on each face [(W m⁻² sr⁻¹)²]
    # (n, K) channels of blackbodies at the temperatures of the directional texels; None without such texels or without
    # mirrors
    mirror_black: NDArray[Any] | None
    static_light: StaticLight | None  # light of the static scene for dynamic objects; None without them
    # Errors of the reflected light [mK at 300 K]: "solution", the bound from its residual, and root mean squares over
    # the surfaces: "noise" of the rays, from independent halves, "faces", of light taken as constant over a face (far
    # ground has its own in `face_error`), and "texels", of baking it to texels; with air also "air", an estimate from
    # above, of leaving it out between surfaces.
    # Where temperatures or light preview an edit, "preview" is the largest error of both, and "preview_rms" the root
    # mean square.
    errors_mk: dict[str, float]
    cache_note: str | None  # why the traced light could not be kept on disk; None where it was kept or need not be


def with_previewed(errors_mk: dict[str, float], scene: Scene) -> dict[str, float]:
    """Return errors of light with those of temperatures that preview an edit [mK]."""
    state = scene.temperature_state
    if not isinstance(state, Available) or state.preview_k is None:
        return errors_mk
    rms, most = (1e3 * value for value in state.preview_k)
    return errors_mk | {
        "preview": errors_mk.get("preview", 0.0) + most,
        "preview_rms": float(np.hypot(errors_mk.get("preview_rms", 0.0), rms)),
    }
