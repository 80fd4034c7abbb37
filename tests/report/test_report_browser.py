"""The report in a real browser: it opens without complaint, asks the network for nothing, answers clicks."""

import base64
import re
from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.judgement.evidence import LensField
from sfm_shapefit.report.matched import DrawnMatches
from sfm_shapefit.report.page import Pictures, write_report
from tests.browser import chromium, complaints, opened, requests, wait_for
from tests.drawings import make_drawing
from tests.report.test_report_page import HOSTILE, doubted

SCENE = "const scene = document.getElementById('scene').scene;"
LABELS = "return [...document.querySelectorAll('#overlay .label')].map((one) => one.textContent);"
TARGET = SCENE + "return scene.view.target;"
SELECTED = "return document.getElementById('scene').dataset.selected;"
# The canvas as drawn now: its commonest color, share and number of others, red pixels, the brightest red.
COLORS = """
    const scene = document.getElementById('scene').scene, canvas = document.getElementById('canvas');
    scene.draw();
    const copy = document.createElement('canvas');
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const pen = copy.getContext('2d');
    pen.drawImage(canvas, 0, 0);
    let [red, brightest] = [0, 0];
    const seen = new Map(), {data} = pen.getImageData(0, 0, copy.width, copy.height);
    for (let k = 0; k < data.length; k += 4) {
        const shade = data[k] * 65536 + data[k + 1] * 256 + data[k + 2];
        if (data[k] > 220 && data[k + 1] < 40 && data[k + 2] < 40) red += 1;
        brightest = Math.max(brightest, data[k]);
        seen.set(shade, (seen.get(shade) || 0) + 1);
    }
    const sorted = [...seen].sort((a, b) => b[1] - a[1]);
    return {common: sorted[0][0], drawn: 1 - 4 * sorted[0][1] / data.length, count: seen.size, red,
        brightest};
"""


DATA = "document.getElementById('data').textContent"
# Where a camera is seen, and the box of the ghosts at other places alone, in pixels.
GHOST_BOX = """
    const scene = document.getElementById('scene').scene, canvas = document.getElementById('canvas');
    const ghosts = scene.layers.find((one) => one.name === 'elsewhere');
    ghosts.segments = null;
    ghosts.shown = true;
    scene.draw();
    const copy = document.createElement('canvas');
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const pen = copy.getContext('2d');
    pen.drawImage(canvas, 0, 0);
    const {data} = pen.getImageData(0, 0, copy.width, copy.height), ratio = copy.width / canvas.clientWidth;
    const [xs, ys] = [[], []];
    for (let k = 0; k < data.length; k += 4) {
        if (data[k] === data[0] && data[k + 1] === data[1] && data[k + 2] === data[2]) continue;
        xs.push((k / 4) % copy.width / ratio);
        ys.push(Math.floor(k / 4 / copy.width) / ratio);
    }
    const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    return [...scene.project(row).slice(0, 2), ...box];
"""


@pytest.fixture(scope="module")
def driver():
    with chromium() as found:
        still = [{"name": "prefers-reduced-motion", "value": "reduce"}]
        found.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": still})
        yield found


@pytest.fixture(scope="module")
def report(driver, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(*make_drawing(), path)
    opened(driver, path)
    return path


def position_of(name):
    """Where the page has a camera: around the median, x to the right, z up."""
    drawing, _ = make_drawing()
    middle = np.median(drawing.cameras.centers[drawing.cameras.placed], axis=0)
    return drawing.axes @ (drawing.cameras.centers[drawing.cameras.names.index(name)] - middle)


def click(driver, selector):
    driver.execute_script("document.querySelector(arguments[0]).click()", selector)


def point_at(driver, row):
    """Move the mouse over a camera in the scene, as it is seen now."""
    from selenium.webdriver import ActionChains

    canvas = driver.find_element("id", "canvas")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", canvas)
    x, y, _ = driver.execute_script(f"{SCENE} return scene.project({row});")
    size = canvas.size
    shift = round(x - size["width"] / 2), round(y - size["height"] / 2)
    return ActionChains(driver).move_to_element_with_offset(canvas, *shift).pause(0.2)


def test_the_report_opens_without_errors_and_without_the_network(driver, report):
    assert complaints(driver) == []
    assert requests(driver) == []
    assert driver.title == "project \N{EN DASH} sfm_shapefit"
    drawn = driver.execute_script(
        "return [...document.querySelectorAll('.chart svg')].map((e) => e.parentNode.id)"
    )
    assert drawn == ["trust", "histogram", "tracks", "reprojection", "matrix", "support", "convergence"]
    assert driver.execute_script(COLORS)["count"] > 50
    assert "workspace" in driver.find_element("id", "command").text
    assert driver.find_element("id", "command").text == "sfm-shapefit workspace OUT IMAGES OUT_dense"


def test_a_click_on_a_row_chooses_its_camera_flies_there_and_the_scene_stays_in_view(driver, report):
    row = driver.find_element("css selector", "#cameras tbody tr[data-row='2']")
    k = int(row.get_attribute("data-row"))
    driver.execute_script("arguments[0].scrollIntoView({block: 'end'}); arguments[0].click()", row)
    assert driver.execute_script(SELECTED) == f"camera:{k}"
    name = driver.find_element("css selector", "#details h3").text
    np.testing.assert_allclose(driver.execute_script(TARGET), position_of(name), atol=1e-5)
    assert driver.execute_script(LABELS) == [name]
    box = driver.execute_script("return document.getElementById('scene').getBoundingClientRect()")
    assert -50 < box["top"] < box["bottom"] < 1050
    chosen = driver.find_element("css selector", "#cameras tr[aria-selected=true]")
    assert chosen.get_attribute("data-row") == str(k)


# What the column of the scene covers of other cards, while the page is scrolled in steps of 50 pixels.
COVERED = """
    const covered = [], column = document.getElementById('stage');
    const isClipped = getComputedStyle(column).overflowY !== 'visible';
    const cards = [...document.querySelectorAll('.findings > *, .more > *, .experts')];
    for (let y = 0; y < document.documentElement.scrollHeight; y += 50) {
        scrollTo({top: y, behavior: 'instant'});
        const boxes = isClipped ? [column] : [...column.children];
        for (const own of boxes.map((one) => one.getBoundingClientRect())) for (const card of cards) {
            const box = card.getBoundingClientRect();
            const width = Math.min(own.right, box.right) - Math.max(own.left, box.left);
            const height = Math.min(own.bottom, box.bottom) - Math.max(own.top, box.top);
            if (width > 1 && height > 1) covered.push([y, height, card.textContent.slice(0, 30)]);
        }
    }
    return covered;
"""


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1280, 720), (1200, 480)])
def test_what_is_chosen_covers_nothing_wherever_the_page_is_scrolled_to(driver, report, width, height):
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    click(driver, "#cameras tbody tr")
    assert driver.execute_script(COVERED) == []
    driver.execute_script("document.querySelector('#details details').open = true")
    assert driver.execute_script(COVERED) == []
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {**size, "width": 1400, "height": 1000})


def test_a_click_in_the_scene_takes_the_camera_and_not_a_pair_drawn_over_it(driver, report):
    from selenium.webdriver import ActionChains

    click(driver, "#whole")
    point_at(driver, 9).perform()
    wait_for(driver, "return !document.getElementById('tooltip').hidden")
    name = driver.find_element("css selector", "#tooltip strong").text
    ActionChains(driver).click().perform()
    assert driver.execute_script(SELECTED) == "camera:9"
    row = driver.find_element("css selector", "#cameras tr[aria-selected=true]")
    assert row.find_element("css selector", "td.name").text == name
    assert driver.find_element("css selector", "#details h3").text == name
    assert complaints(driver) == []


def test_a_click_on_a_line_takes_the_pair_and_shows_its_two_cameras(driver, report):
    from selenium.webdriver import ActionChains

    click(driver, "#whole")
    # A point of a drawn pair that no camera is near, and where no other pair is nearer.
    place = driver.execute_script(
        SCENE
        + "const at = (k) => scene.project(k), pair = scene.layers.find((one) => one.name === 'agrees');"
        "const all = Array.from({length: 24}, (_, k) => at(k));"
        "for (const p of pair.pairs) for (const t of [0.3, 0.4, 0.5, 0.6]) {"
        "  const [a, b] = scene.endsOf(p).map(at);"
        "  const [x, y] = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];"
        "  if (all.every(([u, v]) => Math.hypot(u - x, v - y) > 60)) return [p, x, y];"
        "}"
    )
    assert place is not None
    canvas = driver.find_element("id", "canvas")
    shift = round(place[1] - canvas.size["width"] / 2), round(place[2] - canvas.size["height"] / 2)
    ActionChains(driver).move_to_element_with_offset(canvas, *shift).pause(0.2).click().perform()
    assert driver.execute_script(SELECTED).startswith("pair:")
    shown = [button.text for button in driver.find_elements("css selector", "#details .link")]
    names = [c.text for c in driver.find_elements("css selector", "#pairs tr[aria-selected=true] td.name")]
    assert shown == names
    assert driver.execute_script(LABELS) == shown


def test_tables_sort_filter_and_turn_pages(driver, report):
    def first():
        return driver.find_element("css selector", "#cameras tbody td.name").text

    heading = driver.find_element("css selector", "#cameras th button")
    driver.execute_script("arguments[0].click()", heading)
    assert first() == "images/IMG_00000.jpg"
    driver.execute_script("arguments[0].click()", heading)
    assert first() == "images/IMG_00024.jpg"
    driver.execute_script("[...document.querySelectorAll('#cameras .tools button')].at(-1).click()")
    assert first() == "images/IMG_00014.jpg"
    driver.execute_script(
        "const box = document.querySelector('#cameras input'); box.value = 'img_00007';"
        "box.dispatchEvent(new Event('input'));"
    )
    shown = driver.find_elements("css selector", "#cameras tbody td.name")
    assert [name.text for name in shown] == ["images/IMG_00007.jpg"]


def test_layers_sizes_colors_and_the_theme_can_be_switched_and_the_scene_follows(driver, report):
    click(driver, "#whole")
    before = driver.execute_script(COLORS)
    click(driver, "[data-layer=contradicts]")
    without = driver.execute_script(COLORS)
    assert without["drawn"] < before["drawn"]
    move = "const s = document.querySelector('[data-size=frustum]'); s.value = 0.6; s.oninput();"
    driver.execute_script(move)
    larger = driver.execute_script(COLORS)
    assert larger["drawn"] > without["drawn"]
    modes = [option.text for option in driver.find_elements("css selector", "#mode option")]
    assert modes == ["trust", "uncertainty", "error of its pairs", "shift from the input"]
    driver.execute_script("const m = document.getElementById('mode'); m.value = '3'; m.onchange();")
    assert driver.execute_script(COLORS)["count"] != larger["count"]
    page = "return getComputedStyle(document.body).backgroundColor"
    background = driver.execute_script(page)
    click(driver, "#theme")
    assert driver.execute_script(page) != background
    assert driver.execute_script(COLORS)["common"] == before["common"]  # the ground that shows light points
    assert complaints(driver) == []


CUT_TEXTS = """
    return [...document.querySelectorAll('svg[role=img] text')].filter((text) => {
      const [own, chart] = [text.getBoundingClientRect(), text.ownerSVGElement.getBoundingClientRect()];
      return own.width > 0 && (own.left < chart.left - 1 || own.right > chart.right + 1);
    }).map((text) => text.textContent);
"""


@pytest.mark.parametrize("shade", [0, 40, 230])
def test_the_ground_is_light_behind_dark_points_and_dark_behind_light_ones(driver, shade, tmp_path):
    drawing, facts = make_drawing()
    colors = np.full_like(drawing.points.colors, shade)
    path = tmp_path / "report.html"
    write_report(replace(drawing, points=drawing.points._replace(colors=colors)), facts, path)
    opened(driver, path)
    ground = driver.execute_script(COLORS)["common"]
    red = ground >> 16
    assert red < 64 if shade == 230 else red > 192
    # A dark page has a dark ground, on which points are to be seen, too.
    driver.execute_script(f"{SCENE} scene.layers.forEach((one) => {{ one.shown = one.name === 'points'; }});")
    click(driver, "#theme")
    seen = driver.execute_script(COLORS)
    assert seen["common"] >> 16 < 64
    assert seen["brightest"] >= 120


def test_it_fits_a_narrow_window_and_a_row_brings_the_scene_into_view(driver, report):
    opened(driver, report)
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    wait_for(driver, "return document.documentElement.scrollWidth <= 390")
    # Charts are drawn anew for the width, and every text of them is to be seen.
    wait_for(driver, "return document.querySelector('#histogram svg').viewBox.baseVal.width < 390")
    assert driver.execute_script(CUT_TEXTS) == []
    whole = "return [...document.querySelectorAll('#command, #lenses .scroll, #pieces .scroll')]"
    assert driver.execute_script(f"{whole}.filter((one) => one.scrollWidth > one.clientWidth).length") == 0
    words = "return document.querySelector('#pairs td.verdict').innerText.trim()"
    assert driver.execute_script(words) == "contradicts"
    driver.execute_script("document.querySelector('#pairs tbody tr').scrollIntoView()")
    click(driver, "#pairs tbody tr")
    wait_for(
        driver,
        "const box = document.getElementById('scene').getBoundingClientRect();"
        "return box.top >= 0 && box.bottom <= innerHeight;",
    )
    assert driver.execute_script(COLORS)["count"] > 50
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {**size, "width": 1400, "height": 1000})


def test_hostile_names_do_nothing_in_the_browser(driver, tmp_path):
    drawing, facts = make_drawing(num_cameras=len(HOSTILE), num_pairs=20, names=HOSTILE)
    facts = replace(
        facts,
        inputs=replace(facts.inputs, model=HOSTILE[0]),
        warnings=[f"look at {name}" for name in HOSTILE],
    )
    facts.options["note"] = HOSTILE[1]
    write_report(drawing, facts, tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    parts = driver.execute_script(
        "return [...document.querySelectorAll('#cameras td.name span')].map((span) => span.textContent)"
    )
    assert len(parts) > len(HOSTILE)
    assert all(
        len(part.removesuffix("/").removesuffix(" ").split("/")) == 1 for part in parts
    )  # lines break there
    for row in range(len(HOSTILE)):
        driver.execute_script(f"document.querySelector(\"#cameras tr[data-row='{row}']\").click()")
    driver.execute_script("document.querySelector('#pairs tbody tr').click()")
    assert "owned" not in driver.title
    made = "return document.querySelectorAll('main img, main b:not(.tile b), main a').length"
    assert driver.execute_script(made) == 0
    assert driver.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    assert complaints(driver) == []
    assert requests(driver) == []


def test_groups_that_stand_apart_have_colors_and_another_place_is_a_ghost(driver, tmp_path):
    path = tmp_path / "report.html"
    write_report(*doubted(), path)
    opened(driver, path)
    assert driver.find_element("id", "legend").text.split("\n") == [
        "the rest",
        "group 1",
        "group 2",
        "group 3",
    ]
    layer = f"{SCENE} return scene.layers.find((one) => one.name === 'elsewhere').ghosts.instances;"
    assert driver.execute_script(layer) == 1
    seen = []
    for shown in (True, False):
        only = f"one.shown = {str(shown).lower()} && one.name === 'elsewhere'"
        driver.execute_script(f"{SCENE} scene.layers.forEach((one) => {{ {only}; }});")
        seen.append(driver.execute_script(COLORS)["count"])
    assert seen[0] > seen[1] == 1
    name = doubted()[0].cameras.names[9]
    # The ghost, drawn without the line that leads to it, is not where the camera is.
    names = driver.execute_script(f"return JSON.parse({DATA}).cameras.names")
    x, y, left, top, right, bottom = driver.execute_script(f"const row = {names.index(name)};{GHOST_BOX}")
    assert right - left > 5
    assert not (left <= x <= right and top <= y <= bottom)
    rows = driver.execute_script("return [...document.querySelectorAll('#cameras tr[data-row]')].length")
    assert rows == 10
    search = driver.find_element("css selector", "#cameras input")
    search.send_keys(name)
    click(driver, "#cameras tbody tr")
    assert "2.29 units away, by 5 pairs; 2 for where it is" in driver.find_element("id", "details").text
    assert complaints(driver) == []


def test_thumbnails_stand_in_the_frusta_and_beside_the_facts_and_what_is_left_out_is_a_ghost(
    driver, tmp_path
):
    cv2 = pytest.importorskip("cv2")
    drawing, facts = make_drawing()
    encoded = cv2.imencode(".jpg", np.full((24, 32, 3), (0, 0, 255), dtype=np.uint8))[1].tobytes()
    picture = f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}"
    pictures = Pictures(dict.fromkeys(range(25), picture))
    write_report(drawing, facts, tmp_path / "report.html", pictures)
    opened(driver, tmp_path / "report.html")
    assert wait_for(driver, "return document.getElementById('canvas').dataset.pictures") == "24"
    assert driver.execute_script(COLORS)["red"] > 500
    ghost = driver.find_element("css selector", "[data-layer=ghosts]")
    assert ghost.find_element("xpath", "..").text == "Left out (1)"
    driver.execute_script(
        "[...document.querySelectorAll('#looks button')]"
        ".find((one) => one.textContent.includes('not placed')).click()"
    )
    target = np.array(driver.execute_script(TARGET))
    middle = np.median(drawing.cameras.centers[drawing.cameras.placed], axis=0)
    np.testing.assert_allclose(target, drawing.axes @ (drawing.cameras.poses.centers[24] - middle), atol=1e-5)
    assert complaints(driver) == []


SHOWN = "return document.querySelectorAll('.beside image').length === 2 && document.querySelector('.beside')"


def test_a_picture_stands_beside_that_of_another_camera_with_the_matches_of_the_pair(driver, tmp_path):
    cv2 = pytest.importorskip("cv2")
    drawing, facts = make_drawing()
    encoded = cv2.imencode(".jpg", np.zeros((24, 32, 3), dtype=np.uint8))[1].tobytes()
    picture = f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}"
    ends = drawing.pairs.cameras
    own = np.flatnonzero((ends == 3).any(axis=1) & drawing.cameras.placed[ends].all(axis=1))[:3]
    # The first has most matches, most of the second contradict; each draws one of either kind.
    corners = np.tile([[0, 0, 65535, 65535], [65535, 0, 0, 65535]], (3, 1))
    counts = np.array([[50, 1], [3, 20], [1, 1]])
    matches = DrawnMatches(own, counts, np.ones((3, 2), dtype=np.int64), corners)
    pictures = Pictures(dict.fromkeys(range(25), picture), matches)
    write_report(drawing, facts, tmp_path / "report.html", pictures)
    opened(driver, tmp_path / "report.html")
    names = drawing.cameras.names
    driver.find_element("css selector", "#cameras input").send_keys(names[3])
    click(driver, "#cameras tbody tr")

    def beside(pair):
        text = wait_for(driver, SHOWN).text
        other = names[ends[pair].sum() - 3]
        assert f"Beside {other}: " in text
        return text, driver.execute_script(
            "return [...document.querySelectorAll('.beside .match')].map((one) => one.getAttribute('d'))"
        )

    told, lines = beside(own[1])
    assert "2 of 23 matches drawn: 3 fit, 20 miss" in " ".join(told.split())
    swapped = ends[own[1], 0] != 3  # the chosen camera is on the left; pictures are 100 wide, 2 apart
    fits, contradicts = ("M100.0 75.0L102.0 0.0", "M0.0 75.0L202.0 0.0")
    straight = ("M0.0 0.0L202.0 75.0", "M100.0 0.0L102.0 75.0")
    assert lines == list((fits, contradicts) if swapped else straight)
    for _ in range(3):  # the keys go through the pairs, the facts stay those of the camera
        driver.execute_script(
            "const item = document.querySelector('#details li[aria-current=true] button');"
            "const key = new KeyboardEvent('keydown', {key: arguments[0], bubbles: true, cancelable: true});"
            "item.dispatchEvent(key);",
            "ArrowDown" if _ < 2 else "ArrowUp",
        )
    current = driver.find_element("css selector", "#details li[aria-current=true]").text
    assert f"Beside {current.split()[0]}" in wait_for(driver, SHOWN).text
    assert driver.find_element("css selector", "#details h3").text == names[3]
    click(driver, ".beside .link")
    assert driver.find_element("css selector", "#details h3").text == current.split()[0]
    assert complaints(driver) == []
    assert requests(driver) == []


def test_residuals_of_a_lens_are_arrows_with_their_scale_and_what_they_say(driver, tmp_path):
    drawing, facts = make_drawing()
    places = np.stack(np.meshgrid([0.25, 0.75], [0.25, 0.75]), axis=-1).reshape(-1, 2)
    means = np.array([[0.3, 0.0], [0.0, 0.3], [-0.3, 0.0], [0.0, -0.3]])
    field = LensField(
        "Camera 1, <b>OPENCV</b>", 1.5, places, means, "They point outward.", np.empty(0, dtype=np.int64)
    )
    write_report(replace(drawing, fields=(field,)), facts, tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    card = driver.find_element("id", "fields-card")
    assert "Camera 1, <b>OPENCV</b>" in card.text
    assert "They point outward." in card.text
    assert "0.2 px" in card.text  # a round length that is no longer than the arrows
    path = card.find_element("css selector", ".arrows").get_attribute("d")
    shafts = np.array(re.findall(r"M(\S+) (\S+)l(\S+) (\S+)m", path), dtype=float)
    bar = card.find_element("css selector", ".scale")
    per_px = (float(bar.get_attribute("x2")) - float(bar.get_attribute("x1"))) / 0.2
    np.testing.assert_allclose(shafts[:, 2:], per_px * means, atol=0.1)  # a tenth is the last digit
    assert (shafts[[1, 2], 0] > shafts[[0, 0], 0]).tolist() == [True, False]
    assert complaints(driver) == []


# Turns the scene for ten frames; returns the calls of WebGL, the largest array that is handed over, and how
# often a style was looked up.
TURNING = """
    const scene = document.getElementById('scene').scene, own = getComputedStyle, calls = {};
    const prototype = WebGL2RenderingContext.prototype, kept = {};
    let [styles, largest] = [0, 0];
    for (const name of Object.getOwnPropertyNames(prototype)) {
        const {value} = Object.getOwnPropertyDescriptor(prototype, name);
        if (typeof value !== 'function') continue;
        kept[name] = value;
        prototype[name] = (...given) => {
            calls[name] = (calls[name] || 0) + 1;
            for (const one of given) if (one && one.length > largest) largest = one.length;
        };
    }
    getComputedStyle = (...given) => { styles += 1; return own(...given); };
    for (let k = 0; k < 10; k++) { scene.view.yaw += 0.01; scene.draw(); }
    Object.assign(prototype, kept);
    getComputedStyle = own;
    return {calls, largest, styles};
"""


def test_a_frame_of_ten_thousand_cameras_is_a_dozen_calls_and_hands_nothing_over(driver, tmp_path):
    write_report(*make_drawing(10_000, 10_000, 10_000), tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    found = driver.execute_script(TURNING)
    drawn = found["calls"]["drawArrays"] + found["calls"]["drawArraysInstanced"]
    assert 4 * 10 <= drawn <= 12 * 10
    assert sum(found["calls"].values()) < 120 * 10
    assert not {name for name in found["calls"] if name.startswith(("buffer", "create", "tex"))}
    assert found["largest"] == 16  # the matrix
    assert found["styles"] == 0


def test_the_scene_is_coarse_while_it_turns_slowly_and_whole_again_when_it_rests(driver, report):
    opened(driver, report)
    slow = (
        SCENE + "const end = performance.now() + 120; scene.moved();"
        "requestAnimationFrame(() => { while (performance.now() < end); });"
    )
    for _ in range(2):
        driver.execute_script(slow)
    levels = wait_for(
        driver,
        SCENE + "scene.moved(); const now = performance.now(); while (performance.now() < now + 60);"
        "return scene.detail();",
    )
    assert 1 <= levels <= 3
    wait_for(driver, SCENE + "return scene.detail() === 0")


def test_a_thousand_cameras_are_shown(driver, tmp_path):
    write_report(*make_drawing(1000, 20_000, 20_000), tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    assert complaints(driver) == []


def test_the_first_view_holds_the_ring_and_not_the_few_cameras_far_away(driver, tmp_path):
    drawing, facts = make_drawing()
    centers = drawing.cameras.centers.copy()
    far = np.arange(25) % 5 == 2
    centers[far] *= 2.8
    trust = np.linspace(0.7, 1.0, 25)  # the page sorts by it
    trust[~drawing.cameras.placed] = np.nan
    drawing = replace(drawing, cameras=replace(drawing.cameras, centers=centers, trust=trust))
    write_report(drawing, facts, tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    rows = np.flatnonzero(drawing.cameras.placed & ~far).tolist()
    seen = np.array(driver.execute_script(f"{SCENE} return arguments[0].map(scene.project);", rows))[:, :2]
    size = driver.find_element("id", "canvas").size
    sides = np.array([size["width"], size["height"]])
    assert (seen > 0).all()
    assert (seen < sides).all()
    spans = np.ptp(seen, axis=0) / sides
    assert spans.max() > 0.8  # of 1/1.1, which the margin leaves


def test_points_far_behind_the_scene_do_not_make_a_dot_of_the_cameras(driver, tmp_path):
    drawing, facts = make_drawing()
    positions = drawing.points.xyz.copy()
    positions[::3] *= 20.0  # a third of the points
    drawing = replace(drawing, points=drawing.points._replace(xyz=3.0 * positions))
    write_report(drawing, facts, tmp_path / "report.html")
    opened(driver, tmp_path / "report.html")
    rows = np.flatnonzero(drawing.cameras.placed).tolist()
    seen = np.array(driver.execute_script(f"{SCENE} return arguments[0].map(scene.project);", rows))[:, :2]
    size = driver.find_element("id", "canvas").size
    assert (np.ptp(seen, axis=0) / [size["width"], size["height"]]).max() > 0.5
