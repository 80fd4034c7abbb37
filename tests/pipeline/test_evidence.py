"""Evidence that the fit did not use, in runs of our own and against models as they stand."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.commands.check import check
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.lens_questions import images_to_ask
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.judgement.tied_groups import lost_points
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline import examination as evidence
from sfm_shapefit.pipeline.inputs import inputs_from, open_source
from sfm_shapefit.pipeline.referee import check_source
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
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
    assert (
        sum(f"focal length of camera {wrong_id} ({name}) is wrong" in warning for warning in found.warnings)
        == 1
    )
    assert found.summary()["evidence"]["lenses"][0]["camera"] == wrong_id


@pytest.mark.parametrize(
    ("num_posed", "asked", "expected"),
    [
        (450, None, range(0, 450, 3)),  # at most 200
        (450, range(0, 450, 2), range(0, 450, 4)),
        (150, None, None),
        (150, range(0, 150, 2), range(0, 150, 2)),
    ],
)
def test_of_a_lens_that_took_many_images_only_some_are_asked(num_posed, asked, expected):
    lens, every = Lens("SIMPLE_PINHOLE", (100.0, 0.0, 0.0)), np.arange(450)
    images = SimpleNamespace(lenses=(lens,), lens_of=np.zeros(450, dtype=int), is_posed=every < num_posed)
    found = images_to_ask(images, asked if asked is None else np.isin(every, asked))
    assert (found if found is None else np.flatnonzero(found).tolist()) == (expected and [*expected])


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
    (told,) = wrong.models[0].evidence.untied
    assert told.images == tuple(f"{k:04d}.jpg" for k in range(1, 13))
    assert (told.num_agreeing, told.num_points, told.is_loose) == (1, 0, True)
    assert told.statement in wrong.models[0].warnings
    unknown = {row.name for row in wrong.models[0].cameras if not np.isfinite(row.sigma).all()}
    assert unknown == set(told.images)
    assert wrong.verdict.grade is Grade.DO_NOT_USE
    right = sfm_shapefit.map_database(cut(tmp_path, (4, 25), (5, 24)))
    assert right.verdict.grade is Grade.GOOD


class Row:
    """Cameras of 100 px, 1 apart in a row: two groups of two, and points that they see.

    The groups share the matches of the images in the middle, 1 and 2. `same` of them see one point; of
    `apart` others either group has a point, that of the second group `off_px` from that of the first in
    images 1 and 2.
    """

    def __init__(self, same, apart, off_px):
        rng, n = np.random.default_rng(0), same + apart
        first = np.column_stack([rng.uniform(-1.0, 4.0, n), rng.uniform(-2.0, 2.0, n), np.full(n, 10.0)])
        depth = 100.0 / (10.0 + off_px[0] - off_px[1])
        second = first[same:] * [1.0, depth / 10.0, depth / 10.0]
        second[:, 0] = 1.0 + depth * (10.0 * (first[same:, 0] - 1.0) + off_px[0]) / 100.0
        centers = np.arange(4.0)[:, None] * [1.0, 0.0, 0.0]
        own = np.arange(same, n)
        seen = [(0, 1, 2)] * same + [(0, 1)] * apart + [(2, 3)] * apart
        self.points = Points(
            xyz=np.concatenate([first, second]),
            offsets=np.cumsum([0, *map(len, seen)]),
            images=np.concatenate(seen),
            keypoints=np.repeat([*range(n), *own], [len(one) for one in seen]),
            ids=np.arange(len(seen)),
        )
        pixels = [100.0 * ((x - c)[:, :2] / x[:, 2:]) for c, x in zip(centers, [first] * 4, strict=True)]
        for k in (2, 3):
            pixels[k][same:] = 100.0 * (second - centers[k])[:, :2] / second[:, 2:]
        pixels = [np.vstack([one, np.full((5, 2), 1e3)]) for one in pixels]
        lens = Lens("SIMPLE_PINHOLE", (100.0, 0.0, 0.0))
        self.images = SimpleNamespace(
            num_images=4,
            is_posed=np.ones(4, dtype=bool),
            rotations=np.tile(np.eye(3), (4, 1, 1)),
            centers=centers,
            lenses=(lens,),
            lens_of=np.zeros(4, dtype=int),
        )
        self.pictures = SimpleNamespace(
            count=lambda _: n + 5,
            pixels=lambda k, keypoints: pixels[k][keypoints],
            project=lambda _k, x, **_: 100.0 * x[:, :2] / x[:, 2:],
        )
        self.num_keypoints, self.is_same = np.full(4, n + 5), np.arange(len(seen)) < same
        # Five matches have a point at one end only, and say nothing.
        own = np.column_stack([[*range(n), *range(5)], [*range(n), *range(n, n + 5)]])
        self.matches = KeypointMatches(pairs=np.array([[1, 2]]), offsets=np.array([0, n + 5]), keypoints=own)

    def lost(self, group=(0, 0, 1, 1), pictures=None, also=()):
        view = SimpleNamespace(
            pairs=np.array([[0, 1], [1, 2]]),
            num_keypoints=self.num_keypoints,
            links=lambda **_: [self.matches, *also],
        )
        structure = Structure(self.points, self.images, pictures or self.pictures)
        fits = np.ones(len(self.points.images), dtype=bool)
        return lost_points(view, structure, fits, np.array(group))


@pytest.mark.parametrize(
    ("same", "apart", "off_px", "is_lost"),
    [
        (20, 10, (0.0, 5.0), False),
        (20, 11, (0.0, 5.0), True),
        (20, 11, (5.0, 5.0), True),
        (20, 11, (0.0, 3.0), False),  # two points, but at the same place
        (20, 11, (5.0, 3.0), True),
        (20, 0, (0.0, 5.0), False),
    ],
)
def test_points_are_lost_that_only_a_pair_carries_whose_matches_mostly_see_two_points(
    same, apart, off_px, is_lost
):
    row = Row(same, apart, off_px)
    np.testing.assert_array_equal(row.lost(), row.is_same & is_lost)
    assert not row.lost(group=(0, 0, 0, 0)).any()
    others = SimpleNamespace(**vars(row.pictures) | {"count": lambda _: 1})  # keypoints of another file
    assert not row.lost(pictures=others).any()
    sound = replace(row.matches, keypoints=row.matches.keypoints[:same], offsets=np.array([0, same]))
    assert not row.lost(also=[sound]).any()  # a pair all of whose matches see the same


def test_halves_that_a_join_ties_are_not_doubted(halves):
    model = read_model(halves.models[0].reconstruction)
    joined = np.flatnonzero(np.isin(model.images.ids, [1, 2, 13, 14]))
    clock = Clock.of(None)
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


def test_several_wrong_lenses_are_one_line_with_the_names_of_their_images():
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    names = [truth.image(truth_id).name for truth_id in sorted(truth.reg_image_ids())[5:15:9]]
    given = with_own_lenses(truth, dict.fromkeys(names, 1.1))
    held = sfm_shapefit.locate(given, COURTYARD / "database.db", intrinsics="held")
    assert len(held.evidence.lenses) == 2
    (line,) = (warning for warning in held.warnings if "focal length" in warning)
    freed = sfm_shapefit.locate(given, COURTYARD / "database.db")
    (changed,) = (warning for warning in freed.warnings if "focal length" in warning)
    assert all(name in line and name in changed for name in names)
    assert changed.count("images contradicted what was given") == 1
    assert not any("too far" in one.sentence for one in freed.verdict.findings)


def test_a_known_focal_length_that_changed_by_more_than_one_of_exif_data_is_to_be_looked_at():
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    name = truth.image(sorted(truth.reg_image_ids())[5]).name
    found = sfm_shapefit.locate(with_own_lenses(truth, {name: 0.6}), COURTYARD / "database.db")
    (told,) = (one for one in found.verdict.findings if "the one that was known" in one.sentence)
    assert told.images == (name,)
    assert "a focal length 1.67 times the one that was known" in told.sentence  # 432 px became 720
    assert found.verdict.grade.value == "look"
