"""What the view of the studio shows, compares, keeps, exports and remembers, driven as a user would."""

import csv
import io
import re
from pathlib import Path

import numpy as np
import pytest
from studio_support import POSE, WAIT_MS, Page, serious, served

import thermorender as tr
from scenes import WEATHER, write_balance

SIZES = ((1920, 1080), (1280, 800), (960, 600), (853, 533))


def frame_of(folder, pose=POSE, **materials):
    """The frame of a pose by the public interface."""
    scene = tr.load_scene(folder)
    scene = scene.with_material(materials) if materials else scene
    return tr.Renderer(scene, "fast").frame(scene.pose(*map(float, pose.split(","))))


def pose(page, text):
    """Show another pose."""
    number = page.number
    page.part("pose").fill(text)
    page.part("pose").press("Enter")
    page.later_than(number)


def compare_with(page, option):
    number = page.number
    page.part("against").click()
    page.page.get_by_role("option", name=option).click()
    page.later_than(number)


def downloaded(page, kind):
    """(name, contents) of a file that the page exports."""
    page.page.get_by_role("tab", name="Files").click()
    page.part("kind").click()
    page.page.get_by_role("option", name=kind, exact=True).click()
    with page.page.expect_download() as found:
        page.part("export").click()
    return found.value.suggested_filename, Path(found.value.path()).read_bytes()


@pytest.mark.slow
def test_a_click_on_the_sky_says_that_nothing_is_there(page):
    pose(page, "0,-6,3,0,0,0")
    page.click_pixel(320, 20)
    page.page.locator('[data-key="Surface"]').filter(has_text="none: sky").wait_for(timeout=WAIT_MS)
    assert float(page.figure("Apparent temperature").inner_text().split()[0]) == pytest.approx(260.0, abs=0.01)
    assert not page.part("keep").count() and not page.page.locator(".q-notification").count()
    pose(page, POSE)


@pytest.mark.slow
def test_a_difference_and_a_slider_compare_with_the_saved_scene_and_with_a_version(page, folder):
    page.choose("grass_green")
    first = page.version
    page.edited("emissivity", "0.8", pixel=False)
    compare_with(page, "the saved scene")
    change = frame_of(folder, grass_green=0.8).apparent_temperature - frame_of(folder).apparent_temperature
    mean = float(re.match(r"mean −?([\d.]+) ", page.part("notes").inner_text())[1])
    assert "minus that of the saved scene" in page.part("picture-title").inner_text()
    assert mean == pytest.approx(abs(change.mean(dtype=float)), rel=0.01) or mean == pytest.approx(
        1e3 * abs(change.mean(dtype=float)), rel=0.01
    )
    page.part("compare-as").get_by_text("Split").click()
    page.page.locator("#other[src]").wait_for(state="visible", timeout=WAIT_MS)
    grey = page.page.evaluate(
        """() => ["frame", "other"].map((id) => {
            const image = document.getElementById(id), canvas = document.createElement("canvas");
            [canvas.width, canvas.height] = [640, 512];
            const pen = canvas.getContext("2d");
            pen.drawImage(image, 0, 0);
            return [...pen.getImageData(200, 250, 1, 1).data];
        })"""
    )
    assert grey[0] != grey[1]
    assert page.part("frame").bounding_box() == page.page.locator("#other").bounding_box()
    page.part("compare-as").get_by_text("Difference").click()
    compare_with(page, f"version {first}: as read")
    page.part("picture-title").filter(has_text=f"minus that of version {first}").wait_for(timeout=WAIT_MS)
    compare_with(page, "nothing")


@pytest.mark.slow
def test_a_kept_point_stays_on_its_surface_and_the_address_brings_view_and_material_back(page):
    page.click_pixel(200, 250)
    page.part("keep").click()
    mark = page.page.locator(".cross.named")
    mark.wait_for(timeout=WAIT_MS)
    first, row = mark.bounding_box(), page.part("probes").inner_text()
    assert "grass_green" in row
    page.show("Kinetic temperature")
    pose(page, "2,-6,10,0,-55,0")
    moved = "x => Math.abs(document.querySelector('.cross.named').getBoundingClientRect().left - x) > 30"
    page.page.wait_for_function(moved, arg=first["x"], timeout=WAIT_MS)
    kelvin = [float(each) for each in re.findall(r"(\d{3}\.\d\d) K", row)]
    shown = [float(each) for each in re.findall(r"(\d{3}\.\d\d) K", page.part("probes").inner_text())]
    assert shown[1] == pytest.approx(kelvin[1], abs=0.25)  # kinetic; texels differ by 0.2 K
    page.choose("sand_quartz")
    page.page.wait_for_url(lambda url: "show=kinetic" in url and "material=sand_quartz" in url, timeout=WAIT_MS)
    page.page.reload()
    page.settled()
    assert page.part("picture-title").inner_text() == "Kinetic temperature"
    assert page.part("title").inner_text() == "sand_quartz" and page.part("pose").input_value() == "2,-6,10,0,-55,0"
    page.show("Emissivity in the band")
    page.page.go_back()
    page.part("picture-title").filter(has_text="Kinetic temperature").wait_for(timeout=WAIT_MS)
    page.show("Apparent temperature")
    pose(page, POSE)


@pytest.mark.slow
def test_a_click_belongs_to_the_picture_that_is_seen_while_a_later_one_is_on_its_way(page, folder):
    held, number = [], page.number
    page.page.route("**/frame/**", lambda route: held.append(route))
    page.part("pose").fill("3,-6,10,0,-55,0")
    page.part("pose").press("Enter")
    page.page.wait_for_function("() => studio.loading", timeout=WAIT_MS)
    page.click_pixel(200, 250)
    page.page.wait_for_timeout(500)
    assert page.number == number
    for route in held:
        route.continue_()
    page.page.unroute("**/frame/**")
    page.later_than(number)
    east, north, up = frame_of(folder).truth["position"][250, 200]
    place = page.figure("Position E, N, up").filter(has_text=f"{east:.1f}, {north:.1f}, {up + 0.0:.1f} m")
    place.wait_for(timeout=WAIT_MS)
    pose(page, POSE)


@pytest.mark.slow
def test_the_list_of_edits_goes_to_any_of_them(page):
    page.choose("grass_green")
    first = page.version
    for text in ("0.7", "0.75", "0.8"):
        page.edited("emissivity", text, pixel=False)
    page.part("edits").click()
    page.page.get_by_text("grass_green: grey emissivity 0.7", exact=False).last.click()
    page.has_value(page.part("field-emissivity"), "0.7")
    page.settled()
    page.part("edits").click()
    page.page.locator(f'.edits [data-version="{first}"]').click()
    assert page.settled(first) == page.version == first
    page.has_value(page.part("field-emissivity"), "")


@pytest.mark.slow
def test_a_comparison_with_a_version_that_another_edit_has_replaced_ends_with_a_sentence(page):
    page.choose("grass_green")
    before = page.version
    page.edited("emissivity", "0.7", pixel=False)
    replaced = page.version
    page.edited("emissivity", "0.75", pixel=False)
    compare_with(page, f"version {replaced}: grass_green")
    page.page.wait_for_url(f"**against=version+{replaced}*", timeout=WAIT_MS)
    for _ in range(2):
        version = page.version
        page.part("undo").click()
        page.after(version)
    assert page.version == before and f"minus that of version {replaced}" in page.part("picture-title").inner_text()
    page.edited("emissivity", "0.8", pixel=False)
    page.page.get_by_text(f"version {replaced} is no longer there").wait_for(timeout=WAIT_MS)
    page.page.wait_for_function("() => !location.search.includes('against')", timeout=WAIT_MS)
    page.part("picture-title").get_by_text("Apparent temperature", exact=True).wait_for(timeout=WAIT_MS)


@pytest.mark.slow
def test_one_end_of_the_colours_leaves_the_other_free_and_a_split_view_has_its_own(page):
    page.part("colours").click()
    shown = page.page.evaluate("studio.picture.ticks[0]")
    page.part("low").fill("280")
    page.part("low").press("Enter")
    page.page.wait_for_function("() => studio.picture.ticks.at(-1) === '280.0'", timeout=WAIT_MS)
    assert float(page.page.evaluate("studio.picture.ticks[0]")) == pytest.approx(float(shown), abs=0.1)
    assert page.part("high").input_value() == "" and "range=280,&" in page.page.url
    page.part("high").fill("270")
    page.part("high").press("Enter")
    page.page.get_by_text("range=280…270 is not in order").wait_for(timeout=WAIT_MS)
    compare_with(page, "the saved scene")
    assert page.part("low").input_value() == ""
    page.part("low").fill("-3")
    number = page.number
    page.part("low").press("Enter")
    page.later_than(number)
    assert "range=-3," in page.page.url
    page.part("compare-as").get_by_text("Split").click()
    page.page.wait_for_function("() => studio.picture.other && !location.search.includes('range')", timeout=WAIT_MS)
    assert page.part("low").input_value() == ""
    compare_with(page, "nothing")
    page.part("colours").click()
    assert "slider" not in page.page.url


@pytest.mark.slow
def test_a_polygon_of_two_points_is_refused_and_one_of_three_paints(page):
    page.choose("sand_quartz")
    page.tool("Polygon")
    box, before = page.part("frame").bounding_box(), page.version
    press = lambda x, y, how: how(box["x"] + x * box["width"], box["y"] + y * box["height"])  # noqa: E731
    press(0.2, 0.6, page.page.mouse.click)
    press(0.4, 0.6, page.page.mouse.dblclick)
    page.page.get_by_text("this polygon has 2 points; draw one of 3").wait_for(timeout=WAIT_MS)
    assert page.settled() == before
    press(0.2, 0.6, page.page.mouse.click)
    press(0.4, 0.6, page.page.mouse.click)
    press(0.3, 0.8, page.page.mouse.dblclick)
    page.after(before)
    page.tool("Look")


@pytest.mark.slow
def test_every_export_holds_what_is_shown(page, folder, tmp_path):
    import OpenEXR

    page.show("Kinetic temperature")
    shown = frame_of(folder).truth["kinetic_temperature"]
    name, data = downloaded(page, "CSV, values of the pixels")
    assert name.startswith("tiny-kinetic-version-") and name.endswith(".csv")
    found = np.genfromtxt(io.BytesIO(data), delimiter=",", comments="#")
    np.testing.assert_allclose(found, shown, atol=1e-3)
    head = data.decode().splitlines()[:10]
    assert any(line.startswith("# pose: 0,-6,10,0,-55,0") for line in head) and "# unit: K" in head
    _, data = downloaded(page, "EXR, values of the pixels")
    (tmp_path / "values.exr").write_bytes(data)
    channel = OpenEXR.File(str(tmp_path / "values.exr")).channels()["kinetic_temperature"].pixels
    np.testing.assert_array_equal(channel, shown)
    _, data = downloaded(page, "CSV, table of materials")
    rows = {row["material"]: row for row in csv.DictReader(io.StringIO(data.decode()))}
    assert set(rows) == {"grass_green", "sand_quartz"}
    assert sum(float(row["area_from_above_m2"]) for row in rows.values()) == pytest.approx(225.0, rel=0.01)
    for kind, start in (("SVG, the picture with its bar", b"<?xml"), ("PNG, the picture with its bar", b"\x89PNG")):
        assert downloaded(page, kind)[1].startswith(start)
    _, data = downloaded(page, "EXR, the frame: radiance and truth")
    (tmp_path / "frame.exr").write_bytes(data)
    assert "truth.depth" in OpenEXR.File(str(tmp_path / "frame.exr")).channels()
    page.seen_from("From above")
    page.page.get_by_role("tab", name="Files").click()
    page.part("kind").click()
    page.page.get_by_role("option", name="TIFF, apparent temperature [K]", exact=True).click()
    page.part("export").click()
    page.part("diff").filter(has_text="a plan has no camera frame").wait_for(timeout=WAIT_MS)
    page.seen_from("Camera")
    page.show("Apparent temperature")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_picture_keeps_its_shape_at_every_size_and_axe_finds_nothing_serious(browser, address, scheme):
    for width, height in SIZES:
        page = Page(browser, address, viewport={"width": width, "height": height}, color_scheme=scheme)
        page.click_pixel(200, 250)
        box = page.part("frame").bounding_box()
        assert box["width"] / box["height"] == pytest.approx(1.25, abs=0.01) and box["width"] > 0.3 * width
        assert page.page.evaluate("document.documentElement.scrollWidth") == width
        scale = page.part("scale").bounding_box()
        assert scale["x"] + scale["width"] <= page.page.locator(".middle").bounding_box()["x"] + 0.75 * width
        for part in ("layer", "tool", "state", "undo"):
            place = page.part(part).bounding_box()
            assert place["x"] >= 0.0 and place["x"] + place["width"] <= width
        if width == SIZES[1][0]:
            assert not serious(page)
        page.context.close()
        assert not page.errors


@pytest.mark.slow
def test_the_terms_of_a_heat_balance_are_shown_and_say_why_a_lighter_ground_is_colder(browser, tmp_path):
    classes = np.where(np.mgrid[:32, :32][1] < 16, 1, 2)
    with served(write_balance(tmp_path / "balance", WEATHER, classes=classes)) as address:
        page = Page(browser, address)
        page.click_pixel(500, 250)
        page.page.locator('[data-heat="Sum"]').wait_for(timeout=WAIT_MS)

        def terms():
            rows = page.page.locator("[data-heat]")
            return {
                each.get_attribute("data-heat"): float(each.inner_text().split()[0].replace("−", "-"))
                for each in rows.all()
            }

        before = terms()
        assert abs(before["Sum"]) < 0.06 and before["Sunlight absorbed"] > 400.0 > -400.0 > before["Long-wave emitted"]
        assert sum(value for name, value in before.items() if name != "Sum") == pytest.approx(0.0, abs=0.4)
        page.choose("sand_quartz")
        kelvin = float(page.figure("Kinetic temperature").inner_text().split()[0])
        page.edited("solar_absorptance", "0.2")
        page.page.wait_for_function("() => studio.told === studio.picture.number")
        after = terms()
        assert after["Sunlight absorbed"] == pytest.approx(before["Sunlight absorbed"] * 0.2 / 0.761, rel=0.02)
        assert float(page.figure("Kinetic temperature").inner_text().split()[0]) < kelvin - 5.0
        assert abs(after["Sum"]) < 0.06 and after["Convection"] > before["Convection"]
        page.show("Convection")
        assert "W/m²" in page.part("notes").inner_text()
        page.part("day").click()
        page.part("day-words").get_by_text(f"of version {page.version}", exact=True).wait_for(timeout=WAIT_MS)
        solved = page.version
        page.edited("solar_absorptance", "0.3", pixel=False)
        page.part("day-words").get_by_text(f"of version {solved}, before the edit").wait_for(timeout=WAIT_MS)
        page.context.close()
        assert not page.errors
