"""Time from an edit in the studio's page to the new picture in the browser, memory, and CPU time while idle.

Run it as `python -m validation.edits.browser SCENE…`. It needs the extra `studio`, playwright and Chromium.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermorender import formats
from thermorender.apps.compare.machine import machine
from thermorender.versions import versions
from validation.command import Out, conclude, continued_results, run_command

HEADER = ("scene", "quality", "edit", "edits", "picture [ms]", "95 %", "exact [ms]", "95 %", "accepted", "memory [MB]",
          "idle CPU")  # fmt: skip
# The first edits compile kernels and do not count.
_FIRST, _IDLE_S, _WAIT_MS, _QUIET_MS = 4, 10.0, 60_000, 3000
# Every so many edits, the time to the exact picture is measured too; no divisor in common with the kinds.
_EXACT_EVERY = 7
# Kept by the page: performance.now() when a picture is in place, by its version, and at the last click.
_CLOCK = """
addEventListener('studio-shown', e => (window.shown ??= {})[e.detail.version] ??= performance.now());
window.exact = () =>
  document.getElementById('state').textContent === 'exact' && studio.picture.version === studio.latest;
addEventListener('click', () => (window.clicked = performance.now()), true);
"""
_SEND = "([name, value]) => { const at = performance.now(); emitEvent(name, value); return at; }"
_SHOWN = "before => studio.latest !== before && (window.shown ?? {})[studio.latest]"
_HANDLE = "{wavelength: 10.0, value: %.4f, version: studio.version}"


@contextmanager
def studio(scene, quality):
    """Serve a scene; yield (process number, address)."""
    command = [sys.executable, "-m", "thermorender", "studio", scene, "--port", "0", "--quality", quality]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.pid, re.search(r"open (\S+)", process.stdout.readline())[1]
        finally:
            process.terminate()
            process.wait(30)


def memory_mb(number):
    """Return the resident memory of a process [MB]."""
    return int(re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{number}/status").read_text("utf-8"))[1]) / 1024.0


def cpu_s(number):
    """Return the CPU time of a process [s]."""
    fields = Path(f"/proc/{number}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


class Hand:
    """Edits of a page, each with the time to its picture."""

    def __init__(self, page, seed):
        self.page, self.random = page, np.random.default_rng(seed)

    def choose(self):
        """Choose a material that covers a part of the ground, drawn at random."""
        rows = self.page.locator("tr[data-name]").filter(has_text="%")
        name = str(self.random.choice(rows.evaluate_all("rows => rows.map(row => row.dataset.name)")))
        self.page.locator(f'tr[data-name="{name}"]').click()
        self.page.get_by_test_id("title").filter(has_text=name).wait_for(timeout=_WAIT_MS)

    def emissivity(self):
        """Type an emissivity; the time begins with Enter."""
        return self.typed("field-emissivity", f"{self.random.uniform(0.8, 0.99):.4f}")

    def spectrum(self):
        """Release a point of the spectrum."""
        value = _HANDLE % self.random.uniform(0.8, 0.99)
        return self.page.evaluate(f"() => ({_SEND})(['studio_spectrum', {value}])")

    def absorptance(self):
        """Type a solar absorptance, by which the heat balance changes."""
        return self.typed("field-solar_absorptance", f"{self.random.uniform(0.3, 0.95):.4f}")

    def material(self):
        """Choose another material of a class."""
        given = self.page.locator('[data-testid^="class-"]').first
        name = "snow" if given.input_value() != "snow" else "grass_dry"
        given.fill(name)
        option = self.page.get_by_role("option", name=name, exact=True)
        option.wait_for(timeout=_WAIT_MS)
        option.click()
        return self.page.evaluate("clicked")

    def temperature(self):
        """Type the temperature of an object."""
        return self.typed(self.stated()[0], f"{self.random.uniform(280.0, 320.0):.3f}")

    def stated(self):
        """Return the fields of objects with a stated temperature."""
        fields = self.page.locator('[data-testid^="kelvin-"]')
        shown = fields.evaluate_all("all => all.map((one) => [one.dataset.testid, one.value])")
        return [test for test, value in shown if value != "balance"]

    def typed(self, test, text):
        """Type into a field; return the time of Enter."""
        given = self.page.get_by_test_id(test)
        given.fill(text)
        at = self.page.evaluate("performance.now()")
        given.press("Enter")
        return at

    def exact(self):
        """Wait until the picture is exact."""
        self.page.wait_for_function("exact()", timeout=_WAIT_MS)

    def last_version(self):
        """Wait until no further edit arrives, and return the version."""
        found = None
        while found != (found := self.page.evaluate("studio.version")):
            self.page.wait_for_timeout(_QUIET_MS)
        return found

    def time_ms(self, kind, pause_s, exact):
        """Return the times from an edit to its first picture and, with `exact`, to the exact one [ms].

        The pause lies between what a hand chooses and what it edits there. The time to an exact picture begins from an
        exact one: after quick edits, the studio waits for a pause.
        """
        if exact:
            self.exact()
        optical = kind in ("emissivity", "spectrum", "absorptance")
        if optical:
            self.choose()
        tab = "Optical" if optical else "Cover"
        self.page.get_by_role("tab", name=tab).click()
        self.page.wait_for_timeout(1000.0 * self.random.uniform(0.5, 1.5) * pause_s)
        before = self.page.evaluate("studio.latest")
        at = getattr(self, kind)()
        self.page.wait_for_function(_SHOWN, arg=before, timeout=_WAIT_MS)
        found = [self.page.evaluate(_SHOWN, before) - at]
        if exact:
            self.exact()
            found.append(self.page.evaluate("performance.now()") - at)
        return found


def measured(browser, scene, quality, edits, pause_s, many, limit_s, seed):
    """Return the figures of a scene: times by kind [ms], memory [MB] before and after many edits, idle CPU [1]."""
    with studio(scene, quality) as (number, address):
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(_CLOCK)
        page.goto(address)
        page.wait_for_selector("#frame[data-number]", timeout=_WAIT_MS)
        hand, end = Hand(page, seed), time.monotonic() + limit_s
        kinds = ["emissivity", "spectrum"]
        if page.get_by_test_id("hour").count():
            kinds = ["emissivity", "absorptance"]
        page.get_by_role("tab", name="Cover").click()
        page.wait_for_timeout(500)
        kinds += ["material"] * (page.locator('[data-testid^="class-"]').count() > 0)
        kinds += ["temperature"] * bool(hand.stated())
        times = {kind: [] for kind in kinds}
        for count in range(_FIRST + edits):
            if time.monotonic() > end - 0.4 * limit_s:
                break
            kind = kinds[count % len(kinds)]
            spent = hand.time_ms(kind, pause_s, count < _FIRST or count % _EXACT_EVERY == 0)
            if count >= _FIRST:
                times[kind].append(spent)
        before, first, made = memory_mb(number), page.evaluate("studio.version"), 0
        page.get_by_role("tab", name="Optical").click()
        while made < many and time.monotonic() < end - 1.5 * _IDLE_S:
            made += 1
            # Each value is another one, so that each is an edit.
            hand.typed("field-emissivity", f"{0.8 + 0.0001 * made:.4f}")
        accepted = hand.last_version() - first
        hand.exact()
        after, spent = memory_mb(number), cpu_s(number)
        time.sleep(_IDLE_S)
        idle = (cpu_s(number) - spent) / _IDLE_S
        page.close()
    return {
        "scene": scene, "quality": quality, "pause_s": pause_s,
        "kinds": {kind: {"edits": len(each), "picture_ms": _centre([one[0] for one in each]),
                         "exact_ms": _centre([one[1] for one in each if len(one) > 1])}
                  for kind, each in {**times, "all": [one for each in times.values() for one in each]}.items()},
        "typed": made, "accepted": accepted, "memory_mb": [round(before), round(after)],
        "idle_cpu": round(idle, 4),
    }  # fmt: skip


def _centre(times):
    if not times:
        return {}
    return {"median": round(float(np.median(times)), 1), "percentile_95": round(float(np.quantile(times, 0.95)), 1)}


def rows(result):
    """Return the result as table rows under HEADER."""
    found = []
    for case in result["cases"]:
        for kind, each in case["kinds"].items():
            found.append((case["scene"], case["quality"], kind, each["edits"],
                          *(f"{each[of][share]:.0f}" if each[of] else "" for of in ("picture_ms", "exact_ms")
                            for share in ("median", "percentile_95")), "", "", ""))  # fmt: skip
        memory = " → ".join(map(str, case["memory_mb"]))
        found.append((case["scene"], case["quality"], "typed in succession", case["typed"], "", "", "", "",
                      case["accepted"], memory, f"{case['idle_cpu']:.1%}"))  # fmt: skip
    return found


def main(
    scenes: Annotated[list[str], typer.Argument(help="Scenes, such as heath and village.")],
    output: Out = Path("out/validation/edits"),
    quality: Annotated[str, typer.Option(help="Quality of the renderer.")] = "fast",
    edits: Annotated[int, typer.Option(help="Timed edits of all kinds together.", min=4)] = 100,
    pause_s: Annotated[float, typer.Option(help="Mean pause before an edit [s], half to one and a half of it.")] = 1.0,
    many: Annotated[int, typer.Option(help="Quick edits before memory is read again.", min=0)] = 1000,
    limit_s: Annotated[
        float, typer.Option(help="Longest time for a scene after it opened [s]; fewer edits are made then.")
    ] = 150.0,
    seed: Annotated[int, typer.Option(help="Seed of the edits.", min=0)] = 0,
):
    """Measure the studio's page in a headless Chromium."""
    from playwright.sync_api import sync_playwright

    with continued_results(output) as report, sync_playwright() as started:
        arguments, cases = ["--headless", "--no-sandbox", "--disable-gpu"], []
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        for number, scene in enumerate(scenes):
            report(scene, number / len(scenes))
            cases.append(measured(browser, scene, quality, edits, pause_s, many, limit_s, seed))
        browser.close()
        load = os.getloadavg()[0]
        result = {"cases": cases, "seed": seed, "load": load, "machine": machine(), "versions": versions()}
        formats.write_json(output / "browser.json", result)
    conclude("browser", output, HEADER, rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
