"""What of the observations agrees with the cameras, what contradicts them, and what merely sees no point."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit import LocateOptions
from sfm_shapefit.adjustment.sources import collect_matches
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.row_file import RowFile
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import ModelKeypoints, points_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.judgement.support import (
    ObservationCounts,
    PartnerCounts,
    images_of_few_points,
    images_without_support,
)
from sfm_shapefit.pipeline.finish import finish_model
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
from sfm_shapefit.pipeline.seed import seed_points
from sfm_shapefit.pipeline.stages import set_gauge
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.scene.matches import is_among
from sfm_shapefit.tracks.links import MatchedKeypoints
from tests.judgement.test_lenses import NO_POINTS
from tests.models import arrays, posed
from tests.pipeline.made import FOLDER, opened, state_at
from tests.problems import turn
from tests.scenes import RING

NO_PAIRS = np.zeros((0, 2), dtype=np.int64)


@pytest.fixture
def found(ring_located):
    return ring_located


def counted_at(images, points, apart=NO_PAIRS, make_rows=np.empty):
    model, options = read_model(RING / "sparse" / "0"), LocateOptions()
    inputs = choose_inputs(RING / "sparse" / "0", RING / "database.db", "auto")
    with open_source(model, inputs) as source:
        view, every, poses = source.view, np.arange(images.num_images), views_of(images).poses(images)
        counted = PartnerCounts(images, view.num_keypoints, options.structure.max_reprojection_error_px)
        is_apart = is_among(view.pairs, apart)
        for batches in (view.links(chosen=is_apart), view.links(chosen=~is_apart)):
            pictures = ModelKeypoints(images, view.keypoints)
            room = make_rows((view.num_matches, 2), dtype=np.uint32)
            counted.add(collect_matches(images, pictures, every, batches, room, 2), poses)
    return counted.compare(points)


def shares_at(images, points, apart=NO_PAIRS, make_rows=np.empty):
    return counted_at(images, points, apart, make_rows).shares(images.is_posed)


def arrays_of(found):
    model = arrays(found.reconstruction)
    images = images_of(model)
    return images, points_of(model, images)


def test_observations_of_right_cameras_agree(found):
    shares = shares_at(*arrays_of(found))
    assert shares == found.support.observations
    assert shares.observations > 0.9
    assert shares.contradicting < 0.01
    assert shares_at(*arrays_of(found), np.array([[1, 0], [2, 3]]), RowFile) == shares  # matches in a file


def judged_at(source, **options):
    """The ring at its true places, all of it kept, before it has points."""
    state = state_at(source, 0.1 * source.images.centers, options=LocateOptions(**options))
    return replace(state, placement=judge(state.placement, PlacementOptions()), kept=np.ones(8, dtype=bool))


def with_a_turned_camera():
    """The ring with its third camera turned by five degrees."""
    third = read_model(FOLDER).images.names[2]
    return posed(FOLDER, lambda name, r, c: (turn([0.0, 1.0, 0.0], 5.0 * (name == third)) @ r, c))


def test_partners_that_leave_are_not_counted():
    with opened(with_a_turned_camera()) as source:
        found = seed_points(judged_at(source, min_points_per_image=1), Clock())
    assert np.flatnonzero(~found.images.is_posed).tolist() == [2]
    assert not found.support.unsupported.any()  # it went for its lack of points
    assert found.support.observations == counted_at(found.images, found.points).shares(found.images.is_posed)


def test_observations_without_a_point_contradict_only_cameras_that_are_wrong(found):
    images, points = arrays_of(found)
    none = points.taken(np.zeros(len(points.images), dtype=bool))
    bare = shares_at(images, none)
    assert bare.observations == 0.0
    assert bare.contradicting < 0.05

    frames = images.frames
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.1 * (k % 3)] for k in frames.ids.tolist()]).as_matrix()
    assert shares_at(images.posed(turns @ frames.rotations, frames.centers), none).contradicting > 0.5


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


@pytest.mark.parametrize("min_trust", [0.5, 0.0])
def test_it_is_named_and_can_be_kept(min_trust):
    """A camera that is turned by five degrees, and trusted all the same."""
    name = read_model(FOLDER).images.names[2]
    with opened(with_a_turned_camera()) as source:
        state = replace(judged_at(source, min_trust=min_trust), evidence=ModelEvidence())
        found = finish_model(set_gauge(seed_points(state, Clock())), Clock())
    assert found.seed.images.is_posed[2] == (min_trust == 0.0)
    assert "hardly any of its matches makes a point" in found.cameras[2].reason
    assert name in found.verdict.cameras
    said = [warning for warning in found.warnings if name in warning]
    assert any("kept, as min_trust=0 asks" in one for one in said) == (min_trust == 0.0)


def test_what_agrees_is_counted_among_the_cameras_that_stay():
    """Cameras that are left out for their few points were partners of the others' keypoints until then."""
    with opened() as source:
        state = judged_at(source)
        seen = np.sort(seed_points(state, Clock()).points.count_seen(8))
        options = LocateOptions(min_points_per_image=int(seen[1]) + 1)
        found = seed_points(replace(state, inputs=replace(state.inputs, options=options)), Clock())
    assert 3 <= found.images.is_posed.sum() <= 6
    assert found.support.observations == shares_at(found.images, found.points)
    assert found.support.observations.observations > 0.99


def test_threads_that_share_very_many_matches_count_the_same():
    per_image, rng = 120_000, np.random.default_rng(0)
    images = read_model(RING / "sparse" / "0").images.part(np.arange(3))
    xyz = rng.normal(0.0, 0.3, (per_image, 3)) + images.centers.mean(axis=0)
    in_camera = np.einsum("iab,ixb->ixa", images.rotations, xyz - images.centers[:, None])
    is_wrong = np.arange(per_image) < 20_000
    in_camera[2, is_wrong, :2] += 0.5 * np.abs(in_camera[2, is_wrong, 2:])
    rows = np.arange(3 * per_image).reshape(3, per_image)
    pairs = np.concatenate([rows[[i, j]].T for i, j in ((0, 1), (0, 2), (1, 2), (1, 2))])
    matched = MatchedKeypoints(
        cameras=np.repeat(np.arange(3, dtype=np.int32), per_image),
        keypoints=np.tile(np.arange(per_image, dtype=np.int32), 3),
        pixels=np.zeros((3 * per_image, 2)),
        on_plane=(in_camera[..., :2] / in_camera[..., 2:]).reshape(-1, 2),
        matches=np.ascontiguousarray(pairs, dtype=np.uint32),
    )
    found = []
    for threads in (1, 3):
        counts = PartnerCounts(images, np.full(3, per_image), 4.0)
        counts.add(matched, views_of(images).poses(images), threads)
        told = counts.compare(NO_POINTS)
        found.append([told.checked.tolist(), told.contradicting.tolist()])
    assert found[0] == found[1]
    assert found[0][0] == [per_image] * 3
    assert 15_000 < found[0][1][2] <= 20_000
    assert max(found[0][1][:2]) == 0
