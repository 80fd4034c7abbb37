"""Models of other programs: the axes, signs and units of each, checked on a camera worked out by hand.

The scene: two cameras look along the world's +x axis with the world's +z up, so in COLMAP's
camera axes (x right, y down, z forward) right is -y and down is -z:

    cam_from_world = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]

Camera 0 stands at (1, 2, 3), camera 1 at (1, 0, 3). With f = 100 px and the center at (50, 40), the point
(11, 1, 5) is at (1, -2, 10) in camera 0 and at (-1, -2, 10) in camera 1: at pixels (60, 20) and (40, 20).
"""

import csv
import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.commands.place import place_graph_file
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.other_programs import model_of_opensfm, relative_poses_of
from sfm_shapefit.files.glomap_text import is_relative_poses, read_relative_poses
from sfm_shapefit.files.nerf import nerf_text
from sfm_shapefit.files.opensfm import read_opensfm
from sfm_shapefit.files.tum import poses_csv, tum_text
from sfm_shapefit.scene.lens import Lens
from tests.program import run
from tests.scenes import COURTYARD, RING

R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CENTERS = np.array([[1.0, 2.0, 3.0], [1.0, 0.0, 3.0]])
POINT = np.array([11.0, 1.0, 5.0])
PIXELS = np.array([[60.0, 20.0], [40.0, 20.0]])
NAMES = ("a.jpg", "b.jpg")
TURN = [1.2091995761561452, -1.2091995761561452, 1.2091995761561452]  # R: 120 deg about (1, -1, 1) / sqrt(3)

SIZE = {"width": 100, "height": 80}
OPENSFM = [
    {
        "cameras": {"c": {"projection_type": "perspective", **SIZE, "focal": 1.0, "k1": 0, "k2": 0}},
        "shots": {
            name: {"rotation": TURN, "translation": (-R @ center).tolist(), "camera": "c"}
            for name, center in zip(NAMES, CENTERS, strict=True)
        },
        "points": {"7": {"coordinates": POINT.tolist(), "color": [10.0, 20.0, 30.0]}},
    }
]
TRACKS = (
    "OPENSFM_TRACKS_VERSION_v2\n"
    "a.jpg\t7\t0\t0.1\t-0.2\t0.01\t1\t2\t3\t-1\t-1\n"
    "b.jpg\t7\t0\t-0.1\t-0.2\t0.01\t1\t2\t3\t-1\t-1\n"
)


def opensfm_file(folder, content=OPENSFM, tracks=TRACKS):
    (folder / "tracks.csv").write_text(tracks)
    (folder / "reconstruction.json").write_text(json.dumps(content))
    return folder / "reconstruction.json"


def read_foreign(file):
    return read_model(model_of_opensfm(read_opensfm(file)))


def test_a_hand_made_scene_is_read_with_the_right_axes_and_units(tmp_path):
    model = read_foreign(opensfm_file(tmp_path))
    images = model.images
    assert images.names == NAMES
    np.testing.assert_allclose(images.rotations, [R, R], atol=1e-15)
    np.testing.assert_allclose(images.centers, CENTERS, atol=1e-14)
    np.testing.assert_allclose(images.focal_lengths_px, 100.0)
    (point,) = model.reconstruction.points3D.values()
    np.testing.assert_array_equal(point.xyz, POINT)
    # The point projects onto its observations: poses, intrinsics and pixels share one convention.
    assert point.error < 1e-9
    for k, image_id in enumerate(images.ids.tolist()):
        np.testing.assert_allclose(model.reconstruction.image(image_id).points2D[0].xy, PIXELS[k])


def test_distortion_is_taken_over_in_colmaps_order(tmp_path):
    brown = {"projection_type": "brown", "width": 80, "height": 100, "focal_x": 1.0, "focal_y": 1.1}
    brown |= {"c_x": 0.01, "c_y": -0.02, "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.04, "p2": 0.05}
    (lens,) = read_opensfm(opensfm_file(tmp_path, [OPENSFM[0] | {"cameras": {"c": brown}}])).images.lenses
    expected = (100.0, 110.0, 41.0, 48.0, 0.1, 0.2, 0.04, 0.05, 0.3, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(lens.parameters, expected, rtol=1e-15)
    fisheye = brown | {"projection_type": "fisheye_opencv", "k4": 0.4}
    (lens,) = read_opensfm(opensfm_file(tmp_path, [OPENSFM[0] | {"cameras": {"c": fisheye}}])).images.lenses
    np.testing.assert_allclose(lens.parameters, (*expected[:6], 0.3, 0.4), rtol=1e-15)
    panorama = {"projection_type": "spherical", "width": 200, "height": 100}
    (lens,) = read_opensfm(opensfm_file(tmp_path, [OPENSFM[0] | {"cameras": {"c": panorama}}])).images.lenses
    assert (lens.model, lens.parameters) == ("EQUIRECTANGULAR", (200, 100))


@pytest.mark.parametrize("kind", ["spherical", "equirectangular"])
def test_a_panorama_of_opensfm_is_equirectangular(tmp_path, kind):
    camera = {"projection_type": kind, "width": 1200, "height": 600}
    (lens,) = read_opensfm(opensfm_file(tmp_path, [OPENSFM[0] | {"cameras": {"c": camera}}])).images.lenses
    assert (lens.model, lens.parameters) == ("EQUIRECTANGULAR", (1200.0, 600.0))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"focal": 1.0', '"fokal": 1.0', r"\[0\]/cameras/c has no key 'focal'"),
        ('"focal": 1.0', '"focal": NaN', r"\[0\]/cameras/c/focal is not finite"),
        ('"perspective"', '"dual"', r"projection type 'dual'; perspective, brown"),
        ('"camera": "c"', '"camera": "d"', r"shots/a\.jpg has the camera 'd'"),
        ('"width": 100', '"width": "wide"', r"cameras/c/width is no number"),
        ('"shots"', "shots", r"line 1, column \d+: no JSON"),
        ('"shots": {', '"shots": {}, "others": {', r"\[0\] has no shots"),
    ],
)
def test_a_malformed_file_is_refused_by_its_line_or_key(tmp_path, old, new, message):
    file = opensfm_file(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_opensfm(file)


def test_a_malformed_line_of_tracks_and_a_file_that_is_no_model_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"tracks\.csv, line 2: expected image, track"):
        read_opensfm(opensfm_file(tmp_path, tracks=TRACKS.replace("0.1\t-0.2", "left", 1)))
    (tmp_path / "other.json").write_text('{"frames": []}')
    with pytest.raises(InputError, match=r"is no model: give OpenSfM's reconstruction\.json"):
        read_opensfm(tmp_path / "other.json")


def test_locate_says_how_a_foreign_model_is_read(tmp_path):
    error = run("locate", opensfm_file(tmp_path), tmp_path / "out", code=3).stderr
    assert "`convert` makes one of OpenSfM's reconstruction.json" in error


@pytest.fixture(scope="module")
def courtyard():
    return read_model(COURTYARD / "truth").images


def test_transforms_json_has_opengl_axes_and_poses_come_back(tmp_path, courtyard):
    frames = json.loads(nerf_text(read_opensfm(opensfm_file(tmp_path)).images))
    # Columns: right is -y, up is +z, backwards is -x; then the center.
    expected = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(frames["frames"][0]["transform_matrix"], expected, atol=1e-15)
    assert frames["frames"][0]["file_path"] == "images/a.jpg"
    assert (frames["fl_x"], frames["cx"], frames["cy"], frames["w"]) == (100.0, 50.0, 40.0, 100)
    assert frames["camera_angle_x"] == pytest.approx(2 * np.arctan(0.5))
    flip = np.diag([1.0, -1.0, -1.0])
    matrices = np.array([frame["transform_matrix"] for frame in json.loads(nerf_text(courtyard))["frames"]])
    np.testing.assert_array_equal(flip @ matrices[:, :3, :3].swapaxes(1, 2), courtyard.rotations)
    np.testing.assert_array_equal(matrices[:, :3, 3], courtyard.centers)
    lens = Lens("FOV", (1.0, 1.0, 0.0, 0.0, 0.5))
    with pytest.raises(InputError, match="camera model FOV has no equivalent"):
        nerf_text(courtyard.with_lenses([lens]))


def test_a_trajectory_has_world_from_camera_and_the_names_as_times(tmp_path):
    scene = replace(read_opensfm(opensfm_file(tmp_path)).images, names=("2.5.png", "1.25.png"))
    lines = tum_text(scene).splitlines()
    # R^T is a turn by -120 degrees about (1, -1, 1) / sqrt(3): qw = cos 60, q = -sin 60 / sqrt(3) (1, -1, 1).
    assert lines[1].split()[0] == "1.25"
    np.testing.assert_allclose(
        np.array(lines[2].split(), dtype=float), [2.5, 1, 2, 3, -0.5, 0.5, -0.5, 0.5], atol=1e-15
    )


@pytest.mark.parametrize("kind", ["tum", "csv"])
def test_poses_come_back_from_text(courtyard, kind):
    if kind == "tum":
        rows = [line.split() for line in tum_text(courtyard).splitlines()[1:]]
        order = np.argsort([int(name.split(".")[0]) for name in courtyard.names])
        centers = np.array([row[1:4] for row in rows], dtype=float)
        rotations = Rotation.from_quat([row[4:8] for row in rows]).as_matrix().swapaxes(1, 2)
    else:
        rows = list(csv.DictReader(poses_csv(courtyard).splitlines()))
        order = np.arange(len(rows))
        assert [row["name"] for row in rows] == list(courtyard.names)
        centers = np.array([[row[k] for k in "xyz"] for row in rows], dtype=float)
        rotations = Rotation.from_quat([[row[f"q{k}"] for k in "xyzw"] for row in rows]).as_matrix()
    np.testing.assert_array_equal(centers, courtyard.centers[order])
    np.testing.assert_allclose(rotations, courtyard.rotations[order], atol=1e-14)


def test_a_relative_pose_has_its_second_camera_where_the_first_sees_it(tmp_path):
    # x_2 = x_1 + t: camera 2 stands at -t in the axes of camera 1.
    (tmp_path / "pairs.txt").write_text("# comment\nb.jpg a.jpg 1 0 0 0 -2 0 0\n")
    poses = read_relative_poses(tmp_path / "pairs.txt")
    assert poses.names == NAMES
    assert poses.pairs.tolist() == [[1, 0]]
    np.testing.assert_array_equal(poses.to_second, [[1.0, 0.0, 0.0]])


def relative_poses_of_ring():
    model = read_model(RING / "sparse" / "0").images
    i, j = np.triu_indices(model.num_images, 1)
    rotations = model.rotations[j] @ model.rotations[i].transpose(0, 2, 1)
    towards = np.einsum("kab,kb->ka", model.rotations[i], model.centers[j] - model.centers[i])
    units = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return model, np.column_stack([i, j]), rotations, units


def test_relative_poses_come_back_and_are_solved(tmp_path):
    model, pairs, rotations, units = relative_poses_of_ring()
    quaternions = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    rows = np.column_stack([quaternions, -np.einsum("kab,kb->ka", rotations, units)]).tolist()
    text = (
        f"{model.names[i]} {model.names[j]} {row}" for (i, j), row in zip(pairs.tolist(), rows, strict=True)
    )
    (tmp_path / "relpose.txt").write_text("\n".join(text).translate(str.maketrans("", "", "[],")))
    back = read_relative_poses(tmp_path / "relpose.txt")
    assert back.names == model.names
    np.testing.assert_array_equal(back.pairs, pairs)
    np.testing.assert_allclose(back.rotations, rotations, atol=1e-14)
    np.testing.assert_allclose(back.to_second, units, atol=1e-14)
    found = place_graph_file(tmp_path / "relpose.txt")
    # Averaged rotations stop at 1e-3 rad, which bounds what positions can be.
    spread = found.placement.locations - found.placement.locations.mean(axis=0)
    true = model.centers - model.centers.mean(axis=0)
    distances = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (spread, true)]
    ratios = distances[0][np.triu_indices(len(true), 1)] / distances[1][np.triu_indices(len(true), 1)]
    assert np.ptp(ratios) / np.mean(ratios) < 0.01


def test_a_pose_graph_gives_the_same_relative_poses():
    _, pairs, rotations, units = relative_poses_of_ring()
    graph = pycolmap.PoseGraph()
    for (i, j), rotation, unit in zip(pairs.tolist(), rotations, units, strict=True):
        edge = pycolmap.PoseGraphEdge(
            cam2_from_cam1=pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -3.0 * rotation @ unit),
            num_matches=10 * i + j,
        )
        graph.add_edge(i + 1, j + 1, edge)
    poses = relative_poses_of(graph)
    assert poses.names == tuple(str(k + 1) for k in range(8))
    np.testing.assert_array_equal(poses.pairs, pairs)
    assert rotation_angles_deg(poses.rotations.transpose(0, 2, 1) @ rotations).max() < 1e-6
    np.testing.assert_allclose(poses.to_second, units, atol=1e-12)
    np.testing.assert_array_equal(poses.num_matches, pairs @ [10, 1])
    pose = edge.cam2_from_cam1
    graph.update_edge(i + 1, j + 1, pycolmap.PoseGraphEdge(cam2_from_cam1=pose, num_matches=0))
    assert relative_poses_of(graph).num_matches is None


def test_a_tenth_word_of_relative_poses_counts_matches(tmp_path):
    lines = ["a b 1 0 0 0 1 0 0 50", "b c 1 0 0 0 0 1 0 7"]
    (tmp_path / "pairs.txt").write_text("\n".join(lines))
    assert is_relative_poses(tmp_path / "pairs.txt")
    assert read_relative_poses(tmp_path / "pairs.txt").num_matches.tolist() == [50.0, 7.0]
    for line, message in [
        ("a c 1 0 0 0 0 0 1", "line 3: has 9 columns, expected 10"),
        ("a c 1 0 0 0 0 0 1 0", "line 3: has no positive number of matches"),
    ]:
        (tmp_path / "pairs.txt").write_text("\n".join([*lines, line]))
        with pytest.raises(InputError, match=message):
            read_relative_poses(tmp_path / "pairs.txt")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a b 1 0 0 0 1 0", r"line 2: has 8 columns, expected 9"),
        ("a b 1 1 0 0 1 0 0", r"line 2: has no unit quaternion"),
        ("a b 1 0 0 0 0 0 0", r"line 2: has no translation"),
        ("a a 1 0 0 0 1 0 0", r"line 2: joins a camera with itself"),
        ("d c 1 0 0 0 1 0 0", r"line 2: repeats an earlier pair"),
        ("a b 1 0 0 0 1 0 x", r"line 2: 'x' is not a number"),
    ],
)
def test_a_malformed_relative_pose_is_refused_by_its_line(tmp_path, line, message):
    (tmp_path / "pairs.txt").write_text(f"c d 1 0 0 0 1 0 0\n{line}\n")
    with pytest.raises(InputError, match=message):
        read_relative_poses(tmp_path / "pairs.txt")


def test_convert_writes_every_format_and_replaces_nothing_unasked(tmp_path):
    source = RING / "sparse" / "0"
    for name in ("bin", "text", "t.json", "t.tum", "t.csv", "t.glb", "t.ply"):
        extra = ["--format", "colmap-txt"] if name == "text" else []
        run("convert", source, tmp_path / name, *extra, code=0)
        again = run("convert", source, tmp_path / name, *extra, code=3)
        assert ("." in name and "exists already" in again.output) or "never replaced" in again.output
    folder = run("convert", source, tmp_path / "bin", "--format", "csv", "--overwrite", code=3)
    assert "is a folder; give the name of a file" in folder.output
    nowhere = run("convert", source, tmp_path / "no" / "t.csv", code=3)
    assert "does not exist; make it, or name another" in nowhere.output
    truth = read_model(source)
    for name in ("bin", "text"):
        copy = read_model(tmp_path / name)
        np.testing.assert_array_equal(copy.images.centers, truth.images.centers)
        assert copy.reconstruction.num_points3D() == truth.reconstruction.num_points3D()
    run("convert", source, tmp_path / "t.csv", "--overwrite", code=0)
    run("convert", source, tmp_path / "t.xyz", code=3)


def test_a_foreign_model_becomes_a_colmap_model(tmp_path):
    sfm_shapefit.convert(opensfm_file(tmp_path), tmp_path / "model")
    model = read_model(tmp_path / "model")
    np.testing.assert_allclose(model.images.centers, CENTERS, atol=1e-14)
    assert model.reconstruction.num_points3D() == 1
