"""What the studio says of a picture belongs to the picture that is shown, whatever the network does."""

import re

import numpy as np
import pytest
from studio_support import POSE, Page, served, wait_for

import thermorender as tr
from scenes import WEATHER, write_balance, write_terrain
from thermorender.apps.studio.session import Session
from thermorender.apps.studio.view import Pose, View

PLACE = 200, 250
LOW, HIGH = 270.0, 310.0
# Each frame of the browser: the grey of the pixel in the middle of the grass, and what is said of the picture.
WATCH = """([column, row]) => {
    window.seen = [];
    const canvas = document.createElement("canvas"), pen = canvas.getContext("2d", {willReadFrequently: true});
    const look = () => {
        const image = document.getElementById("frame");
        if (image.complete && image.naturalWidth) {
            canvas.width = image.naturalWidth;
            canvas.height = image.naturalHeight;
            pen.drawImage(image, 0, 0);
            const card = document.getElementById("figures");
            seen.push({
                grey: pen.getImageData(column, row, 1, 1).data[0], label: document.getElementById("version").innerText,
                state: document.getElementById("state").innerText, latest: studio.latest,
                before: !document.getElementById("stale").hidden, card: Number(card.dataset.version),
                dim: document.getElementById("cards").classList.contains("before"),
                ends: [...document.querySelectorAll("#scale .ticks div")].map((each) => each.innerText).join(),
            });
        }
        requestAnimationFrame(look);
    };
    look();
}"""


def greys(folder, values):
    """The grey of the pixel for each emissivity of the grass, by the public interface."""
    scene, found = tr.load_scene(folder), []
    for value in values:
        own = scene if value is None else scene.with_material(grass_green=value)
        numbers = [float(number) for number in POSE.split(",")]
        kelvin = tr.Renderer(own, "fast").frame(own.pose(*numbers)).apparent_temperature[PLACE[1], PLACE[0]]
        found.append(255.0 * (kelvin - LOW) / (HIGH - LOW))
    return np.array(found)


def fixed(page):
    """Fix the colours, so that a grey is a temperature."""
    page.part("colours").click()
    for key, end in (("low", LOW), ("high", HIGH)):
        number = page.number
        page.part(key).fill(f"{end:g}")
        page.part(key).press("Enter")
        page.later_than(number)
    page.page.locator(".q-select:visible").filter(has_text="Palette").click()
    number = page.number
    page.page.get_by_role("option", name="white-hot").click()
    page.later_than(number)


@pytest.mark.slow
def test_no_picture_is_ever_under_the_label_of_another_version(browser, folder):
    values = [None, 0.9, 0.8, 0.7, 0.6, 0.5]
    expected = greys(folder, values)
    assert np.abs(np.diff(expected)).min() > 6.0
    with served(folder) as address:
        page = Page(browser, address)
        page.choose("grass_green")
        page.click_pixel(*PLACE)
        fixed(page)
        page.page.evaluate(WATCH, list(PLACE))
        link = page.context.new_cdp_session(page.page)
        link.send("Network.enable")

        def network(latency_ms=0.0, bytes_s=-1.0, offline=False):
            link.send("Network.emulateNetworkConditions", {
                "offline": offline, "latency": latency_ms, "downloadThroughput": bytes_s, "uploadThroughput": bytes_s,
            })  # fmt: skip

        page.enter("emissivity", "0.9")
        page.settled(1)
        network(150.0, 400_000.0)
        page.enter("emissivity", "0.8")
        page.settled(2)
        page.enter("emissivity", "0.7")
        page.page.wait_for_timeout(300)
        page.context.set_offline(True)
        page.page.wait_for_timeout(700)
        assert page.part("state").inner_text() == "offline"
        page.context.set_offline(False)
        page.settled(3)
        network()
        # Pictures that do not arrive are asked for again.
        page.page.route("**/frame/**", lambda route: route.abort())
        page.enter("emissivity", "0.6")
        page.page.wait_for_timeout(1500)
        assert page.part("state").inner_text() in ("loading …", "solving 0 %")
        assert page.page.locator("#stale").is_visible()
        page.page.unroute("**/frame/**")
        page.settled(4)
        page.enter("emissivity", "0.5")
        page.part("undo").click()
        page.settled(4)
        seen = page.page.evaluate("seen")
        page.context.close()
    assert len(seen) > 100
    assert {each["label"] for each in seen} >= {f"version {number}" for number in range(5)}
    for each in seen:
        version = int(each["label"].split()[1])
        # A preview differs from the exact picture by its error, which is far below a step here.
        assert abs(each["grey"] - expected[version]) < 0.4 * np.abs(np.diff(expected)).min() + 1.0, each
        assert each["before"] == (version != each["latest"]), each
        assert each["dim"] or each["card"] == version, each
        if each["state"] == "exact":
            assert version == each["latest"] and abs(each["grey"] - expected[version]) <= 1.0, each
        assert each["ends"] == seen[0]["ends"]


@pytest.mark.slow
def test_a_new_hour_says_how_far_its_solution_is_and_the_old_picture_says_its_version(browser, tmp_path):
    classes = np.where(np.mgrid[:32, :32][1] < 16, 1, 2)
    with served(write_balance(tmp_path / "balance", WEATHER, classes=classes)) as address:
        page = Page(browser, address)
        page.page.evaluate(
            "() => { window.said = []; const at = (id) => document.getElementById(id); new MutationObserver(() => "
            "said.push([at('state').innerText, at('version').innerText])).observe(at('state'), {childList: true, "
            "characterData: true, subtree: true}); }"
        )
        before = page.version
        page.part("hour").locator("[tabindex]").focus()
        page.page.keyboard.press("ArrowRight")
        page.after(before)
        said = page.page.evaluate("said")
        page.context.close()
    solving = [int(state.split()[1]) for state, version in said if re.fullmatch(r"solving \d+ %", state)]
    assert solving == sorted(solving) and len(set(solving)) > 2
    assert {version for state, version in said if state.startswith("solving")} == {f"version {before}"}
    assert said[-1][0] == "exact"


def test_a_solution_reports_a_share_that_never_falls_and_then_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr("thermorender.apps.studio.renders.REPORTS_S", -1.0)
    session = Session(tr.Renderer(tr.load_scene(write_terrain(tmp_path / "tiny")), "fast"), "fast")
    told, shown, renders, view = [], [], session.renders, View(Pose.typed(POSE, session.base))
    renders.start()
    renders.look("tab", view, shown.append, tell=lambda *given: told.append((*given, len(shown))))
    wait_for(lambda: shown)
    session.edit(0, "", lambda document: document.with_text("grass_green", "emissivity", "0.8"))
    wait_for(lambda: any(picture.version == 1 and picture.exact for picture in shown))
    shares = [share for _, share, _ in told if share is not None]
    assert {version for version, _, _ in told} == {1}
    assert shares[0] == 0.0 and shares[-1] == 1.0 and shares == sorted(shares)
    # The end is told before the exact picture is shown, which so never says that it is being solved.
    assert told[-1][1] is None and told[-1][2] == len(shown) - 1
    session.close()
