"""Classes for which errors are reported: of pixels (surface, material, edges, range, view angle) and of pictures."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.ground_intervals import Cells
from thermorender.apps.compare.sums import WIDTH, Sums, rows_by
from thermorender.apps.compare.view import View
from thermorender.apps.training.dataset import Entry
from thermorender.apps.training.map_inputs import NO_MATERIAL

# Man-made and natural materials of the library; other materials, such as a scene's own, count for neither group.
MAN_MADE = frozenset(
    "asphalt concrete roof_shingle roof_slate roof_rubber glass paint_black paint_metallic wood brass tar "
    "paint_black_gloss paint_black_matt gold_plate roof_rubber_black roof_rubber_white brick_clay roof_tile_clay "
    "paint_olive roof_tar_paper steel_galvanised steel_galvanised_oxidised aluminium_sheet asphalt_stone tarmac "
    "roof_felt brick_cement brick_painted cement concrete_urban granite_paving roof_slate_urban fibre_cement "
    "roof_tile_cement sandstone_building limestone_building pvc_roofing quartzite metal_painted steel_aluzinc "
    "aluminium_stucco aluminium_weathered lead_weathered iron_weathered glass_fresnel silica_fused "
    "aluminium_polished copper_polished gold_polished iron_polished roof_tile_loft roof_flat_gravel roof_flat_membrane "
    "roof_metal_insulated road_asphalt pavement_concrete".split()
)
NATURAL = frozenset(
    "grass_green grass_dry heath_shrub conifer broadleaf leaf_litter bark soil_loam soil_dark sand_quartz granite "
    "limestone basalt water snow ice lichen needles_dry oak_leaves maple_leaves soil_arid sand_gypsum granite_powder "
    "sandstone marble sea_foam frost snow_fine snow_medium snow_coarse water_fresnel water_breeze ice_fresnel".split()
)
# An edge: a gradient of the true apparent temperature above this [K/px], widened by this many pixels.
EDGE_K_PX = 1.0
EDGE_PX = 2
EDGES = (f"within {EDGE_PX} px of an edge", "elsewhere")
# Class limits of range [m] and of the angle between the line of sight and the vertical [deg].
RANGES_M = (50.0, 100.0, 200.0, 400.0, 800.0)
ANGLES_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)
GROUND = "ground"
# Labels of pairs that define groups.
LABELS = ("kind", "view", "weather", "season")


def edge_class(temperature: ArrayLike) -> NDArray[np.intp]:
    """Return the number in `EDGES` of each pixel of a true picture [K], (H, W) int; unknown pixels make no edge.

    A pixel is near an edge if the central differences in its 5 × 5 neighbourhood contain a strong gradient.
    """
    import cv2

    down, right = np.gradient(np.asarray(temperature, np.float64))
    # False where either is NaN.
    strong = np.hypot(down, right) > EDGE_K_PX
    side = 2 * EDGE_PX + 1
    widened: NDArray[np.intp] = cv2.dilate(strong.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.intp)
    return 1 - widened


def picture_classes(entry: Entry) -> dict[str, str]:
    """Return {grouping: class} of an Entry: its local solar hour and its labels, where present."""
    found = {}
    if "solar_hour" in entry.conditions:
        hour = int(entry.conditions["solar_hour"] % 24.0)
        found["hour"] = f"{hour:02d}–{hour + 1:02d} h"
    return found | {name: str(entry.labels[name]) for name in LABELS if name in entry.labels}


def class_names(limits: Sequence[float], unit: str) -> list[str]:
    """Return the names of the classes between limits: "below 50 m", "50–100 m", …, "above 800 m"."""
    inner = [f"{low:g}–{high:g} {unit}" for low, high in zip(limits[:-1], limits[1:], strict=True)]
    return [f"below {limits[0]:g} {unit}", *inner, f"above {limits[-1]:g} {unit}"]


class PixelClasses:
    """Classes of the known pixels of a View with a reference, as flat numbers.

    A pair has classes by edges; a pose also by `objects`, range, view angle, and cells of ground of `cell_m` [m].
    """

    def __init__(self, view: View, objects: Sequence[str] = (), cell_m: float | None = None) -> None:
        assert view.truth is not None
        known = view.known
        self.known, self.surfaces = known, [GROUND, *objects]
        surface = view.object[known] + 1
        self.groupings = {"edges": list(EDGES)}
        parts = [edge_class(np.where(known, view.truth, np.nan))[known]]
        if view.position is not None and view.pose is not None:
            offset = view.position[known] - view.pose[:3, 3].astype(np.float32)
            distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-6)
            slant = np.degrees(np.arccos(np.clip(-offset[:, 2] / distance, -1.0, 1.0)))
            self.groupings |= {"range": class_names(RANGES_M, "m"), "view angle": class_names(ANGLES_DEG, "°")}
            parts += [np.digitize(distance, RANGES_M), np.digitize(slant, ANGLES_DEG)]
        self._shape = (len(self.surfaces), NO_MATERIAL + 1, *map(len, self.groupings.values()))
        self._flat = np.ravel_multi_index((surface, view.material[known], *parts), self._shape)
        self._cell_m = cell_m
        if cell_m is not None and view.position is not None:
            place = np.floor(view.position[view.ground][:, :2].astype(np.float64) / cell_m).astype(np.int32)
            self._places, self._cell = np.unique(place, axis=0, return_inverse=True)
            self._on_ground = surface == 0

    def sums(self, error: NDArray[np.float64]) -> Sums:
        """Return the sums of an error (n,) of the known pixels [K]: (surface, material, …groupings, 5)."""
        return rows_by(error, self._flat, int(np.prod(self._shape))).reshape(*self._shape, WIDTH)

    def cells(self, error: NDArray[np.float64], land: str) -> Cells | None:
        """Return the sums of an error (n,) of the known pixels by cells of a land's ground; None without positions."""
        if self._cell_m is None:
            return None
        found = rows_by(error[self._on_ground], self._cell, len(self._places))[:, :3]
        used = found[:, 0] > 0
        return Cells(land, self._cell_m, self._places[used], found[used].astype(np.float32))
