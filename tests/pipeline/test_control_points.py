"""Ground control points set scale, origin and axes; what is wrong with them is said."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.cli import app
from sfm_shapefit.files.colmap.control_points import read_control_points
from sfm_shapefit.files.colmap.known import read_known
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.placement.control_points import control_gauge, fit_control_points
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.report.page import page_data
from sfm_shapefit.report.results import draw_result
from sfm_shapefit.scene.given import ControlPoints
from tests.models import write_priors
from tests.scenes import RING

TURN = pycolmap.Rotation3d(np.array([0.3, -0.2, 0.1])).matrix()
WORLD = Similarity(scale=2.5, rotation=TURN, translation=np.array([10.0, -20.0, 30.0]))
CORNERS = 0.3 * np.array([[1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0], [0, 0, 1], [0, 1, -1], [1, 0, 1]])


@pytest.fixture(scope="module")
def ring():
    return pycolmap.Reconstruction(RING / "sparse" / "0")


def marks_of(ring, points, world=WORLD.apply):
    """Return the lines of points (k, 3) of the ring's world: P0, P1, ..., with all their marks."""
    images = sorted(ring.images.values(), key=lambda image: image.name)
    lines = []
    for k, (point, xyz) in enumerate(zip(points, world(points).tolist(), strict=True)):
        for image in images:
            u, v = image.project_point(point)
            lines.append(
                " ".join(f"{value!r}" for value in (*xyz, float(u), float(v))) + f" {image.name} P{k}"
            )
    return lines


def written(folder, lines, projection="local"):
    path = folder / "gcp_list.txt"
    path.write_text("\n".join([projection, *lines]) + "\n")
    return str(path)


def centers_of(model):
    return {image.name: image.projection_center() for image in model.images.values() if image.has_pose}


def test_the_model_stands_where_the_points_are_and_check_points_say_so(ring, tmp_path):
    lines = marks_of(ring, CORNERS)
    for k, line in enumerate(lines):  # P6 checks only; P4 is a meter too high
        cells = line.split()
        if cells[6] == "P4":
            lines[k] = " ".join([*cells[:2], repr(float(cells[2]) + 1.0), *cells[3:]])
        if cells[6] == "P6":
            lines[k] = f"{line} check"
    wrong = lines[0].split()
    lines[0] = " ".join([*wrong[:3], repr(float(wrong[3]) + 300.0), *wrong[4:]])
    path = written(tmp_path, lines)
    found = sfm_shapefit.locate(ring, RING / "database.db", control_points=path, adjust="full")
    assert found.gauge.scale == "control points"
    assert found.gauge.statement.startswith(f"control points: 7 points of {path}; 5 of 6 agree")
    for name, center in centers_of(found.reconstruction).items():
        true = WORLD.apply(ring.find_image_with_name(name).projection_center()[None])[0]
        np.testing.assert_allclose(center, true, atol=1e-4)  # keypoints of float32 are off by 3e-5 px
    centers = [centers_of(found.reconstruction)[row.name] for row in found.cameras]
    np.testing.assert_allclose([row.center for row in found.cameras], centers, atol=1e-12)
    near = found.gauge.apply(found.placement.locations)
    np.testing.assert_allclose(near, [row.center for row in found.cameras], atol=1e-2)
    rows = {row["name"]: row for row in found.summary()["control_points"]}
    assert [rows[f"P{k}"]["use"] for k in range(7)] == ["control"] * 4 + ["unused", "control", "check"]
    assert rows["P6"]["error"] < 1e-4
    np.testing.assert_allclose(rows["P4"]["residual"], [0.0, 0.0, -1.0], atol=1e-3)
    assert rows["P0"]["num_agreeing_marks"] == rows["P0"]["num_marks"] - 1 == 7
    columns = found.table("control_points")
    assert list(columns["name"]) == [f"P{k}" for k in range(7)]
    assert columns["residual_z"][4] == rows["P4"]["residual"][2]
    assert (columns["num_marks"][0], columns["num_agreeing_marks"][0]) == (8, 7)
    data = page_data(draw_result(found), found.facts)
    assert data["control"][0][:3] == ["P4", "not used: contradicts the others", "1"]
    assert data["notes"]["control"].startswith("5 control points off by ")
    assert "; 1 check point off by " in data["notes"]["control"]
    said = " ".join(found.warnings)
    assert "1 control point contradicts the others and is not used: P4, off by 1; check" in said
    assert "1 mark of control points miss where the others put the point, that of P0 in" in said


def test_map_stands_where_the_points_are(ring, tmp_path):
    path = written(tmp_path, marks_of(ring, CORNERS))
    found = sfm_shapefit.map_database(RING / "database.db", control_points=path).models[0]
    for name, center in centers_of(found.reconstruction).items():
        true = WORLD.apply(ring.find_image_with_name(name).projection_center()[None])[0]
        np.testing.assert_allclose(center, true, atol=1e-3)


@pytest.mark.parametrize("fixed", [False, True])
def test_control_points_come_before_distances_and_priors_and_only_check_what_is_fixed(ring, tmp_path, fixed):
    centers = centers_of(ring)
    first, second = centers["0001.jpg"], centers["0004.jpg"]
    told = {
        "control_points": written(tmp_path, marks_of(ring, CORNERS)),
        "known_distance": ("0001.jpg", "0004.jpg", 1.1 * float(np.linalg.norm(first - second))),
        "priors": write_priors(tmp_path / "priors.txt", centers),
    }
    if fixed:
        (tmp_path / "names.txt").write_text("\n".join(sorted(centers)[:3]))
        told["fix"] = str(tmp_path / "names.txt")
    found = sfm_shapefit.locate(ring, RING / "database.db", **told)
    unused = [warning for warning in found.warnings if "not used" in warning]
    assert found.gauge.scale == ("fixed" if fixed else "control points")
    others = ["known distances", "position priors", *(["control points"] if fixed else [])]
    assert [warning.split(" were")[0] for warning in unused] == others
    assert all("; they differ by " in warning for warning in unused)
    assert {row.use for row in found.control_points} == {"check" if fixed else "control"}


ORIGIN = np.array([48.1, 11.5, 520.0])


def on_earth(points):
    """Latitude, longitude and altitude of points (k, 3), in meters from a place in Munich."""
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.enu_to_ellipsoid(points, *ORIGIN))


def in_utm(points):
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.ellipsoid_to_utm(on_earth(points))[0])


@pytest.mark.parametrize(
    ("projection", "world"),
    [
        ("EPSG:4326", lambda p: on_earth(p)[:, [1, 0, 2]]),
        ("+proj=longlat +datum=WGS84 +no_defs", lambda p: on_earth(p)[:, [1, 0, 2]]),
        ("WGS84 UTM 32N", in_utm),
        ("EPSG:32632", in_utm),
        ("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", in_utm),
    ],
)
def test_coordinates_on_earth_become_east_north_and_up_of_their_median(ring, tmp_path, projection, world):
    known = read_control_points(
        tmp_path / written(tmp_path, marks_of(ring, CORNERS, world), projection), read_model(ring).images
    )
    assert known.datum.geodetic == pytest.approx(np.median(on_earth(CORNERS), axis=0), abs=1e-5)
    apart = known.positions - known.positions[0]
    np.testing.assert_allclose(apart, CORNERS - CORNERS[0], atol=1e-6)  # a nanometer of UTM's series


def test_evaluate_maps_a_finished_model_onto_control_points_and_tells_both_errors(ring, tmp_path):
    moved = CORNERS + np.array([[0, 0, 0]] * 4 + [[0, 0, 0.4], [0, 0, 0], [0.12, 0, 0]])
    lines = marks_of(ring, CORNERS, lambda _: WORLD.apply(moved))
    lines = [f"{line} check" if line.endswith((" P5", " P6")) else line for line in lines]
    command = ["evaluate", str(RING / "sparse" / "0"), "--control-points", written(tmp_path, lines)]
    told = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    compared = told["control_points"]
    assert compared["control_rms"] < 1e-4  # pixels are exact
    assert compared["check_rms"] == pytest.approx(2.5 * 0.12 / np.sqrt(2.0), rel=1e-3)
    assert compared["points_from_model"]["scale"] == pytest.approx(2.5, rel=1e-4)
    np.testing.assert_allclose(compared["points_from_model"]["rotation"], TURN, atol=1e-4)
    assert [row["use"] for row in compared["points"]] == ["control"] * 4 + ["unused", "check", "check"]
    assert told["warnings"][-1].startswith(
        "1 control point contradicts the others and is not used: P4, off by 1"
    )
    said = " ".join(CliRunner().invoke(app, command).stdout.replace("│", " ").split())
    assert "4 control points off by" in said
    assert "2 check points off by 0.212 in space (root mean square), P6 most, by 0.3; 1 not used" in said
    assert "after a similarity onto 4 control points: scale 2.5, turned by 21.4 deg, moved by" in said
    with_reference = CliRunner().invoke(app, [*command[:2], *command[1:]])
    assert with_reference.exit_code == 2


def test_evaluate_compares_a_model_as_it_stands_with_fewer_than_three_control_points(ring, tmp_path):
    shifted = CORNERS[:4] + np.array([[0.3, 0, 0]] + [[0, 0, 0]] * 3)
    lines = marks_of(ring, CORNERS[:4], lambda _: shifted)
    path = written(tmp_path, [line if line.endswith(("P0", "P1")) else f"{line} check" for line in lines])
    compared = sfm_shapefit.evaluate_lengths(ring, control_points=path).control_points
    assert compared.points_from_model is None
    assert compared.check_rms == pytest.approx(0.15, abs=1e-4)
    assert "as the model stands: 2 of the control points can be triangulated" in compared.statement
    on_a_map = written(tmp_path, lines[:16], "EPSG:4326")
    with pytest.raises(InputError, match="the model does not say where on Earth it is, so it cannot be comp"):
        sfm_shapefit.evaluate_lengths(ring, control_points=on_a_map)


def test_evaluate_compares_points_on_earth_with_a_model_placed_by_others(ring, tmp_path):
    """The medians of the points differ by 15 cm, and so do the origins of the axes east, north and up."""
    path = written(tmp_path, marks_of(ring, CORNERS, in_utm), "WGS84 UTM 32N")
    found = sfm_shapefit.locate(ring, RING / "database.db", control_points=path)
    path = written(tmp_path, marks_of(ring, CORNERS[4:], in_utm)[:16], "WGS84 UTM 32N")
    compared = sfm_shapefit.evaluate_lengths(found, control_points=path).control_points
    assert compared.points_from_model is None
    assert [row.use for row in compared.points] == ["check"] * 2
    assert compared.check_rms < 1e-3


def test_points_on_both_sides_of_longitude_180_are_near_their_datum(ring, tmp_path):
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    geodetic = np.asarray(transform.enu_to_ellipsoid(CORNERS, -16.8, 180.0, 5.0))
    assert set(np.sign(geodetic[:, 1])) == {-1.0, 1.0}
    lines = marks_of(ring, CORNERS, lambda _: geodetic[:, [1, 0, 2]])
    known = read_control_points(tmp_path / written(tmp_path, lines, "EPSG:4326"), read_model(ring).images)
    apart = known.positions - known.positions[0]
    np.testing.assert_allclose(apart, CORNERS - CORNERS[0], atol=1e-6)


def line(k, image="0001.jpg", name=None):
    x, y, z = CORNERS[k].tolist()
    return f"{x} {y} {z} 100 100 {image} {f'P{k}' if name is None else name}"


TWICE = [line(k, image) for k in range(4) for image in ("0001.jpg", "0002.jpg")]


@pytest.mark.parametrize(
    ("projection", "lines", "said"),
    [
        ("EPSG:31468", TWICE, "line 1: the projection 'EPSG:31468' is not one that is converted"),
        ("+proj=utm +zone=32 +ellps=bessel", TWICE, "is not one that is converted"),
        ("WGS84 UTM 61N", TWICE, "is not one that is converted"),
        ("WGS84 UTM 32N", [one.replace("0.3 0.3", "5e5 1e28") for one in TWICE], "beyond those of UTM"),
        (
            "EPSG:4326",
            [line.replace("0.3 0.3", "11.0 95.0") for line in TWICE],
            "latitude or longitude is out",
        ),
        ("local", [*TWICE, "1 2 nan 3 4 0001.jpg P9"], "line 10: numbers must be finite, and all of them"),
        ("local", [*TWICE, "1 2 3 4 0001.jpg"], "line 10: expected x y z, two pixel coordinates"),
        ("local", [*TWICE, TWICE[0]], "line 10: P0 is marked twice in 0001.jpg; keep one of its marks"),
        ("local", [*TWICE, line(1, "0003.jpg", "P0")], "line 10: P0 has other coordinates than in line 2"),
        (
            "local",
            [*TWICE, f"{line(0, '0003.jpg')} check"],
            "line 10: P0 is a check point in one line and none",
        ),
        ("local", [line(k, "other.jpg") for k in range(4)], "has no mark in an image of the model, such as"),
        (
            "local",
            TWICE[:4],
            "2 of the control points have marks in two images of the model, and scale and axes",
        ),
        ("local", TWICE[::2], "0 of the control points have marks in two images"),
        (
            "local",
            [line.replace("0002.jpg", "9999.jpg") for line in TWICE],
            "in two images of the model, and scale and axes need three; the model has no 9999.jpg",
        ),
        ("local", [line.replace("P3", "CHK-3").replace("P2", "CHK-2") for line in TWICE], "2 of the control"),
        (
            "local",
            [f"{k} {k} {k} 1 1 {image} P{k}" for k in range(4) for image in ("0001.jpg", "0002.jpg")],
            "the control points that have marks in two images of the model lie on a line",
        ),
    ],
)
def test_a_file_that_cannot_serve_is_refused(ring, tmp_path, projection, lines, said):
    path = written(tmp_path, lines, projection)
    with pytest.raises(InputError, match=path.replace(".", r"\.")) as refused:
        read_known(read_model(ring).images, None, control_points=path)
    assert said in str(refused.value)


def test_an_empty_file_is_refused(ring, tmp_path):
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match=r"is empty; its first line is the projection"):
        read_control_points(tmp_path / "empty.txt", read_model(ring).images)


def test_points_that_cannot_be_triangulated_leave_the_model_as_it_is(ring, tmp_path):
    found = sfm_shapefit.locate(ring, RING / "database.db", control_points=written(tmp_path, TWICE))
    assert found.gauge.scale == "input"
    assert any("the model is not in the axes of the control points" in said for said in found.warnings)
    assert {row["use"] for row in found.summary()["control_points"]} == {"unused"}


@pytest.mark.parametrize("count", [5, 8])
def test_wrong_points_have_no_part_in_the_fit(count):
    """A quarter of the points is wrong, rounded down but one at least."""
    wrong, lost, found_all = max(1, count // 4), [], 0
    for seed in range(3):
        rng = np.random.default_rng([count, seed])
        found = rng.uniform(-10.0, 10.0, (count, 3))
        positions = WORLD.apply(found) + 0.02 * rng.standard_normal((count, 3))
        positions[:wrong] += 2.0 * rng.standard_normal((wrong, 3))
        none = np.zeros(0, dtype=np.int64)
        known = ControlPoints(
            names=tuple(map(str, range(count))),
            positions=positions,
            is_check=np.zeros(count, dtype=np.bool_),
            points=none,
            images=none,
            pixels=np.zeros((0, 2)),
            statement="",
        )
        fit = fit_control_points(known, found)
        found_all += not fit.fitting[:wrong].any()
        lost.append(int(np.sum(~fit.fitting[wrong:])))
        # Of 3 n coordinates with 7 parameters, sigma is known to 1 / sqrt(2 (3 n - 7)).
        if not fit.fitting[:wrong].any() and not lost[-1]:
            freedom = 3 * (count - wrong) - 7
            assert fit.sigma == pytest.approx(0.02, rel=4.0 / np.sqrt(2 * freedom))
    assert found_all == 3
    assert sum(lost) <= 1


def test_where_the_scale_is_known_control_points_turn_and_shift():
    rng = np.random.default_rng(8)
    found = rng.uniform(-10.0, 10.0, (6, 3))
    positions = 1.01 * replace(WORLD, scale=1.0).apply(found)
    none = np.zeros(0, dtype=np.int64)
    known = ControlPoints(
        names=tuple("abcdef"),
        positions=positions,
        is_check=np.zeros(6, dtype=np.bool_),
        points=none,
        images=none,
        pixels=np.zeros((0, 2)),
        statement="",
    )
    fit = fit_control_points(known, found, resize=False)
    assert fit.motion.scale == 1.0
    np.testing.assert_allclose(fit.motion.rotation, WORLD.rotation, atol=1e-9)
    np.testing.assert_allclose(fit.residuals.mean(axis=0), 0.0, atol=1e-9)
    rigs = Gauge(similarity=fit.motion, scale="rig", statement="rig: x; y", scale_statement="rig: x")
    gauge = control_gauge(rigs, known, fit, resize=False)
    assert gauge.scale == "rig"
    assert gauge.statement.startswith("rig: x; control points: ")
    assert gauge.statement.endswith("; origin and axes: theirs")
