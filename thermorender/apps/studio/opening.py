"""The scene that a studio has open, one at a time, and the work in the background that opens, imports or makes one."""

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from thermorender import Renderer, load_scene
from thermorender.apps.studio.forms import Texts, imported, made
from thermorender.apps.studio.scene_files import SceneFiles
from thermorender.apps.studio.scene_list import Listed, remember
from thermorender.apps.studio.session import Session
from thermorender.apps.studio.view import Pose
from thermorender.cli.process import sentence
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress
from thermorender.render.tiled.tiled_renderer import give_memory_back

# Longest waits: for tabs to leave a scene that is closed, and for the work under way to end with the studio [s].
_LEAVES_S, _ENDS_S = 2.0, 10.0
_FORMS = {"import": imported, "practice": made}


class _Cancelled(Exception):
    """The work under way was cancelled."""


@dataclass(eq=False)
class Work:
    """Work in the background, and how it ended."""

    title: str
    part: str  # Of the start page, where it began and its fault is shown
    what: str = "reading the scene"
    share: float = 0.0
    fault: str = ""  # The sentence of why it failed
    cancelled: bool = False
    ended: bool = False

    def report(self, what: str, share: float) -> None:
        """Take note of what is done; raise to end the work where it was cancelled."""
        if self.cancelled:
            raise _Cancelled
        self.what, self.share = what, share


@dataclass(eq=False)
class Studio:
    """The scene that is open, and the work under way. Another scene closes the one before for all tabs."""

    quality: str
    device: str
    session: Session | None = None
    pose: str = ""  # Of the first view
    work: Work | None = None  # The latest
    listed: dict[str, Listed] = field(default_factory=dict)  # Scenes of the start page by folder
    told: str = ""  # Why the scene before was closed
    notes: list[str] = field(default_factory=list)  # On the scene that is open
    # Sends the tabs of a scene that is closed to the start page.
    leave: Callable[[], object] = lambda: None
    # The version of the scene that is open, whose unsaved edits the user has agreed to lose.
    _agreed: int | None = None
    _beginning: threading.Lock = field(default_factory=threading.Lock)
    _thread: threading.Thread | None = None

    @property
    def busy(self) -> Work | None:
        """The work under way."""
        return self.work if self.work and not self.work.ended else None

    def begin_opening(self, folder: Path, part: str) -> None:
        """Open a scene in the background; ThermorenderError where other work is under way."""
        self._begin(Work(f"Opening {folder.name}", part), partial(self.open, folder))

    def begin_form(self, part: str, texts: Texts) -> None:
        """Import or make a scene in the background, and open it."""

        def work(progress: Progress) -> None:
            folder, notes = _FORMS[part](texts, progress)
            self.open(folder, progress)
            self.notes += notes

        self._begin(Work({"import": "Importing", "practice": "Making"}[part] + " a scene", part, "reading"), work)

    def _begin(self, work: Work, does: Callable[[Progress], object]) -> None:
        with self._beginning:
            if self.busy:
                raise ThermorenderError(f"{self.busy.title} is under way; wait until it ends, or cancel it")
            self.work, self._agreed = work, self.session.history.version if self.session else None
            self._thread = threading.Thread(target=self._run, args=(work, does), name="studio opens", daemon=True)
            self._thread.start()

    def _run(self, work: Work, does: Callable[[Progress], object]) -> None:
        try:
            does(work.report)
            # Else it was cancelled after its last step.
            work.cancelled = False
        except _Cancelled:
            pass
        except (ThermorenderError, OSError, MemoryError) as error:
            work.fault = sentence(error)
        except Exception as error:  # The page shows it, and the studio goes on.
            traceback.print_exception(error)
            work.fault = f"the studio failed here ({type(error).__name__}), its terminal says where; open another scene"
        finally:
            work.ended = True

    def cancel(self) -> None:
        """End the work under way at its next step."""
        if self.busy:
            self.busy.cancelled = True

    def open(self, name: str | Path, progress: Progress, pose: str = "") -> None:
        """Open a scene, whose first view is at `pose`, in place of the one before.

        That one is closed when the files of the new one are read, so that their light is not in memory together.
        """
        progress("reading the scene", 0.0)
        scene = load_scene(name)
        scene.refuse_tiles("the studio")
        # Before the light is traced, which takes seconds in which a file may change.
        files = SceneFiles(scene)
        if pose:
            Pose.typed(pose, scene, "pose")
        progress("reading the scene", 1.0)
        self._refuse_edited(scene.name)
        self._close(f"is closed, as {scene.name} was opened in its place")
        renderer = Renderer(scene, self.quality, device=self.device, progress=progress, edits=True)  # type: ignore[arg-type]
        note = renderer.cache_note
        session = Session(renderer, self.quality, files)
        session.renders.start()
        notes = note, remember(scene.spec.folder)
        self.pose, self.notes, self.session = pose, [each for each in notes if each], session

    def _refuse_edited(self, name: str) -> None:
        """Raise where the scene that is open was edited after the user agreed to open another one, `name`."""
        session = self.session
        if session is not None and session.unsaved and session.history.version != self._agreed:
            raise ThermorenderError(
                f"{session.base.name} was edited meanwhile and is not saved, so it stays open; save it, and open "
                f"{name} again"
            )

    def _close(self, why: str) -> None:
        session, self.session = self.session, None
        if session is None:
            return
        self.told = f"{session.base.name} {why}"
        self.leave()
        # Tabs hold what they show.
        end = time.monotonic() + _LEAVES_S
        while session.tabs and time.monotonic() < end:
            time.sleep(0.05)
        session.close()
        del session
        give_memory_back()

    def end(self) -> None:
        """End the work under way, rendering and training."""
        self.cancel()
        if self._thread is not None:
            self._thread.join(_ENDS_S)
        if self.session is not None:
            self.session.close()
