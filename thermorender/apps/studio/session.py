"""The scene that a studio has open: its edits with undo and redo, what renders it, and the tabs that show it."""

import threading
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Material
from thermorender.apps.studio.cards import Point
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.layers import BAND_K, top_of
from thermorender.apps.studio.renders import Renders
from thermorender.apps.studio.scene_files import Save, SceneFiles
from thermorender.errors import ThermorenderError
from thermorender.materials.mixture import parts_of
from thermorender.output.day import solar_midnight
from thermorender.render.geometry import refuse_other_surfaces

if TYPE_CHECKING:
    from thermorender import Renderer, Scene
    from thermorender.apps.studio.page import Tab

# Edits that undo can take back, and moves between them by which outdated edits are told.
MOST_EDITS, _MOST_MOVES = 300, 1000
# Scenes of documents that are kept, so that each is solved once.
_SCENES = 8
# Places along a side at which the scene is seen from above, for what covers how much of it.
_PLACES = 800
# A surface with texels so many times the finest is land around the scene; so are faces beyond all but a share of them,
# where they reach so many times as far.
_COARSE, _TAIL, _WIDER = 8.0, 0.05, 3.0


class Outdated(ThermorenderError):
    """An edit of values that another tab has changed."""


class History:
    """The edits of a scene. Each has a number, its version, which undo and redo bring back."""

    def __init__(self, first: Document) -> None:
        self._steps: list[tuple[Document, str, int]] = [(first, "", 0)]
        self._at, self._latest = 0, 0
        # (version, who came to it), the latest last.
        self._moves: list[tuple[int, str]] = [(0, "")]

    @property
    def document(self) -> Document:
        """The Document that is shown."""
        return self._steps[self._at][0]

    @property
    def version(self) -> int:
        """The version that is shown."""
        return self._steps[self._at][2]

    @property
    def undoes(self) -> str:
        """What undo would take back; "" for nothing."""
        return self._steps[self._at][1]

    @property
    def redoes(self) -> str:
        """What redo would do again; "" for nothing."""
        return self._steps[self._at + 1][1] if self._at + 1 < len(self._steps) else ""

    @property
    def entries(self) -> list[tuple[int, str, int]]:
        """(version, what its edit was, steps from the version that is shown) of all versions, in order."""
        return [(version, what, k - self._at) for k, (_, what, version) in enumerate(self._steps)]

    def has(self, version: int) -> bool:
        """Return whether a version is still there, undone or not."""
        return any(number == version for _, _, number in self._steps)

    def document_of(self, version: int) -> Document:
        """Return the Document of a version."""
        for document, _, number in self._steps:
            if number == version:
                return document
        raise ThermorenderError(f"version {version} is no longer there; choose one of the list of edits")

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
        self._latest += 1
        self._steps = [*self._steps[: self._at + 1], (made, what, self._latest)][-MOST_EDITS:]
        self._moved(len(self._steps) - 1, by)
        return True

    def _moved(self, at: int, by: str) -> None:
        self._at = at
        self._moves = [*self._moves, (self.version, by)][-_MOST_MOVES:]

    def refuse_outdated(self, version: int, by: str = "") -> None:
        """Raise unless `version` is the current one, or all moves from it were of the same tab."""
        for number, who in reversed(self._moves):
            if number == version:
                return
            if not by or who != by:
                break
        raise Outdated(
            f"this tab showed version {version}, and another tab has changed the tables since (version "
            f"{self.version}); nothing was changed, look at the new values and repeat the edit"
        )

    def step(self, version: int, steps: int, by: str = "") -> bool:
        """Undo (−) or redo (+) so many edits for the tab `by`; return whether there are as many."""
        self.refuse_outdated(version, by)
        if not steps or not 0 <= self._at + steps < len(self._steps):
            return False
        self._moved(self._at + steps, by)
        return True

    def loaded(self, first: Document) -> None:
        """Take over a Document from files; edits before it are gone."""
        self._latest += 1
        self._steps = [(first, "", self._latest)]
        self._moves = []
        self._moved(0, "")


class Session:
    """A scene and its edits, shared by all tabs. It starts from the Renderer of the scene as its files describe it."""

    def __init__(self, renderer: "Renderer", quality: str, files: SceneFiles | None = None) -> None:
        self.quality = quality
        self.files = files or SceneFiles(renderer.scene)
        self.history = History(self.files.origin)
        self.renders = Renders(renderer, self.files.scene)
        self.tabs: list[Tab] = []
        self.labels: list[list[dict[str, Any]]] = []  # GeoJSON features of each label to train a map on
        # Held by the training under way; set to end it.
        self.training, self.stop_training = threading.Lock(), threading.Event()
        self.points: tuple[Point, ...] = ()  # kept, in all tabs
        self._named = 0  # points so far
        self._scenes: list[tuple[Document, Scene]] = [(self.files.origin, self.base)]
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

    @property
    def unsaved(self) -> bool:
        """Whether the Document differs from the files; its instant is not saved."""
        now, saved = self.document, self.files.saved
        parts = [(each.library.keys(), each.classes, each.objects, each.painted) for each in (now, saved)]
        return parts[0] != parts[1] or bool(now.changed(saved))

    def edit(self, version: int, what: str, change: Callable[[Document], Document], by: str = "") -> bool:
        """Change the Document for a tab, render it, and tell all tabs; return whether it differs. ThermorenderError
        where it is refused.
        """
        with self._editing:
            if differs := self.history.edit(version, what, change, self._use, by):
                self._render(by)
            return differs

    def step(self, version: int, steps: int, by: str = "") -> bool:
        """Undo (−) or redo (+) so many edits for a tab; return whether there are as many."""
        with self._editing:
            if stepped := self.history.step(version, steps, by):
                self._use(self.document)
                self._render(by)
            return stepped

    def reload(self, scene: "Scene") -> None:
        """Take over the scene as its files describe it now; ThermorenderError if its surfaces are other ones."""
        with self._editing:
            refuse_other_surfaces(self.base.surfaces, scene.surfaces)
            self.files, self._scene = SceneFiles(scene), scene
            self._scenes = [(self.files.origin, scene)]
            self.history.loaded(self.files.origin)
            self._render()
            self._saved()

    def write(self, save: Save) -> None:
        """Write a Save; the edits count as saved: differences begin from them, and undo still goes behind them."""
        with self._editing:
            if save.document is not self.document:
                raise ThermorenderError(
                    "another tab has changed the tables since these changes were listed; nothing was written, so press "
                    "Save again to see all changes"
                )
            self.files.write(save)
            self._saved()

    def next_name(self) -> str:
        """Return the name of the next point, which no other had."""
        self._named += 1
        return str(self._named)

    def keep(self, points: Iterable[Point]) -> None:
        """Keep these points, and no others."""
        self.points = tuple(points)
        for tab in list(self.tabs):
            tab.later(tab.stage.pointed)()

    def _saved(self) -> None:
        """Show all tabs what is saved now."""
        for tab in list(self.tabs):
            tab.later(tab.saved)()

    def _use(self, document: Document) -> None:
        scene = self._scene_of(document)
        scene.refuse_disagreement()
        try:
            refuse_other_surfaces(self.base.surfaces, scene.surfaces)
        except ThermorenderError:
            # Such as of an object whose temperature follows the heat balance: faces beside it are split for that.
            raise ThermorenderError(
                "this edit changes the faces of the scene, which the studio keeps; make it in scene.toml, and open the "
                "scene again"
            ) from None
        self._scene = scene

    def _scene_of(self, document: Document) -> "Scene":
        """The Scene of a Document, the same one while it is used."""
        for known, scene in self._scenes:
            if known is document:
                return scene
        scene = document.scene(self.base, self.files.origin)
        self._scenes = [*self._scenes, (document, scene)][-_SCENES:]
        return scene

    def reference(self, against: str) -> "tuple[Scene, str] | None":
        """Return (scene, its name) of what a view is compared with, as of `View.against`; None for nothing."""
        if not against:
            return None
        with self._editing:
            kind, _, text = against.partition(" ")
            if kind == "saved":
                # The hour is not saved, and no difference is to be that of two hours.
                return self._scene_of(self._at(self.files.saved, self.document.time)), "the saved scene"
            if kind == "version":
                other = self.history.document_of(int(text))
                hour = "" if other.time == self.document.time else f" ({self.hour_text(other)})"
                return self._scene_of(other), against + hour
            return self._scene_of(self._at(self.document, self.at_hour(float(text)))), f"solar hour {float(text):g}"

    def _at(self, document: Document, time: "np.datetime64 | None") -> Document:
        """A Document at an instant, the same one while its scene is kept."""
        if document.time == time:
            return document
        known = next((of for of, _ in self._scenes if _is_at(of, document, time)), None)
        return known or replace(document, time=time)

    def hour_text(self, document: Document) -> str:
        """Return the solar hour of a Document as on a clock."""
        return f"solar hour {clock(self.hour_of(document))}"

    def hour_of(self, document: Document) -> float:
        """Return the solar hour of a Document of a scene that has one."""
        time = document.time or self.base.time
        assert time is not None
        return float((time - self.midnight) / np.timedelta64(3600, "s"))

    @property
    def midnight(self) -> np.datetime64:
        """Start of the local solar day of the scene's time."""
        assert self.base.time is not None
        return solar_midnight(self.base.time, self.base.weather.longitude_deg)

    def at_hour(self, hour: float) -> np.datetime64:
        """Return the instant of a solar hour; ThermorenderError in a scene whose temperatures do not follow it."""
        if not self.base.temperature_state.weather_driven or self.base.time is None:
            raise ThermorenderError(
                f'{self.base.name} has the same temperatures at every hour; give it the temperature "balance"'
            )
        return self.midnight + np.timedelta64(round(3600.0 * hour), "s")

    def _render(self, by: str = "") -> None:
        self.renders.solve(self._scene, self.history.version)
        for tab in list(self.tabs):
            tab.changed(by)

    @cached_property
    def _from_above(self) -> tuple[NDArray[np.int64], float]:
        """(texels under places straight from above, all over the scene (n,); area of a place [m²])."""
        low, high = extent(self.base)
        step = (high - low) / _PLACES
        east, north = (low[k] + (np.arange(_PLACES) + 0.5) * step[k] for k in (0, 1))
        place = np.stack([each.ravel() for each in np.meshgrid(east, north)], axis=-1)
        start = np.column_stack([place, np.full(len(place), top_of(self.renders.renderer) + 1.0)])
        _, texel = self.renders.renderer.hits(start, np.broadcast_to([0.0, 0.0, -1.0], start.shape))
        return texel[texel >= 0], float(step.prod())

    def areas(self) -> dict[str, float]:
        """Return the area that each material covers, seen straight from above [m²]; a mixture counts by its parts."""
        texel, each_m2 = self._from_above
        numbers = np.concatenate([surface.material.ravel() for surface in self._scene.surfaces])
        count = np.bincount(numbers[texel], minlength=256)
        areas: dict[str, float] = {}
        for material, places in zip(self._scene.materials, count, strict=False):
            for part, share in parts_of(material):
                areas[part.name] = areas.get(part.name, 0.0) + float(share * places) * each_m2
        return areas

    def shares(self) -> dict[str, float]:
        """Return the share of the scene, seen straight from above, that each material covers."""
        areas = self.areas()
        total = sum(areas.values())
        return {name: area / total for name, area in areas.items()} if total else {}


def clock(hour: float) -> str:
    """Return an hour of the day as on a clock."""
    minutes = round(60.0 * hour)
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def _is_at(document: Document, other: Document, time: "np.datetime64 | None") -> bool:
    """Whether a Document is another one at an instant."""
    parts = ("library", "classes", "objects", "painted")
    return document.time == time and all(getattr(document, name) is getattr(other, name) for name in parts)


def extent(scene: "Scene") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (east, north) of the corners of a scene's terrain, without the coarse land around it [m]."""
    finest = min(surface.texel_m for surface in scene.near_ground)
    fine = [surface for surface in scene.near_ground if surface.texel_m <= _COARSE * finest]
    corner = np.concatenate([surface.vertices[surface.faces].reshape(-1, 3)[:, :2] for surface in fine])
    low, high = corner.min(axis=0), corner.max(axis=0)
    # A few large faces of a surface may reach to the horizon.
    inner = np.quantile(corner, (_TAIL, 1.0 - _TAIL), axis=0)
    return (inner[0], inner[1]) if (high - low > _WIDER * (inner[1] - inner[0])).any() else (low, high)


@lru_cache(1000)
def band_mean(material: Material, band_um: tuple[float, float]) -> float | None:
    """Return the band emissivity at 300 K; None where the band is not measured."""
    try:
        return float(material.band_emissivity(*band_um, BAND_K))
    except ThermorenderError:
        return None
