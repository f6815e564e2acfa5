"""Frames for the tabs, made in one thread in the background: the latest request of each tab counts.

This is the only module of the studio that renders, and it calls the public interface of scenes and renderers. An edit
shows first as a preview with its estimated error, where the renderer has one, and then exactly. Solutions have a thread
of their own: the next edit cancels the one under way and does not wait for its end.
"""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np

from thermorender import Frame, Renderer, Scene
from thermorender.apps.studio.pictures import Picture, picture_of
from thermorender.apps.studio.view import View
from thermorender.errors import ThermorenderError
from thermorender.render.pixels.parts import PixelParts

_T = TypeVar("_T")
# Longest wait for a job, such as an export behind a long solution.
_ANSWERS_S = 120.0
# Longest wait for the pages to fetch a preview before its solution begins, which would slow them down.
_FETCHED_S = 0.1


# Where edits come faster than solutions, which only delay previews then, the next solution waits for such a pause.
PAUSE_S = 1.5


class _Newer(Exception):
    """The solution under way is outdated."""


class _Unknown(Exception):
    """An edit has no preview."""


class _Replaced(Exception):
    """What differences are to has been solved, or replaced, while it was solved here."""


@dataclass
class Seen:
    """What a tab looks at: its view, and whom to call with the picture."""

    view: View
    show: Callable[[Picture], object]


@dataclass(frozen=True)
class Light:
    """A rendered state of the scene: the Renderer, the version of the edits, and what to say about it."""

    renderer: Renderer
    version: int
    words: str
    exact: bool


@dataclass(eq=False)
class _Solution:
    """A solution under way: of which scene, and of which version of the edits."""

    scene: Scene
    version: int


@dataclass(eq=False)
class Renders:
    """The thread that renders, and the one that solves beside it; it starts from the Renderer of the scene as saved."""

    renderer: Renderer
    light: Light = field(init=False)
    saved: Renderer = field(init=False)
    _news: threading.Condition = field(default_factory=threading.Condition)
    _edit: tuple[Scene, int] | None = None
    _reference: Scene | None = None
    _tabs: dict[str, Seen] = field(default_factory=dict)
    _waiting: dict[str, None] = field(default_factory=dict)
    _jobs: list[Callable[[], object]] = field(default_factory=list)
    _long: Callable[[], object] | None = None
    _ended: bool = False
    _last: dict[str, tuple[View, Frame, int]] = field(default_factory=dict)
    _pictures: dict[str, Picture] = field(default_factory=dict)
    _fetched: dict[str, Picture] = field(default_factory=dict)
    _solved: Renderer = field(init=False)
    _ready: Renderer | None = None
    _solving: _Solution | None = None
    _found: tuple[_Solution, Renderer | Exception] | None = None
    _solver: threading.Thread | None = None

    def __post_init__(self) -> None:
        self.saved = self._solved = self.renderer
        self.light = Light(self.renderer, 0, "exact", True)
        self._thread = threading.Thread(target=self._run, name="studio renders", daemon=True)

    def start(self) -> None:
        """Begin rendering."""
        self._thread.start()

    def stop(self) -> None:
        """End rendering, after what is under way."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        for thread in (self._thread, self._solver):
            if thread is not None and thread.is_alive():
                thread.join(10.0)

    def solve(self, scene: Scene, version: int) -> None:
        """Show an edited scene in all tabs."""
        with self._news:
            self._edit = (scene, version)
            self._news.notify_all()

    def compare_with(self, scene: Scene) -> None:
        """Take a scene as what differences are to; it is solved when a tab first asks for one."""
        with self._news:
            self._reference = scene
            self._waiting |= dict.fromkeys(self._tabs)
            self._news.notify_all()

    def look(self, tab: str, view: View, show: Callable[[Picture], object]) -> None:
        """Show a tab its view; `show` is called from the thread that renders."""
        with self._news:
            self._tabs[tab] = Seen(view, show)
            self._waiting[tab] = None
            self._news.notify_all()

    def forget(self, tab: str) -> None:
        """Drop a tab that was closed."""
        with self._news:
            for known in (self._tabs, self._waiting, self._last, self._pictures, self._fetched):
                known.pop(tab, None)

    def run(self, job: Callable[[], object]) -> None:
        """Call a function in the thread that renders."""
        with self._news:
            self._jobs.append(job)
            self._news.notify_all()

    def call(self, job: Callable[[], _T]) -> _T:
        """Return the result of a function that the thread that renders has called; not for that thread itself."""
        made: Future[_T] = Future()

        def run() -> None:
            try:
                made.set_result(job())
            except BaseException as error:
                made.set_exception(error)

        self.run(run)
        try:
            return made.result(_ANSWERS_S)
        except TimeoutError:
            raise ThermorenderError(
                f"the work under way has taken longer than {_ANSWERS_S:g} s; wait until the state says exact, and "
                "ask again"
            ) from None

    def later(self, job: Callable[[Callable[[str, float], object]], object]) -> None:
        """Call a function that takes long; what it reports to, (what, share), ends it after an edit or another one."""
        with self._news:
            self._long = partial(job, self._between_long)
            self._news.notify_all()

    def parts(self, tab: str, pixel: tuple[int, int]) -> PixelParts | None:
        """Return the parts of the radiance at a (row, column) of a tab's frame; for the thread that renders."""
        frame = self.frame(tab)
        if frame is None:
            return None
        try:
            return self.light.renderer.parts_at(frame.pose, [pixel], frame.time_s)[0]
        except ThermorenderError:
            return None

    def fetch(self, tab: str) -> Picture | None:
        """Return the latest Picture of a tab, for its page."""
        with self._news:
            picture = self._pictures.get(tab)
            if picture is not None:
                self._fetched[tab] = picture
                self._news.notify_all()
        return picture

    def frame(self, tab: str) -> Frame | None:
        """Return the latest Frame of a tab."""
        known = self._last.get(tab)
        return known[1] if known else None

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._asked() or self._unready())
                if self._ended:
                    return
                asked = self._asked()
                edit, self._edit = self._edit, None
            try:
                if not asked:
                    # In the pause after a picture, so that the preview of the next edit need not wait for it.
                    self._ready = self.light.renderer
                    self._ready.baked.ready_for_edits()
                elif edit:
                    self._edited(*edit)
                elif found := self._found:
                    self._found = None
                    self._take(*found)
                elif self._waiting or self._jobs:
                    self._draw()
                elif long := self._long:
                    self._long = None
                    long()
            except _Newer:
                pass  # A later edit is waiting, and the loop takes it next.
            except Exception as error:  # The pages show it; the thread goes on, since all pictures come from it.
                self._report(_sentence(error))

    def _asked(self) -> bool:
        return bool(self._ended or self._edit or self._found or self._waiting or self._jobs or self._long)

    def _unready(self) -> bool:
        return bool(self._pictures) and self._ready is not self.light.renderer

    def _report(self, sentence: str) -> None:
        for seen in list(self._tabs.values()):
            try:
                seen.show(Picture.of_fault(sentence, self.light.version))
            except Exception as error:  # The terminal shows it; the other tabs still need their report.
                traceback.print_exception(error)

    def _between(self, what: str, share: float) -> None:
        """Stop what an edit has outdated, and serve tabs that look elsewhere meanwhile."""
        if self._edit or self._ended:
            raise _Newer
        if self._waiting or self._jobs:
            self._draw()

    def _between_long(self, what: str, share: float) -> None:
        if self._long:
            raise _Newer
        self._between(what, share)
        if found := self._found:
            self._found = None
            self._guarded(partial(self._take, *found))

    def _edited(self, scene: Scene, version: int) -> None:
        """Show the preview of an edit, if it has one, and begin its solution."""
        with self._news:
            # The one under way is outdated, and ends at its next step.
            hurried, self._solving = self._solving is not None, (solution := _Solution(scene, version))
            self._news.notify_all()
        made = self._preview(scene)
        if made is not None:
            errors = made.baked.errors_mk
            words = f"preview ± {errors['preview']:.3g} mK, {errors['preview_rms']:.2g} mK RMS"
            self._show(Light(made, version, words, False))
            with self._news:
                self._news.wait_for(lambda: self._asked() or self._fetched == self._pictures, _FETCHED_S)
        if self._edit is None:
            work = partial(self._solve, solution, self._solved, PAUSE_S if hurried else 0.0, self._solver)
            self._solver = threading.Thread(target=work, name="studio solves", daemon=True)
            self._solver.start()

    def _preview(self, scene: Scene) -> Renderer | None:
        """The Renderer of a scene's preview; None where it has to be solved."""

        def solves(what: str, share: float) -> None:
            raise _Unknown

        try:
            return self.light.renderer.preview_for(scene, solves)
        except _Unknown:
            return None

    def _solve(
        self, solution: _Solution, start: Renderer, pause_s: float, before: threading.Thread | None
    ) -> None:  # fmt: skip
        """Solve a scene beside the thread that renders, after a pause and after the solution before has ended."""

        def under_way(what: str, share: float) -> None:
            if self._solving is not solution or self._ended:
                raise _Newer

        with self._news:
            self._news.wait_for(lambda: self._solving is not solution or self._ended, pause_s)
        if before is not None:
            before.join()
        found: Renderer | Exception
        try:
            under_way("", 0.0)
            found = self._exact(solution.scene, start, under_way)
            _ = found.baked.device  # Uploaded here, where no edit waits for it.
        except _Newer:
            return
        except Exception as error:
            found = error
        with self._news:
            self._found = solution, found
            self._news.notify_all()

    def _take(self, solution: _Solution, found: Renderer | Exception) -> None:
        """Show the end of a solution, unless it is outdated."""
        if solution is not self._solving:
            return
        self._solving = None
        if isinstance(found, Exception):
            raise found
        self._solved = found
        self._show(Light(found, solution.version, "exact", True))

    def _exact(self, scene: Scene, start: Renderer, progress: Callable[[str, float], object]) -> Renderer:
        """The Renderer of a scene, solved from an earlier solution."""
        if scene.temperature_state.solved:
            return start.solved_for(scene, progress)
        settings = start.plan.sampling.settings()
        made = Renderer(scene, **settings, seed=self.renderer.seed, progress=progress, like=start, edits=True)
        _ = made.baked
        return made

    def _solve_reference(self) -> None:
        """Solve what differences are to, unless it is solved."""
        while (wanted := self._reference) is not None:

            def under_way(what: str, share: float, wanted: Scene = wanted) -> None:
                self._between(what, share)
                # Other tabs, which are served meanwhile, may have needed it too.
                if self._reference is not wanted:
                    raise _Replaced

            try:
                found = self._exact(wanted, self._solved, under_way)
            except _Replaced:
                continue
            with self._news:
                if self._reference is wanted:
                    self.saved, self._reference = found, None

    def _show(self, light: Light) -> None:
        self.light = light
        with self._news:
            self._waiting |= dict.fromkeys(self._tabs)
        self._draw()

    def _draw(self) -> None:
        while True:
            with self._news:
                jobs, self._jobs = self._jobs, []
                tab = next(iter(self._waiting), None)
                if tab is not None:
                    del self._waiting[tab]
                seen = self._tabs.get(tab) if tab is not None else None
            for job in jobs:
                self._guarded(job)
            if tab is None:
                return
            if seen is None:
                continue
            self._guarded(partial(self._show_in, tab, seen))

    def _guarded(self, job: Callable[[], object]) -> None:
        """Call a function whose fault must not end a solution under way."""
        try:
            job()
        except _Newer:
            raise
        except Exception as error:
            self._report(_sentence(error))

    def _show_in(self, tab: str, seen: Seen) -> None:
        try:
            made = self._picture(tab, seen.view)
        except ThermorenderError as error:
            made = Picture.of_fault(str(error), self.light.version)
        with self._news:
            # During a solution that this view needed, the tab may have been shown a later one, or closed.
            if self._tabs.get(tab) is not seen and tab not in self._waiting:
                return
            self._pictures[tab] = made
        seen.show(made)

    def _picture(self, tab: str, view: View) -> Picture:
        light, (known, last, version) = self.light, self._last.get(tab, (None, None, -1))
        pose, time_s = view.pose.matrix(), view.time_s
        # The exact frame after a preview has the rays of the preview, so that they differ by their light alone.
        again = version == light.version and known is not None and (known.pose, known.time_s) == (view.pose, time_s)
        frame = light.renderer.frame(pose, time_s, sampled_as=last if again else None)
        with self._news:
            if tab in self._tabs:
                self._last[tab] = (view, frame, light.version)
        before = None
        if view.mode == "difference":
            self._solve_reference()
            before = self.saved.frame(pose, time_s, sampled_as=frame).apparent_temperature
        colour = light.renderer.visible(pose, time_s=time_s) if view.mode == "photograph" else None
        number = (self._pictures[tab].number if tab in self._pictures else 0) + 1
        blank = Picture(number, light.version, light.words, light.exact)
        return picture_of(frame, view, blank, before, colour)


def _sentence(error: Exception) -> str:
    """What a page says about a fault; the terminal shows where one of the studio itself was."""
    if isinstance(error, ThermorenderError):
        return str(error)
    traceback.print_exception(error)
    return f"the studio failed here ({type(error).__name__}), its terminal says where; undo the edit"


def figures(frame: Frame, column: int, row: int) -> dict[str, Any] | None:
    """Return what a frame shows at a pixel; None outside the image."""
    height, width = frame.radiance.shape
    if not (0 <= column < width and 0 <= row < height):
        return None
    truth = frame.truth
    number = int(truth["material"][row, column])
    thing = int(truth["object"][row, column])
    known = np.isfinite(truth["depth"][row, column])
    return {
        "apparent_k": float(frame.apparent_temperature[row, column]),
        "radiance": float(frame.radiance[row, column]),
        "kinetic_k": float(truth["kinetic_temperature"][row, column]),
        "emissivity": float(truth["emissivity"][row, column]),
        "position": tuple(float(v) for v in truth["position"][row, column]),
        "material": frame.materials[number] if known and number < len(frame.materials) else "",
        "object": frame.objects[thing - 1] if thing else "",
    }
