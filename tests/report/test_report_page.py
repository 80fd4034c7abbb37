"""The report as a file: small, whole, honest about what it leaves out, and deaf to hostile names."""

import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.adjustment.estimate import BundleAdjustment
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.intrinsics import CameraIntrinsics
from sfm_shapefit.facts.lengths import LengthFacts
from sfm_shapefit.facts.placed import IN_MEMORY, KeyFigures
from sfm_shapefit.facts.scale_bars import ScaleBar
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, contradicting
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.reasons import Grade, ModelVerdict
from sfm_shapefit.report import thumbnails
from sfm_shapefit.report.charts import (
    reprojection_error_bars,
    residual_histogram,
    residuals_of_states,
    track_length_bars,
    view_graph_matrix,
)
from sfm_shapefit.report.drawing import MAX_PAIRS, PairClass, frustum_corners, view_axes
from sfm_shapefit.report.first_screen import banner, scene_name, tiles
from sfm_shapefit.report.page import page_data, report_html
from sfm_shapefit.report.sentences import first_looks, shorten, summary_sentences
from sfm_shapefit.report.thumbnails import read_thumbnails
from tests.drawings import draw, make_drawing, table_of
from tests.judgement.made import group_apart, opinion_with, place_of

HOSTILE = [
    "<script>document.title='owned'</script>.jpg",
    "</script><img src=x onerror=alert(1)>.jpg",
    "\"quotes\" and 'quotes' & &lt;entities&gt;.jpg",
    "new\nline\r\n\u2028separator\x00.jpg",
    "{{script}}{{data}}.jpg",
    "<b>bold</b><br><a href='http://example.org'>link</a>.jpg",
    "\u202eright to left\udcff.jpg",
    "x" * 10_000 + ".jpg",
]
ADJUSTED = BundleAdjustment(converged=True, iterations=9, initial_error_px=2.0, final_error_px=1.0)


def data_of(page):
    """Return the JSON of a page as a browser finds it: up to the first end of a script element."""
    return json.loads(page.split('id="data">')[1].split("</script", 1)[0])


def unpacked(column):
    kinds = {"f4": "<f4", "i4": "<i4", "u2": "<u2", "u1": "u1"}
    return np.frombuffer(base64.b64decode(column["bytes"]), kinds[column["type"]])


@pytest.fixture(scope="module")
def page():
    return report_html(*make_drawing())


def test_columns_survive_the_way_into_the_page_by_trust_and_contradicting_pairs_first(page):
    drawing, _ = make_drawing()
    data = data_of(page)
    order = [drawing.cameras.names.index(name) for name in data["cameras"]["names"]]
    centers = unpacked(data["cameras"]["center"]).reshape(-1, 3)
    world = data["middle"] + centers @ np.reshape(data["axes"], (3, 3)).T
    np.testing.assert_allclose(world, drawing.cameras.centers[order], atol=1e-5)
    ends = np.stack([unpacked(data["pairs"][end]) for end in ("first", "second")], axis=1)
    rows = drawing.pairs.worst_first()
    np.testing.assert_array_equal(np.array(order)[ends], drawing.pairs.cameras[rows])
    residuals = unpacked(data["pairs"]["residual"])
    np.testing.assert_array_equal(residuals, drawing.pairs.residuals_deg[rows].astype(np.float32))
    trust = unpacked(data["cameras"]["trust"])
    known = trust[np.isfinite(trust)]
    assert (np.diff(np.round(known, 2)) >= 0).all()  # as it is shown; of equal ones doubted ones come first
    assert np.isfinite(trust[: len(known)]).all()
    verdicts = unpacked(data["pairs"]["verdict"])
    count = int(np.sum(verdicts == PairClass.CONTRADICTS))
    assert (verdicts[:count] == PairClass.CONTRADICTS).all()
    assert (np.diff(residuals[:count]) <= 0).all()
    kinds = list(dict.fromkeys(PairClass(kind) for kind in verdicts.tolist()))
    ranked = [PairClass.CONTRADICTS, PairClass.REJECTED, PairClass.UNDETERMINED, PairClass.AGREES]
    assert kinds == [kind for kind in (*ranked, PairClass.NO_DIRECTION) if kind in kinds]


def test_the_page_is_small_and_the_same_for_the_same_scene():
    drawing, facts = make_drawing(1000, 20_000, 20_000)
    page = report_html(drawing, facts)
    assert len(page.encode()) < 2_500_000
    assert page == report_html(drawing, facts)


def test_of_many_pairs_the_worst_are_listed_and_the_page_says_so():
    drawing, facts = make_drawing(300, MAX_PAIRS + 10_000, 10)
    data = page_data(drawing, facts)
    assert len(unpacked(data["pairs"]["first"])) == MAX_PAIRS
    wrong = int(np.sum(drawing.pairs.classes == PairClass.CONTRADICTS))
    assert int(np.sum(unpacked(data["pairs"]["verdict"]) == PairClass.CONTRADICTS)) == wrong
    assert "30,000 pairs the worst 20,000" in data["pairsNote"]
    assert data["pairsNote"] in data["sceneNote"]
    counted = sum(data["histogram"]["counts"]["output"])
    assert counted == int(np.isfinite(drawing.pairs.residuals_deg).sum())  # all of them, listed or not
    assert page_data(*make_drawing())["pairsNote"] == ""


def test_hostile_names_stay_text_in_the_file():
    drawing, facts = make_drawing(num_cameras=len(HOSTILE), num_pairs=20, names=HOSTILE)
    facts = replace(
        facts,
        inputs=replace(facts.inputs, model=HOSTILE[0]),
        warnings=[f"look at {name}" for name in HOSTILE],
    )
    page = report_html(drawing, facts)
    assert page.count("<script") == report_html(*make_drawing()).count("<script")
    assert "<img" not in page.split("<script>", 1)[0]
    assert "<title>script&gt;.jpg" in page
    names = data_of(page)["cameras"]["names"]
    assert sorted(names) == sorted(shorten(name) for name in HOSTILE)
    assert max(map(len, names)) < 200
    page.encode("utf-8")  # lone surrogates would raise


def test_only_the_script_of_the_page_may_run_and_nothing_be_fetched(page):
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page).group(1)
    (script,) = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in policy
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy.split("script-src")[1].split(";")[0]
    assert not re.findall(r"(?:src|href)\s*=\s*[\"'](?!data:,)", page)
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "")


def test_the_words_say_what_is_placed_and_what_to_look_at():
    drawing, facts = make_drawing()
    text = " ".join(summary_sentences(drawing, facts))
    assert text.startswith("Of 120 pairs, 95 agree with the placed cameras and 18 contradict them; ")
    assert "The least certain position is that of " in text
    assert (
        "Uncertainties cover noise, rotations and calibration, relative to the model's mean position." in text
    )
    assert text.endswith("Units and axes: scale and origin of the input's centers.")
    assert "ShapeFit's optimum is certified to 3.0e-09" in " ".join(facts.expert_sentences())
    looks = first_looks(drawing, facts)
    assert looks[0].text == facts.warnings[0]
    assert any(look.camera == 24 and "not placed" in look.text for look in looks)
    least = int(np.nanargmin(drawing.cameras.trust))
    assert next(look for look in looks if "has trust" in look.text).camera == least
    pair = next(look.pair for look in looks if look.pair is not None)
    against = drawing.pairs.classes == PairClass.CONTRADICTS
    assert drawing.pairs.support[pair] == drawing.pairs.support[against].max()


def test_a_lens_in_doubt_is_a_row_of_the_table_and_no_sentence():
    drawing, facts = make_drawing()
    lens = CameraIntrinsics(
        image="0001.jpg",
        camera=3,
        num_images=7,
        model="SIMPLE_RADIAL",
        origin="a guess",
        decided_by="adjusted",
        given_focal_px=1000.0,
        focal_px=1100.0,
        focal_sigma_px=2.0,
        given_parameters=[1000.0, 0.0],
        parameters=[1100.0, 0.05],
    )
    facts = replace(facts, intrinsics=(lens,))
    (cells,) = page_data(drawing, facts)["intrinsics"]
    assert cells == ["3", "SIMPLE_RADIAL", "7", "1,000.0 (a guess)", "1,100.0 ± 2.0", "+10.0%", "0.0500"]
    assert not any("focal length" in sentence for sentence in summary_sentences(drawing, facts))
    held = replace(lens, decided_by="held", focal_px=1000.0, parameters=[1000.0, 0.0])
    assert held.cells[4:] == ["kept", "", ""]


def doubted():
    """A drawing with a group that stands apart, one within it, and a camera with another place."""
    drawing, facts = make_drawing()
    names = drawing.cameras.names

    def apart(*rows):
        return group_apart(*(names[k] for k in rows))

    place = replace(place_of(names[9], 2, 5), offset=(1.0, 2.0, -0.5))
    second = opinion_with(wrong=(names[4], names[12]))
    evidence = ModelEvidence(places=(place,), seams=(apart(4, 5), apart(3, 4, 5, 6)), second=second)
    return drawing, replace(facts, evidence=evidence, warnings=evidence.statements)


def test_a_group_that_stands_apart_and_another_place_reach_the_scene_and_are_told():
    drawing, facts = doubted()
    data = page_data(drawing, facts)
    columns, names = data["cameras"], drawing.cameras.names
    group = dict(zip(columns["names"], unpacked(columns["group"]).tolist(), strict=True))
    assert [group[name] for name in names[2:8]] == [-1, 1, 0, 0, 1, -1]
    assert [group[name] for name in names[11:14]] == [-1, 2, -1]  # elsewhere in the second opinion alone
    others = unpacked(columns["other"]).reshape(-1, 3)
    row = columns["names"].index(names[9])
    assert np.flatnonzero(np.isfinite(others).all(axis=1)).tolist() == [row]
    world = data["middle"] + np.reshape(data["axes"], (3, 3)) @ others[row]
    np.testing.assert_allclose(world, drawing.cameras.centers[9] + [1.0, 2.0, -0.5], atol=1e-5)
    assert unpacked(columns["otherCounts"])[2 * row : 2 * row + 2].tolist() == [2, 5]
    told = [look["text"].lower() for look in data["looks"]]
    assert all(any(statement[:60].lower() in text for text in told) for statement in facts.warnings)


def test_evidence_is_told_of_a_camera_of_which_something_else_is_told():
    drawing, facts = doubted()
    trust = drawing.cameras.trust.copy()
    trust[9] = 0.1
    drawing = replace(drawing, cameras=replace(drawing.cameras, trust=trust))
    texts = [look["text"] for look in page_data(drawing, facts)["looks"]]
    assert any("has trust 0.10" in text for text in texts)
    assert any(text.startswith("2 pairs put") for text in texts)


def test_the_banner_tells_cameras_that_are_left_out_from_those_that_may_be_wrong():
    drawing, facts = make_drawing()
    names = drawing.cameras.names
    assert not drawing.cameras.placed[24]
    for cameras, said in (
        (names[:2], f"{names[0]}, {names[1]} may be wrong; the others show no weakness."),
        (names[24:], f"{names[24]} is left out; the others show no weakness."),
        ((names[0], names[24]), f"{names[0]} may be wrong; {names[24]} is left out; the others show"),
        (names[:24], "and 21 more may be wrong."),
    ):
        verdict = ModelVerdict(grade=Grade.LOOK, cameras=cameras, reasons=())
        sentence = banner(drawing, replace(facts, verdict=verdict))["sentence"]
        assert said in sentence
        assert ("the others" in said) == ("the others" in sentence)


def test_a_warning_leads_to_its_camera_and_is_not_said_of_one_that_is_listed_anyway():
    drawing, facts = make_drawing()
    facts = replace(facts, warnings=[f"{name} looks odd" for name in drawing.cameras.names])
    looks = first_looks(drawing, facts)
    odd = [look.camera for look in looks if "looks odd" in look.text]
    listed = [look.camera for look in looks if "is not placed" in look.text or "has trust" in look.text]
    assert sorted([*odd, *listed]) == list(range(25))


@pytest.mark.parametrize(
    ("grade", "adjusted", "headline", "command"),
    [
        ("good", None, "Good: this model can be used", "workspace"),
        ("good", ADJUSTED, "Good: this model can be used", "workspace"),
        ("look", None, "Look at 2 cameras first", "workspace"),
        (
            "do not use",
            None,
            "Do not use this model",
            "map 'a folder/d.db' mapped",
        ),
    ],
)
def test_the_banner_says_whether_it_is_good_and_what_is_next(grade, adjusted, headline, command):
    drawing, facts = make_drawing()
    reasons = ["only 30% of the pairs agree"] if grade == "do not use" else []
    names = drawing.cameras.names[:2]
    facts = replace(
        facts,
        verdict=ModelVerdict(grade=Grade(grade), cameras=names, reasons=tuple(reasons)),
        bundle_adjustment=adjusted,
        inputs=replace(facts.inputs, model="a folder/sparse/0", database="a folder/d.db"),
    )
    found = banner(drawing, facts)
    assert (found["grade"], found["headline"]) == (grade, headline)
    assert command in found["command"]
    said = {
        "good": "24 of 25 cameras are placed; 1 is not in this model; 95 pairs agree with them, ",
        "look": "IMG_00000.jpg, images/IMG_00001.jpg may be wrong",
        "do not use": "Only 30% of the pairs agree; look at images/IMG_00000.jpg, images/IMG_00001.jpg.",
    }
    assert said[grade] in found["sentence"]


def test_what_map_made_and_is_not_to_be_used_is_inspected_where_it_was_written():
    _, facts = make_drawing()
    bad = ModelVerdict(grade=Grade.DO_NOT_USE, cameras=(), reasons=("it is folded",))
    inputs = replace(
        facts.inputs, model=IN_MEMORY, database="scene/database.db"
    )  # `inspect` takes no database
    step = replace(facts, verdict=bad, inputs=inputs).next_step
    assert step.command == "sfm-shapefit inspect {out} --database scene/database.db"


def test_tiles_tell_errors_in_pixels_and_degrees_and_how_uncertain_positions_are():
    drawing, facts = make_drawing()
    shown = {tile["label"]: tile["value"] for tile in tiles(drawing, facts)}
    order = (
        "cameras placed",
        "typical uncertainty",
        "3D points",
        "camera to check",
        "typical error of a pair",
    )
    assert [one for label in shown for one in order if label.startswith(one)] == list(order)
    assert shown["cameras placed"] == "24 of 25"
    assert shown["typical error of a pair"] == "1.4 px, 0.08°"
    assert shown["camera to check"] == "1"
    assert shown["typical uncertainty, 0.07% of the scene"] == "± 0.015 units"
    facts = replace(
        facts, figures=KeyFigures.of_cameras(table_of([], CameraRow), None, 1000.0, "units")
    )  # nothing is known
    labels = [tile["label"] for tile in tiles(drawing, facts)]
    assert not any(label.startswith(("typical error", "typical uncertainty")) for label in labels)


def test_an_ellipsoid_lies_along_the_axes_of_the_covariance_and_survives_the_way_into_the_page(page):
    drawing, _ = make_drawing()
    data = data_of(page)
    order = [drawing.cameras.names.index(name) for name in data["cameras"]["names"]]
    halves = unpacked(data["cameras"]["ellipsoids"]).reshape(-1, 3, 3)[0]
    covariance = drawing.cameras.covariances[order[0]]
    np.testing.assert_allclose(halves.T @ halves, drawing.axes @ covariance @ drawing.axes.T, atol=1e-9)
    products = halves @ halves.T  # they are orthogonal
    np.testing.assert_allclose(products - np.diag(np.diag(products)), 0.0, atol=1e-9)
    row = CameraRow(name="a", placed=True, center=(0, 0, 0), sigma=(3.0, 4.0, 1.0), correlation=(1.0, 0, 0))
    long = draw([row], []).cameras.ellipsoids[0, 2]  # errors along x and y are one and the same
    np.testing.assert_allclose(np.abs(long), [3.0, 4.0, 0.0], atol=1e-9)
    plane = CameraRow(name="a", placed=True, center=(0, 0), sigma=(3.0, 4.0), correlation=(1.0,))
    np.testing.assert_allclose(
        np.abs(draw([plane], [], dimension=2).cameras.ellipsoids[0, 2]), [3, 4, 0], atol=1e-9
    )


def test_every_point_is_in_a_bar_of_the_track_lengths_and_of_the_errors():
    lengths = np.array([2, 2, 3, 10, 11, 12, 40])
    bars = track_length_bars(lengths)
    named = dict(zip(bars["texts"], bars["counts"], strict=True))
    assert named["seen by 2 images"] == 2
    assert named["seen by 10-11 images"] == 2
    assert named["seen by 30-40 images"] == 1
    assert sum(bars["counts"]) == len(lengths)
    assert [place for place, _ in bars["ticks"]] == [k + 0.5 for k in range(len(bars["counts"]))]

    errors = np.append(np.linspace(0.0, 1.0, 100), [50.0, np.nan])
    bars = reprojection_error_bars(errors)
    assert sum(bars["counts"]) == 101
    assert bars["counts"][-1] == np.sum(errors >= float(bars["texts"][-1].split()[0]))
    assert bars["texts"][0] == "0 to 0.05 px"
    assert bars["counts"][0] == np.sum(errors < 0.05)
    assert track_length_bars(lengths[:0]) is None
    assert reprojection_error_bars(np.array([np.nan])) is None
    assert sum(reprojection_error_bars(np.zeros(3))["counts"]) == 3


def test_agreeing_pairs_and_median_errors_are_counted_per_camera():
    pairs = make_drawing()[0].pairs
    agreeing, errors = pairs.per_camera(26)  # the last has no pair
    for camera in (0, 7, 25):
        own = (pairs.cameras == camera).any(axis=1)
        assert agreeing[camera] == np.sum(own & (pairs.classes == PairClass.AGREES))
        expected = np.nanmedian(pairs.residuals_deg[own]) if own.any() else np.nan
        np.testing.assert_allclose(errors[camera], expected)


def test_options_that_differ_from_the_defaults_stand_apart():
    options = page_data(*make_drawing())["options"]
    assert [name for name, _ in options["changed"]] == ["scale", "min trust"]
    assert options["unchanged"] == [["solver", "auto"], ["refine", "yes"]]


def test_thumbnails_are_small_in_all_and_only_of_files_inside_the_folder(tmp_path, monkeypatch):
    cv2 = pytest.importorskip("cv2")
    picture = np.random.default_rng(5).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    (tmp_path / "images" / "sub").mkdir(parents=True)
    for name in ("images/a.jpg", "images/sub/b.png", "secret.jpg"):
        cv2.imwrite(str(tmp_path / name), picture)
    (tmp_path / "images" / "text.jpg").write_text("no picture")
    names = ["a.jpg", "sub/b.png", "../secret.jpg", "text.jpg", "missing.jpg", "\x00.jpg"]
    found = read_thumbnails(tmp_path / "images", names, np.arange(len(names), dtype=float))
    assert sorted(found) == [0, 1]
    raw = base64.b64decode(found[1].removeprefix("data:image/jpeg;base64,"))
    assert cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR).shape == (240, 320, 3)
    monkeypatch.setattr(thumbnails, "MAX_BYTES", 2000)
    assert sorted(read_thumbnails(tmp_path / "images", names, np.arange(len(names), dtype=float))) == [0]
    assert read_thumbnails(tmp_path / "images", names[2:], np.zeros(1)) == {}
    with pytest.raises(InputError, match="is no folder"):
        read_thumbnails(tmp_path / "secret.jpg", names, np.zeros(1))


def test_a_pair_that_is_off_by_little_does_not_contradict():
    told = {"name1": "aaa", "name2": "bbb", "verdict": ["outlier"] * 3, "residual_deg": [0.05, 1.5, np.nan]}
    columns = {name: list(values) for name, values in told.items()}
    assert contradicting(Table(PairRow, 3, columns)).tolist() == [False, True, True]


def test_a_good_model_lists_no_task():
    drawing, facts = make_drawing()
    good = replace(facts, verdict=ModelVerdict.weigh(()), warnings=["points have no colors"])
    assert [look.text for look in first_looks(drawing, good)] == ["Points have no colors"]


def test_what_is_said_of_a_camera_is_one_line_and_its_pairs_are_not_told_again():
    drawing, facts = make_drawing()
    names, against = drawing.cameras.names, drawing.pairs.classes == PairClass.CONTRADICTS
    worst = int(np.argmax(np.bincount(drawing.pairs.cameras[against].ravel())))
    others = [k for k in range(3, 9) if k != worst]
    told = [
        f"{names[worst]}: its pixels are off",
        f"{names[worst]}: its pairs too",
        f"{names[others[0]]} and {names[others[1]]} stand apart",
    ]
    trust = np.where(drawing.cameras.placed, 1.0, np.nan)
    drawing = replace(drawing, cameras=replace(drawing.cameras, trust=trust))
    looks = first_looks(drawing, replace(facts, warnings=told))
    (of_worst,) = (look.text for look in looks if look.camera == worst)
    assert of_worst == f"{names[worst]}: its pixels are off; its pairs too"
    assert told[2] in [look.text for look in looks if look.camera == others[0]]  # said of both
    assert all(worst not in drawing.pairs.cameras[look.pair] for look in looks if look.pair is not None)


def test_pairs_whose_matches_contradict_the_rotations_are_rejected_and_no_gray_pairs():
    names = [f"{k}.jpg" for k in range(4)]
    cameras = [CameraRow(name=name, placed=True, center=(k, k * k, 0)) for k, name in enumerate(names)]
    reasons = {1: "", 2: "most matches contradict the rotations", 3: "too few matches"}
    pairs = [
        PairRow(
            name1=names[0],
            name2=names[k],
            direction=() if reason else (1.0, 0.0, 0.0),
            residual_deg=float("nan") if reason else 0.1,
            support=10 * k,
            verdict="undetermined" if reason else "inlier",
            reason=reason,
        )
        for k, reason in reasons.items()
    ]
    drawing, (_, facts) = draw(cameras, pairs), make_drawing()
    assert drawing.pairs.classes.tolist() == [PairClass.AGREES, PairClass.REJECTED, PairClass.NO_DIRECTION]
    assert summary_sentences(drawing, facts)[0] == (
        "Of 3 pairs, 1 agrees with the placed nodes and 0 contradict them; 1 is rejected, as most of their "
        "matches contradict the rotations; 1 has no usable direction."
    )
    data = page_data(drawing, facts)
    assert unpacked(data["pairs"]["verdict"]).tolist() == [4, 0, 3]
    colors = "Blue agrees, violet is rejected, gray has no direction."
    assert (
        data["notes"]["matrix"]
        == f"{colors} The stronger the color, the more matches fit the pair (up to 30)."
    )
    assert "inlier and outlier" in data["pairsWords"]


def test_how_many_pairs_contradict_is_said_once():
    drawing, facts = make_drawing()
    warning = "60% of the pairs contradict the solution and are set aside"
    warned = replace(facts, warnings=(warning,))
    texts = [look.text for look in first_looks(drawing, warned)]
    assert sum("contradict" in text for text in texts) == 1
    assert sum("off by" in text for text in texts) == 3  # the worst are named all the same


@pytest.mark.parametrize(
    ("inputs", "title"),
    [
        ({"model": "project/sparse/0", "database": "a.db"}, "project"),
        ({"model": "/data/castle/dense/sparse", "database": None}, "castle"),
        ({"model": "in memory", "database": "scene/database.db"}, "scene"),
        ({"model": "in memory", "database": "a.db"}, "yard"),
        ({"model": "in memory", "database": "../yard/a.db"}, "yard"),
        ({"model": "in memory", "database": None}, "in memory"),
        ({"model": "0", "database": None}, "yard"),
    ],
)
def test_the_title_is_the_name_of_the_scene(inputs, title, tmp_path, monkeypatch):
    (tmp_path / "yard").mkdir()
    monkeypatch.chdir(tmp_path / "yard")
    facts = make_drawing()[1]
    assert scene_name(replace(facts, inputs=replace(facts.inputs, **inputs))) == title


LENGTHS = LengthFacts(
    length=10.0,
    half_width=0.004,
    worst_direction=[0.0, 0.1, 0.99],
    worst_half_width=0.006,
    unit="m",
    has_up=True,
    has_scale=True,
)


def test_a_length_is_told_in_the_users_unit_or_relative_and_never_where_nothing_is_known():
    drawing, facts = make_drawing()
    said = "length of 10 m is known to ± 4 mm (95 %), worst direction up (± 6 mm)"

    def told(lengths):
        known = replace(facts, lengths=lengths)
        values = [tile["value"] for tile in tiles(drawing, known) if tile["label"].startswith("on a length")]
        return " ".join(summary_sentences(drawing, known)), values

    text, values = told(LENGTHS)
    assert said in text
    assert values == ["± 4 mm"]
    text, values = told(replace(LENGTHS, has_scale=False))
    assert "the scene, a length is known to ± 0.04 % (95 %), worst direction up (± 0.06 %)." in text
    assert said not in text
    assert values == []
    text, values = told(None)
    assert "length" not in text
    assert values == []


def test_scale_bars_have_a_table_the_worst_first():
    drawing, facts = make_drawing()
    bar = ScaleBar(
        name="long",
        use="control",
        known=2.0,
        known_sigma=0.001,
        found=2.001,
        found_sigma=0.001,
        error=0.001,
        error_sigmas=0.7,
        error_px=0.5,
        num_marks=6,
        num_agreeing_marks=5,
    )
    worse = replace(bar, name="short", use="check", error_sigmas=-3.0)
    bars = page_data(drawing, replace(facts, scale_bars=(bar, worse)))["bars"]
    assert [cells[0] for cells in bars] == ["short", "long"]
    assert bars[1] == bar.cells
    assert replace(bar, use="unused").cells[1] == "not used: contradicts the others"


def test_of_cameras_of_equal_trust_those_whose_pairs_are_off_most_come_first():
    drawing, facts = make_drawing()
    trusted = replace(drawing.cameras, trust=np.ones_like(drawing.cameras.trust), reasons=[""] * 25)
    facts = replace(facts, verdict=replace(facts.verdict, cameras=()))
    errors_deg = unpacked(page_data(replace(drawing, cameras=trusted), facts)["cameras"]["error"])
    known = errors_deg[np.isfinite(errors_deg)]
    assert len(known) > 20
    assert (np.diff(known) <= 0.0).all()


def test_nothing_known_nothing_claimed():
    drawing, facts = make_drawing(num_cameras=3, num_pairs=2, num_points=0)
    figures = KeyFigures.of_cameras(table_of([], CameraRow), None, 1000.0, "units")
    none = {
        "residual_level_deg": None,
        "mean_reprojection_error_px": None,
        "sigma_of": "",
        "figures": figures,
    }
    data = page_data(drawing, replace(facts, warnings=[], loose_groups=[], **none))
    assert "standard deviation" not in " ".join(data["expertFacts"])
    json.dumps(data, allow_nan=False)


def test_residuals_at_the_optimum_are_angles_and_the_histogram_counts_the_same_pairs_in_each_state():
    pairs = make_drawing()[0].pairs
    used = pairs.classes != PairClass.NO_DIRECTION
    # The made optimum is the truth plus 1 cm per axis and end, on baselines of 2 m: 2 degrees are 5 sigma.
    assert np.nanmax(pairs.certified_deg[used]) < 2.0
    assert np.isnan(pairs.certified_deg[~used]).all()
    residuals = residuals_of_states(pairs)
    totals = {state: sum(counts) for state, counts in residual_histogram(residuals)["counts"].items()}
    assert list(totals) == ["input", "optimum", "output"]
    assert len(set(totals.values())) == 1
    assert np.median(residuals["output"]) == pytest.approx(np.nanmedian(pairs.residuals_deg))


def test_the_matrix_counts_the_pairs_of_cells_that_several_cameras_share():
    drawing, _ = make_drawing()
    matrix = view_graph_matrix(drawing.pairs, np.arange(25))
    assert (matrix["side"], matrix["perCell"]) == (25, 1)  # the listed pairs say the rest

    large, _ = make_drawing(1000, 5000, 0)
    matrix = view_graph_matrix(large.pairs, np.arange(1000))
    assert (matrix["side"], matrix["perCell"]) == (200, 5)
    counts, against = (np.tril(unpacked(matrix[key]).reshape(200, 200)) for key in ("counts", "against"))
    assert counts.sum() == 5000
    assert against.sum() == np.sum(large.pairs.classes == PairClass.CONTRADICTS)


def test_frusta_stand_before_their_cameras_with_the_pictures_shape():
    drawing, _ = make_drawing()
    rows = np.arange(24)
    centers = drawing.cameras.centers[rows]
    corners = frustum_corners(drawing, rows, centers)
    middle = corners.mean(axis=1) - centers
    np.testing.assert_allclose(
        middle, drawing.frustum_depth * drawing.cameras.poses.rotations[rows, 2], atol=1e-12
    )
    width = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    np.testing.assert_allclose(width, 2 * 0.6 * drawing.frustum_depth)


def test_up_is_where_level_cameras_have_it_and_a_long_name_keeps_both_its_ends():
    rotations = make_drawing()[0].cameras.poses.rotations  # they look inwards all around, y down
    axes = view_axes(rotations)
    np.testing.assert_allclose(axes[2], [0, -1, 0], atol=0.05)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    downwards = np.array([[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]])
    np.testing.assert_allclose(view_axes(downwards)[2], [0, -1, 0], atol=1e-6)  # they look along +y
    text = shorten("a" * 300 + "end.jpg")
    assert (text[:3], text[-7:], len(text) < 180) == ("aaa", "end.jpg", True)
