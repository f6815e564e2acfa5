"""Draw the pictures of the studio's guide: docs/figures/studio-1280.png and studio-1920.png.

`python docs/studio_pictures.py SCENE` opens a scene in a headless Chromium. It needs playwright and Chromium.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

FIGURES = Path(__file__).with_name("figures")
ARGUMENTS = ["--headless", "--no-sandbox", "--disable-gpu"]
WAIT_MS = 120_000
# A rubber roof of the village is then at the clicked place.
POSE = "0,-96,96,0,-45,0"
# {size: share of the picture's width and height that is clicked}
SIZES = {(1280, 800): (0.40, 0.60), (1920, 1080): (0.40, 0.60)}


def draw(page, address, place):
    """Click a roof, edit its emissivity, and show the difference."""
    page.goto(address)
    page.wait_for_selector("#frame[data-number]", timeout=WAIT_MS)
    box = page.get_by_test_id("frame").bounding_box()
    page.mouse.click(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])
    name = page.locator('[data-key="Material"]').inner_text(timeout=WAIT_MS)
    page.locator(f'tr[data-name="{name}"]').click()
    page.get_by_test_id("title").filter(has_text=name).wait_for(timeout=WAIT_MS)


def main(scene):
    """Draw both sizes."""
    command = [sys.executable, "-m", "thermorender", "studio", scene, "--port", "0", f"--pose={POSE}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, sync_playwright() as started:
        address = re.search(r"open (\S+)", server.stdout.readline())[1]
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        for (width, height), place in SIZES.items():
            page = browser.new_page(viewport={"width": width, "height": height})
            draw(page, address, place)
            if width == 1920:
                page.get_by_test_id("field-emissivity").fill("0.85")
                page.get_by_test_id("field-emissivity").press("Enter")
                page.wait_for_selector('#frame[data-version="1"]', timeout=WAIT_MS)
                page.get_by_test_id("state").filter(has_text="exact").wait_for(timeout=WAIT_MS)
                page.get_by_test_id("mode").click()
                page.get_by_text("Difference to saved").click()
                page.get_by_test_id("notes").filter(has_text="mean").wait_for(timeout=WAIT_MS)
            page.mouse.move(5, height - 5)
            page.wait_for_timeout(2500)
            page.screenshot(path=FIGURES / f"studio-{width}.png")
        browser.close()
        server.terminate()


if __name__ == "__main__":
    main(*sys.argv[1:] or ["village"])
