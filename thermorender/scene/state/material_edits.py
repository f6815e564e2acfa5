"""Edits of a scene's materials: of what a name or class covers, within an area, or read from the orthophoto."""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from typing import Any, TypeVar

from numpy.typing import ArrayLike

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.scene.georeference import place_of
from thermorender.scene.parts.cover import OBJECT, SURFACE_OF_MESH
from thermorender.scene.parts.patch import Patch, areas, texels_in
from thermorender.scene.parts.read import Parts
from thermorender.scene.spec import EmissivitySpec
from thermorender.scene.state.arguments import checked_spec, material_of, refuse_other
from thermorender.scene.state.declared import Declared

_S = TypeVar("_S", bound="MaterialEdits")


class MaterialEdits:
    """The edits of a Scene's materials."""

    _parts: Parts | None
    _declared: Declared
    ground: Any

    def _edited(self: _S, declared: Declared) -> _S:
        """Return the scene that declares something else."""
        raise NotImplementedError

    def with_learned_materials(self: _S, spec: EmissivitySpec) -> _S:
        """Return this scene with its terrain's materials read from orthophoto or textures, as of a source "learned".

        The materials of a [[surface]] stay.
        """
        if not isinstance(spec, EmissivitySpec) or spec.source != "learned":
            shown = f"source={spec.source!r}" if isinstance(spec, EmissivitySpec) else f"a {type(spec).__name__}"
            raise ThermorenderError(
                f"with_learned_materials was given {shown}; give EmissivitySpec('learned', model=…, fallback=…)"
            )
        spec = checked_spec(spec, "with_learned_materials", self._declared.spec.folder)
        terrain = self._declared.spec.terrain
        if not (terrain.orthophoto or terrain.mesh):
            raise ThermorenderError(
                f"{self._declared.where}: a learned emissivity map reads materials from an orthophoto; add "
                "terrain.orthophoto"
            )
        return self._edited(replace(self._declared, spec=replace(self._declared.spec, emissivity=spec)))

    def with_material(
        self: _S, replaced: Mapping[int | str, str | float | Material] | None = None, /,
        **more: str | float | Material,
    ) -> _S:  # fmt: skip
        """Return this scene with materials of its terrain or objects replaced by others.

        Parameters
        ----------
        replaced, **more : str, float or Material, by what it replaces
            A key is a class number, the name of an object, the name of a mesh's node, group, material or texture, or
            the name of a material, as in the scene's files; the first of these that the scene has counts. A value is
            the name of a material, a grey emissivity 0…1, or a Material. All replacements apply at once: with
            `grass="sand"` and `sand="snow"` grass becomes sand, and sand becomes snow.
        """
        now, parts = self._declared, self._parts
        refuse_other("with_material", replaced or {}, "{what it replaces: material}, or name=material")
        given: dict[int | str, str | float | Material] = dict(replaced or {})
        given.update(more)
        if parts is None:
            raise ThermorenderError(
                f"{now.where}: with_material needs materials that files describe, and this scene's surfaces were made "
                "in memory; give with_surfaces other materials"
            )
        names = {item.name for item in now.spec.objects}
        of_mesh = frozenset[str]().union(*(texture.known for texture in parts.textures))

        def place(key: int | str) -> int | str:
            if not isinstance(key, str) or key not in names | of_mesh:
                return key
            return (OBJECT if key in names else SURFACE_OF_MESH) + key

        found = {place(key): material_of(key, value, parts.library) for key, value in given.items()}
        return self._edited(replace(now, replaced={**now.replaced, **found}))

    def with_material_in(
        self: _S, area: str | PathLike[str] | Mapping[str, Any] | ArrayLike,
        material: str | float | Material | None = None,
    ) -> _S:  # fmt: skip
        """Return this scene with another material within an area of its terrain, such as one roof.

        Parameters
        ----------
        area : path, dict or (N, 2) array
            GeoJSON of polygons, a file or its contents, in longitude and latitude unless its "crs" member names another
            CRS; or the corners of one polygon, local east and north [m]. Texels with their middle inside get the
            material.
        material : str, float or Material, optional
            The name of a material, a grey emissivity 0…1, or a Material; by default the property "material" of each
            polygon. It has no other effect: temperatures of a raster or map stay.
        """
        now, parts = self._declared, self._parts
        place = place_of(parts.frame, parts.grid) if parts else None
        if parts is None or parts.grid is None or place is None:
            raise ThermorenderError(
                f"{now.where}: with_material_in needs a terrain of an elevation raster that files describe; for a mesh "
                "use with_material"
            )
        name = f"area {area}" if isinstance(area, (str, PathLike)) else "with_material_in: the area"
        patches = []
        for geometry, own in areas(area, place, self.ground):
            chosen = own if material is None else material
            if chosen is None:
                raise ThermorenderError(
                    f"{name} has a polygon without the property 'material'; give a material, or name it there"
                )
            new = material_of("material", chosen, parts.library, "with_material_in")
            patches.append(Patch(texels_in(geometry, parts.grid, name), new))
        return self._edited(replace(now, painted=(*now.painted, *patches)))
