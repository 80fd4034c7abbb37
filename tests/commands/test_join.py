"""`join`: models of one scene in one world, and one sentence for each that cannot be."""

import json
import shutil
from contextlib import closing

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.seed import write_model
from sfm_shapefit.pipeline.pieces import ModelPiece, tie_pieces
from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_scene
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.facts.test_schema import problems
from tests.models import only
from tests.pipeline.made import DATABASE, FOLDER, PAIR
from tests.problems import turn
from tests.program import run, run_refused
from tests.scenes import COURTYARD, RING, edit_database, fingerprint

WHOLE = pycolmap.Reconstruction(FOLDER)
IDS = sorted(WHOLE.reg_image_ids())
MOVE = pycolmap.Sim3d(0.4, pycolmap.Rotation3d(turn([0.3, -0.2, 0.1], 70.0)), np.array([1.0, -2.0, 3.0]))


def piece(ids, *, moved=False, renumbered=False, compact=False):
    """Some images of the ring, in a world of their own, with the ids or the keypoints of another program."""
    part = only(WHOLE, ids)
    if moved:
        part.transform(MOVE)
    if not (renumbered or compact):
        return part
    other = pycolmap.Reconstruction()
    (camera,) = part.cameras.values()
    other.add_camera_with_trivial_rig(camera)
    new, place = {}, {}
    for k, i in enumerate(sorted(part.reg_image_ids()), start=1):
        seen = [p for p, point in enumerate(part.image(i).points2D) if point.has_point3D() or not compact]
        place |= {(i, p): row for row, p in enumerate(seen[::-1] if compact else seen)}
        xy = np.array([part.image(i).points2D[p].xy for p in (seen[::-1] if compact else seen)])
        image = pycolmap.Image(name=part.image(i).name, keypoints=xy, camera_id=camera.camera_id, image_id=k)
        other.add_image_with_trivial_frame(image, part.image(i).cam_from_world())
        new[i] = k
    for point in part.points3D.values():
        elements = [
            pycolmap.TrackElement(new[e.image_id], place[e.image_id, e.point2D_idx])
            for e in point.track.elements
        ]
        other.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    return other


def written(folder, *models):
    """Write models to folders and return these."""
    folders = [folder / str(k) for k in range(len(models))]
    for path, model in zip(folders, models, strict=True):
        path.mkdir()
        write_model(model, path)
    return folders


def errors_of(model):
    found = sfm_shapefit.evaluate(model, FOLDER)
    return len(found.names), found.position.max / found.extent


@pytest.mark.parametrize("adjust", ["none", "full"])
def test_models_are_joined_in_the_world_of_the_first(tmp_path, adjust):
    models = written(tmp_path, piece(IDS[:4]), piece(IDS[4:], moved=True))
    before = [*map(fingerprint, models), DATABASE.read_bytes()]
    out = tmp_path / "out"
    shown = run("join", *models, out, "--database", DATABASE, "--adjust", adjust, code=0).output
    assert before == [*map(fingerprint, models), DATABASE.read_bytes()]
    facts = json.loads((out / "locate.json").read_text())
    assert problems(facts, "joined") == []
    (told,) = facts["joins"]
    assert told["joined"]
    assert (told["model"], told["to"]) == (str(models[1]), str(models[0]))
    assert " ".join(told["statement"].split()[:3]) == f"{models[1]} is joined"
    assert "joined" in shown
    assert told["agreeing_pairs"] >= 3
    assert (told["solve"]["status"], told["solve"]["gap"] <= 1e-8) == ("converged", True)
    assert (told["folder"], facts["models"]) == (".", [*map(str, models)])
    assert f"workspace {out} IMAGES {out}_dense" in " ".join(shown.split())
    assert told["similarity"]["scale"] == pytest.approx(2.5, rel=1e-4)
    assert 0.0 < told["scale_sigma"] < 0.01
    assert errors_of(out) == (8, pytest.approx(0.0, abs=1e-4))
    joined = pycolmap.Reconstruction(out)
    first = pycolmap.Reconstruction(models[0])
    if adjust == "none":  # the world is that of the first
        for i in first.reg_image_ids():
            np.testing.assert_array_equal(
                joined.image(i).cam_from_world().matrix(), first.image(i).cam_from_world().matrix()
            )
    # Points that both see are one, so that there are no more than in the whole scene.
    assert joined.num_points3D() <= 1.02 * WHOLE.num_points3D()
    assert joined.compute_mean_reprojection_error() < 0.1
    title = " + ".join(model.name for model in models)
    assert f"<title>{title} " in (out / "report.html").read_text()


def test_models_that_share_images_are_joined_without_a_database_and_whatever_their_ids():
    second = piece([*IDS[:1], *IDS[3:]], moved=True, renumbered=True)
    found = sfm_shapefit.join([piece(IDS[:5]), second])
    assert found.joins[0].statement.startswith("model 1 is joined to model 0 by 3 of 3 pairs of images")
    assert errors_of(found.reconstruction) == (8, pytest.approx(0.0, abs=1e-5))
    names = [image.name for image in found.reconstruction.images.values()]
    assert sorted(names) == sorted(image.name for image in WHOLE.images.values())
    assert found.reconstruction.num_points3D() <= 1.02 * WHOLE.num_points3D()


def assert_tracks_hold(model):
    """Each observation of a point is that of its keypoint, and no keypoint observes what does not see it."""
    seen = {
        (e.image_id, e.point2D_idx): i for i, point in model.points3D.items() for e in point.track.elements
    }
    told = {
        (i, k): point.point3D_id
        for i, image in model.images.items()
        for k, point in enumerate(image.points2D)
        if point.has_point3D()
    }
    assert seen == told


def other_keypoints(model, *, noise_px, seed=0):
    """The model with keypoints of another program, so many pixels away and in another order."""
    rng = np.random.default_rng(seed)
    ids = sorted(model.reg_image_ids())
    place = {i: rng.permutation(model.image(i).num_points2D()) for i in ids}
    other = pycolmap.Reconstruction()
    (camera,) = model.cameras.values()
    other.add_camera_with_trivial_rig(camera)
    for i in ids:
        xy = np.array([point.xy for point in model.image(i).points2D])
        xy = (xy + rng.normal(0.0, noise_px, xy.shape))[np.argsort(place[i])]
        image = pycolmap.Image(name=model.image(i).name, keypoints=xy, camera_id=camera.camera_id, image_id=i)
        other.add_image_with_trivial_frame(image, model.image(i).cam_from_world())
    for point in model.points3D.values():
        elements = [(e.image_id, int(place[e.image_id][e.point2D_idx])) for e in point.track.elements]
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
        other.add_point3D(point.xyz, track, point.color)
    return other


@pytest.mark.parametrize(("last", "noise_px"), [(4, 1.0), (5, 0.0), (6, 0.3)])
def test_images_of_both_keep_the_keypoints_of_both(tmp_path, last, noise_px):
    second = other_keypoints(piece(IDS[2:], moved=True), noise_px=noise_px)
    models = written(tmp_path, piece(IDS[:last]), second)
    out = tmp_path / "out"
    run("join", *models, out, code=0)
    facts = json.loads((out / "locate.json").read_text())
    assert (facts["verdict"]["grade"], facts["verdict"]["reasons"]) == ("good", [])
    assert errors_of(out) == (8, pytest.approx(0.0, abs=1e-3))
    joined, first = pycolmap.Reconstruction(out), pycolmap.Reconstruction(models[0])
    assert_tracks_hold(joined)
    for i in IDS[2:last]:
        name = WHOLE.image(i).name
        found = [model.find_image_with_name(name).points2D for model in (first, second, joined)]
        ours, theirs, both = ([tuple(point.xy) for point in points] for points in found)
        assert both[: len(ours)] == ours
        if noise_px == 0.0:
            assert both == ours
        else:
            assert len(ours) < len(both) <= len(ours) + len(theirs)
            assert {*both[len(ours) :]} <= {*theirs}
    alone = sum(model.compute_num_observations() for model in (first, second))
    if noise_px == 1.0:  # few of them lie within half a pixel of one another by chance
        assert joined.compute_num_observations() >= 0.95 * alone
    elif noise_px == 0.0:
        same = sfm_shapefit.join([first, piece(IDS[2:], moved=True)]).reconstruction
        assert joined.compute_num_observations() == same.compute_num_observations()


def test_three_models_with_keypoints_of_their_own_stay_whole():
    ids = [IDS[:4], IDS[1:6], IDS[3:]]
    models = [other_keypoints(piece(some), noise_px=1.0, seed=k) for k, some in enumerate(ids)]
    found = sfm_shapefit.join(models)
    assert found.verdict.grade == "good"
    assert errors_of(found.reconstruction) == (8, pytest.approx(0.0, abs=1e-3))
    assert_tracks_hold(found.reconstruction)
    alone = sum(model.compute_num_observations() for model in models)
    assert found.reconstruction.compute_num_observations() >= 0.95 * alone


def test_a_database_of_the_first_model_alone_is_said_and_does_not_judge_the_others(tmp_path):
    (tmp_path / "a").mkdir()
    database = tmp_path / "a" / "database.db"
    shutil.copy(DATABASE, database)
    pairs = f"DELETE FROM two_view_geometries WHERE pair_id % {PAIR} > 5"
    edit_database(database, "DELETE FROM images WHERE image_id > 5", pairs)
    first, second = written(tmp_path / "a", piece(IDS[:5]), other_keypoints(piece(IDS[2:]), noise_px=1.0))
    shown = " ".join(run("join", first, second, tmp_path / "out", code=0).output.split())
    assert "matches: images that the models share;" in shown
    assert "database.db, found beside the first, lacks 3 of 8 images" in shown
    assert "verdict: good" in shown
    told = run("join", first, second, tmp_path / "asked", "--database", database, code=0).output
    assert "the database lacks 3 images" in " ".join(told.split())


@pytest.mark.parametrize("form", ["images/{}", ".\\images\\{}", "D:\\shots\\{}"])
def test_images_of_one_name_but_for_folders_are_one(form):
    second = other_keypoints(piece(IDS[2:], moved=True), noise_px=1.0)
    for image in second.images.values():
        image.name = form.format(image.name)
    found = sfm_shapefit.join([piece(IDS[:5]), second])
    assert found.verdict.grade == "good"
    names = [image.name for image in found.reconstruction.images.values()]
    assert len(names) == 8
    assert {WHOLE.image(i).name for i in IDS[:5]} <= {*names}
    assert all(second.image(i).name == form.format(WHOLE.image(i).name) for i in IDS[2:])


def test_names_that_a_database_has_both_are_two_images(tmp_path):
    database = shutil.copy(DATABASE, tmp_path / "both.db")
    first, last = (WHOLE.image(i).name for i in (IDS[0], IDS[7]))
    edit_database(tmp_path / "both.db", f"UPDATE images SET name = 'b/{first}' WHERE name = '{last}'")
    second = piece(IDS[4:], moved=True)
    second.image(IDS[7]).name = f"b/{first}"
    found = sfm_shapefit.join([piece(IDS[:4]), second], database)
    assert found.reconstruction.num_reg_images() == 8
    assert found.verdict.grade == "good"


def test_a_second_model_that_is_bent_is_not_called_good(tmp_path):
    second = other_keypoints(piece(IDS[2:], moved=True), noise_px=1.0)
    for i in IDS[5:]:
        frame = second.frame(second.image(i).frame_id)
        pose = frame.rig_from_world
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([1.0, 0.0, 0.0]))
    found = sfm_shapefit.join([piece(IDS[:5]), second])
    assert found.verdict.grade != "good"


def test_models_without_points_are_joined_by_the_images_that_they_share():
    models = [piece(IDS[:6]), piece(IDS[3:], moved=True)]
    for model in models:
        for point in [*model.points3D]:
            model.delete_point3D(point)
    found = sfm_shapefit.join(models)
    assert "3 by images that both have" in found.joins[0].statement
    assert errors_of(found.reconstruction) == (8, pytest.approx(0.0, abs=1e-5))
    models[1].frame(models[1].image(IDS[4]).frame_id).rig_from_world = pycolmap.Rigid3d()
    found = sfm_shapefit.join(models)  # a wrong pose of one image, which tells no scale, is no rival
    assert "2 of 3 pairs of images between them, 2 by images that both have" in found.joins[0].statement


def test_keypoints_of_another_program_are_found_in_the_database_by_their_pixels():
    second = piece(IDS[4:], moved=True, compact=True)
    firsts = [model.find_image_with_name("0006.jpg").points2D[0].xy for model in (second, WHOLE)]
    assert not np.allclose(*firsts)  # in another order
    known = []
    for other in (second, piece(IDS[4:], moved=True)):
        pieces = [ModelPiece(label="", model=read_model(model)) for model in (piece(IDS[:4]), other)]
        with closing(
            open_database(DATABASE, sorted(image.name for image in WHOLE.images.values()))
        ) as matches:
            tied = tie_pieces(pieces, matches, frozenset())
        known.append(np.isfinite(tied.ties.points).all(axis=2).sum(axis=0).tolist())
    assert known[0] == known[1]
    assert min(known[0]) > 100
    found = sfm_shapefit.join([piece(IDS[:4]), second], DATABASE)
    assert errors_of(found.reconstruction) == (8, pytest.approx(0.0, abs=1e-4))


def test_three_models_are_joined_at_once():
    parts = [piece(IDS[:3]), piece(IDS[3:6], moved=True), piece(IDS[6:] + IDS[:1], moved=True)]
    found = sfm_shapefit.join(parts, DATABASE)
    assert [join.join is not None for join in found.joins] == [True, True]
    assert found.models == (0, 1, 2)
    assert repr(found).startswith("<JoinedModel: 8 images of 3 models, ")
    assert found.warnings == []
    assert list(found.table("cameras")["name"]) == [camera.name for camera in found.cameras]
    assert errors_of(sfm_shapefit.check(found, DATABASE)) == errors_of(found)
    assert errors_of(found.reconstruction) == (8, pytest.approx(0.0, abs=1e-4))


def test_an_adjustment_of_the_whole_chooses_its_loss_and_makes_photographs_better(tmp_path):
    """Most keypoints far better than the rest, as of photographs; a loss of 1 px gives most of that away."""
    scene = make_scene(SceneOptions(num_images=16, num_points=480, pixel_noise_px=0.1))
    write_workspace(scene, tmp_path / "drawn", WorkspaceOptions(database=False))
    truth = pycolmap.Reconstruction(tmp_path / "drawn" / "sparse" / "0")
    photographed, rng = pycolmap.Reconstruction(truth), np.random.default_rng(0)
    for i in sorted(photographed.reg_image_ids()):
        for point in photographed.image(i).points2D:
            point.xy = point.xy + (rng.random() < 0.3) * rng.normal(0.0, 1.5, 2)
    ids = sorted(photographed.reg_image_ids())
    parts = [only(photographed, some) for some in (ids[:11], ids[8:])]
    models = [sfm_shapefit.bundle_adjust(part, loss_scale_px=0.25).reconstruction for part in parts]
    joined, whole = (sfm_shapefit.join(models, adjust=adjust).reconstruction for adjust in ("none", "full"))
    at_one_px = sfm_shapefit.bundle_adjust(joined).reconstruction
    before, after, worse = (
        sfm_shapefit.evaluate(model, truth).position.mean for model in (joined, whole, at_one_px)
    )
    assert after < 0.9 * before < before < worse


def test_what_ties_too_little_is_refused_with_its_reason(tmp_path):
    models = written(tmp_path, piece(IDS[:4]), piece([IDS[3], *IDS[5:]], moved=True))
    told = run_refused("join", *models, tmp_path / "out", code=4)
    assert f"{models[1]} is not joined to {models[0]}: 1 of 1 pair of images" in told
    assert "it needs 3" in told
    assert not (tmp_path / "out").exists()
    across = tmp_path / "without.txt"
    names = [WHOLE.image(i).name for i in IDS]
    across.write_text("\n".join(f"{a} {b}" for a in names[:4] for b in names[4:]))
    with pytest.raises(UnsolvableError, match="no pair of images ties it to another"):
        sfm_shapefit.join([piece(IDS[:4]), piece(IDS[4:])], DATABASE, without=str(across))


def test_bad_input_is_one_sentence(tmp_path):
    first, second, same = written(tmp_path, piece(IDS[:4]), piece(IDS[4:]), piece(IDS[1:3]))
    out = tmp_path / "out"
    assert "share no image, and there is no database" in run_refused("join", first, second, out)
    assert f"every image of {same} is in {first} too" in run_refused("join", first, same, out)
    other = COURTYARD / "images"
    assert "images" in run_refused("join", first, second, out, "--database", other)
    with pytest.raises(sfm_shapefit.InputError, match="needs two models or more"):
        sfm_shapefit.join([first], DATABASE)
    with pytest.raises(sfm_shapefit.InputError, match="needs two models or more"):
        sfm_shapefit.join(str(first), DATABASE)
    assert run("join", first, out, code=2).exit_code == 2
    assert not out.exists()


def test_a_database_that_knows_no_image_of_one_model_is_refused():
    foreign = piece(IDS[4:])
    renamed = {i: f"other{i}.jpg" for i in foreign.images}
    for i, name in renamed.items():
        foreign.image(i).name = name
    with pytest.raises(sfm_shapefit.InputError, match=r"has no image of model 1, such as other\d"):
        sfm_shapefit.join([RING / "sparse" / "0", foreign], DATABASE)
