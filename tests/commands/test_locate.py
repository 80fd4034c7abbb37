"""`locate` end to end: from rotations and matches to a seeded model, on bundled and real scenes."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from scripts.make_data import SCENES  # the one place that knows how a bundled scene was made
from sfm_shapefit import LocateOptions
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.commands.write import write_result
from sfm_shapefit.files.colmap.read_binary import read_folder
from sfm_shapefit.files.colmap.reconstructions import points2d_xy
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_scene, write_workspace
from tests.models import centers_of, posed
from tests.scenes import COURTYARD, FACADE, RING, copied, edit_database, fingerprint, rows_of


def true_corruption():
    """Names of the pairs of the courtyard whose stored direction is wrong, drawn again from its seed."""
    scene = make_scene(SCENES["courtyard"].scene)
    wrong = scene.pairs[scene.pair_is_corrupted]
    return {(f"{i + 1:04d}.jpg", f"{j + 1:04d}.jpg") for i, j in wrong.tolist()}


def test_the_courtyard_is_placed_in_spite_of_a_quarter_of_wrong_pairs_which_are_named(courtyard_located):
    courtyard = courtyard_located
    errors = sfm_shapefit.evaluate(courtyard.reconstruction, COURTYARD / "truth")
    assert len(errors.names) == 25
    # 0.5 px at 720 px focal length and 10 m gives 7 mm per match; a pair has hundreds of matches.
    assert errors.position.median < 0.005
    assert errors.position.max < 0.03
    assert courtyard.certified.gap <= 1e-8
    outliers = {(row.name1, row.name2) for row in courtyard.pairs if row.verdict == "outlier"}
    assert outliers == true_corruption()


def test_the_inputs_centers_place_nothing():
    rng = np.random.default_rng(0)
    given = posed(RING / "sparse" / "0", lambda _name, rotation, center: (rotation, center))
    moved = posed(RING / "sparse" / "0", lambda _name, rotation, _center: (rotation, rng.standard_normal(3)))
    found = (sfm_shapefit.locate(model, RING / "database.db", scale="unit") for model in (given, moved))
    np.testing.assert_array_equal(*(centers_of(one.reconstruction) for one in found))


def test_exact_data_give_the_exact_answer_in_the_inputs_scale_and_no_file_is_changed(tmp_path):
    scene = copied(RING, tmp_path)
    before = fingerprint(scene)
    found = sfm_shapefit.locate(scene / "sparse" / "0")
    write_result(found, tmp_path / "out")
    assert fingerprint(scene) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "ring8"]
    truth = pycolmap.Reconstruction(RING / "sparse" / "0")
    for image_id, image in truth.images.items():
        center = found.reconstruction.image(image_id).projection_center()
        # Keypoints are stored as float32: 6e-5 px at 1000 px focal length.
        np.testing.assert_allclose(center, image.projection_center(), atol=2e-6)
    assert found.reconstruction.compute_mean_reprojection_error() < 1e-3


def test_tracks_serve_where_there_is_no_database_and_points_keep_their_colors():
    found = sfm_shapefit.locate(FACADE / "sparse" / "0")
    assert found.inputs.database is None
    errors = sfm_shapefit.evaluate(found.reconstruction, FACADE / "sparse" / "0")
    assert errors.position.max < 0.05  # meters, on a grid of 9 cameras before a wall
    assert found.reconstruction.num_points3D() > 300
    truth = pycolmap.Reconstruction(FACADE / "sparse" / "0")
    for point_id, point in found.reconstruction.points3D.items():
        np.testing.assert_array_equal(point.color, truth.point3D(point_id).color)


def test_points_of_a_databases_matches_have_the_colors_of_the_inputs_points():
    truth = pycolmap.Reconstruction(RING / "sparse" / "0")
    for point_id, point in truth.points3D.items():
        point.color = np.array([point_id % 200 + 1, 7, 99], dtype=np.uint8)
    for image in truth.images.values():
        for point2D in image.points2D:
            point2D.xy = point2D.xy.astype(np.float32)  # as a database stores them, and a mapper reads them
    found = sfm_shapefit.locate(truth, RING / "database.db").reconstruction
    assert found.num_points3D() > 300
    for point in found.points3D.values():
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        (seen,) = {truth.image(i).point2D(k).point3D_id for i, k in elements}  # matches have no errors
        np.testing.assert_array_equal(point.color, truth.point3D(seen).color)


PAIRS_ONLY = LocateOptions(points="never")


WANTED = {
    "pendant": lambda i, j: 1 not in (i, j) or (i, j) == (1, 2),
    "ring": lambda i, j: j - i in (1, 7),
    "hinge": lambda i, j: {i, j} <= {1, 2, 3, 4} or {i, j} <= {4, 5, 6, 7, 8},
}


@pytest.mark.parametrize("kept", WANTED)
def test_points_place_cameras_that_pairs_do_not_determine(tmp_path, kept):
    found = sfm_shapefit.locate(ring_with_pairs(tmp_path, WANTED[kept]))
    errors = sfm_shapefit.evaluate(found.reconstruction, RING / "sparse" / "0").position
    assert found.reconstruction.num_reg_images() == 8
    assert errors.max < 0.02  # of a ring of radius 5; a pair alone leaves the distance free


def test_the_points_of_false_pairs_put_no_cameras_elsewhere(tmp_path):
    options = SceneOptions(
        shape="courtyard", num_images=16, num_points=1200, corrupted_pair_fraction=0.2, seed=1
    )
    write_workspace(make_scene(options), tmp_path / "thin", WorkspaceOptions(model="rotations"))
    found = sfm_shapefit.locate(tmp_path / "thin" / "sparse" / "0")
    assert found.verdict.grade == "good"
    errors = sfm_shapefit.evaluate(found.reconstruction, tmp_path / "thin" / "truth")
    assert len(errors.names) == 16
    assert errors.position.max < 0.001 * errors.extent


def test_a_camera_that_hangs_by_one_pair_is_left_out_by_name(tmp_path):
    found = sfm_shapefit.locate(ring_with_pairs(tmp_path, WANTED["pendant"]), options=PAIRS_ONLY)
    rows = {row.name: row for row in found.cameras}
    assert [name for name, row in rows.items() if not row.placed] == ["0001.jpg"]
    assert rows["0001.jpg"].reason == "pendant: joined by a single pair to 0002.jpg"
    assert found.reconstruction.num_reg_images() == 7
    assert not found.reconstruction.image(1).has_pose


@pytest.fixture(scope="module")
def hinged(tmp_path_factory):
    """The ring as two groups of cameras, 1 to 4 and 4 to 8, that meet at one camera."""
    model = ring_with_pairs(tmp_path_factory.mktemp("hinged"), WANTED["hinge"])
    return sfm_shapefit.locate(model, options=PAIRS_ONLY)


def test_two_groups_joined_at_one_camera_are_two_pieces(hinged):
    facts = hinged.summary()
    assert [piece["num_cameras"] for piece in facts["pieces"]] == [5, 4]
    assert [piece["hinges"] for piece in facts["pieces"]] == [["0004.jpg"], ["0004.jpg"]]
    left_out = [row for row in hinged.cameras if not row.placed]
    assert {row.reason for row in left_out} == {"another rigid piece, hinged at 0004.jpg; see pieces/1"}
    assert {row.piece for row in left_out} == {1}


def test_figures_in_pixels_are_at_the_median_focal_length_of_the_images(hinged):
    """Pairs are of images, and a camera counts as often as it took one; `check MODEL` says so, too."""
    focal_lengths_px = np.array([900.0, 100.0, 100.0, 100.0, 100.0, 100.0, 800.0, 700.0])
    images = hinged.images
    lenses = [Lens("SIMPLE_PINHOLE", (f, 0.0, 0.0), id=k) for k, f in enumerate(focal_lengths_px.tolist())]
    images = replace(images, lenses=tuple(lenses), lens_of=np.arange(8))
    figures = replace(hinged, images=images).summary()["figures"]
    slope = np.tan(np.radians(figures["pair_error_deg"]))
    assert figures["pair_error_px"] == pytest.approx(100.0 * slope)


def test_cameras_of_a_further_piece_are_judged_by_their_pairs_as_those_of_the_largest(hinged):
    for placement in (hinged.placement, hinged.further[0].placement):
        doubts = placement.assessment.doubts
        assert doubts is not None
        assert len(doubts.kinds) == len(placement.cameras)
        assert {kind.value for kind in doubts.kinds} == {"right"}


def test_a_further_piece_is_written_with_a_scale_of_its_own(hinged, tmp_path):
    first, second = {1, 2, 3, 4}, {4, 5, 6, 7, 8}
    write_result(hinged, tmp_path / "out")
    folder = tmp_path / "out" / "pieces" / "1"
    assert sorted(path.name for path in folder.parent.iterdir()) == ["1"]
    read_folder(folder)
    piece = pycolmap.Reconstruction(folder)
    assert set(piece.reg_image_ids()) == first  # the hinge stands in both models
    assert set(hinged.reconstruction.reg_image_ids()) == second
    assert piece.num_points3D() > 50
    assert piece.compute_mean_reprojection_error() < 1e-3  # exact data, keypoints stored as float32
    centers = np.array([piece.image(i).projection_center() for i in sorted(first)])
    np.testing.assert_allclose(centers.mean(axis=0), 0.0, atol=1e-12)
    assert np.median(np.linalg.norm(centers, axis=1)) == pytest.approx(1.0)
    assert sfm_shapefit.evaluate(folder, RING / "sparse" / "0").position.max < 1e-5
    row = hinged.summary()["pieces"][1]
    assert (row["folder"], row["num_placed"]) == ("pieces/1", 4)
    assert row["scale"].startswith("unit")
    rows = rows_of(folder / "cameras.csv")
    assert [row["name"] for row in rows] == [f"000{k}.jpg" for k in range(1, 5)]
    assert {(row["placed"], row["piece"]) for row in rows} == {("true", "1")}
    assert {int(row["degree"]) for row in rows} <= {2, 3}  # a pair without enough parallax has no direction
    np.testing.assert_allclose([[float(row[k]) for k in "xyz"] for row in rows], centers, atol=1e-12)
    verdicts = {(row.name1, row.name2): row.verdict for row in hinged.pairs}
    assert verdicts["0001.jpg", "0002.jpg"] == "inlier"


def ring_with_pairs(folder, wanted):
    """A copy of the ring whose database keeps the two-view geometries of the pairs that are wanted."""
    scene = copied(RING, folder)
    pairs = [(i, j) for j in range(2, 9) for i in range(1, j) if not wanted(i, j)]
    ids = ", ".join(str(2147483647 * i + j) for i, j in pairs)
    edit_database(scene / "database.db", f"DELETE FROM two_view_geometries WHERE pair_id IN ({ids})")
    return scene / "sparse" / "0"


def test_the_files_say_what_the_result_says_and_pycolmaps_adjustment_starts_from_them(
    courtyard_located, tmp_path
):
    courtyard = courtyard_located
    write_result(courtyard, tmp_path / "out")
    read_folder(tmp_path / "out")
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    assert facts["schema_version"] == 1
    assert facts["num_placed"] == facts["num_images"] == 25
    assert facts["num_pairs_rejected"] == facts["pairs"]["outlier"] == 44
    solve = facts["solve"]
    assert solve["gap"] == pytest.approx(solve["objective"] - solve["dual_bound"], abs=1e-15)
    cameras = rows_of(tmp_path / "out" / "cameras.csv")
    for row in cameras:
        image = courtyard.reconstruction.find_image_with_name(row["name"])
        assert row["placed"] == "true"
        # Sums of three products of the yard's 25 m, once in our order and once in pycolmap's.
        center = [float(row[k]) for k in "xyz"]
        np.testing.assert_allclose(
            center, image.projection_center(), rtol=0.0, atol=25.0 * 8 * np.finfo(float).eps
        )
        assert 0.0 < float(row["sigma_x"]) < 0.1
        assert 0.0 <= float(row["trust"]) <= 1.0
    pairs = rows_of(tmp_path / "out" / "pairs.csv")
    assert len(pairs) == facts["num_pairs"]
    for row in pairs:
        images = (courtyard.reconstruction.find_image_with_name(row[k]) for k in ("name1", "name2"))
        baseline = normalized(np.subtract(*(image.projection_center() for image in images)))
        direction = np.array([float(row[k]) for k in ("vx", "vy", "vz")])
        assert angle_between_deg(direction, baseline) == pytest.approx(float(row["residual_deg"]), abs=1e-6)

    seed = pycolmap.Reconstruction(tmp_path / "out")
    before = seed.compute_mean_reprojection_error()
    pycolmap.bundle_adjustment(seed)
    seed.update_point_3d_errors()
    assert seed.compute_mean_reprojection_error() < before


def test_images_that_are_not_in_the_database_or_have_no_rotation_are_named_and_the_input_stays():
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    model.image(3).name = "elsewhere.jpg"
    model.deregister_frame(model.image(5).frame_id)
    poses = {i: image.cam_from_world().matrix() for i, image in model.images.items() if image.has_pose}
    before = {i: points2d_xy(image) for i, image in model.images.items()}
    num_points = model.num_points3D()
    found = sfm_shapefit.locate(model, RING / "database.db")
    assert any("elsewhere.jpg" in warning for warning in found.warnings)
    reasons = {row.name: row.reason for row in found.cameras}
    assert len(reasons) == 8
    assert reasons["elsewhere.jpg"] == "no matches with any posed image"
    assert reasons["0005.jpg"] == "the input has no rotation for it"
    assert model.num_points3D() == num_points
    for image_id, xy in before.items():
        np.testing.assert_array_equal(points2d_xy(model.image(image_id)), xy)
    np.testing.assert_array_equal(points2d_xy(found.reconstruction.image(3)), before[3])  # of no database
    for image_id, matrix in poses.items():
        np.testing.assert_array_equal(model.image(image_id).cam_from_world().matrix(), matrix)


def test_no_progress_is_told_of_a_stage_that_has_ended():
    under_way, told_late = set(), []

    def hear(stage, done, total):
        if (done, total) == (0, 1):
            under_way.add(stage)
        elif stage not in under_way:
            told_late.append(stage)
        if (done, total) == (1, 1):
            under_way.discard(stage)

    sfm_shapefit.locate(RING / "sparse" / "0", progress=hear)
    assert told_late == []


def test_threads_change_no_byte_of_a_model_whose_adjustment_they_share(drawn_workspace, tmp_path):
    """Enough images for strips of the dense factor, and observations for several chunks of points."""
    model = drawn_workspace("ring", num_images=48, num_points=1200) / "sparse" / "0"
    written = []
    for threads in (1, 2, 3, 7):
        out = tmp_path / str(threads)
        sfm_shapefit.write_result(sfm_shapefit.locate(model, threads=threads, adjust="full"), out)
        files = [*out.glob("*.bin"), out / "cameras.csv"]
        written.append({path.name: path.read_bytes() for path in files})
    assert len(written[0]) > 4
    assert written[1:] == written[:1] * 3
