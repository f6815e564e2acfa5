"""The scene that a studio has open: its edits with undo and redo, what renders it, and the tabs that show it."""

import threading
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender import Material
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.renders import Renders
from thermorender.apps.studio.scene_files import Save, SceneFiles
from thermorender.errors import ThermorenderError
from thermorender.materials.mixture import parts_of
from thermorender.render.geometry import refuse_other_surfaces

if TYPE_CHECKING:
    from thermorender import Renderer, Scene
    from thermorender.apps.studio.ground import Layer
    from thermorender.apps.studio.page import Tab

# Edits that undo can take back.
MOST_EDITS = 300
# Temperature for band emissivities [K].
BAND_K = 300.0


class Outdated(ThermorenderError):
    """An edit of values that another tab has changed."""


class History:
    """The edits of a scene, and the number of the version that all tabs show."""

    def __init__(self, first: Document) -> None:
        self._steps: list[tuple[Document, str]] = [(first, "")]
        # The version counts every edit, undo and redo, so that no two states have the same number.
        self._at = self.version = 0
        # Who made the current version, and the first version since which nobody else made one.
        self._by, self._since = "", 0

    def _count(self, by: str) -> bool:
        if by != self._by:
            self._by, self._since = by, self.version
        self.version += 1
        return True

    @property
    def document(self) -> Document:
        """The Document that is shown."""
        return self._steps[self._at][0]

    @property
    def undoes(self) -> str:
        """What undo would take back; "" for nothing."""
        return self._steps[self._at][1]

    @property
    def redoes(self) -> str:
        """What redo would do again; "" for nothing."""
        return self._steps[self._at + 1][1] if self._at + 1 < len(self._steps) else ""

    def edit(
        self, version: int, what: str, change: Callable[[Document], Document], check: Callable[[Document], object],
        by: str = "",
    ) -> bool:  # fmt: skip
        """Change the Document of the `version` that the user saw; return whether it differs. `check` raises where the
        changed one cannot be used, and nothing changes.
        """
        self.refuse_outdated(version, by)
        made = change(self.document)
        if made is self.document:
            return False
        check(made)
        self._steps = [*self._steps[: self._at + 1], (made, what)][-MOST_EDITS:]
        self._at = len(self._steps) - 1
        return self._count(by)

    def refuse_outdated(self, version: int, by: str = "") -> None:
        """Raise unless `version` is the current one, or all later ones are of the same tab."""
        if version != self.version and not (by and by == self._by and self._since <= version < self.version):
            raise Outdated(
                f"this tab showed version {version}, and another tab has changed the tables since (version "
                f"{self.version}); nothing was changed, look at the new values and repeat the edit"
            )

    def step(self, version: int, steps: int, by: str = "") -> bool:
        """Undo one edit (−1) or redo one (+1); return whether there is one."""
        self.refuse_outdated(version, by)
        if not 0 <= self._at + steps < len(self._steps):
            return False
        self._at += steps
        return self._count(by)

    def loaded(self, first: Document) -> None:
        """Take over a Document from files; edits before it are gone."""
        self._steps, self._at = [(first, "")], 0
        self._by, self.version = "", self.version + 1


class Session:
    """A scene and its edits, shared by all tabs. It starts from the Renderer of the scene as its files describe it."""

    def __init__(self, renderer: "Renderer", quality: str, files: SceneFiles | None = None) -> None:
        self.quality = quality
        self.files = files or SceneFiles(renderer.scene)
        self.history = History(self.files.origin)
        self.renders = Renders(renderer)
        self.tabs: list[Tab] = []
        self.labels: list[dict[str, Any]] = []  # GeoJSON features to train a map on
        self.learned: dict[str, Layer] = {}  # What the latest training gave
        # Held by the training under way; set to end it.
        self.training, self.stop_training = threading.Lock(), threading.Event()
        self._scene: Scene = self.base
        # Held by the edit, step, reload or write under way, in whatever thread.
        self._editing = threading.RLock()

    def close(self) -> None:
        """End rendering and training."""
        self.stop_training.set()
        self.renders.stop()

    @property
    def base(self) -> "Scene":
        """The scene as loaded."""
        return self.files.scene

    @property
    def scene(self) -> "Scene":
        """The scene that is shown."""
        return self._scene

    @property
    def document(self) -> Document:
        """The Document that is shown."""
        return self.history.document

    def edit(self, version: int, what: str, change: Callable[[Document], Document], by: str = "") -> None:
        """Change the Document for a tab, render it, and tell all tabs; ThermorenderError where it is refused."""
        with self._editing:
            if self.history.edit(version, what, change, self._use, by):
                self._render(by)

    def step(self, version: int, steps: int, by: str = "") -> None:
        """Undo one edit (−1) or redo one (+1) for a tab."""
        with self._editing:
            if self.history.step(version, steps, by):
                self._use(self.document)
                self._render(by)

    def reload(self, scene: "Scene") -> None:
        """Take over the scene as its files describe it now; ThermorenderError if its surfaces are other ones."""
        with self._editing:
            refuse_other_surfaces(self.base.surfaces, scene.surfaces)
            self.files, self._scene = SceneFiles(scene), scene
            self.history.loaded(self.files.origin)
            self.renders.compare_with(scene)
            self._render()

    def write(self, save: Save) -> None:
        """Write a Save; the edits count as saved: differences begin from them, and undo still goes behind them."""
        with self._editing:
            if save.document is not self.document:
                raise ThermorenderError(
                    "another tab has changed the tables since these changes were listed; nothing was written, so press "
                    "Save again to see all changes"
                )
            self.files.write(save)
            self.renders.compare_with(self._scene)
            for tab in list(self.tabs):
                tab.refresh()

    def _use(self, document: Document) -> None:
        scene = document.scene(self.base, self.files.origin)
        scene.refuse_disagreement()
        self._scene = scene

    def _render(self, by: str = "") -> None:
        self.renders.solve(self._scene, self.history.version)
        for tab in list(self.tabs):
            tab.changed(by)

    def shares(self) -> dict[str, float]:
        """Return the share of the terrain's texels that each material covers; a mixture counts by its parts."""
        numbers = [surface.material.ravel() for surface in self._scene.surfaces[: self._scene.terrain_count]]
        count = np.sum([np.bincount(each, minlength=256) for each in numbers], axis=0)
        shares: dict[str, float] = {}
        for material, each in zip(self._scene.materials, count, strict=False):
            for part, share in parts_of(material):
                shares[part.name] = shares.get(part.name, 0.0) + float(share * each / max(count.sum(), 1))
        return shares


@lru_cache(1000)
def band_mean(material: Material, band_um: tuple[float, float]) -> float | None:
    """Return the band emissivity at 300 K; None where the band is not measured."""
    try:
        return float(material.band_emissivity(*band_um, BAND_K))
    except ThermorenderError:
        return None
