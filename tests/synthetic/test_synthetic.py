"""Synthetic scenes are what they say: visible, noisy and wrong exactly where and as much as asked."""

import contextlib
import shutil
import sqlite3
from dataclasses import astuple, fields, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scripts.make_data import SCENES, write_scene
from sfm_shapefit import synthetic
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.solver.program import differences
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.scenes import BUNDLED

SHAPES = ("ring", "facade", "drive", "cloud", "courtyard")


@cache
def scene_of(shape, **changes) -> synthetic.Scene:
    options = synthetic.SceneOptions(shape=shape, num_images=12, num_points=1200, pixel_noise_px=0.5, seed=3)
    return synthetic.make_scene(replace(options, **changes))


def pinhole(scene: synthetic.Scene, image: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and depths by the textbook formula, without OpenCV and without K as a matrix."""
    options = scene.options
    cam = np.array([scene.rotations[image] @ (point - scene.centers[image]) for point in points])
    x = options.focal_length_px * cam[:, 0] / cam[:, 2] + options.image_width / 2.0
    y = options.focal_length_px * cam[:, 1] / cam[:, 2] + options.image_height / 2.0
    return np.stack([x, y], axis=1), cam[:, 2]


def world_rays(scene: synthetic.Scene, image: int, xy: np.ndarray) -> np.ndarray:
    cam = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(scene.calibration).T
    return normalized(cam @ scene.rotations[image])


def true_direction(scene: synthetic.Scene, pair: int) -> np.ndarray:
    i, j = scene.pairs[pair]
    return normalized(scene.centers[i] - scene.centers[j])


@pytest.mark.parametrize("shape", SHAPES)
def test_keypoints_are_pinhole_projections_of_points_in_front_and_inside_the_image(shape):
    scene = scene_of(shape, pixel_noise_px=0.0)
    for image, (xy, points) in enumerate(zip(scene.keypoints, scene.keypoint_points, strict=True)):
        expected, depth = pinhole(scene, image, scene.points[points])
        assert depth.min() > 0.0
        # The rotation passes through a rotation vector: a few roundings of coordinates of 1e3 px.
        np.testing.assert_allclose(xy, expected, rtol=0.0, atol=1e-9)
    for xy in scene_of(shape, pixel_noise_px=3.0, corrupted_pair_fraction=0.3).keypoints:
        assert (xy >= 0.0).all()
        assert (xy <= [scene.options.image_width, scene.options.image_height]).all()


def test_pixel_noise_has_the_size_asked_for():
    scene = scene_of("facade", pixel_noise_px=0.5)
    shown = enumerate(zip(scene.keypoints, scene.keypoint_points, strict=True))
    errors = np.concatenate([xy - pinhole(scene, k, scene.points[points])[0] for k, (xy, points) in shown])
    # More than 5000 draws: the standard error of the standard deviation is below 1 %.
    assert errors.size > 5000
    assert errors.std() == pytest.approx(0.5, rel=0.05)


def test_a_point_behind_the_camera_is_refused_and_not_projected():
    points = np.array([[0.1, 0.2, 5.0], [0.1, 0.2, -5.0]])
    with pytest.raises(ValueError, match="point 1 is not in front of the camera"):
        synthetic.project_points(points, np.eye(3), np.zeros(3), np.eye(3))


def test_walls_are_not_seen_from_behind():
    scene = scene_of("ring")
    for image, points in enumerate(scene.keypoint_points):
        to_camera = scene.centers[image] - scene.points[points]
        assert (np.sum(to_camera * scene.points[points], axis=1) > 0.0).all()


def test_the_largest_points_are_kept_when_an_image_has_too_many():
    every = scene_of("facade", pixel_noise_px=0.0)
    few = scene_of("facade", pixel_noise_px=0.0, max_keypoints_per_image=60)
    for image in range(few.num_images):
        kept, shown = few.keypoint_points[image], every.keypoint_points[image]
        assert len(kept) == 60
        assert set(kept) < set(shown)
        distance = np.linalg.norm(few.points[kept] - few.centers[image], axis=1)
        assert distance.mean() < np.linalg.norm(every.points[shown] - every.centers[image], axis=1).mean()


def test_cameras_have_proper_rotations_and_look_where_the_shape_says():
    for shape in SHAPES:
        rotations = scene_of(shape).rotations
        identity = np.broadcast_to(np.eye(3), rotations.shape)
        np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), identity, atol=1e-14)
        np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-14)
        if shape != "cloud":  # upright: the image's y axis points down in the world
            assert (rotations[:, 1, 2] < -0.5).all()
    ring = scene_of("ring")
    inward = normalized(-ring.centers)
    assert angle_between_deg(ring.rotations[:, 2], inward).max() < 10.0


@pytest.mark.parametrize("shape", SHAPES)
def test_true_matches_join_the_same_point_and_satisfy_the_epipolar_constraint(shape):
    scene = scene_of(shape)
    for pair, (i, j) in enumerate(scene.pairs):
        matches = scene.matches_of(pair)
        assert len(matches) >= scene.options.min_matches
        in_i = scene.keypoint_points[i][matches[:, 0]]
        np.testing.assert_array_equal(in_i, scene.keypoint_points[j][matches[:, 1]])
        assert len(np.unique(in_i)) == len(in_i)
        residual_px = epipolar_residual_px(scene, pair, scene.centers[i] - scene.centers[j])
        # The median of |N(0, 0.5^2)| is 0.337 px, with a standard error of 0.39 / sqrt(k) px; four of
        # them. (Not the mean square: near an epipole in view, on the drive, the residual is not normal.)
        assert np.median(np.abs(residual_px)) < 0.337 + 4.0 * 0.39 / np.sqrt(len(matches))


def epipolar_residual_px(scene: synthetic.Scene, pair: int, baseline: np.ndarray) -> np.ndarray:
    """Sampson residuals (pixels) of the pair's matches for the true rotations and a given C_i - C_j."""
    i, j = scene.pairs[pair]
    matches = scene.matches_of(pair)
    x, y, z = scene.rotations[j] @ baseline
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ scene.rotations[j] @ scene.rotations[i].T
    inverse = np.linalg.inv(scene.calibration)
    fundamental = inverse.T @ essential @ inverse
    ones = np.ones(len(matches))
    first = np.column_stack([scene.keypoints[i][matches[:, 0]], ones])
    second = np.column_stack([scene.keypoints[j][matches[:, 1]], ones])
    line_j, line_i = first @ fundamental.T, second @ fundamental
    gradient = np.sqrt(np.sum(line_j[:, :2] ** 2 + line_i[:, :2] ** 2, axis=1))
    return np.sum(second * line_j, axis=1) / gradient


def test_each_image_asks_for_the_images_it_shares_most_points_with():
    scene = scene_of("drive", max_pairs_per_image=2)
    shared = np.array(
        [[len(np.intersect1d(a, b)) for b in scene.keypoint_points] for a in scene.keypoint_points]
    )
    np.fill_diagonal(shared, -1)
    wanted = {
        (min(i, j), max(i, j))
        for i, row in enumerate(shared)
        for j in np.lexsort((np.arange(len(row)), -row))[:2].tolist()
    }
    assert {tuple(pair) for pair in scene.pairs.tolist()} == wanted


def test_wrong_matches_are_as_many_as_asked_and_all_wrong():
    scene = scene_of("facade", wrong_match_fraction=0.2)
    clean = scene_of("facade")
    for pair, (i, j) in enumerate(scene.pairs):
        rows = slice(*scene.match_offsets[pair : pair + 2])
        matches, wrong = scene.matches[rows], scene.match_is_wrong[rows]
        assert wrong.sum() == round(0.2 * len(matches))
        same = scene.keypoint_points[i][matches[:, 0]] == scene.keypoint_points[j][matches[:, 1]]
        np.testing.assert_array_equal(same, ~wrong)
        np.testing.assert_array_equal(np.sort(matches[:, 1]), np.sort(clean.matches_of(pair)[:, 1]))


def in_front(scene: synthetic.Scene, pair: int, direction: np.ndarray) -> float:
    """Share of the matches whose rays meet in front of both cameras, by a direction of C_i - C_j."""
    (i, j), matches = scene.pairs[pair], scene.matches_of(pair)
    a = world_rays(scene, i, scene.keypoints[i][matches[:, 0]])
    b = world_rays(scene, j, scene.keypoints[j][matches[:, 1]])
    cos = np.sum(a * b, axis=1)
    return float(np.mean((cos * (b @ direction) > a @ direction) & (b @ direction > cos * (a @ direction))))


@pytest.mark.parametrize("shape", SHAPES)
def test_relative_poses_are_exact_and_wrong_pairs_as_many_as_asked_agree_on_a_false_one(shape):
    scene = scene_of(shape, pixel_noise_px=0.0, corrupted_pair_fraction=0.25)
    assert scene.pair_is_corrupted.sum() == round(0.25 * scene.num_pairs)
    off_deg = []
    for pair, (i, j) in enumerate(scene.pairs):
        rotation = scene.rotations[j] @ scene.rotations[i].T
        np.testing.assert_allclose(scene.relative_rotations[pair], rotation, atol=1e-14)
        stated = scene.rotations[j].T @ scene.relative_translations[pair]  # parallel to C_i - C_j
        error_deg = angle_between_deg(stated, true_direction(scene, pair))
        off_deg.append(error_deg)
        assert (error_deg > 9.9) if scene.pair_is_corrupted[pair] else (error_deg < 1e-10)
        assert len(scene.matches_of(pair)) >= 15
        assert in_front(scene, pair, stated) > 0.9
        # The stated pose is the one that the matches show, the false baseline included.
        np.testing.assert_allclose(epipolar_residual_px(scene, pair, stated), 0.0, atol=1e-7)
    assert np.median(np.array(off_deg)[scene.pair_is_corrupted]) > 20.0


def test_stated_rotations_err_by_the_noise_asked_for():
    scene = scene_of("ring", num_images=200, rotation_noise_deg=2.0)
    turns = turn_angles_deg(scene.stated_rotations @ scene.rotations.swapaxes(1, 2))
    # 200 squared angles, each 2^2 times a chi-squared with 3 degrees of freedom: 6 % relative.
    assert np.sqrt(np.mean(turns**2) / 3.0) == pytest.approx(2.0, rel=0.2)
    np.testing.assert_array_equal(scene_of("ring").stated_rotations, scene_of("ring").rotations)


def turn_angles_deg(rotations: np.ndarray) -> np.ndarray:
    return np.degrees(2.0 * np.arcsin(np.linalg.norm(rotations - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)))


def test_the_same_seed_makes_the_same_scene_and_another_seed_another():
    options = synthetic.SceneOptions(
        shape="cloud", num_images=8, num_points=600, wrong_match_fraction=0.1, corrupted_pair_fraction=0.2
    )
    first, second, other = (
        synthetic.make_scene(options),
        synthetic.make_scene(options),
        synthetic.make_scene(replace(options, seed=1)),
    )
    for field in fields(synthetic.Scene):
        one, two = getattr(first, field.name), getattr(second, field.name)
        if field.name == "rigs":
            one, two = astuple(one), astuple(two)
        for a, b in zip(one, two, strict=True) if isinstance(one, tuple) else [(one, two)]:
            np.testing.assert_array_equal(a, b, err_msg=field.name)
    assert not np.array_equal(first.points, other.points)


def test_a_scene_with_too_few_points_says_so():
    with pytest.raises(InputError, match="no two images of this scene share 30 points"):
        synthetic.make_scene(synthetic.SceneOptions(num_points=20))


def table_rows(database: Path) -> dict[str, list[tuple]]:
    """Every row of every table: the logical content of a database."""
    with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as connection:
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")
        return {
            name: connection.execute(f"SELECT * FROM {name} ORDER BY 1, 2").fetchall()
            for (name,) in names.fetchall()
        }


def test_pycolmap_reads_back_the_scene_from_a_workspace(tmp_path):
    scene = scene_of("facade", corrupted_pair_fraction=0.25)
    write_workspace(scene, tmp_path / "made/out", synthetic.WorkspaceOptions(relative_poses=True))
    files = sorted(path.name for path in (tmp_path / "made/out").iterdir())
    assert files == ["database.db", "sparse"]  # no -wal or -shm, and no truth beside an exact model
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["out"]

    model = pycolmap.Reconstruction(tmp_path / "made/out/sparse/0")
    shutil.copy(tmp_path / "made/out/database.db", tmp_path / "copy.db")
    with contextlib.closing(pycolmap.Database.open(tmp_path / "copy.db")) as database:
        assert (database.num_cameras(), database.num_rigs()) == (1, 1)
        assert (database.num_images(), database.num_frames()) == (12, 12)
        assert database.num_verified_image_pairs() == scene.num_pairs
        for index in range(scene.num_images):
            image = model.images[index + 1]
            assert database.read_image(index + 1).name == image.name
            np.testing.assert_allclose(image.projection_center(), scene.centers[index], atol=1e-12)
            xy = np.array([point.xy for point in image.points2D])
            np.testing.assert_array_equal(xy, scene.keypoints[index])
            stored = database.read_keypoints(index + 1)
            np.testing.assert_array_equal(stored, scene.keypoints[index].astype(np.float32))
        for pair, (i, j) in enumerate((scene.pairs + 1).tolist()):
            geometry = database.read_two_view_geometry(i, j)
            assert geometry.config == int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
            np.testing.assert_array_equal(geometry.inlier_matches, scene.matches_of(pair))
            np.testing.assert_array_equal(database.read_matches(i, j), scene.matches_of(pair))
            pose = geometry.cam2_from_cam1
            np.testing.assert_allclose(pose.rotation.matrix(), scene.relative_rotations[pair], atol=1e-12)
            np.testing.assert_allclose(pose.translation, scene.relative_translations[pair], atol=1e-12)


def test_model_points_have_the_tracks_and_colors_of_the_scene(tmp_path):
    scene = scene_of("courtyard", corrupted_pair_fraction=0.25)
    write_workspace(scene, tmp_path / "out", synthetic.WorkspaceOptions(database=False))
    assert not (tmp_path / "out/database.db").exists()
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    seen = np.bincount(np.concatenate([ids[ids >= 0] for ids in scene.keypoint_points]))
    assert set(model.points3D) == set((np.flatnonzero(seen >= 2) + 1).tolist())
    for point_id, point in model.points3D.items():
        np.testing.assert_array_equal(point.xyz, scene.points[point_id - 1])
        np.testing.assert_array_equal(point.color, scene.colors[point_id - 1])
        shown_as = [scene.keypoint_points[e.image_id - 1][e.point2D_idx] for e in point.track.elements]
        assert shown_as == [point_id - 1] * seen[point_id - 1]
    # Mean length of a two-dimensional normal error of 0.5 px: 0.5 sqrt(pi / 2) = 0.63 px.
    assert model.compute_mean_reprojection_error() == pytest.approx(0.627, rel=0.1)


def test_stored_e_and_f_annul_the_true_matches_and_poses_are_null_by_default(tmp_path):
    scene = scene_of("ring", pixel_noise_px=0.0, corrupted_pair_fraction=0.2)
    write_workspace(scene, tmp_path / "out")
    with contextlib.closing(sqlite3.connect(tmp_path / "out/database.db")) as connection:
        # Write-ahead logging would leave companions beside the file for every reader.
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("delete",)
        rows = connection.execute(
            "SELECT pair_id, F, E, qvec, tvec FROM two_view_geometries ORDER BY pair_id"
        ).fetchall()
    assert [row[0] for row in rows] == [2147483647 * (i + 1) + j + 1 for i, j in scene.pairs.tolist()]
    for pair, (_, f_bytes, e_bytes, qvec, tvec) in enumerate(rows):
        assert qvec is None
        assert tvec is None
        fundamental, essential = (np.frombuffer(b).reshape(3, 3) for b in (f_bytes, e_bytes))
        i, j = scene.pairs[pair]
        matches = scene.matches_of(pair)
        first = np.column_stack([scene.keypoints[i][matches[:, 0]], np.ones(len(matches))])
        second = np.column_stack([scene.keypoints[j][matches[:, 1]], np.ones(len(matches))])
        lines = first @ fundamental.T
        distance_px = np.sum(second * lines, axis=1) / np.linalg.norm(lines[:, :2], axis=1)
        np.testing.assert_allclose(distance_px, 0.0, atol=1e-7)
        np.testing.assert_allclose(np.linalg.svd(essential)[1], [1.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "options"),
    [
        ("courtyard", synthetic.WorkspaceOptions(model="rotations")),
        ("facade", synthetic.WorkspaceOptions(database=False)),
    ],
    ids=["rotations", "full"],
)
def test_a_perturbed_model_has_the_truth_beside_it_and_of_rotations_only_no_points(tmp_path, shape, options):
    scene = scene_of(shape, rotation_noise_deg=0.5)
    write_workspace(scene, tmp_path / "out", options)
    model, truth = (pycolmap.Reconstruction(tmp_path / "out" / name) for name in ("sparse/0", "truth"))
    assert model.num_reg_images() == truth.num_reg_images() == scene.num_images
    for index in range(scene.num_images):
        image, exact = (m.images[index + 1] for m in (model, truth))
        rotations = [i.cam_from_world().rotation.matrix() for i in (image, exact)]
        expected = [scene.stated_rotations[index], scene.rotations[index]]
        np.testing.assert_allclose(rotations, expected, atol=1e-14)
        np.testing.assert_allclose(exact.projection_center(), scene.centers[index], atol=1e-12)
        if options.model == "rotations":
            np.testing.assert_array_equal(image.cam_from_world().translation, 0.0)
        else:
            np.testing.assert_allclose(image.projection_center(), scene.centers[index], atol=1e-12)
    if options.model == "rotations":
        assert model.num_points3D() == 0
    else:
        assert set(model.points3D) == set(truth.points3D)
        assert model.compute_mean_reprojection_error() > 3.0 * truth.compute_mean_reprojection_error()


def assert_models_equal(made: Path, bundled: Path) -> None:
    one, two = pycolmap.Reconstruction(made), pycolmap.Reconstruction(bundled)
    assert set(one.images) == set(two.images)
    assert set(one.points3D) == set(two.points3D)
    for image_id, image in one.images.items():
        other = two.images[image_id]
        assert image.name == other.name
        # Another processor may round the last bits of a matrix product differently.
        poses = (m.cam_from_world().matrix() for m in (image, other))
        np.testing.assert_allclose(*poses, rtol=0.0, atol=1e-10)
        assert [p.point3D_id for p in image.points2D] == [p.point3D_id for p in other.points2D]
        xy, other_xy = (np.array([p.xy for p in m.points2D]).reshape(-1, 2) for m in (image, other))
        np.testing.assert_allclose(xy, other_xy, rtol=0.0, atol=1e-8)
    for point_id, point in one.points3D.items():
        np.testing.assert_allclose(point.xyz, two.points3D[point_id].xyz, rtol=0.0, atol=1e-10)
        np.testing.assert_array_equal(point.color, two.points3D[point_id].color)


def assert_databases_equal(made: Path, bundled: Path) -> None:
    one, two = table_rows(made), table_rows(bundled)
    assert one.keys() == two.keys()
    real_valued = {"keypoints": (3, np.float32), "two_view_geometries": (5, np.float64)}
    for name, rows in one.items():
        column, dtype = real_valued.get(name, (len(rows[0]) if rows else 0, None))
        for row, other in zip(rows, two[name], strict=True):
            assert row[:column] == other[:column], name
            for value, expected in zip(row[column:], other[column:], strict=True):
                if isinstance(value, bytes) and isinstance(expected, bytes):
                    a, b = np.frombuffer(value, dtype), np.frombuffer(expected, dtype)
                    np.testing.assert_allclose(a, b, rtol=2e-7, atol=1e-10)
                else:
                    assert value == expected


@pytest.mark.parametrize("name", ["courtyard", "ring8", "facade9"])
def test_a_bundled_scene_is_what_its_command_makes(name, tmp_path):
    made, bundled = tmp_path / name, BUNDLED / name
    write_scene(name, made)
    files = [sorted(p.relative_to(root) for p in root.rglob("*")) for root in (made, bundled)]
    assert files[0] == files[1]
    assert (bundled / "SOURCE.md").read_text() == (made / "SOURCE.md").read_text()
    for folder in ("sparse/0", "truth"):
        if (bundled / folder).exists():
            assert_models_equal(made / folder, bundled / folder)
    if (bundled / "database.db").exists():
        shutil.copy(bundled / "database.db", tmp_path / "bundled.db")
        assert_databases_equal(made / "database.db", tmp_path / "bundled.db")


def test_bundled_scenes_stay_under_five_megabytes_and_the_ring_has_enough_pairs_to_be_rigid():
    assert sum(path.stat().st_size for path in BUNDLED.rglob("*") if path.is_file()) < 5e6
    scene = synthetic.make_scene(SCENES["ring8"].scene)
    # A direction in space is two equations; n positions up to shift and scale are 3 n - 4 unknowns.
    assert 2 * scene.num_pairs >= 3 * scene.num_images - 4
    assert np.bincount(scene.pairs.ravel()).min() >= 3


FAMILIES = {
    "random": partial(synthetic.random_graph_problem, 120, p=0.5),
    "box": partial(synthetic.box_graph_problem, 500, degree=20.0),
    "trajectory": partial(synthetic.trajectory_graph_problem, 500, degree=20.0),
    "varying speed": partial(synthetic.trajectory_graph_problem, 500, degree=20.0, speed_ratio=4.0),
    "ring": partial(synthetic.ring_graph_problem, 300, degree=20.0),
    "lawn": partial(synthetic.lawn_graph_problem, 500, degree=20.0),
    "corridor": partial(synthetic.corridor_graph_problem, 500, degree=20.0),
    "community": partial(synthetic.community_graph_problem, 1200, degree=30.0),
}


def true_directions(problem: synthetic.GraphProblem) -> np.ndarray:
    return normalized(differences(problem.locations, problem.edges))


@pytest.mark.parametrize("family", FAMILIES)
def test_graph_problems_are_simple_connected_and_exact_without_noise(family):
    problem = FAMILIES[family](seed=5)
    i, j = problem.edges.T
    assert (i < j).all()
    assert len(np.unique(problem.edges, axis=0)) == len(problem.edges)
    # Normalized twice: a few roundings.
    np.testing.assert_allclose(problem.directions, true_directions(problem), rtol=0.0, atol=1e-15)
    assert not problem.corrupted.any()
    n = len(problem.locations)
    assert connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)[0] == 1


@pytest.mark.parametrize("family", FAMILIES)
def test_graph_problems_are_corrupted_and_noisy_as_asked(family):
    problem = FAMILIES[family](sigma=0.01, q=0.3, seed=6)
    m = len(problem.edges)
    assert problem.corrupted.mean() == pytest.approx(0.3, abs=4.0 * np.sqrt(0.21 / m))
    np.testing.assert_allclose(np.linalg.norm(problem.directions, axis=1), 1.0, atol=1e-14)
    error_deg = angle_between_deg(problem.directions, true_directions(problem))
    # A perturbation of length sigma turns a unit vector by asin(sigma) at most.
    assert error_deg[~problem.corrupted].max() <= np.degrees(np.arcsin(0.01)) * (1.0 + 1e-9)
    assert error_deg[~problem.corrupted].mean() > 0.5 * np.degrees(0.01)
    # A uniformly random direction is 90 degrees off on average, 39 in standard deviation.
    mean_deg = error_deg[problem.corrupted].mean()
    assert mean_deg == pytest.approx(90.0, abs=4.0 * 39.2 / np.sqrt(0.3 * m))


@pytest.mark.parametrize(
    ("family", "degree"), [("random", 59.5), ("box", 20.0), ("trajectory", 20.4), ("community", 33.0)]
)
def test_graph_problems_have_about_the_degree_asked_for(family, degree):
    problem = FAMILIES[family](seed=7)
    assert 2.0 * len(problem.edges) / len(problem.locations) == pytest.approx(degree, rel=0.15)


@pytest.mark.parametrize("d", [2, 3, 10])
def test_the_paper_model_has_any_dimension_and_one_answer_per_seed(d):
    problem = synthetic.random_graph_problem(30, 0.5, d=d, sigma=0.05, q=0.2, seed=9)
    assert problem.locations.shape == (30, d)
    assert problem.directions.shape == (len(problem.edges), d)
    again = synthetic.random_graph_problem(30, 0.5, d=d, sigma=0.05, q=0.2, seed=np.random.default_rng(9))
    np.testing.assert_array_equal(problem.directions, again.directions)
    other = synthetic.random_graph_problem(30, 0.5, d=d, sigma=0.05, q=0.2, seed=10)
    assert not np.array_equal(problem.locations, other.locations)


def smooth_speeds(problem: synthetic.GraphProblem) -> np.ndarray:
    steps = np.linalg.norm(np.diff(problem.locations, axis=0), axis=1)
    return np.convolve(steps, np.ones(50) / 50, "valid")


def test_the_speed_of_a_trajectory_varies_by_the_factor_asked_for():
    varying = smooth_speeds(synthetic.trajectory_graph_problem(900, seed=1, speed_ratio=4.0))
    assert 2.5 < varying.max() / varying.min() < 5.0  # jitter of 0.3 per axis adds more to short steps
    even = smooth_speeds(synthetic.trajectory_graph_problem(900, seed=1))
    assert even.max() / even.min() < 1.5


def test_a_ring_closes_with_five_far_links_and_strips_of_a_lawn_are_tied_to_the_next_ones_only():
    n = 300
    edges = synthetic.ring_graph_problem(n, degree=20.0, seed=2).edges
    apart = np.minimum(edges[:, 1] - edges[:, 0], n - (edges[:, 1] - edges[:, 0]))
    assert np.sum(apart > 10) == 5
    assert apart[apart > 10].min() >= n // 4
    assert np.sum(apart <= 10) == 10 * n
    assert any((edges == [0, n - 1]).all(axis=1))
    strip = synthetic.lawn_graph_problem(500, degree=20.0, seed=3).edges // 50
    apart = strip[:, 1] - strip[:, 0]
    assert set(np.unique(apart).tolist()) == {0, 1}
    assert np.bincount(apart)[1] == pytest.approx(np.bincount(apart)[0], rel=0.1)


def test_a_corridor_falls_apart_at_its_junctions_only():
    """Each branch of 50 cameras is tied to the main corridor near its junction, and to no other branch."""
    edges = synthetic.corridor_graph_problem(500, degree=20.0, seed=4).edges
    part = np.where(edges < 250, -1, (edges - 250) // 50)
    crossing = edges[part[:, 0] != part[:, 1]]
    assert (crossing[:, 0] < 250).all()
    for branch in range(5):
        ties = crossing[(crossing[:, 1] - 250) // 50 == branch]
        assert np.ptp(ties[:, 0]) <= 18
        assert ((ties[:, 1] - 250) % 50).max() == 9  # within 10 steps


def test_given_pairs_and_locations_are_kept():
    t = np.random.default_rng(1).standard_normal((20, 3))
    edges = np.array([(i, i + 1) for i in range(19)])
    problem = synthetic.measured_problem(t, edges, sigma=0.0, q=0.0, seed=1)
    np.testing.assert_array_equal(problem.edges, edges)
    np.testing.assert_allclose(problem.directions, true_directions(problem), atol=1e-15)
    assert synthetic.measured_problem(t, edges, q=1.0, seed=1).corrupted.all()


def test_a_street_is_straight_and_its_points_stand_beside_it():
    street = synthetic.street_problem(60, 5, seed=5)
    cameras, points = street.locations[:60], street.locations[60:]
    assert np.abs(cameras[:, 1:]).max() == 0.0
    speed = np.diff(cameras[:, 0])
    assert speed.max() / speed.min() == pytest.approx(3.0, rel=0.1)
    aside = np.abs(points[:, 1])
    assert (aside.min() >= 3.0, aside.max() <= 10.0) == (True, True)
    assert len(points) == 300


def test_street_tracks_have_four_to_eight_views_and_noise_as_the_covariance_says():
    street = synthetic.street_problem(200, 10, seed=6)
    to_point = street.edges[:, 1] >= street.num_cameras
    assert np.flatnonzero(to_point).min() == np.sum(~to_point)  # pairs of cameras come first
    views = np.bincount(street.edges[to_point, 1])[street.num_cameras :]
    assert set(np.unique(views).tolist()) == {4, 5, 6, 7, 8}
    off = np.linalg.norm(street.directions - true_directions(street), axis=1)
    for kind, share in ((~to_point, 0.1), (to_point, 0.15)):
        assert street.corrupted[kind].mean() == pytest.approx(share, abs=0.02)
        right = kind & ~street.corrupted
        variance = np.trace(street.covariance[right], axis1=1, axis2=2)
        assert np.mean(off[right] ** 2 / variance) == pytest.approx(1.0, rel=0.05)
