"""Evidence that the fit did not use, in runs of our own and against models as they stand."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pipeline import evidence
from sfm_shapefit.pipeline.check import check
from sfm_shapefit.pipeline.checked import check_source
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.inputs import inputs_from, open_source
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.scene.points import Points
from sfm_shapefit.solver.options import SolverOptions
from tests.models import by_name, write_priors
from tests.scenes import COURTYARD, RING, copied, edit_database


def with_own_lenses(source, factors):
    """A copy whose images have a lens each; focal lengths of some, by name, are off by factors."""
    model = pycolmap.Reconstruction()
    for image_id in sorted(source.reg_image_ids()):
        image = source.image(image_id)
        camera = pycolmap.Camera(
            model=image.camera.model, width=image.camera.width, height=image.camera.height,
            params=image.camera.params, camera_id=image_id,
        )  # fmt: skip
        params = camera.params.copy()
        params[camera.focal_length_idxs()] *= factors.get(image.name, 1.0)
        camera.params = params
        model.add_camera_with_trivial_rig(camera)
        copy = pycolmap.Image(name=image.name, camera_id=image_id, image_id=image_id)
        copy.points2D = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    return model


def test_a_wrong_lens_that_is_held_is_named_with_the_right_focal_length():
    truth, wrong_id = pycolmap.Reconstruction(RING / "sparse" / "0"), 5
    name = truth.image(wrong_id).name
    model = with_own_lenses(truth, {name: 1.1})
    found = sfm_shapefit.locate(model, RING / "database.db", intrinsics="held")
    (told,) = found.evidence.lenses
    right_px = truth.image(wrong_id).camera.mean_focal_length()
    assert told.camera == wrong_id
    assert told.focal_px == pytest.approx(1.1 * right_px)
    assert told.asked_focal_px == pytest.approx(right_px, rel=0.01)
    assert name in found.verdict.cameras
    assert found.verdict.grade is Grade.LOOK
    assert sum(f"focal length of camera {wrong_id} is wrong" in warning for warning in found.warnings) == 1
    assert found.summary()["evidence"]["lenses"][0]["camera"] == wrong_id


def test_of_a_lens_that_took_many_images_only_some_are_asked(monkeypatch):
    images = read_model(COURTYARD / "truth").images
    n, own = images.num_images, np.arange(images.num_images) % 2 == 0
    assert evidence._ask_some(images, None) is None
    assert evidence._ask_some(images, own) is own
    monkeypatch.setattr(evidence, "_MOST_ASKED", 4)
    assert np.flatnonzero(evidence._ask_some(images, None)).tolist() == list(range(0, n, -(-n // 4)))
    asked = evidence._ask_some(images, own)
    assert 2 <= asked.sum() <= 4
    assert not asked[~own].any()


def spoiled(amount_deg=0.0, shift=0.0):
    """The courtyard with a third of its cameras, and their points, turned about their middle, or shifted."""
    model = pycolmap.Reconstruction(COURTYARD / "truth")
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)[:8]
    own = {image.image_id for image in images}
    centers = np.array([image.projection_center() for image in images])
    turn = pycolmap.Rotation3d(np.radians(amount_deg) * np.array([0.0, 0.6, 0.8]))
    about = centers.mean(axis=0)
    moved = pycolmap.Sim3d(1.0, turn, about + shift - turn * about)
    for image in images:
        rotation = image.frame.rig_from_world.rotation * turn.inverse()
        center = moved * image.projection_center()
        image.frame.rig_from_world = pycolmap.Rigid3d(rotation, -(rotation * center))
    for point in model.points3D.values():
        if np.mean([element.image_id in own for element in point.track.elements]) > 0.5:
            point.xyz = moved * point.xyz
    return model, {image.name for image in images}


@pytest.mark.parametrize(("amount_deg", "shift"), [(90.0, 0.0), (0.0, 3.0)])
def test_a_group_that_is_moved_as_a_whole_is_named_and_the_model_not_to_be_used(
    tmp_path, courtyard_mapped, amount_deg, shift
):
    model, wrong = spoiled(amount_deg, shift)
    model.write(tmp_path)
    facts = check(tmp_path, COURTYARD / "database.db", second_opinion=courtyard_mapped).facts
    named = {name for seam in facts.evidence.seams for name in seam.images}
    assert len(named & wrong) >= 7
    assert len(named - wrong) <= 1
    assert facts.verdict.grade is Grade.DO_NOT_USE
    assert any("stand apart from the rest" in reason for reason in facts.verdict.reasons)
    assert any("cameras stand apart from the rest (" in warning for warning in facts.warnings)


def cut(folder, *kept):
    """The courtyard's database with few pairs between the first twelve images and the others."""
    pair, rows = 2147483647, ", ".join(str(pycolmap.image_pair_to_pair_id(*ends)) for ends in kept)
    across = f"pair_id / {pair} <= 12 AND pair_id % {pair} > 12 AND pair_id NOT IN ({rows})"
    database = copied(COURTYARD, folder) / "database.db"
    return edit_database(
        database, *(f"DELETE FROM {table} WHERE {across}" for table in ("matches", "two_view_geometries"))
    )


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    """What `map` makes of halves that two pairs tie, one of which it rejects: 6.6 % of the extent off."""
    return sfm_shapefit.map_database(cut(tmp_path_factory.mktemp("cut"), (5, 21), (10, 13)))


def test_halves_that_two_pairs_tie_are_doubted_where_what_tied_them_was_rejected_and_no_point_crosses(
    tmp_path, halves
):
    wrong = halves
    (told,) = wrong.models[0].located.evidence.untied
    assert told.images == tuple(f"{k:04d}.jpg" for k in range(1, 13))
    assert (told.num_agreeing, told.num_points, told.is_loose) == (1, 0, True)
    assert told.statement in wrong.models[0].located.warnings
    unknown = {row.name for row in wrong.models[0].located.cameras if not np.isfinite(row.sigma).all()}
    assert unknown == set(told.images)
    assert wrong.verdict.grade is Grade.DO_NOT_USE
    right = sfm_shapefit.map_database(cut(tmp_path, (4, 25), (5, 24)))
    assert right.verdict.grade is Grade.GOOD


@pytest.mark.parametrize(("same", "apart", "is_lost"), [(20, 10, False), (20, 11, True), (20, 0, False)])
def test_points_are_lost_that_only_a_pair_carries_whose_matches_mostly_see_two_points(
    monkeypatch, same, apart, is_lost
):
    """Two groups of two images; images 1 and 2 share points, and match some of their own."""
    total = same + 2 * apart
    seen = [(0, 1, 2)] * same + [(0, 1)] * apart + [(2, 3)] * apart
    keypoint = np.array([*range(same + apart), *range(same, same + apart)])
    points = Points(
        xyz=np.zeros((total, 3)),
        offsets=np.cumsum([0, *map(len, seen)]),
        images=np.concatenate(seen),
        keypoints=np.repeat(keypoint, [len(one) for one in seen]),
        ids=np.arange(total),
    )
    own = np.tile(np.arange(same + apart)[:, None], 2)
    matches = KeypointMatches(pairs=np.array([[1, 2]]), offsets=np.array([0, same + apart]), keypoints=own)
    view = SimpleNamespace(
        pairs=np.array([[0, 1], [1, 2]]),
        num_keypoints=np.full(4, same + apart),
        links=lambda **_: [matches],
    )
    images = SimpleNamespace(is_posed=np.ones(4, dtype=bool), num_images=4)
    pictures = SimpleNamespace(count=lambda _: same + apart)
    structure = evidence.Structure(points, images, pictures)
    errors_px = {
        1: 0.0,
        2: 5.0,
    }  # of points of the second group seen by the first, and of the first by the second
    monkeypatch.setattr(
        evidence,
        "keypoint_errors_px",
        lambda seen, *_: np.array([errors_px[k] for k in seen.images.tolist()]),
    )
    fits, group = np.ones(len(points.images), dtype=bool), np.array([0, 0, 1, 1])
    lost = evidence._are_lost(view, structure, fits, group)
    assert lost.tolist() == [is_lost] * same + [False] * 2 * apart
    assert not evidence._are_lost(view, structure, fits, np.zeros(4, dtype=int)).any()
    other = structure._replace(pictures=SimpleNamespace(count=lambda _: 1))  # keypoints of another file
    assert not evidence._are_lost(view, other, fits, group).any()
    errors_px[2] = 3.0  # two points, but at the same place
    assert not evidence._are_lost(view, structure, fits, group).any()
    errors_px[1] = 5.0
    assert evidence._are_lost(view, structure, fits, group).any() == is_lost
    again = replace(matches, keypoints=own[:same], offsets=np.array([0, same]))
    view.links = lambda **_: [matches, again]  # a pair all of whose matches see the same
    assert not evidence._are_lost(view, structure, fits, group).any()


def test_halves_that_a_join_ties_are_not_doubted(halves):
    model = read_model(halves.models[0].located.reconstruction)
    joined = np.flatnonzero(np.isin(model.images.ids, [1, 2, 13, 14]))
    clock = Clock.of(None, SolverOptions())
    with open_source(model, inputs_from(halves.database)) as source:
        tied = replace(source, tied=np.array([*combinations(joined.tolist(), 2)]))
        told = [check_source(model, one, DirectionOptions(), clock).facts.evidence for one in (source, tied)]
    assert [len(one.untied) for one in told] == [1, 0]


@pytest.mark.parametrize(("share", "num_tied"), [(0.002, 8), (0.2, 0)])
def test_priors_that_are_as_certain_as_cameras_tie_these(tmp_path, monkeypatch, share, num_tied):
    images, told = read_model(RING / "sparse" / "0").images, []
    sigma = share * np.linalg.norm(np.ptp(images.centers, axis=0))
    off = 0.1 * sigma * np.random.default_rng(0).standard_normal(images.centers.shape)
    priors = write_priors(tmp_path / "priors.txt", by_name(images, images.centers + off), sigma)
    gather = evidence.gather_evidence
    monkeypatch.setattr(
        evidence, "gather_evidence", lambda *given: told.append(given[0].tied) or gather(*given)
    )
    sfm_shapefit.locate(RING / "sparse" / "0", priors=priors)
    assert len(np.unique(told[0])) == num_tied


def test_a_displaced_camera_has_its_other_place_with_both_counts(tmp_path, courtyard_mapped):
    model = pycolmap.Reconstruction(COURTYARD / "truth")
    image = model.image(sorted(model.reg_image_ids())[7])
    pose = image.frame.rig_from_world
    image.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([2.0, 0.0, 0.0]))
    model.write(tmp_path)
    facts = check(tmp_path, COURTYARD / "database.db", second_opinion=courtyard_mapped).facts
    (told,) = [place for place in facts.evidence.places if place.image == image.name]
    assert np.linalg.norm(told.offset) == pytest.approx(2.0, rel=0.05)
    assert told.num_there > 2 * told.num_here
    assert f"{told.num_there} put it 2" in told.statement
    assert image.name in facts.verdict.cameras
