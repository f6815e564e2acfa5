"""Frames for the tabs, made in one thread in the background: the latest request of each tab counts.

This is the only module of the studio that renders, and it calls the public interface of scenes and renderers. An edit
shows first as a preview with its estimated error, where the renderer has one, and then exactly. Solutions have a thread
of their own: the next edit cancels the one under way and does not wait for its end.
"""

import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from thermorender import Renderer, Scene
from thermorender.apps.studio.layers import LAYERS, Learned, Plan, Shot
from thermorender.apps.studio.pictures import MaterialColours, Picture, picture_of, quantity
from thermorender.apps.studio.view import View
from thermorender.errors import ThermorenderError
from thermorender.render.pixels.parts import PixelParts

_T = TypeVar("_T")
# Longest wait for a job, such as an export behind a long solution.
_ANSWERS_S = 120.0
# Longest wait for the pages to fetch a preview before its solution begins, which would slow them down.
_FETCHED_S = 0.1
# Least time between two reports of progress [s].
REPORTS_S = 0.2
# Pictures of a tab that a hand may still point at while a later one is on its way.
_LAST = 3
# Solutions that are kept to compare with.
_KEPT = 3
# Share of a solution that is its heat balance, where it has one.
_HEAT = 0.9

# Where edits come faster than solutions, which only delay previews then, the next solution waits for such a pause.
PAUSE_S = 1.5


class _Newer(Exception):
    """The solution under way is outdated."""


class _Elsewhere(Exception):
    """A tab no longer needs what is solved for it, or another one has solved it."""


class _Unknown(Exception):
    """An edit has no preview."""


@dataclass
class Seen:
    """What a tab looks at: its view, the scene that it is compared with and what this one is called, and whom to call
    with the picture and with (version, share done) of a solution under way.
    """

    view: View
    reference: tuple[Scene, str] | None
    show: Callable[[Picture], object]
    tell: Callable[[int, float | None], object]


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
    """The thread that renders, and the one that solves beside it; it starts from the Renderer of a scene, `base`."""

    renderer: Renderer
    base: Scene
    light: Light = field(init=False)
    learned: Learned | None = None
    colours: MaterialColours = field(default_factory=MaterialColours)
    _news: threading.Condition = field(default_factory=threading.Condition)
    _edit: tuple[Scene, int] | None = None
    _known: list[tuple[Scene, Renderer]] = field(default_factory=list)
    _tabs: dict[str, Seen] = field(default_factory=dict)
    _waiting: dict[str, None] = field(default_factory=dict)
    _jobs: list[Callable[[], object]] = field(default_factory=list)
    _long: Callable[[], object] | None = None
    _ended: bool = False
    _shown: dict[str, list[tuple[Shot, Picture]]] = field(default_factory=dict)  # of each tab, the latest last
    _fetched: dict[str, Picture] = field(default_factory=dict)
    _solved: Renderer = field(init=False)
    _ready: Renderer | None = None
    _solving: _Solution | None = None
    _found: tuple[_Solution, Renderer | Exception] | None = None
    _solver: threading.Thread | None = None

    def __post_init__(self) -> None:
        self._solved = self.renderer
        self._known.append((self.base, self.renderer))
        self.light = Light(self.renderer, 0, "exact", True)
        # Before a tab asks, so that colours are the same whenever this scene is opened.
        self.colours.numbers([material.name for material in self.base.materials])
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

    def look(
        self, tab: str, view: View, show: Callable[[Picture], object], reference: tuple[Scene, str] | None = None,
        tell: Callable[[int, float | None], object] = lambda version, share: None,
    ) -> None:  # fmt: skip
        """Show a tab its view, beside or minus that of the scene `reference`, which its second member names. `show` and
        `tell`, of (version, share done or None at its end) of a solution, are called from other threads.
        """
        with self._news:
            self._tabs[tab] = Seen(view, reference, show, tell)
            self._waiting[tab] = None
            self._news.notify_all()

    def forget(self, tab: str) -> None:
        """Drop a tab that was closed."""
        with self._news:
            for known in (self._tabs, self._waiting, self._shown, self._fetched):
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
        shot, _ = self.shown(tab)
        if shot is None or shot.frame is None:
            return None
        try:
            return shot.renderer.parts_at(shot.frame.pose, [pixel], shot.frame.time_s)[0]
        except ThermorenderError:
            return None

    def fetch(self, tab: str) -> Picture | None:
        """Return the latest Picture of a tab, for its page."""
        with self._news:
            _, picture = self.shown(tab)
            if picture is not None:
                self._fetched[tab] = picture
                self._news.notify_all()
        return picture

    def shown(self, tab: str, number: int | None = None) -> tuple[Shot | None, Picture | None]:
        """Return the latest Shot of a tab and its Picture, or those with the `number` of a picture; (None, None) where
        there are none any more.
        """
        for shot, picture in reversed(self._shown.get(tab, [])):
            if number is None or picture.number == number:
                return shot, picture
        return None, None

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._asked() or self._unready())
                if self._ended:
                    return
                asked = self._asked()
                edit, self._edit = self._edit, None
                # What a fault is about: the edit or the solution at hand, or what is shown.
                version = edit[1] if edit else self._found[0].version if self._found else self.light.version
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
                self._report(_sentence(error), version)

    def _asked(self) -> bool:
        return bool(self._ended or self._edit or self._found or self._waiting or self._jobs or self._long)

    def _unready(self) -> bool:
        return bool(self._shown) and self._ready is not self.light.renderer

    def _all_fetched(self) -> bool:
        return all(self._fetched.get(tab) is shown[-1][1] for tab, shown in self._shown.items())

    def _report(self, sentence: str, version: int) -> None:
        for seen in list(self._tabs.values()):
            try:
                seen.show(Picture.of_fault(sentence, version))
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
            self._guarded(partial(self._take, *found), found[0].version)

    def _tell(self, version: int, share: float | None) -> None:
        for seen in list(self._tabs.values()):
            seen.tell(version, share)

    def _progress(self, version: int, scene: Scene) -> Callable[[str, float], None]:
        """A function of (what, share) that tells the tabs the share of a solution that is done, which never falls."""
        heat = not scene.temperature_state.solved
        done, at = 0.0, 0.0

        def report(what: str, share: float) -> None:
            nonlocal done, at
            part = share if not heat else _HEAT * share if "heat balance" in what else _HEAT + (1.0 - _HEAT) * share
            done = max(done, part)
            if time.monotonic() - at > REPORTS_S:
                at = time.monotonic()
                self._tell(version, done)

        return report

    def _edited(self, scene: Scene, version: int) -> None:
        """Show the preview of an edit, if it has one, and begin its solution."""
        self._tell(version, 0.0)
        with self._news:
            # The one under way is outdated, and ends at its next step.
            hurried, self._solving = self._solving is not None, (solution := _Solution(scene, version))
            self._news.notify_all()
        made = self._preview(scene)
        if made is not None:
            errors = made.baked.errors_mk
            rms, most = (quantity(1e-3 * errors[name], "K") for name in ("preview_rms", "preview"))
            words = f"preview ± {rms} RMS, {most} at most"
            self._show(Light(made, version, words, False))
            with self._news:
                self._news.wait_for(lambda: self._asked() or self._all_fetched(), _FETCHED_S)
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
        report = self._progress(solution.version, solution.scene)

        def refuse_outdated() -> None:
            if self._solving is not solution or self._ended:
                raise _Newer

        def under_way(what: str, share: float) -> None:
            refuse_outdated()
            report(what, share)

        with self._news:
            self._news.wait_for(lambda: self._solving is not solution or self._ended, pause_s)
        if before is not None:
            before.join()
        found: Renderer | Exception
        try:
            refuse_outdated()
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
        self._tell(solution.version, None)
        if isinstance(found, Exception):
            raise found
        self._solved = found
        self._keep(solution.scene, found)
        self._show(Light(found, solution.version, "exact", True))

    def _exact(self, scene: Scene, start: Renderer, progress: Callable[[str, float], object]) -> Renderer:
        """The Renderer of a scene, solved from an earlier solution."""
        if scene.temperature_state.solved:
            return start.solved_for(scene, progress)
        settings = start.plan.sampling.settings()
        made = Renderer(scene, **settings, seed=self.renderer.seed, progress=progress, like=start, edits=True)
        _ = made.baked
        return made

    def _keep(self, scene: Scene, found: Renderer) -> None:
        with self._news:
            self._known = [*(each for each in self._known if each[0] is not scene), (scene, found)][-_KEPT:]

    def _reference(self, tab: str, seen: Seen, scene: Scene) -> Renderer:
        """The Renderer of a scene that a tab is compared with; it is solved unless it is known."""
        found = next((known for of, known in self._known if of is scene), None)
        if found is not None:
            return found
        report = self._progress(self.light.version, scene)

        def under_way(what: str, share: float) -> None:
            self._between(what, share)
            # The tab may look elsewhere meanwhile, or another one may have needed the same solution.
            if self._tabs.get(tab) is not seen or any(of is scene for of, _ in self._known):
                raise _Elsewhere
            report(what, share)

        found = self._exact(scene, self._solved, under_way)
        self._tell(self.light.version, None)
        self._keep(scene, found)
        return found

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

    def _guarded(self, job: Callable[[], object], version: int | None = None) -> None:
        """Call a function whose fault must not end a solution under way."""
        try:
            job()
        except _Newer:
            raise
        except Exception as error:
            self._report(_sentence(error), self.light.version if version is None else version)

    def _show_in(self, tab: str, seen: Seen) -> None:
        if LAYERS[seen.view.layer].terms and not self.light.exact:
            return  # A preview has no terms of the heat balance; the exact solution is under way.
        made: tuple[Shot, Picture] | None = None
        try:
            made = self._made(tab, seen)
            told = made[1]
        except _Elsewhere:
            with self._news:
                if self._tabs.get(tab) is seen:
                    self._waiting[tab] = None
            return
        except ThermorenderError as error:
            told = Picture.of_fault(str(error), self.light.version)
        with self._news:
            # During a solution that this view needed, the tab may have been shown a later one, or closed.
            if self._tabs.get(tab) is not seen and tab not in self._waiting:
                return
            if made is not None:
                self._shown[tab] = [*self._shown.get(tab, []), made][-_LAST:]
        seen.show(told)

    def _made(self, tab: str, seen: Seen) -> tuple[Shot, Picture]:
        light, (last, before) = self.light, self.shown(tab)
        like = None
        if last is not None and before is not None and before.version == light.version:
            # The exact frame after a preview has the rays of the preview, so that they differ by their light alone.
            like = last if last.view.place == seen.view.place else None
        shot = self._shot(light.renderer, seen.view, like)
        what = ""
        if seen.reference is not None:
            of, what = seen.reference
            shot.other = self._shot(self._reference(tab, seen, of), seen.view, shot)
        number = before.number + 1 if before else 1
        blank = Picture(number, light.version, light.words, light.exact, seen.view)
        return shot, picture_of(shot, what, blank, self.colours)

    def _shot(self, renderer: Renderer, view: View, like: Shot | None) -> Shot:
        """The Shot of a view; it has the rays of `like`, which has the same place."""
        if view.plan:
            plan = like.plan if like is not None else None
            return Shot(view, renderer, None, plan or Plan.of(renderer, view, renderer.scene.camera), self.learned)
        sampled = like.frame if like is not None else None
        frame = renderer.frame(view.pose.matrix(), view.time_s, sampled_as=sampled)
        return Shot(view, renderer, frame, None, self.learned)


def _sentence(error: Exception) -> str:
    """What a page says about a fault; the terminal shows where one of the studio itself was."""
    if isinstance(error, ThermorenderError):
        return str(error)
    traceback.print_exception(error)
    return f"the studio failed here ({type(error).__name__}), its terminal says where; undo the edit"
