"""Rigs and fixed cameras in `locate`: metric scale, poses that stay, and what is refused."""

import json
import shutil
from contextlib import closing
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit import InputError, LocateOptions
from sfm_shapefit.base.geometry import fit_similarity, rotation_angles_deg
from sfm_shapefit.commands.convert import convert
from sfm_shapefit.commands.write import write_result
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES
from sfm_shapefit.files.colmap.listed_poses import read_list
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.template import template_of
from sfm_shapefit.pipeline.model_joins import judge_joins
from sfm_shapefit.pipeline.pieces import ModelPiece, tie_pieces
from sfm_shapefit.placement.fixed_and_rigged import find_fixed_and_rigged
from sfm_shapefit.placement.gauge_rule import GaugeRule
from sfm_shapefit.scene.points import number_points
from sfm_shapefit.synthetic import (
    SceneOptions,
    WorkspaceOptions,
    make_rendered_scene,
    make_scene,
)
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.models import centers_of, posed, poses_of
from tests.pipeline.made import keep_few_matches
from tests.problems import made_priors
from tests.scenes import RING, edit_database


@pytest.fixture(scope="module")
def rigs(rig_drive):
    return rig_drive[0]


@pytest.fixture(scope="module")
def workspace(rig_drive):
    return rig_drive[1]


@pytest.fixture(scope="module")
def found(workspace):
    return sfm_shapefit.locate(workspace / "sparse" / "0", scale="unit")


def test_a_written_drive_has_its_rigs_and_true_poses_and_offsets_are_read_in_world_axes(rigs, workspace):
    model = read_model(workspace / "truth")
    truth = model.reconstruction
    assert (truth.num_rigs(), truth.num_frames(), truth.num_cameras()) == (2, 12, 6)
    np.testing.assert_allclose(centers_of(truth), rigs.centers, atol=1e-12)
    assert truth.compute_mean_reprojection_error() < 1.0  # of half a pixel per coordinate: 0.63
    with pycolmap.Database.open(workspace / "database.db") as database:
        assert (database.num_rigs(), database.num_frames()) == (2, 12)
    first = rigs.rigs.sensor_of_image == 0
    expected = rigs.centers - rigs.centers[first][rigs.rigs.frame_of_image]
    np.testing.assert_allclose(model.images.offsets, expected, atol=1e-12)
    assert not model.images.offsets[first].any()
    np.testing.assert_array_equal(model.images.frame_of, rigs.rigs.frame_of_image)
    assert model.images.has_rigs


def test_a_sensor_without_a_pose_in_its_rig_is_refused_by_name(workspace):
    model = pycolmap.Reconstruction(workspace / "truth")
    sensor = model.camera(2).sensor_id
    model.rig(1).reset_sensor_from_rig(sensor)
    with pytest.raises(InputError, match=r"camera 2 has no pose in rig 1 \(sensor_from_rig\)"):
        read_model(model)


def test_a_seed_moves_frames_and_keeps_their_sensors(workspace):
    model = read_model(workspace / "truth")
    before = [model.reconstruction.frame(f).rig_from_world.matrix() for f in range(1, 13)]
    centers = 2.0 * (model.images.centers - model.images.offsets) + [1.0, 2.0, 3.0] + model.images.offsets
    placed = model.images.frame_of != 4
    placed[1:3] = False  # of a frame whose first image is placed: they come with it
    rows = np.flatnonzero(placed)
    images = model.images.placed(rows, centers[rows])
    seed = SeededModel.of(template_of(model), images, number_points([]), None).reconstruction
    expected = model.images.frame_of != 4
    assert sorted(seed.reg_image_ids()) == model.images.ids[expected].tolist()
    np.testing.assert_allclose(centers_of(seed), centers[expected], atol=1e-12)
    assert_rigs_equal(seed, model.reconstruction)
    for frame, matrix in enumerate(before, start=1):  # the input is not touched
        np.testing.assert_array_equal(model.reconstruction.frame(frame).rig_from_world.matrix(), matrix)


def assert_rigs_equal(a, b, atol=0.0):
    assert set(a.rigs) == set(b.rigs)
    for rig_id, rig in a.rigs.items():
        for sensor, pose in rig.non_ref_sensors.items():
            other = b.rig(rig_id).sensor_from_rig(sensor)
            # Bundle adjustment normalizes quaternions anew; nothing else changes a bit.
            np.testing.assert_allclose(pose.matrix(), other.matrix(), rtol=0.0, atol=atol)


def test_the_metric_scale_is_found_to_a_thousandth_with_a_fifth_of_the_pairs_wrong(rigs, workspace, found):
    own = centers_of(found.reconstruction)
    assert len(own) == 36
    fit = fit_similarity(own, rigs.centers, rotate=False)
    assert abs(fit.scale - 1.0) < 1e-3
    errors = np.linalg.norm(fit.apply(own) - rigs.centers, axis=1)
    assert np.median(errors) < 0.01  # half a pixel at 10 m is 5 mm in a single match
    assert found.certified.gap <= 1e-8
    assert found.gauge.statement.startswith("rig: ")
    assert "the scale unit was not used, but that of the rigs" in found.warnings
    assert_rigs_equal(found.reconstruction, pycolmap.Reconstruction(workspace / "sparse" / "0"))


def test_tables_say_what_moved_together(workspace, found, tmp_path):
    write_result(found, tmp_path / "out")
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    inner = facts["rigid_groups"].pop("num_inner_pairs")
    assert facts["rigid_groups"] == {"num_groups": 12, "num_placed": 12, "num_fixed": 0}
    assert sum("inside a frame" in row.reason for row in found.pairs) == inner
    assert facts["num_placed"] == 36
    again = pycolmap.Reconstruction(tmp_path / "out")
    assert_rigs_equal(again, pycolmap.Reconstruction(workspace / "sparse" / "0"))
    assert found.summary()["num_placed"] == again.num_reg_images()


def test_an_image_without_pairs_comes_with_its_frame(rigs, workspace, found):
    images = rigs
    kept = ~(images.pairs == 4).any(axis=1)
    counts = np.diff(images.match_offsets)
    rows = np.repeat(kept, counts)
    per_pair = ("pairs", "pair_is_corrupted", "relative_rotations", "relative_translations")
    parts = {name: getattr(images, name)[kept] for name in per_pair}
    parts |= {name: getattr(images, name)[rows] for name in ("matches", "match_is_wrong")}
    lonely = replace(images, **parts, match_offsets=np.append(0, np.cumsum(counts[kept])))
    out = workspace.parent / "lonely"
    write_workspace(lonely, out, WorkspaceOptions(model="rotations"))
    located = sfm_shapefit.locate(out / "sparse" / "0", points="never")
    row = located.cameras[4]
    assert row.placed
    assert row.reason == "placed with its frame; no pair of its own takes part"
    offsets = [np.subtract(x.cameras[4].center, x.cameras[3].center) for x in (located, found)]
    np.testing.assert_allclose(*offsets, atol=1e-9)
    assert located.reconstruction.num_reg_images() == 36


def test_bundle_adjustment_keeps_the_rigs_their_scale_and_the_origin_of_the_input(workspace, rigs):
    located = sfm_shapefit.locate(workspace / "truth", workspace / "database.db", adjust="full")
    assert_rigs_equal(located.reconstruction, pycolmap.Reconstruction(workspace / "truth"), atol=1e-12)
    centers = centers_of(located.reconstruction)
    assert abs(fit_similarity(centers, rigs.centers, rotate=False).scale - 1.0) < 1e-3
    np.testing.assert_allclose(np.median(rigs.centers - centers, axis=0), 0.0, atol=1e-9)


def test_a_list_of_poses_keeps_the_rigs_of_its_database(workspace, rigs, tmp_path):
    convert(workspace / "truth", tmp_path / "poses.json")
    given = read_model(read_list(tmp_path / "poses.json", workspace / "database.db")[0])
    assert_rigs_equal(given.reconstruction, pycolmap.Reconstruction(workspace / "truth"), atol=1e-9)
    np.testing.assert_allclose(given.images.centers, rigs.centers, atol=1e-9)
    found = sfm_shapefit.locate(tmp_path / "poses.json", workspace / "database.db", rotations=2.0)
    assert found.gauge.scale == "rig"
    assert fit_similarity(centers_of(found.reconstruction), rigs.centers).scale == pytest.approx(
        1.0, abs=0.01
    )


def test_what_rigs_rule_out_is_said_and_inspecting_says_how_many_frames_hang_together(workspace):
    model = workspace / "sparse" / "0"
    with pytest.raises(InputError, match="no solver admm"):
        sfm_shapefit.locate(model, solver="admm")

    seen = sfm_shapefit.inspect(workspace / "sparse" / "0", points="never")
    assert seen.rigs.startswith("12 frames of 36 images, of which the pairs tie 12 in metric scale")
    assert sfm_shapefit.inspect(RING / "sparse" / "0").rigs.startswith("none")


def test_the_scale_is_that_of_the_rigs_and_what_else_is_told_checks_it(workspace):
    images, every = read_model(workspace / "truth").images, np.arange(36)
    apart = float(np.linalg.norm(images.centers[0] - images.centers[20]))
    distances = ((images.names[0], images.names[20], 2.0 * apart),)
    rigid = find_fixed_and_rigged(images, every < 0)
    rule = GaugeRule(images, rigid, "unit", made_priors(3.0 * images.centers), distances)
    chosen = rule.choose(every, 0.1 * images.centers, 0.1)
    assert chosen.scale == "rig"
    centers = chosen.apply(0.1 * images.centers)
    np.testing.assert_allclose(centers - centers[0], images.centers - images.centers[0], atol=1e-9)
    assert list(rule.check(chosen, every, centers)) == [
        f"{what} not used for the scale, which is that of the rigs; they differ by {percent} %"
        for what, percent in (("known distances were", 100), ("position priors were", 200))
    ]


def test_rigs_whose_sensors_coincide_are_no_yardstick(rigs, tmp_path):
    write_workspace(rigs, tmp_path / "w", WorkspaceOptions(database=False))
    model = pycolmap.Reconstruction(tmp_path / "w" / "sparse" / "0")
    for rig in model.rigs.values():
        for sensor, pose in rig.non_ref_sensors.items():
            rig.set_sensor_from_rig(sensor, pycolmap.Rigid3d(pose.rotation, np.zeros(3)))
    found = sfm_shapefit.locate(model, points="never", adjust="none", min_trust=0.0)
    assert found.placement.unit is None
    assert found.gauge.scale == "input"


@pytest.fixture
def moved_ring(tmp_path):
    """The ring with true centers of five cameras, in a unit of 0.37 m, and the others at the origin."""
    truth, names = read_model(RING / "sparse" / "0").images, tmp_path / "names.txt"
    centers = truth.centers / 0.37 + [100.0, -50.0, 7.0]
    given = dict(zip(truth.names[:5], centers, strict=False))
    model = posed(RING / "sparse" / "0", lambda name, turn, _: (turn, given.get(name, np.zeros(3))))
    names.write_text("# solved last week\n" + "\n".join(truth.names[:5]) + "\n\n")
    return model, centers, names, truth.names


def input_findings(verdict):
    """Return the sentences that doubt the input."""
    return [one.sentence for one in verdict.findings if one.kind == "input"]


@pytest.mark.parametrize(("offset", "told"), [(0.0, "have one center"), (1.0, "contradict by 90 degrees")])
def test_a_rig_that_matches_inside_its_frames_contradict_is_told(tmp_path, offset, told):
    scene = make_scene(SceneOptions(rig="pair", shape="courtyard", num_images=16, num_points=800, seed=2))
    write_workspace(scene, tmp_path / "yard")
    database, model = (
        tmp_path / "yard" / "database.db",
        pycolmap.Reconstruction(tmp_path / "yard" / "sparse" / "0"),
    )
    assert not input_findings(sfm_shapefit.check(model, database, second_opinion=False).verdict)
    (sensor,) = model.rig(1).non_ref_sensors
    pose = model.rig(1).sensor_from_rig(sensor)
    side = np.linalg.norm(pose.translation) * np.array([0.0, 0.0, offset])  # truth: along x
    model.rig(1).set_sensor_from_rig(sensor, pycolmap.Rigid3d(pose.rotation, side))
    verdict = sfm_shapefit.check(model, database, second_opinion=False).verdict
    (sentence,) = input_findings(verdict)
    assert told in sentence
    assert len(verdict.cameras) == 16


def test_fixed_cameras_keep_their_poses_to_the_bit_and_the_rest_finds_its_place(moved_ring):
    model, centers, names, all_names = moved_ring
    given = poses_of(model)
    options = LocateOptions(fix=str(names), adjust="full")
    found = sfm_shapefit.locate(model, RING / "database.db", options=options)
    after = poses_of(found.reconstruction)
    for name in all_names[:5]:
        np.testing.assert_array_equal(after[name], given[name])
    errors = np.linalg.norm(centers_of(found.reconstruction) - centers, axis=1) * 0.37
    assert errors.max() < 0.02  # meters; half a pixel at 4 m is 2 mm
    assert found.summary()["rigid_groups"]["num_fixed"] == 5
    assert ", 5 cameras fixed" in found.facts.rigid_groups.statement
    assert found.gauge.statement == "fixed: scale and origin of the fixed cameras"
    assert found.certified.gap <= 1e-8


def test_pairs_of_fixed_cameras_are_not_measured_and_the_others_stand_as_with_them(moved_ring):
    model, _, names, _ = moved_ring
    found, whole = (sfm_shapefit.locate(model, RING / "database.db", fix=fix) for fix in (str(names), ""))
    assert len(found.directions.pairs) == 9  # of 16
    assert (found.directions.pairs >= 5).any(axis=1).all()
    one, other = (centers_of(each.reconstruction) for each in (found, whole))
    away = np.abs(fit_similarity(other, one).apply(other) - one)
    assert away.max() < 2e-3 * np.ptp(one)
    assert found.reconstruction.num_points3D() == pytest.approx(whole.reconstruction.num_points3D(), rel=0.02)


def test_a_single_fixed_camera_keeps_its_place_and_the_scale_is_chosen_as_without(moved_ring):
    model, _, names, all_names = moved_ring
    names.write_text(all_names[2])
    given = poses_of(model)[all_names[2]]
    options = LocateOptions(fix=str(names), scale="unit", adjust="full")
    found = sfm_shapefit.locate(model, RING / "database.db", options=options)
    np.testing.assert_array_equal(poses_of(found.reconstruction)[all_names[2]], given)
    own = centers_of(found.reconstruction)
    assert np.median(np.linalg.norm(own - own.mean(axis=0), axis=1)) == pytest.approx(1.0)
    assert f"shifted so that {all_names[2]} stays where it is" in found.gauge.statement


def test_new_images_join_a_solved_model_without_moving_it(moved_ring):
    model, _, names, all_names = moved_ring
    solved = sfm_shapefit.locate(model, RING / "database.db", fix=str(names)).reconstruction
    new = all_names[-1]
    for image in list(solved.images.values()):  # one image has never been placed: a rotation, no points
        if image.name == new:
            for index in [k for k, point in enumerate(image.points2D) if point.has_point3D()]:
                solved.delete_observation(image.image_id, index)
            frame = solved.frame(image.frame_id)
            frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.zeros(3))
    given = poses_of(solved)
    found = sfm_shapefit.locate(solved, RING / "database.db", fix="solved")
    after = poses_of(found.reconstruction)
    assert found.summary()["rigid_groups"]["num_fixed"] == len(all_names) - 1
    for name in all_names[:-1]:
        np.testing.assert_array_equal(after[name], given[name])
    assert np.abs(after[new] - given[new]).max() > 1.0


def test_a_frame_with_a_fixed_image_stays_and_the_others_keep_the_metric_scale(rigs, workspace, tmp_path):
    model = pycolmap.Reconstruction(workspace / "truth")
    names = tmp_path / "names.txt"
    names.write_text("0008.jpg\n")
    found = sfm_shapefit.locate(model, workspace / "database.db", fix=str(names), points="never")
    for image_id in (7, 8, 9):
        np.testing.assert_array_equal(
            found.reconstruction.image(image_id).cam_from_world().matrix(),
            model.image(image_id).cam_from_world().matrix(),
        )
    errors = np.linalg.norm(centers_of(found.reconstruction) - rigs.centers, axis=1)
    assert np.median(errors) < 0.02  # grows with the distance from the frame that is held


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0001.jpg\nnobody.jpg\n", "line 2: the model has no posed image 'nobody.jpg'"),
        ("# nobody\n", "names no image"),
        ("".join(f"000{k}.jpg\n" for k in range(1, 9)), "every posed image of the model would be fixed"),
        (None, "does not exist"),
        ("0001.jpg\n0002.jpg\n0003.jpg\n", "the 3 fixed cameras are at one place"),
    ],
)
def test_names_that_fit_nothing_and_cameras_without_positions_are_refused(tmp_path, text, message):
    model = posed(RING / "sparse" / "0", lambda _, rotation, center: (rotation, 0.0 * center))
    names = tmp_path / "names.txt"
    if text is not None:
        names.write_text(text)
    with pytest.raises(InputError, match=message):
        sfm_shapefit.locate(model, RING / "database.db", fix=str(names))


@pytest.fixture(scope="module")
def mapped(workspace):
    return sfm_shapefit.map_database(workspace / "database.db")


def test_map_averages_over_frames_and_has_the_scale_of_the_rigs(mapped, workspace):
    (model,) = mapped.models
    assert (mapped.num_placed, mapped.left_out, mapped.warnings) == (36, {}, ())
    assert model.gauge.scale == "rig"
    errors = sfm_shapefit.evaluate(model.reconstruction, workspace / "truth")
    assert abs(errors.ref_from_model.scale - 1.0) < 1e-3
    # Half a pixel of noise; `locate` with the true rotations ends at 0.001 of an extent of 10.
    assert errors.position.max < 0.01
    truth = pycolmap.Reconstruction(workspace / "truth")
    assert_rigs_equal(model.reconstruction, truth, atol=1e-12)


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory):
    """A yard seen by a rig of four whose sensors are said to be 1 deg and 2 % of their distance off."""
    options = SceneOptions(rig="four", shape="courtyard", num_images=32, num_points=1200, seed=3)
    workspace, rng = tmp_path_factory.mktemp("rigs") / "yard", np.random.default_rng(3)
    scene = make_scene(replace(options, wrong_match_fraction=0.05))
    write_workspace(scene, workspace, WorkspaceOptions(model="rotations"))
    statements, model = [], pycolmap.Reconstruction(workspace / "sparse" / "0")
    for k, share in ((1, 0.02), (2, -0.02), (3, 0.02)):
        axis = rng.standard_normal(3)
        turn = Rotation.from_rotvec(np.radians(1.0) * axis / np.linalg.norm(axis)).as_matrix()
        rotation = turn @ scene.rigs.sensor_rotations[0, k]
        shift = -rotation @ scene.rigs.sensor_centers[0, k] * (1.0 + share)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)
        model.rig(1).set_sensor_from_rig(model.camera(k + 1).sensor_id, pose)
        blob = pose.rotation.quat[[3, 0, 1, 2]].tobytes() + pose.translation.tobytes()
        statements.append(
            f"UPDATE rig_sensors SET sensor_from_rig = x'{blob.hex()}' WHERE sensor_id = {k + 1}"
        )
    edit_database(workspace / "database.db", *statements)
    return scene, model, workspace / "database.db"


@pytest.mark.parametrize("way", ["map", "locate"])
def test_disturbed_rigs_are_refined_to_the_truth_and_the_mean_baseline_stays(disturbed, way):
    scene, model, database = disturbed
    if way == "locate":
        found = sfm_shapefit.locate(model, database, rigs="free")
    else:
        found = sfm_shapefit.map_database(database, rigs="free").models[0]
    said = np.array([pose.translation for pose in model.rig(1).non_ref_sensors.values()])
    (rig,) = found.reconstruction.rigs.values()
    poses = {sensor.id: pose for sensor, pose in rig.non_ref_sensors.items()}
    shifts = np.array([poses[camera].translation for camera in (2, 3, 4)])
    mean = np.linalg.norm(shifts, axis=1).mean()
    assert mean == pytest.approx(np.linalg.norm(said, axis=1).mean(), rel=1e-9)
    true = scene.rigs.sensor_centers[0]
    size = np.linalg.norm(true[1:], axis=1).mean() / mean
    assert [row.camera for row in found.rigs] == [2, 3, 4]
    for row in found.rigs:
        camera, pose = row.camera, poses[row.camera]
        turn = scene.rigs.sensor_rotations[0, camera - 1].T @ pose.rotation.matrix()
        center = -size * pose.rotation.matrix().T @ pose.translation
        # Largest of three axes, of the noise and of what is left of the wrong matches: 2.5 times at most.
        assert rotation_angles_deg(turn) < 5.0 * row.turn_sigma_deg < 0.1
        assert np.linalg.norm(center - true[camera - 1]) < 5.0 * row.place_sigma < 0.02
        assert row.turned_deg == pytest.approx(1.0, abs=0.05)
    own = centers_of(found.reconstruction)
    assert len(own) == 32
    fit = fit_similarity(own, scene.centers)
    assert np.linalg.norm(fit.apply(own) - scene.centers, axis=1).max() < 0.01  # as they are said: 0.2
    assert abs(fit.scale / size - 1.0) < 2e-3


def test_a_component_without_rigs_has_a_scale_of_its_own_beside_one_with_rigs(workspace, tmp_path):
    database = tmp_path / "database.db"
    shutil.copy(workspace / "database.db", database)
    of_second = "SELECT frame_id FROM frames WHERE rig_id = 2"
    second = f"(SELECT data_id FROM frame_data WHERE frame_id IN ({of_second}))"
    ends = (f"pair_id / {MAX_NUM_IMAGES} IN {second}", f"pair_id % {MAX_NUM_IMAGES} IN {second}")
    edit_database(
        database,
        f"DELETE FROM two_view_geometries WHERE ({ends[0]}) != ({ends[1]})",
        f"DELETE FROM frame_data WHERE frame_id IN ({of_second})",
        *(f"DELETE FROM {table} WHERE rig_id = 2" for table in ("frames", "rig_sensors", "rigs")),
    )
    found = sfm_shapefit.map_database(database, points="never")
    scales = [model.gauge.scale for model in found.models]
    assert sorted(scales) == ["rig", "unit"]


def test_rigs_that_cannot_be_refined_are_refused(tmp_path):
    # The two that look to the sides see nothing of a facade.
    scene = make_scene(SceneOptions(rig="four", shape="facade", num_images=24, num_points=1500, seed=2))
    write_workspace(scene, tmp_path / "facade")
    with pytest.raises(InputError, match=r"the matches do not tell where camera [34] is in its rig"):
        sfm_shapefit.locate(tmp_path / "facade" / "sparse" / "0", rigs="free")
    (mapped,) = sfm_shapefit.map_database(tmp_path / "facade" / "database.db", rigs="free").models
    assert mapped.warnings[0].startswith("the sensors of rigs are held: the matches do not tell where camera")
    for call in (
        lambda: sfm_shapefit.map_database(RING / "database.db", rigs="free"),
        lambda: sfm_shapefit.locate(RING / "sparse" / "0", rigs="free"),
    ):
        with pytest.raises(InputError, match=r"no rig of several cameras .*to refine; leave out rigs=free"):
            call()
    with pytest.raises(ValueError, match="rigs=free needs an adjustment"):
        LocateOptions(rigs="free", adjust="none")


def test_models_of_rigs_are_joined_in_their_common_scale_and_their_frames_stay_together(tmp_path):
    options = SceneOptions(rig="four", shape="courtyard", num_images=32, num_points=1200, seed=3)
    scene = make_scene(options)
    write_workspace(scene, tmp_path / "yard")
    database = edit_database(tmp_path / "yard" / "database.db", keep_few_matches(16, 8))
    found = sfm_shapefit.map_database(database)
    assert [len(model.averaged_names) for model in found.models] == [16, 16]
    (told,) = found.joins
    assert told.join is not None, told.statement
    assert told.join.to_from_piece.scale == 1.0
    sigmas = [model.gauge.scale_sigma for model in found.models]
    assert told.join.scale_sigma == pytest.approx(np.hypot(*sigmas))
    (joined,) = found.joined
    whole = read_model(joined.reconstruction)
    assert (whole.images.num_images, len(whole.images.frames.ids), whole.images.has_rigs) == (32, 8, True)
    assert (joined.reconstruction.num_rigs(), joined.reconstruction.num_cameras()) == (1, 4)
    own, truth = whole.images.centers, scene.centers[whole.images.ids - 1]
    fit = fit_similarity(own, truth)
    errors = np.linalg.norm(fit.apply(own) - truth, axis=1)
    assert errors.max() < 4.0 * told.join.center_sigma + 0.005
    assert abs(fit.scale - 1.0) < 2e-3


def test_photographs_of_a_pair_back_to_back_have_its_frames(tmp_path):
    size = {"image_width": 160, "image_height": 120, "focal_length_px": 120.0, "num_images": 4}
    scene = make_rendered_scene(SceneOptions(rig="back-to-back", shape="courtyard", seed=5, **size))
    write_rendered_workspace(scene, tmp_path / "yard", WorkspaceOptions())
    images = read_model(tmp_path / "yard" / "sparse" / "0").images
    np.testing.assert_array_equal(images.frame_of, scene.rigs.frame_of_image)
    np.testing.assert_allclose(images.centers, scene.centers, atol=1e-12)
    with pycolmap.Database.open(tmp_path / "yard" / "database.db") as database:
        assert (database.num_rigs(), database.num_frames()) == (1, 2)


def test_models_with_rigs_are_joined_at_the_scale_that_they_have(rigs, workspace):
    whole = pycolmap.Reconstruction(workspace / "truth")
    parts = [pycolmap.Reconstruction(whole), pycolmap.Reconstruction(whole)]
    for part, gone in zip(parts, (range(7, 13), range(1, 7)), strict=True):
        for frame in gone:
            part.deregister_frame(frame)
        assert part.num_reg_frames() == 6
    parts[1].transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d([0.0, 0.0, 0.6, 0.8]), [5.0, 1.0, 0.0]))
    found = sfm_shapefit.join(parts, workspace / "database.db")
    assert found.joins[0].join.to_from_piece.scale == 1.0
    errors = sfm_shapefit.evaluate(found.reconstruction, whole)
    assert len(errors.names) == 36
    assert errors.position.max < 0.01 * errors.extent
    assert found.reconstruction.num_reg_frames() == 12
    pieces = [ModelPiece(label=f"model {k}", model=read_model(part)) for k, part in enumerate(parts)]
    with closing(open_database(workspace / "database.db", read_model(whole).images.names)) as matches:
        (told,) = judge_joins(pieces, tie_pieces(pieces, matches, frozenset()))
    assert told.statement == "model 1 is not joined to model 0: their rigs do not give the scale of both"
    alone = pycolmap.Reconstruction(RING / "sparse" / "0")
    with pytest.raises(
        InputError, match="model 1 has rigs of several cameras, and a scale by that, but model 0"
    ):
        sfm_shapefit.join([alone, whole])


@pytest.mark.parametrize(
    "told", [{"scale": "unit"}, {"known_distance": (("0001.jpg", "0004.jpg", 2.0),)}, {}]
)
def test_the_offset_of_an_imu_is_in_the_unit_of_the_output(told):
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    imu, before = pycolmap.sensor_t(type=pycolmap.SensorType.IMU, id=1), [0.1, 0.02, 0.0]
    for rig in model.rigs.values():
        rig.add_sensor(imu, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array(before)))
    found = sfm_shapefit.locate(model, RING / "database.db", **told).reconstruction
    scale = fit_similarity(centers_of(model), centers_of(found)).scale
    own = [rig.sensor_from_rig(imu).translation for rig in found.rigs.values()]
    expected = np.multiply(before, scale if told else 1.0)
    np.testing.assert_allclose(own, np.broadcast_to(expected, (len(own), 3)), rtol=1e-3 if told else 0.0)


def test_priors_turn_and_shift_a_model_whose_rigs_tell_the_scale(rigs, workspace, tmp_path):
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    where = rigs.centers @ turn.T + [450.0, 5200.0, 400.0]
    names = read_model(workspace / "truth").images.names
    table = tmp_path / "priors.txt"
    rows = zip(names[::3], where[::3].tolist(), strict=True)
    table.write_text("".join(f"{name} {x} {y} {z}\n" for name, (x, y, z) in rows))
    found = sfm_shapefit.locate(workspace / "sparse" / "0", priors=table)
    assert found.gauge.scale == "rig"
    assert "agree" in found.gauge.statement
    own = centers_of(found.reconstruction)
    assert np.median(np.linalg.norm(own - where, axis=1)) < 0.02  # as the scale to a thousandth, over 20
    assert np.nanmax(found.prior_fit.off) < 0.2
