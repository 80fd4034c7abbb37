"""The report in a real browser: it opens without complaint, asks the network for nothing, answers clicks."""

import numpy as np
import pytest

from sfm_shapefit.report.page import write_report
from tests.browser import chromium, complaints, opened, requests, wait_for
from tests.drawings import make_drawing
from tests.report.test_report_page import HOSTILE

HIGHLIGHT = """
    const [line, mark] = document.getElementById('scene').data.slice(-2);
    return {line: line.x.length, mark: [mark.x, mark.y, mark.z].map((values) => values[0])};
"""
CENTER = "const c = document.getElementById('scene').layout.scene.camera.center; return [c.x, c.y, c.z];"
SELECTED = "return document.getElementById('scene').dataset.selected;"


@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def report(driver, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(*make_drawing(), path)
    opened(driver, path)
    return path


def test_the_report_opens_without_errors_and_without_the_network(driver, report):
    assert complaints(driver) == []
    assert requests(driver) == []
    assert driver.title == "project/sparse/0 \N{EN DASH} sfm_shapefit"
    drawn = driver.execute_script("return [...document.querySelectorAll('.js-plotly-plot')].map((e) => e.id)")
    assert drawn == ["scene", "histogram", "trust", "matrix", "support", "convergence"]


def test_a_click_on_a_row_highlights_and_centers_its_camera(driver, report):
    before = driver.execute_script(HIGHLIGHT), driver.execute_script(CENTER)
    row = driver.find_element("css selector", "#cameras tbody tr:nth-child(3)")
    k = int(row.get_attribute("data-row"))
    driver.execute_script("arguments[0].click()", row)
    assert driver.execute_script(SELECTED) == f"camera:{k}"
    after, center = driver.execute_script(HIGHLIGHT), driver.execute_script(CENTER)
    assert after["line"] > before[0]["line"]
    assert before[0]["mark"] == [None, None, None]
    drawing, _ = make_drawing()
    name = driver.find_element("css selector", "#details h3").text
    position = drawing.cameras.centers[drawing.cameras.names.index(name)]
    middle = np.median(drawing.cameras.centers[drawing.cameras.placed], axis=0)
    np.testing.assert_allclose(after["mark"], drawing.axes @ (position - middle), atol=1e-5)  # float32 of 10
    assert center != before[1]
    assert driver.find_element("css selector", "#cameras tr[aria-selected=true]").get_attribute(
        "data-row"
    ) == str(k)


def test_a_click_in_the_scene_leads_to_the_row_and_a_pair_shows_its_two_cameras_and_its_line(driver, report):
    # Plotly's own event, as over a camera that the table's first page does not show, then a press.
    driver.execute_script(
        "const plot = document.getElementById('scene');"
        "const at = plot.data.findIndex((trace) => trace.mode === 'markers');"
        "plot.emit('plotly_hover', {points: [{curveNumber: at, pointNumber: 20}]});"
        "for (const kind of ['pointerdown', 'pointerup']) plot.dispatchEvent(new PointerEvent(kind));"
    )
    k = int(driver.execute_script(SELECTED).removeprefix("camera:"))
    row = driver.find_element("css selector", "#cameras tr[aria-selected=true]")
    assert int(row.get_attribute("data-row")) == k
    assert row.find_element("tag name", "td").text == driver.find_element("css selector", "#details h3").text
    driver.execute_script("document.querySelector('#pairs tbody tr:nth-child(2)').click()")
    shown = [button.text for button in driver.find_elements("css selector", "#details button")]
    names = [c.text for c in driver.find_elements("css selector", "#pairs tr[aria-selected=true] td.name")]
    assert shown == names
    assert driver.execute_script("return document.getElementById('scene').data.at(-1).x.length") == 2


def test_the_mouse_over_a_camera_tells_of_it_and_a_click_selects_it(driver, report):
    from selenium.webdriver import ActionChains

    driver.execute_script("document.querySelector('#cameras tbody tr').click()")  # which centers it
    chosen = driver.execute_script(SELECTED)
    plot = driver.find_element("id", "scene")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", plot)
    driver.execute_script("delete document.getElementById('scene').dataset.selected")
    ActionChains(driver).move_to_element(plot).pause(0.3).move_by_offset(1, 1).perform()
    wait_for(driver, "return !document.getElementById('tooltip').hidden")
    name = driver.find_element("css selector", "#tooltip strong").text
    assert name == driver.find_element("css selector", "#details h3").text
    ActionChains(driver).click().perform()
    assert wait_for(driver, SELECTED) == chosen
    assert complaints(driver) == []


def test_tables_sort_filter_and_turn_pages(driver, report):
    def first():
        return driver.find_element("css selector", "#cameras tbody td").text

    heading = driver.find_element("css selector", "#cameras th button")
    driver.execute_script("arguments[0].click()", heading)
    assert first() == "images/IMG_00000.jpg"
    driver.execute_script("arguments[0].click()", heading)
    assert first() == "images/IMG_00024.jpg"
    driver.execute_script("[...document.querySelectorAll('#cameras .tools button')].at(-1).click()")
    assert first() == "images/IMG_00012.jpg"
    driver.execute_script(
        "const box = document.querySelector('#cameras input'); box.value = 'img_00007';"
        "box.dispatchEvent(new Event('input'));"
    )
    assert [row.text.split()[0] for row in driver.find_elements("css selector", "#cameras tbody tr")] == [
        "images/IMG_00007.jpg"
    ]


def test_layers_and_the_theme_can_be_switched_and_the_plots_follow(driver, report):
    box = driver.find_element("css selector", "[data-layer=contradicts]")
    driver.execute_script("arguments[0].click()", box)
    scene = "return document.getElementById('scene')"
    shown = f"{scene}.data.filter((t) => t.kind === 'pair').map((t) => t.visible)"
    assert driver.execute_script(shown) == [True, False, True, False]
    paper = f"{scene}.layout.paper_bgcolor"
    light = driver.execute_script(paper)
    driver.execute_script("document.getElementById('theme').click()")
    assert driver.execute_script(paper) != light
    assert complaints(driver) == []


def test_it_fits_a_narrow_window_and_a_screenshot_shows_the_scene(driver, report, tmp_path):
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    wait_for(driver, "return document.documentElement.scrollWidth <= 390")
    picture = driver.find_element("id", "scene").screenshot(str(tmp_path / "scene.png"))
    assert picture
    assert (tmp_path / "scene.png").stat().st_size > 3000  # an empty plot has under 2 kB
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {**size, "width": 1400, "height": 1000})


def test_hostile_names_do_nothing_in_the_browser(driver, tmp_path):
    drawing, facts = make_drawing(num_cameras=len(HOSTILE), num_pairs=20, names=HOSTILE)
    facts["inputs"]["model"] = HOSTILE[0]
    facts["warnings"] = [f"look at {name}" for name in HOSTILE]
    facts["options"]["note"] = HOSTILE[1]
    write_report(drawing, facts, tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    for row in range(len(HOSTILE)):
        if row < 3:  # each draws the scene anew
            driver.execute_script(f"document.querySelectorAll('#cameras tbody tr')[{row}].click()")
        point = f"{{points: [{{pointNumber: {min(row, 6)}}}]}}"
        driver.execute_script(f"document.getElementById('trust').emit('plotly_hover', {point})")
    assert "owned" not in driver.title.replace(HOSTILE[0], "")
    made = "return document.querySelectorAll('main img, main b:not(.tile b), main a').length"
    assert driver.execute_script(made) == 0
    assert driver.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    assert complaints(driver) == []
    assert requests(driver) == []
