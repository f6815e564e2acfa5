"""The scene that a studio has open: its edits, what renders it, and the tabs that show it."""

import threading
from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Protocol

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import read_text
from thermorender.materials.library import load_library, read_library
from thermorender.materials.material import Material
from thermorender.materials.mixture import parts_of
from thermorender.paths import data_folder
from thermorender.render.geometry import refuse_other_surfaces
from thermorender.studio.document import Document, History
from thermorender.studio.renders import Renders
from thermorender.studio.saving import snapshot

if TYPE_CHECKING:
    from pathlib import Path

    from thermorender.render.renderer import Renderer
    from thermorender.scene.scene import Scene
    from thermorender.studio.ground import Label, Learned

# Temperature for band emissivities [K].
BAND_K = 300.0


class Shown(Protocol):
    """A tab, as the session knows it."""

    def changed(self, by: str) -> None:
        """Take note of a version of the edits that the tab `by` made."""

    def refresh(self) -> None:
        """Show the current version of the edits."""


class Session:
    """A scene and its edits, shared by all tabs.

    Parameters
    ----------
    renderer : Renderer
        Of the scene as its files describe it.
    quality : str
        Its quality, for the lines that a user copies.
    files : dict, optional
        `thermorender.studio.saving.snapshot` of the scene when it was loaded; by default as it is now.

    Attributes
    ----------
    base : Scene
    origin : Document
        Of the base scene.
    history : History
    renders : Renders
    tabs : list of Shown
    files : dict
        Checksums of the scene's files as they were read or written.
    class_raster : bytes
        The file of the class raster as it was read; b"" without one.
    areas : TemporaryDirectory
        Painted areas.
    labels : list of Label
        To train a map on.
    learned : Learned or None
        What the latest training gave.
    training, stop_training : Lock, Event
        Held by the training under way; set to end it.
    """

    def __init__(self, renderer: "Renderer", quality: str, files: "dict[Path, str] | None" = None) -> None:
        self.quality = quality
        self.base: Scene = renderer.scene
        self.origin = document_of(self.base)
        self.history = History(self.origin)
        self.files = snapshot(self.base) if files is None else files
        self.class_raster = class_raster_of(self.base)
        self.areas = TemporaryDirectory(prefix="thermorender-studio-")
        self.renders = Renders(renderer)
        self.tabs: list[Shown] = []
        self.labels: list[Label] = []
        self.learned: Learned | None = None
        self.training, self.stop_training = threading.Lock(), threading.Event()
        self._band: dict[int, tuple[Material, float | None]] = {}
        self._scene: Scene = self.base

    def close(self) -> None:
        """End rendering and training, and remove the painted areas."""
        self.stop_training.set()
        self.renders.stop()
        self.areas.cleanup()

    @property
    def document(self) -> Document:
        """The Document that is shown."""
        return self.history.document

    def edit(self, version: int, what: str, change: Callable[[Document], Document], by: str = "") -> None:
        """Change the Document for a tab, render it, and tell all tabs; ThermorenderError where it is refused."""
        before = self.history.version
        try:
            self.history.edit(version, what, change, self._use, by)
        finally:
            if self.history.version != before:
                self._render(by)

    def step(self, version: int, steps: int, by: str = "") -> None:
        """Undo one edit (−1) or redo one (+1) for a tab."""
        before = self.history.version
        self.history.step(version, steps, by)
        if self.history.version != before:
            self._use(self.document)
            self._render(by)

    def reload(self, scene: "Scene") -> None:
        """Take over the scene as its files describe it now; ThermorenderError if its surfaces are other ones."""
        refuse_other_surfaces(self.base.surfaces, scene.surfaces)
        self.files, self.class_raster = snapshot(scene), class_raster_of(scene)
        self.base = self._scene = scene
        self.origin = document_of(scene)
        self.history.loaded(self.origin)
        self.renders.compare_with(scene)
        self._render()

    def saved(self, files: "dict[Path, str]") -> None:
        """Count the edits as saved: differences begin from them, and undo still goes behind them."""
        self.files, self.history.saved = files, self.document
        self.renders.compare_with(self._scene)
        for tab in list(self.tabs):
            tab.refresh()

    def _use(self, document: Document) -> None:
        scene = document.scene(self.base, self.origin)
        scene.refuse_disagreement()
        self._scene = scene

    def _render(self, by: str = "") -> None:
        self.renders.solve(self._scene, self.history.version)
        for tab in list(self.tabs):
            tab.changed(by)

    @property
    def scene(self) -> "Scene":
        """The scene that is shown."""
        return self._scene

    def shares(self) -> dict[str, float]:
        """Return the share of the terrain's texels that each material covers; a mixture counts by its parts."""
        numbers = [surface.material.ravel() for surface in self._scene.surfaces[: self._scene.terrain_count]]
        count = np.sum([np.bincount(each, minlength=256) for each in numbers], axis=0)
        shares: dict[str, float] = {}
        for material, each in zip(self._scene.materials, count, strict=False):
            for part, share in parts_of(material):
                shares[part.name] = shares.get(part.name, 0.0) + float(share * each / max(count.sum(), 1))
        return shares

    def band_mean(self, material: Material) -> float | None:
        """Return the band emissivity for the scene's camera at 300 K; None where the band is not measured."""
        known = self._band.get(id(material))
        if known is None or known[0] is not material:
            try:
                value: float | None = float(material.band_emissivity(*self.base.camera.band_um, BAND_K))
            except ThermorenderError:
                value = None
            if len(self._band) > 2000:
                self._band.clear()
            known = self._band[id(material)] = (material, value)
        return known[1]


def class_raster_of(scene: "Scene") -> bytes:
    """Return the contents of a scene's class raster; b"" without one."""
    raster = scene.spec.emissivity.raster
    return raster.read_bytes() if raster else b""


def document_of(scene: "Scene") -> Document:
    """Return the Document of a scene, with its library."""
    folder = scene.spec.folder / "materials"
    own = frozenset(read_library(folder)) if (folder / "index.csv").is_file() else frozenset[str]()
    library, tables = load_library(folder if folder.is_dir() else None), {}
    for name, each in library.items():
        if each.directional != "lambertian":
            path = (folder if name in own else data_folder("materials")) / "spectra" / f"{name}.csv"
            tables[name] = read_text(path)
    return Document.of(scene, library, own, tables)
