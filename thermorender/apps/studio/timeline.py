"""Time in the page: along the scene's flight, and the hour of temperatures that follow the weather."""

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from thermorender import load_trajectory
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.panels import VALUE_AND_VERSION, draw
from thermorender.apps.studio.spectrum import chart
from thermorender.apps.studio.view import Pose
from thermorender.errors import ThermorenderError
from thermorender.units import utc_text

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# Steps of playing a flight: time between pictures at most this often [s].
_STEP_S = 0.2
_STEP_MIN = 60


class Timeline:
    """Sliders along the flight and over the day, where the scene has them."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        self._playing = False
        base = self._session.base
        own = base.spec.folder / "flight.csv"
        self._flight = None
        if own.is_file():
            try:
                self._flight = load_trajectory(own, base)
            except ThermorenderError as error:
                tab.say(str(error), "warning")
        self._box = ui.element("div").classes("tools").style("padding-top:0;padding-bottom:4px;border:0")
        self._chart = ui.echart({"series": []}).style("height:180px;width:100%")
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
        self._box.set_visibility(self._flight is not None or base.temperature_state.weather_driven)

    def fly(self, time_s: float) -> None:
        """Show the view of the flight at a time [s]."""
        assert self._flight is not None
        self._clock.set_text(f"{time_s:.1f} s")
        self._tab.turn_to(Pose.seen(self._flight.pose(time_s), self._session.base), time_s)

    async def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.props(f"icon={'pause' if self._playing else 'play_arrow'}")
        assert self._flight is not None
        stop = self._flight.span_s[1]
        while self._playing and not self._tab.closed:
            time_s = min(float(self._slider.value) + _STEP_S, stop)
            number = self._tab.shown
            self._slider.set_value(time_s)
            self.fly(time_s)
            # The next picture only after this one, so that playing never queues.
            while self._playing and self._tab.shown == number and not self._tab.closed:
                await asyncio.sleep(_STEP_S / 4.0)
            if time_s >= stop:
                self._playing = False
                self._play.props("icon=play_arrow")

    # The hour.

    def _hours(self, base: Any) -> None:
        from thermorender.output.day import solar_midnight

        self._midnight = solar_midnight(base.time, base.weather.longitude_deg)
        hour = float((base.time - self._midnight) / np.timedelta64(3600, "s"))
        ui.label("Solar hour").classes("soft")
        slider = ui.slider(min=0.0, max=24.0, step=0.25, value=round(4.0 * hour) / 4.0)
        slider.props('label aria-label="Solar hour" data-testid="hour"').style("flex:1")
        slider.on("change", self._at, js_handler=VALUE_AND_VERSION)
        ui.button("Day's curve", on_click=self._day).props('flat dense data-testid="day"')

    def _at(self, event: Any) -> None:
        time = self._midnight + np.timedelta64(round(3600.0 * float(event.args[0])), "s")

        def change(document: Document) -> Document:
            return replace(document, time=time)

        self._tab.edit(int(event.args[1]), f"time {utc_text(time)}", change)

    def _day(self) -> None:
        """Compute a day of the clicked pixel and of each material in the background, and draw it."""
        from thermorender.output.day import day_frames

        session, pixel, pose = self._session, self._tab.pixel, self._tab.view.pose.matrix()
        sampling, scene = session.renders.renderer.plan.sampling, session.scene
        show = self._tab.later(self._drawn)
        self._tab.say("The day is computed in the background; the curve appears below the picture.", "info")

        def job(progress: Any) -> None:
            rows: list[dict[str, Any]] = []
            settings: dict[str, Any] = {"samples": sampling.samples, "taps": sampling.taps, "rays": sampling.rays}
            try:
                for frame, row in day_frames(scene, pose, _STEP_MIN, progress, **settings):
                    own = {} if pixel is None else {"pixel": float(frame.apparent_temperature[pixel[1], pixel[0]])}
                    rows.append({**row, **own})
                    show(list(rows), "")
            except ThermorenderError as error:
                show(rows, str(error))

        session.renders.later(job)

    def _drawn(self, rows: list[dict[str, Any]], fault: str) -> None:
        if fault:
            self._tab.say(fault)
        if not rows:
            return
        names = [key for key in rows[0] if key.endswith("_mean_k") and key != "apparent_mean_k"]
        curves = {"clicked pixel, apparent": "pixel"} if "pixel" in rows[0] else {}
        curves |= {"air": "air_k"} | {name.removesuffix("_mean_k"): name for name in names}
        series = [
            {"type": "line", "name": name, "showSymbol": False,
             "data": [[row["solar_hour"], round(row[key], 2)] for row in rows if key in row]}
            for name, key in curves.items()
        ]  # fmt: skip
        x, y = {"min": 0, "max": 24, "interval": 3, "name": "solar hour"}, {"scale": True, "name": "K"}
        legend = {"type": "scroll", "top": 0, "textStyle": {"fontSize": 11}}
        draw(self._chart, chart(x, y, series, top=28) | {"tooltip": {"trigger": "axis"}, "legend": legend})
        self._chart.set_visibility(True)
