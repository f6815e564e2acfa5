"""How finely pixels, light and wavelengths are sampled: one value from the user's arguments to the kernels."""

from dataclasses import asdict, dataclass
from typing import Any

from thermorender.errors import ThermorenderError
from thermorender.render.pixels.sampling import PATTERNS

# Rays per pixel, texture taps per ray, error above which an edge pixel gets more rays [mK], and rays per face.
QUALITIES = {"fast": (1, 4, 500.0, 128), "standard": (1, 4, 150.0, 128), "high": (4, 4, 24.0, 512)}


@dataclass(frozen=True)
class Sampling:
    """How finely pixels, light and wavelengths are sampled."""

    samples: int  # rays per pixel
    taps: int  # texture taps per ray
    edge_mk: float  # error above which a pixel that shows an edge gets more rays [mK]; infinite: never
    rays: int  # rays per face of the bake; powers of two are most efficient
    # Largest error on the scene's envelope allowed to the spectral nodes [mK]. A proven bound limits the error of the
    # light between surfaces to a tenth of it. Reflection that adds less than a tenth to any pixel is left out.
    tolerance_mk: float

    @classmethod
    def of(
        cls, quality: str = "standard", samples: int | None = None, taps: int | None = None,
        edge_mk: float | None = None, rays: int | None = None, tolerance_mk: float = 5.0,
    ) -> "Sampling":  # fmt: skip
        """Return the Sampling of a quality; what is given replaces the quality's own."""
        if quality not in QUALITIES:
            raise ThermorenderError(f"quality={quality!r} is unknown; give one of {', '.join(QUALITIES)}")
        preset = QUALITIES[quality]
        samples, taps = preset[0] if samples is None else samples, preset[1] if taps is None else taps
        edge_mk, rays = preset[2] if edge_mk is None else edge_mk, preset[3] if rays is None else rays
        for name, value in (("samples", samples), ("taps", taps)):
            if value not in PATTERNS:
                allowed = ", ".join(map(str, sorted(PATTERNS)))
                raise ThermorenderError(f"{name}={value} is not allowed; give one of {allowed}")
        if not edge_mk > 0.0:
            raise ThermorenderError(f"edge_mk={edge_mk:g} is not allowed; give a number of mK above 0, or inf for none")
        if not 1 <= rays <= 65536:
            raise ThermorenderError(f"rays={rays} is not allowed; give 1…65536 rays per face")
        if not tolerance_mk > 0.0:
            raise ThermorenderError(f"tolerance_mk={tolerance_mk:g} is not allowed; give a number of mK above 0")
        return cls(samples, taps, float(edge_mk), rays, float(tolerance_mk))

    def settings(self) -> dict[str, Any]:
        """Return the keywords of `Renderer` for this sampling."""
        return asdict(self)
