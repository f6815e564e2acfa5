"""Time in the page: along the scene's flight, and the hour of temperatures that follow the weather."""

import asyncio
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from thermorender import load_trajectory
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.panels import draw
from thermorender.apps.studio.renders import REPORTS_S
from thermorender.apps.studio.session import clock
from thermorender.apps.studio.spectrum import COLOURS, chart
from thermorender.apps.studio.view import Pose
from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab
    from thermorender.apps.studio.stage import Stage

# Steps of playing a flight: time between pictures at most this often [s].
_STEP_S = 0.2
_STEP_MIN = 60
# Lines of points, as of CSS; numbers are lengths of dashes and gaps [px].
_DASHES: tuple[Any, ...] = ("dashed", [10, 4], [2, 4], [10, 4, 2, 4], [16, 4], [2, 8])


@dataclass(frozen=True)
class _Curves:
    """Temperatures over a day."""

    rows: list[dict[str, Any]]  # of `day_temperatures`, and of points by their names
    points: tuple[str, ...]
    version: int  # of the edits


class Timeline:
    """Sliders along the flight and over the day, where the scene has them."""

    def __init__(self, tab: "Tab", stage: "Stage") -> None:
        self._tab, self._stage, self._session = tab, stage, tab.session
        self._playing = False
        self._curves: _Curves | None = None
        base = self._session.base
        own = base.spec.folder / "flight.csv"
        self._flight = None
        if own.is_file():
            try:
                self._flight = load_trajectory(own, base)
            except ThermorenderError as error:
                tab.say(str(error), "warning")
        self._box = ui.element("div").classes("tools").style("padding-top:0;padding-bottom:4px;border:0")
        self._chart = ui.echart({"series": []}).style("height:240px;width:100%")
        self._chart.set_visibility(False)
        with self._box:
            if self._flight is not None:
                start, stop = self._flight.span_s
                ui.label("Flight").classes("soft")
                self._slider = ui.slider(min=start, max=stop, step=0.1, value=start)
                self._slider.props('aria-label="Time of the flight [s]" data-testid="flight"').style("flex:1")
                self._slider.on("update:model-value", lambda e: self.fly(float(e.args)), throttle=0.1)
                self._clock = ui.label(f"{start:.1f} s").classes("soft").style("width:56px")
                self._play = ui.button(icon="play_arrow", on_click=self._toggle)
                self._play.props('flat dense round aria-label="Play the flight" data-testid="play"')
            if base.temperature_state.weather_driven:
                self._hours(base)
            else:
                ui.label("The temperatures of this scene do not follow the hour.").classes("soft")

    def fly(self, time_s: float) -> None:
        """Show the view of the flight at a time [s]."""
        assert self._flight is not None
        self._clock.set_text(f"{time_s:.1f} s")
        self._stage.turn_to(Pose.seen(self._flight.pose(time_s), self._session.base), time_s)

    async def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.props(f"icon={'pause' if self._playing else 'play_arrow'}")
        assert self._flight is not None
        stop = self._flight.span_s[1]
        while self._playing and not self._tab.closed:
            time_s = min(float(self._slider.value) + _STEP_S, stop)
            number = self._stage.shown
            self._slider.set_value(time_s)
            self.fly(time_s)
            # The next picture only after this one, so that playing never queues.
            while self._playing and self._stage.shown == number and not self._tab.closed:
                await asyncio.sleep(_STEP_S / 4.0)
            if time_s >= stop:
                self._playing = False
                self._play.props("icon=play_arrow")

    # The hour.

    def _hours(self, base: Any) -> None:
        ui.label("Solar hour").classes("soft")
        self._hour = ui.slider(min=0.0, max=24.0, step=0.25, value=12.0)
        self._hour.props('aria-label="Solar hour" data-testid="hour"').style("flex:1")
        self._hour_words = ui.label().classes("soft").style("width:44px").props('data-testid="hour-words"')
        self._hour.on("update:model-value", lambda e: self._hour_words.set_text(clock(float(e.args))))
        self._hour.on("change", self._at, js_handler="(value) => studio.held(emit, value)")
        ui.button("Day's curve", on_click=self._day).props('flat dense data-testid="day"')
        self._day_words = ui.label("").classes("soft").props('data-testid="day-words"')

    def refresh(self) -> None:
        """Show the hour of the edits."""
        if self._session.base.temperature_state.weather_driven:
            # The slider has quarters of an hour, and the words any minute.
            hour = self._session.hour_of(self._session.document)
            self._hour.set_value(round(4.0 * hour) / 4.0)
            self._hour_words.set_text(clock(hour))
            self._say_day()

    def _at(self, event: Any) -> None:
        time = self._session.at_hour(float(event.args[0]))

        def change(document: Document) -> Document:
            return document if document.time == time else replace(document, time=time)

        self._tab.edit(int(event.args[1]), f"solar hour {clock(float(event.args[0]))}", change)

    def _day(self) -> None:
        """Compute a day of the kept points and of each material in the background, and draw it."""
        from thermorender.output.day import day_temperatures

        session, scene, version = self._session, self._session.scene, self._session.history.version
        points = [(f"point {point.name}", point.texel) for point in session.points if point.texel >= 0]
        picked = self._stage.picked_texel()
        if picked is not None and all(texel != picked for _, texel in points):
            points.append(("picked point", picked))
        names = tuple(name for name, _ in points)
        drawn, going = self._tab.later(self._drawn), self._tab.later(self._going)
        self._going("waiting for the solution under way")

        def job(between: Any) -> None:
            said = 0.0

            def progress(what: str, share: float) -> None:
                nonlocal said
                between(what, share)
                if time.monotonic() - said > REPORTS_S:
                    said = time.monotonic()
                    going(f"{what}: {share:.0%}")

            rows: list[dict[str, Any]] = []
            ended = "ended by an edit or by another day"
            try:
                for solved, row in day_temperatures(scene, _STEP_MIN, progress):
                    kelvin = np.concatenate([surface.temperature.ravel() for surface in solved.surfaces])
                    rows.append({**row, **{name: float(kelvin[texel]) for name, texel in points}})
                    drawn(_Curves(list(rows), names, version), "")
                ended = ""
            except ThermorenderError as error:
                ended = ""
                drawn(None, str(error))
            finally:
                going(ended)

        session.renders.later(job)

    def follow(self, time_s: float) -> None:
        """Let the slider of the flight show the time of a view [s]."""
        if self._flight is not None and float(self._slider.value) != time_s:
            start, stop = self._flight.span_s
            self._slider.set_value(min(max(time_s, start), stop))
            self._clock.set_text(f"{time_s:.1f} s")

    def _going(self, words: str) -> None:
        """Say how far the day under way is; "" where none is."""
        if words:
            self._day_words.set_text(words)
        else:
            self._say_day()

    def _drawn(self, curves: "_Curves | None", fault: str) -> None:
        if fault:
            self._tab.say(fault)
        if curves is not None:
            self._curves = curves
            self._say_day()
            self.redraw()

    def _say_day(self) -> None:
        """Say which version the curves are of."""
        curves = self._curves
        if curves is None:
            self._day_words.set_text("")
            return
        old = ", before the edit" if curves.version != self._session.history.version else ""
        part = "" if len(curves.rows) == 1440 // _STEP_MIN else f", {len(curves.rows)} of {1440 // _STEP_MIN} hours"
        self._day_words.set_text(f"of version {curves.version}{old}{part}")

    def redraw(self) -> None:
        """Draw the curves of the day, if there are some."""
        if self._curves is None:
            return
        rows, points = self._curves.rows, self._curves.points
        ink = COLOURS[self._tab.dark]["ink"]
        # (words, key of a row, colour, line); materials in the colours that they have in the list and in pictures.
        lines = [(name, name, ink, _DASHES[k % len(_DASHES)]) for k, name in enumerate(points)]
        lines += [("air", "air_k", COLOURS[self._tab.dark]["soft"], "dotted")]
        for key in rows[0]:
            if key.endswith("_mean_k"):
                name = key.removesuffix("_mean_k")
                lines.append((name, key, self._session.renders.colours.of(name), "solid"))
        series = [
            {"type": "line", "name": name, "showSymbol": False, "color": colour,
             "lineStyle": {"type": line, "color": colour},
             "data": [[row["solar_hour"], round(row[key], 2)] for row in rows if key in row]}
            for name, key, colour, line in lines
        ]  # fmt: skip
        x = {"min": 0, "max": 24, "interval": 3, "name": "solar hour"}
        y = {"scale": True, "name": "kinetic temperature [K]", "nameLocation": "middle", "nameGap": 38}
        legend = {"type": "scroll", "top": 0, "textStyle": {"fontSize": 11, "color": ink}}
        draw(
            self._chart,
            chart(x, y, series, top=28, dark=self._tab.dark) | {"tooltip": {"trigger": "axis"}, "legend": legend},
        )
        self._chart.set_visibility(True)
