"""What of the observations agrees with the cameras, what contradicts them, and what merely sees no point."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit import LocateOptions
from sfm_shapefit.adjustment.sources import collect_matches
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import ModelPictures, points_of
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.judgement.support import (
    ObservationCounts,
    PartnerCounts,
    images_of_few_points,
    images_without_support,
)
from sfm_shapefit.pipeline import seed
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
from sfm_shapefit.scene.matches import is_among
from tests.models import arrays
from tests.scenes import RING

NO_PAIRS = np.zeros((0, 2), dtype=np.int64)


@pytest.fixture
def found(ring_located):
    return ring_located


def counted_at(images, points, apart=NO_PAIRS):
    model, options = read_model(RING / "sparse" / "0"), LocateOptions()
    inputs = choose_inputs(RING / "sparse" / "0", RING / "database.db", "auto")
    with open_source(model, inputs, options) as source:
        view, every, poses = source.view, np.arange(images.num_images), views_of(images).poses(images)
        counted = PartnerCounts(images, view.num_keypoints, options.structure.max_reprojection_error_px)
        is_apart = is_among(view.pairs, apart)
        for batches in (view.links(chosen=is_apart), view.links(chosen=~is_apart)):
            pictures = ModelPictures(images, view.keypoints)
            counted.add(collect_matches(images, pictures, every, batches, view.num_matches), poses)
    return counted.compare(points)


def judge(images, points, apart=NO_PAIRS):
    return counted_at(images, points, apart).shares(images.is_posed)


def arrays_of(found):
    model = arrays(found.reconstruction)
    images = images_of(model)
    return images, points_of(model, images)


def test_observations_of_right_cameras_agree(found):
    shares = judge(*arrays_of(found))
    assert shares == found.observations
    assert shares.observations > 0.9
    assert shares.contradicting < 0.01
    assert judge(*arrays_of(found), apart=np.array([[1, 0], [2, 3]])) == shares


def test_partners_that_leave_are_not_counted(found, monkeypatch):
    def leave(points, *_):
        return np.where(np.arange(8) == 3, points.count_seen(8), -1)

    monkeypatch.setattr(seed, "images_of_few_points", leave)
    told = []
    monkeypatch.setattr(
        seed, "images_without_support", lambda counts, *_: told.append(counts) or np.zeros(8, bool)
    )
    fewer = sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db")
    assert fewer.reconstruction.num_reg_images() == 7
    expected = counted_at(*arrays_of(fewer))
    np.testing.assert_array_equal(told[-1].checked, expected.checked)
    np.testing.assert_array_equal(told[-1].agreeing, expected.agreeing)
    assert expected.checked.sum() < counted_at(*arrays_of(found)).checked.sum()


def test_observations_without_a_point_contradict_only_cameras_that_are_wrong(found):
    images, points = arrays_of(found)
    none = points.taken(np.zeros(len(points.images), dtype=bool))
    bare = judge(images, none)
    assert bare.observations == 0.0
    assert bare.contradicting < 0.05

    frames = images.frames
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.1 * (k % 3)] for k in frames.ids.tolist()]).as_matrix()
    assert judge(images.posed(turns @ frames.rotations, frames.centers), none).contradicting > 0.5


def counts_of(checked, agreeing):
    none = np.zeros(8, dtype=int)
    return ObservationCounts(checked=np.array(checked), agreeing=np.array(agreeing), contradicting=none)


def test_a_camera_whose_matches_make_no_points_goes_and_others_stay(found):
    images, _ = arrays_of(found)
    # Of 100 that could, 4 is chance and 5 is not; of 29, none says nothing.
    counts = counts_of([100, 100, 29, *[100] * 5], [4, 5, 0, *[90] * 5])
    assert images_without_support(counts, images, np.zeros(8, dtype=bool)).tolist() == [True] + [False] * 7


def test_frames_that_are_fixed_stay_and_so_do_all_where_hardly_any_is_left(found):
    images, none = arrays_of(found)[0], np.zeros(8, dtype=bool)
    fixed = np.arange(8) == images.frame_of[0]
    assert not images_without_support(counts_of([100] * 8, [0, *[90] * 7]), images, fixed).any()
    assert not images_without_support(counts_of([100] * 8, [0] * 6 + [90] * 2), images, none).any()


def test_images_of_few_points_take_theirs_along_and_three_frames_stay(found):
    images, points = arrays_of(found)
    seen, none = points.count_seen(8), np.zeros(8, dtype=bool)
    assert (images_of_few_points(points, images, np.full(8, int(seen.min())), none) == -1).all()
    poorest = int(np.argmin(seen))
    fixed = np.arange(8) == images.frame_of[poorest]
    gone = images_of_few_points(points, images, np.full(8, int(seen.min()) + 1), none)
    assert gone[poorest] == seen.min()
    assert images_of_few_points(points, images, np.full(8, int(seen.min()) + 1), fixed)[poorest] == -1
    assert np.sum(images_of_few_points(points, images, np.full(8, 10**6), none) == -1) == 8
    without = points.taken(points.paired((gone < 0)[points.images]))
    assert (without.lengths() >= 2).all()
    assert not without.count_seen(8)[gone >= 0].any()


def test_it_is_named_and_can_be_kept(monkeypatch):
    class Misled(PartnerCounts):
        def compare(self, points):
            counts = super().compare(points)
            counts.agreeing[2] = 0
            return counts

    monkeypatch.setattr(seed, "PartnerCounts", Misled)
    found = sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db")
    name = found.images.names[2]
    row = next(row for row in found.cameras if row.name == name)
    assert not row.placed
    assert "hardly any of its matches makes a point" in row.reason
    assert found.verdict.grade is Grade.LOOK
    assert name in found.verdict.cameras
    assert any(name in warning and "min_trust=0" in warning for warning in found.warnings)
    assert name in found.summary()["few_points"]

    kept = sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db", min_trust=0.0)
    assert all(row.placed for row in kept.cameras)
    assert [row.name for row in kept.cameras if row.reason] == [name]
    assert name in kept.verdict.cameras
    assert any(name in warning and "kept, as min_trust=0 asks" in warning for warning in kept.warnings)
