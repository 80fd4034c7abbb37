"""The 1DSfM format and g2o: conventions, round trips, and malformed lines by their number."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import angle_between_deg, fit_similarity, normalized, tangent_bases
from sfm_shapefit.commands.place import place_graph_file
from sfm_shapefit.files.g2o import is_g2o, read_g2o, read_g2o_rotations
from sfm_shapefit.files.onedsfm import is_onedsfm, read_onedsfm, read_rotations
from tests.scenes import real_scene

IDENTITY = "1 0 0 0 1 0 0 0 1"
GOOD = f"3 7 {IDENTITY} 1 0 0\n3 12 {IDENTITY} 0 1 0\n7 12 {IDENTITY} 0 0 1\n"


def scene(n=6, seed=4):
    """Bundler cameras: world-to-camera rotations (n, 3, 3), y up, looking along -z, and centers (n, 3)."""
    rng = np.random.default_rng(seed)
    return Rotation.random(n, random_state=rng).as_matrix(), rng.standard_normal((n, 3))


def egs_text(rotations, centers):
    """EGs.txt as its manual says: R_i R_j^T, and the direction to camera j in the axes of camera i."""
    lines = []
    for i in range(len(centers)):
        for j in range(i + 1, len(centers)):
            t = rotations[i] @ (centers[j] - centers[i])
            row = [*(rotations[i] @ rotations[j].T).ravel(), *(t / np.linalg.norm(t))]
            lines.append(f"{10 * i} {10 * j} {' '.join(map(repr, map(float, row)))}\n")
    return "".join(lines)


def rots_text(rotations):
    return "".join(f"{10 * k} {' '.join(map(repr, R.ravel().tolist()))}\n" for k, R in enumerate(rotations))


def folder_with(path, **files):
    path.mkdir(exist_ok=True)
    for name, text in files.items():
        (path / f"{name}.txt").write_text(text)
    return path


def write_scene(path, n=6, num_rotations=None):
    """Write a scene as a 1DSfM folder, and return it with the rotations and centers."""
    rotations, centers = scene(n)
    rots = rots_text(rotations[:num_rotations])
    return folder_with(path, EGs=egs_text(rotations, centers), rots=rots), rotations, centers


def test_directions_in_world_axes_point_to_the_first_camera_and_camera_axes_become_those_of_colmap(tmp_path):
    folder, rotations, centers = write_scene(tmp_path)
    found = read_onedsfm(folder)
    cam_from_world, all_known = read_rotations(folder / "rots.txt", found.names)
    graph = found.measured(cam_from_world, all_known).graph
    i, j = graph.edges.T
    assert graph.names == ("0", "10", "20", "30", "40", "50")
    np.testing.assert_allclose(graph.directions, normalized(centers[i] - centers[j]), atol=1e-12)
    # Bundler's camera looks along -z and its y is up: in COLMAP's axes both turn round.
    np.testing.assert_allclose(cam_from_world[:, 1:], -rotations[:, 1:], atol=1e-12)
    i, j = found.pairs.T
    relative = cam_from_world[j] @ cam_from_world[i].swapaxes(1, 2)  # cam_j_from_cam_i
    np.testing.assert_allclose(found.rotations, relative, atol=1e-12)


def test_cameras_without_rotation_have_no_directions_and_the_format_is_told_from_bare_graphs(tmp_path):
    folder, _, _ = write_scene(tmp_path, num_rotations=4)
    found = read_onedsfm(folder)
    graph = found.measured(*read_rotations(folder / "rots.txt", found.names)).graph
    assert graph.degrees().tolist() == [3, 3, 3, 3, 0, 0]
    folder_with(folder, graph="0 1 1 0 0\n1 2 0 1 0\n", wide="0 1 1" + " 0" * 11 + "\n")
    assert is_onedsfm(folder)
    assert is_onedsfm(folder / "EGs.txt")
    for name in ("graph.txt", "wide.txt", "nowhere.txt"):  # the second has directions in 12 dimensions
        assert not is_onedsfm(folder / name)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("EGs", "", "no lines of the form i j R11"),
        ("EGs", f"1 2 {IDENTITY} 1 0\n", "line 1: has 13 columns, expected 14"),
        ("EGs", f"{GOOD}\n1 2 {IDENTITY} 1 0 x\n", "line 5: 'x' is not a number"),
        ("EGs", f"{GOOD}1 2 {IDENTITY} 1 0 inf\n", "line 4: has a number that is not finite"),
        ("EGs", f"{GOOD}1 2 1 0 0 0 1 0 0 0 -1 1 0 0\n", "line 4: has no rotation matrix"),
        ("EGs", f"{GOOD}1 2 2 0 0 0 1 0 0 0 1 1 0 0\n", "line 4: has no rotation matrix"),
        ("EGs", f"{GOOD}1 2 {IDENTITY} 2 0 0\n", "line 4: has no unit direction"),
        ("EGs", f"{GOOD}1 1 {IDENTITY} 1 0 0\n", "line 4: joins a camera with itself"),
        ("EGs", f"{GOOD}7 3 {IDENTITY} 1 0 0\n", "line 4: repeats an earlier pair"),
        ("rots", f"3 {IDENTITY}\n7 1 2 3\n", "line 2: has 4 columns, expected 10"),
        ("rots", f"3 {IDENTITY}\n7 1 0 0 0 1 0 0 0 2\n", "line 2: has no rotation matrix"),
        ("rots", f"3 {IDENTITY}\n3 {IDENTITY}\n", "line 2: gives an earlier camera a second rotation"),
        ("rots", f"4 {IDENTITY}\n", "a rotation of none of the 3 cameras"),
        ("cc", "3\n7 1\n", "line 2: is not one"),
        ("cc", "1\n", "keeps no pair"),
    ],
)
def test_malformed_pairs_rotations_and_components_are_refused_by_line(tmp_path, name, text, words):
    folder_with(tmp_path, **({"EGs": GOOD} | {name: text}))
    with pytest.raises(InputError, match=words):
        read_rotations(tmp_path / "rots.txt", read_onedsfm(tmp_path).names)


def test_the_published_scene_has_the_conventions_of_its_manual():
    source = real_scene("1dsfm-Madrid_Metropolis")
    found = read_onedsfm(source)
    assert (len(found.names), len(found.pairs)) == (394, 23_784)
    stored = np.load(source / "viewgraph.npz")
    names = [str(k) for k in stored["image_index"].tolist()]
    assert set(names) == set(found.names)
    ours = {(found.names[i], found.names[j]): k for k, (i, j) in enumerate(found.pairs.tolist())}
    rows = [ours[names[i], names[j]] for i, j in stored["edges"].tolist()]
    np.testing.assert_allclose(found.rotations[rows], stored["R_ji"], atol=1e-5)  # six digits, float32
    to_second = -np.einsum("eba,eb->ea", stored["R_ji"], stored["t_ji"]).astype(np.float64)
    assert angle_between_deg(found.to_second[rows], to_second).max() < 1e-3


def vertices_text(centers, cam_from_world):
    """All cameras as a pose-graph tool writes them: centers, and quaternions world_from_cam."""
    turns = Rotation.from_matrix(cam_from_world.swapaxes(1, 2)).as_quat()
    rows = np.concatenate([centers, turns], axis=1).tolist()
    return "".join(f"VERTEX_SE3:QUAT {10 * k} {' '.join(map(repr, row))}\n" for k, row in enumerate(rows))


def edges_text(cam_from_world, centers, information=""):
    """All pairs as a pose-graph tool writes them: the pose of j in the axes of i, in meters."""
    lines = []
    for i in range(len(centers)):
        for j in range(i + 1, len(centers)):
            seen = cam_from_world[i] @ (centers[j] - centers[i])
            turn = Rotation.from_matrix(cam_from_world[i] @ cam_from_world[j].T).as_quat()
            numbers = " ".join(map(repr, map(float, [*seen, *turn])))
            lines.append(f"EDGE_SE3:QUAT {10 * i} {10 * j} {numbers}{information}\n")
    return "".join(lines)


def test_the_edges_of_a_g2o_file_are_relative_poses_and_its_vertices_rotations(tmp_path):
    cam_from_world, centers = scene()
    names = [str(10 * k) for k in range(6)]
    vertices = vertices_text(centers, cam_from_world)
    information = " 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    file = tmp_path / "graph.g2o"
    file.write_text(f"# made here\n{vertices}FIX 0\n{edges_text(cam_from_world, centers, information)}")
    poses = read_g2o(file)
    assert is_g2o(file)
    assert poses.names == tuple(names)
    i, j = poses.pairs.T
    np.testing.assert_allclose(
        poses.rotations, cam_from_world[j] @ cam_from_world[i].swapaxes(1, 2), atol=1e-14
    )
    rotations, known = read_g2o_rotations(file, poses.names)
    assert known.all()
    np.testing.assert_allclose(rotations, cam_from_world, atol=1e-14)
    graph = poses.measured(rotations, known).graph
    np.testing.assert_allclose(graph.directions, normalized(centers[i] - centers[j]), atol=1e-12)


def test_a_g2o_file_is_solved_from_the_rotations_of_its_vertices(tmp_path):
    cam_from_world, centers = scene()
    file = tmp_path / "graph.g2o"
    vertices = vertices_text(np.zeros((6, 3)), cam_from_world)
    file.write_text(edges_text(cam_from_world, centers) + vertices)
    found = place_graph_file(file, rotations=file)
    assert "6 of 6 rotations of" in found.statement
    placed, true = (x - x.mean(axis=0) for x in (found.placement.locations, centers))
    # Exact directions: positions come back but for scale, to the solve's tolerance.
    np.testing.assert_allclose(placed / np.linalg.norm(placed), true / np.linalg.norm(true), atol=1e-6)


def g2o_with(path, information, length=1.0):
    """Write all pairs of a scene, the k-th with the 6 x 6 matrix information(k); return what is read."""
    cam_from_world, centers = scene()
    lines = edges_text(cam_from_world, centers).splitlines()
    for k, line in enumerate(lines):
        words, seen = line.split(), np.array(line.split()[3:6], dtype=float)
        words[3:6] = [repr(x) for x in (length * seen / np.linalg.norm(seen)).tolist()]
        lines[k] = " ".join([*words, *map(repr, information(k)[np.triu_indices(6)].tolist())])
    path.write_text("\n".join(lines))
    return read_g2o(path), cam_from_world, centers


def random_information(k):
    matrix = np.random.default_rng(k).standard_normal((6, 6))
    return matrix @ matrix.T + np.eye(6)


def test_information_of_a_g2o_file_is_that_of_rotations_and_of_directions_of_length_1(tmp_path):
    poses, cam_from_world, _ = g2o_with(tmp_path / "graph.g2o", random_information)
    graph = poses.measured(cam_from_world, np.ones(6, dtype=bool))
    bases = tangent_bases(graph.graph.directions)
    for k, (_, j) in enumerate(poses.pairs):
        covariance = np.linalg.inv(random_information(k))  # in axes of camera j
        np.testing.assert_allclose(np.linalg.inv(poses.information[k]), covariance[3:, 3:], rtol=1e-9)
        across = cam_from_world[j] @ bases[k]
        np.testing.assert_allclose(graph.covariance[k], across.T @ covariance[:3, :3] @ across, rtol=1e-9)
    metric, *_ = g2o_with(tmp_path / "graph.g2o", random_information, length=3.0)
    assert metric.covariance is None
    np.testing.assert_array_equal(metric.information, poses.information)


def test_rotations_are_averaged_with_the_information_of_a_g2o_file(tmp_path):
    """Three loose pairs turn camera 0, the first of all its pairs, by 2 degrees; two tight ones do not."""

    def loose_for_three(k):
        return np.eye(6) / np.radians(2.0 if k < 3 else 0.05) ** 2

    file, errors = tmp_path / "graph.g2o", []
    _, _, centers = g2o_with(file, loose_for_three, length=2.0)
    rows = [line.split() for line in file.read_text().splitlines()]
    turn = Rotation.from_rotvec([np.radians(2.0), 0.0, 0.0])
    for row in rows[:3]:
        row[6:10] = map(repr, (turn * Rotation.from_quat([float(x) for x in row[6:10]])).as_quat().tolist())
    for width in (10, 31):
        file.write_text("\n".join(" ".join(row[:width]) for row in rows))
        found = place_graph_file(file).placement.locations
        errors.append(np.linalg.norm(fit_similarity(found, centers).apply(found) - centers, axis=1).max())
    # With the floor of the variances, the weights of the five pairs leave 3 / (3 + 40^2) of the turn.
    assert errors[1] < 0.01 * errors[0]


@pytest.mark.parametrize("information", [np.eye(6), 1e4 * np.eye(6), np.zeros((6, 6)), -np.eye(6)])
def test_information_that_is_a_placeholder_changes_no_bit(tmp_path, information):
    def alike(k):
        return information * (1.0 if np.trace(information) > 0.0 else 1.0 + k)

    poses, *_ = g2o_with(tmp_path / "graph.g2o", alike)
    assert poses.information is None
    assert poses.covariance is None
    (tmp_path / "bare.g2o").write_text(
        "\n".join(" ".join(line.split()[:10]) for line in (tmp_path / "graph.g2o").read_text().splitlines())
    )
    found, bare = (place_graph_file(tmp_path / name) for name in ("graph.g2o", "bare.g2o"))
    np.testing.assert_array_equal(found.placement.locations, bare.placement.locations)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (f"EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1{' 1' * 20} x", "line 2: 'x' is not a number"),
        ("EDGE_SE3:QUAT 1 2 1 0 0 0 0 0", "line 2: has 9 columns, expected 10"),
        ("EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1 5 5", "line 2: has 12 columns, expected 10"),
        ("EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 x", "line 2: 'x' is not a number"),
        ("EDGE_SE3:QUAT 1 2 nan 0 0 0 0 0 1", "line 2: has a number that is not finite"),
        ("EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 2", "line 2: has no unit quaternion"),
        ("EDGE_SE3:QUAT 1 2 0 0 0 0 0 0 1", "line 2: has no translation"),
        ("EDGE_SE3:QUAT 2 2 1 0 0 0 0 0 1", "line 2: joins a camera with itself"),
        ("EDGE_SE3:QUAT 1 0 1 0 0 0 0 0 1", "line 2: repeats an earlier pair"),
        ("EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1", "line 2: is neither a vertex nor EDGE_SE3:QUAT"),
    ],
)
def test_malformed_edges_of_g2o_are_refused_by_line(tmp_path, line, words):
    (tmp_path / "graph.g2o").write_text(f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1{' 1' * 21}\n{line}\n")
    with pytest.raises(InputError, match=words):
        read_g2o(tmp_path / "graph.g2o")


def test_vertices_that_are_none_twice_or_of_others_are_refused(tmp_path):
    file = tmp_path / "graph.g2o"
    vertex = "VERTEX_SE3:QUAT 0 1 2 3 0 0 0 1\n"
    for text, words in [
        (vertex * 2, "line 2: gives an earlier camera a second rotation"),
        (vertex, "has a rotation of none of the 1 cameras"),
        ("VERTEX_SE2 0 1 2 0\n", "has no VERTEX_SE3:QUAT"),
    ]:
        file.write_text(text)
        with pytest.raises(InputError, match=words):
            read_g2o_rotations(file, ("7",))
    with pytest.raises(InputError, match="has no EDGE_SE3:QUAT"):
        read_g2o(file)
