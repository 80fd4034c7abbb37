"""Each stage of the pipeline alone: from the ring as it stands, or a little off, not from other stages."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit import LocateOptions
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import (
    angle_between_deg,
    fit_similarity,
    mean_rotation_l1,
    normalized,
    rotation_angles_deg,
    turned_deg,
)
from sfm_shapefit.facts.command_options import pull_of_rotations
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.judgement.measured_pairs import MeasuredPairs
from sfm_shapefit.judgement.reasons import Grade, Kind
from sfm_shapefit.judgement.turns import Doubt
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline.camera_adjustment import adjust_placed
from sfm_shapefit.pipeline.doubts import doubt_cameras
from sfm_shapefit.pipeline.finish import finish_model
from sfm_shapefit.pipeline.measure import MeasureRequest, add_evidence, build_graph, measure
from sfm_shapefit.pipeline.model_joins import judge_joins, merge_groups
from sfm_shapefit.pipeline.pieces import ModelPiece, tie_pieces
from sfm_shapefit.pipeline.placing import place_cameras
from sfm_shapefit.pipeline.seed import seed_points, select_trusted
from sfm_shapefit.pipeline.stages import (
    adjust_cameras,
    examine_model,
    judge_piece,
    measure_directions,
    place_rigid_pieces,
    seed_model,
    set_gauge,
)
from sfm_shapefit.pipeline.starts import begin_model
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.fixed_and_rigged import find_fixed_and_rigged
from sfm_shapefit.placement.gauge_rule import GaugeRule
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.tracks.structure_options import NodeOptions
from tests.models import centers_of, only, posed
from tests.pipeline.made import DATABASE, FOLDER, delivered, directions_of, opened, placement_at, state_at
from tests.problems import all_pairs, exact_graph, made_priors, made_rotations, turn
from tests.scenes import view_of

MODEL = read_model(FOLDER)
TRUTH = MODEL.images
TURN = turn([0.3, -0.2, 0.1], 30.0)


def relative_rotations(model, turned=()):
    """The rotations between all cameras of a model; those of some are turned by 10 degrees."""
    rotations = model.rotations.copy()
    rotations[list(turned)] = turn([0.0, 0.6, 0.8], 10.0) @ rotations[list(turned)]
    pairs = np.array(all_pairs(model.num_images))
    i, j = pairs.T
    return made_rotations(pairs, rotations[j] @ rotations[i].transpose(0, 2, 1))


def test_measure_tells_directions_tracks_and_errors_of_one_pass_and_makes_a_graph_of_them():
    with opened() as source:
        found = measure(source, DirectionOptions(), Clock(), MeasureRequest(tracks="always", errors=True))
        bare = measure(source, DirectionOptions(), Clock())
    i, j = found.directions.pairs[found.directions.usable()].T
    true = normalized(TRUTH.centers[i] - TRUTH.centers[j])
    usable = found.directions.directions[found.directions.usable()]
    assert angle_between_deg(usable, true).max() < 1e-3  # keypoints are stored as float32
    np.testing.assert_array_equal(bare.directions.directions, found.directions.directions)
    assert (bare.tracks, bare.errors) == (None, None)
    graph = add_evidence(build_graph(TRUTH, found, NodeOptions()), found)
    assert graph.num_cameras == 8 < graph.graph.num_nodes
    assert graph.graph.names[:8] == TRUTH.names
    np.testing.assert_array_equal(graph.graph.edges[: len(i)], np.stack([i, j], axis=1))
    assert len(graph.evidence.errors) == graph.graph.num_edges
    share = 1 + np.arange(len(bare.directions.pairs)) % 2  # every other pair loses half of its inliers
    uneven = replace(bare.directions, num_inliers=bare.directions.num_inliers // share)
    weights = build_graph(TRUTH, replace(bare, directions=uneven), NodeOptions()).graph.weights
    assert np.ptp(weights) > 0.1
    np.testing.assert_array_equal(weights, uneven.weights()[uneven.usable()])


def test_many_cameras_that_pairs_of_many_directions_hold_need_no_points(monkeypatch):
    with opened() as source:
        found = measure(source, DirectionOptions(), Clock(), MeasureRequest(tracks="always"))
    parallel = np.where(np.isfinite(found.directions.directions), [1.0, 0.0, 0.0], np.nan)
    flat = replace(found, directions=replace(found.directions, directions=parallel))
    degree = int(build_graph(TRUTH, found, NodeOptions(points="never")).graph.degrees().min())

    def has_points(told, points="auto"):
        return build_graph(TRUTH, told, NodeOptions(points=points)).num_points > 0

    assert has_points(found)  # few
    monkeypatch.setattr("sfm_shapefit.pipeline.measure._MANY_CAMERAS", 8)
    monkeypatch.setattr("sfm_shapefit.pipeline.measure._MANY_PAIRS", 2)
    assert [has_points(found), has_points(found, "always"), has_points(flat)] == [False, True, True]
    with opened() as source:
        assert measure(source, DirectionOptions(), Clock(), MeasureRequest(tracks="auto")).tracks is None
        monkeypatch.setattr("sfm_shapefit.pipeline.measure._MANY_PAIRS", degree + 6)
        again = measure(source, DirectionOptions(), Clock(), MeasureRequest(tracks="auto", checked=True))
    assert has_points(found)
    assert again.checks
    own, usual = again.tracks.tracks(), found.tracks.tracks()  # joined after all directions were known
    assert usual.num_tracks > 10
    np.testing.assert_array_equal(own.rays, usual.rays)
    np.testing.assert_array_equal(own.offsets, usual.offsets)


@pytest.mark.parametrize(
    ("known", "off_deg"),
    [({}, 0.1), ({"is_component": True}, 0.1), ({"rough_rad": np.radians(2.0)}, 2.0)],
    ids=["given", "averaged", "rough"],
)
def test_begin_takes_rotations_as_they_are_or_makes_averaged_and_rough_ones_finer(known, off_deg):
    rng = np.random.default_rng(0)
    errors = Rotation.from_rotvec(np.radians(off_deg) * rng.standard_normal((8, 3))).as_matrix()
    turns = dict(zip(TRUTH.names, errors, strict=True))
    off = posed(FOLDER, lambda name, rotation, center: (turns[name] @ rotation, center))
    with opened(off) as source:
        priors = made_priors(TRUTH.centers)
        inputs = replace(state_at(source, TRUTH.centers, priors=priors, pull_rad=np.inf).inputs, **known)
        state = begin_model(inputs, source, Clock())
    assert state.inputs is inputs  # positions are known again after a first placement
    assert state.warnings == ()
    turned = TRUTH.rotations.transpose(0, 2, 1) @ state.source.images.rotations
    left_deg = rotation_angles_deg(turned @ mean_rotation_l1(turned).T)
    if not known:
        assert (state.first, state.near) == (None, None)
        assert left_deg.max() > 0.1
        return
    assert left_deg.max() < 1e-4  # keypoints are stored as float32
    placed = fit_similarity(state.near.locations, TRUTH.centers).apply(state.near.locations)
    assert np.abs(placed - TRUTH.centers).max() < 1e-6 * np.ptp(TRUTH.centers)


def test_a_state_says_who_is_fixed_and_whose_matches_are_read():
    with opened() as source:
        state, fixed = state_at(source, 0.1 * TRUTH.centers), np.arange(8) < 2
        held = ModelState.of(replace(state.inputs, fixed=fixed), source)
    assert (state.source.fixed, state.among) == (None, None)
    np.testing.assert_array_equal(held.source.fixed, fixed)
    second = replace(state.placement, pieces=2 * state.placement.pieces, piece=1)
    np.testing.assert_array_equal(replace(state, placement=second).among, np.arange(8))
    assert state.given_poses(np.arange(8)).rotations is None
    adjusted = replace(state, adjustment=SimpleNamespace()).given_poses(np.arange(2, 5))
    np.testing.assert_array_equal(adjusted.rotations, state.inputs.images.rotations[2:5])
    first, last = SimpleNamespace(), SimpleNamespace()
    assert replace(state, first=first).estimate is first
    assert replace(state, first=first, adjustment=last).estimate is last
    assert replace(state, first=first, adjustment=first, bundle=last).estimate is last


def test_measured_directions_are_those_of_the_true_cameras():
    with opened() as source:
        state = measure_directions(state_at(source, TRUTH.centers), Clock())
    i, j = state.directions.pairs[state.directions.usable()].T
    found = state.directions.directions[state.directions.usable()]
    assert angle_between_deg(found, normalized(TRUTH.centers[i] - TRUTH.centers[j])).max() < 1e-3
    assert state.measured.tracks is not None


def test_a_further_piece_begins_without_what_is_known_of_positions():
    edges = [*all_pairs(4), *all_pairs((3, 4, 5, 6, 7))]
    with opened() as source:
        told = {"scale": "input", "priors": made_priors(TRUTH.centers)}
        known = replace(state_at(source, TRUTH.centers, **told).inputs, fixed=np.arange(8) == 4)
        measured = MeasuredPairs(directions=directions_of(TRUTH, edges))
        state = replace(ModelState.of(known, source), measured=measured)
        first, second = place_rigid_pieces(state, Clock())
    assert [one.placement.cameras.tolist() for one in (first, second)] == [[3, 4, 5, 6, 7], [0, 1, 2, 3]]
    assert first.inputs is known
    assert (second.inputs.known.priors, second.inputs.scale) == (None, "unit")
    assert not second.inputs.fixed.any()
    for one in (first, second):
        true = TRUTH.centers[one.placement.cameras]
        found = one.frame.apply(one.placement.locations)
        np.testing.assert_allclose(fit_similarity(found, true, rotate=False).apply(found), true, atol=1e-7)


def test_adjust_leaves_what_a_first_placement_adjusted_and_says_why_a_step_is_left_out():
    with opened() as source:
        state = state_at(source, TRUTH.centers)
        done = replace(state, first=SimpleNamespace())
        assert adjust_cameras(done, Clock()) is done
        fixed = np.ones(8, np.bool_)  # no point is seen by a camera that moves
        still = replace(state, source=replace(source, fixed=fixed), inputs=replace(state.inputs, fixed=fixed))
        lost = adjust_cameras(still, Clock())
    (said,) = lost.warnings
    assert said.startswith("its cameras are not adjusted to the pixels")
    assert lost.adjustment is None
    assert [one.kind for one in lost.reasons] == [Kind.FAILED]


def test_a_camera_of_few_points_is_left_out_unless_the_pixels_confirm_it():
    with opened() as source:
        state = state_at(source, 0.1 * TRUTH.centers)
        state = replace(
            state, placement=judge(state.placement, PlacementOptions()), kept=np.ones(8, np.bool_)
        )
        counts = seed_points(state, Clock()).points.count_seen(8)
        options = LocateOptions(min_points_per_image=int(counts.min()) + 1)
        state = replace(state, inputs=replace(state.inputs, options=options))
        once, confirmed = seed_points(state, Clock()), seed_model(state, Clock())
    assert np.flatnonzero(~once.images.is_posed).tolist() == [counts.argmin()]
    np.testing.assert_array_equal(confirmed.points.count_seen(8), counts)
    assert confirmed.kept.all()


def test_examine_finds_nothing_against_the_truth_and_a_camera_that_pairs_put_elsewhere():
    with opened() as source:
        state = delivered(source)
        right = examine_model(state, Clock()).evidence
        away = TRUTH.centers.copy()
        away[2] += 0.3 * (TRUTH.centers[6] - TRUTH.centers[2])
        placement = judge(move_cameras(state.placement, 0.1 * away), PlacementOptions())
        moved = replace(state, images=TRUTH.placed(np.arange(8), away), placement=placement)
        wrong = examine_model(moved, Clock()).evidence
    assert (right.places, right.contradicted, right.seams) == ((), (), ())
    assert {*(one.image for one in wrong.places), *wrong.contradicted} == {TRUTH.names[2]}


def test_finish_tells_the_state_and_puts_what_speaks_against_the_model_first():
    with opened() as source:
        state = set_gauge(delivered(source)).failed("a step is left out")
        found = finish_model(replace(state, support=state.support._replace(num_seen=np.full(8, -1))), Clock())
    np.testing.assert_allclose(found.placed.centers, TRUTH.centers, atol=1e-9)
    assert found.model.num_points3D() == state.points.num_points
    assert found.warnings[-1] == "a step is left out"
    assert found.verdict.grade is Grade.LOOK
    assert found.gauge.scale == "input"


def test_place_yields_the_rigid_pieces_the_largest_first():
    edges = [*all_pairs(4), *all_pairs((3, 4, 5, 6, 7))]
    measured = MeasuredGraph(exact_graph(TRUTH.centers, edges))
    pieces = list(place_cameras(measured, PlacementOptions(), NodeOptions(), Clock()))
    assert [piece.cameras.tolist() for piece in pieces] == [[3, 4, 5, 6, 7], [0, 1, 2, 3]]
    for number, piece in enumerate(pieces):
        assert piece.piece == number
        true = TRUTH.centers[piece.cameras]
        fit = fit_similarity(piece.locations, true, rotate=False)
        np.testing.assert_allclose(fit.apply(piece.locations), true, atol=1e-7)
    loose = MeasuredGraph(exact_graph(TRUTH.centers[:4], [(0, 1), (1, 2), (2, 3)]))
    with pytest.raises(UnsolvableError, match="no three cameras"):
        next(place_cameras(loose, PlacementOptions(), NodeOptions(), Clock()))


@pytest.mark.parametrize("pull_rad", [0.0, np.inf])
def test_adjust_moves_cameras_and_free_rotations_to_where_the_pixels_are_and_measures_there_again(pull_rad):
    rng = np.random.default_rng(0)
    off = posed(
        FOLDER,
        lambda _name, rotation, center: (
            Rotation.from_rotvec(min(pull_rad, 5e-4) * rng.standard_normal(3)).as_matrix() @ rotation,
            center,
        ),
    )
    with opened(off) as source:
        away = TRUTH.centers + 0.004 * rng.standard_normal((8, 3))
        state = state_at(source, 0.1 * away, all_pairs=False, pull_rad=pull_rad)
        after = adjust_placed(state, Clock())
    found = state.frame.similarity.apply(after.placement.locations)
    fit = fit_similarity(found, TRUTH.centers, rotate=pull_rad > 0.0)
    np.testing.assert_allclose(fit.apply(found), TRUTH.centers, atol=1e-4)
    assert after.adjustment.freedom.holds_rotations == (pull_rad == 0.0)
    if pull_rad == 0.0:
        assert after.source is state.source
        assert after.directions is state.directions
        np.testing.assert_array_equal(
            after.adjustment.images.frames.rotations, source.images.frames.rotations
        )
        return
    rotations = after.source.images.rotations @ fit.rotation.T
    assert rotation_angles_deg(rotations @ TRUTH.rotations.transpose(0, 2, 1)).max() < 1e-3
    i, j = after.directions.pairs.T
    true = normalized(TRUTH.centers[i] - TRUTH.centers[j]) @ fit.rotation
    off_deg = [angle_between_deg(one.directions, true) for one in (state.directions, after.directions)]
    assert np.median(off_deg[0]) > 0.01
    assert off_deg[1].max() < 1e-3


def test_adjust_turns_cameras_as_far_as_was_asked():
    rng, found = np.random.default_rng(0), {}
    errors = Rotation.from_rotvec(np.radians(0.03) * rng.standard_normal((8, 3))).as_matrix()
    turns = dict(zip(TRUTH.names, errors, strict=True))
    off = posed(FOLDER, lambda name, rotation, center: (turns[name] @ rotation, center))
    with opened(off) as source:
        for rotations in ("held", 1e-4, 0.03, "free"):
            pull_rad = pull_of_rotations(rotations)
            state = state_at(source, 0.1 * TRUTH.centers, all_pairs=False, pull_rad=pull_rad)
            after = adjust_placed(state, Clock())
            turned = turned_deg(source.images.rotations, after.source.images.rotations)
            found[rotations] = after.adjustment.statement, np.median(turned)
            assert after.adjustment.errors is None  # how far they are off is no question
    assert found["held"][1] == 0.0
    assert 0.0 < found[1e-4][1] < 1e-4
    assert 0.01 < found[0.03][1] < found["free"][1]
    assert "weighted by 0.03 deg, as asked" in found[0.03][0]
    assert "rotations free, as asked" in found["free"][0]


def test_judge_names_the_pairs_that_contradict_and_who_is_turned_by_what_its_pairs_say():
    graph = exact_graph(TRUTH.centers)
    wrong = graph.directions.copy()
    wrong[5] = normalized(np.cross(wrong[5], wrong[6]))
    placement = judge(placement_at(TRUTH.centers), PlacementOptions())
    assert placement.assessment.inliers.all()
    assert select_trusted(placement, 0.9).all()
    measured = MeasuredGraph(ViewGraph(8, graph.edges, wrong))
    (bent,) = place_cameras(measured, PlacementOptions(), NodeOptions(), Clock())
    assert np.flatnonzero(~judge(bent, PlacementOptions()).assessment.inliers).tolist() == [5]
    directions = directions_of(TRUTH)
    directions = replace(directions, parallax_deg=np.full(len(directions.pairs), 60.0))  # no turn is as large
    for turned in ([], [3]):
        judged = doubt_cameras(placement, directions, relative_rotations(TRUTH, turned), TRUTH)
        kinds = judged.assessment.doubts.kinds
        assert [k for k, kind in enumerate(kinds) if kind is Doubt.TURNED] == turned
        assert np.flatnonzero(~select_trusted(judged, 0.5)).tolist() == turned
    assert doubt_cameras(placement, directions, None, TRUTH).assessment.doubts is None


def test_judge_takes_errors_from_a_first_placement_in_the_scale_of_the_cameras_that_had_places_then():
    """The places of one camera are not known; with it all errors would be those of the pairs' noise."""
    before = 4.0 * TRUTH.centers
    before[5] = np.nan
    with opened() as source:
        state = state_at(source, 0.1 * TRUTH.centers, pull_rad=0.0)
        rows = np.flatnonzero(np.arange(8) != 5)
        known = np.tile(np.diag([1.0, 4.0, 9.0]), (7, 1, 1))
        first = SimpleNamespace(
            images=TRUTH.part(rows), covariances=known, lens_errors=None, scale_sigma=None
        )
        after = judge_piece(
            replace(state, near=replace(state.placement.refined, locations=before), first=first), Clock()
        )
        bare = judge_piece(state, Clock())
    np.testing.assert_allclose(after.judged.adjusted_covariances[rows], known / 40.0**2, rtol=1e-9)
    assert np.isnan(after.judged.adjusted_covariances[5]).all()
    assert bare.judged.adjusted_covariances is None
    assert after.kept.all()


def test_seed_has_the_points_that_kept_cameras_see_and_leaves_the_others_unregistered():
    kept = np.arange(8) != 2
    with opened() as source:
        state = state_at(source, 0.1 * TRUTH.centers)
        every = seed_points(state, Clock())
        some = seed_points(replace(state, kept=kept), Clock())
    np.testing.assert_allclose(every.images.centers, TRUTH.centers, atol=1e-9)
    assert every.bundle is None
    assert (every.support.num_seen == -1).all()
    assert every.points.errors_px.max() < 1e-2  # keypoints are stored as float32
    assert every.points.num_points > some.points.num_points > 200
    np.testing.assert_array_equal(some.images.is_posed, kept)
    assert set(some.points.images) == set(np.flatnonzero(kept))


PAIR = (TRUTH.names[0], TRUTH.names[2])
APART = float(np.linalg.norm(TRUTH.centers[0] - TRUTH.centers[2]))
DISTANCE = {"distances": ((*PAIR, 1.5 * APART),)}
PRIORS = {"priors": made_priors(2.0 * TRUTH.centers)}
OFF = 0.01 * np.random.default_rng(1).standard_normal(TRUTH.centers.shape)
TURNED_PRIORS = {"priors": made_priors(2.0 * (TRUTH.centers + OFF) @ TURN.T + 100.0)}


@pytest.mark.parametrize(
    ("fixed", "told", "scale", "checks"),
    [
        (5, DISTANCE | PRIORS, "fixed", ["known distances 50 %", "position priors 100 %"]),
        (0, DISTANCE | PRIORS, "distance", ["position priors 33.3 %"]),
        (0, DISTANCE | {"scale": "input"}, "distance", []),
        (0, PRIORS | {"scale": "unit"}, "prior", []),
        (1, PRIORS, "input", ["position priors 100 %"]),
        (1, DISTANCE, "distance", []),
        (0, {"scale": "unit"}, "unit", []),
        (0, {}, "input", []),
    ],
)
def test_gauge_the_first_by_precedence_sets_the_scale_and_the_others_check_it(fixed, told, scale, checks):
    locations, rigid = 0.1 * TRUTH.centers, find_fixed_and_rigged(TRUTH, np.arange(8) < fixed)
    rule = GaugeRule(TRUTH, rigid, **{"scale": "auto", **told})
    chosen = rule.choose(np.arange(8), locations, 0.1 if fixed > 1 else None)
    assert chosen.scale == scale
    found = chosen.apply(locations)
    size = {"distance": 1.5, "prior": 2.0, "unit": None}.get(scale, 1.0)
    if size is None:
        assert np.median(np.linalg.norm(found, axis=1)) == pytest.approx(1.0)
    else:
        assert np.linalg.norm(found[0] - found[2]) == pytest.approx(size * APART, rel=1e-6)
    if fixed:
        np.testing.assert_allclose(found[0], TRUTH.centers[0], atol=1e-9)
    said = list(rule.check(chosen, np.arange(8), found))
    if fixed and "priors" in told:
        assert "no part in origin and axes" in said.pop()
    words = [f"{one.split(' were')[0]} {one.split('differ by ')[1]}" for one in said]
    assert words == checks


@pytest.mark.parametrize("adjust", ["seed", "full"])
@pytest.mark.parametrize(
    "told", [{}, {"scale": "unit"}, DISTANCE, TURNED_PRIORS], ids=["input", "unit", "distance", "priors"]
)
def test_seed_has_the_scale_the_origin_and_the_axes_that_are_told_also_where_all_was_adjusted(told, adjust):
    """The input has its cameras off by a tenth of the ring's radius, in another unit."""
    rng = np.random.default_rng(0)
    given = posed(
        FOLDER, lambda _name, turn, center: (turn, 3.0 * (center + 0.5 * rng.standard_normal(3)) + 5.0)
    )
    with opened(given) as source:
        state = state_at(source, 0.1 * TRUTH.centers, options=LocateOptions(adjust=adjust), **told)
        placement = judge(state.placement, PlacementOptions())
        state = replace(state, placement=placement, kept=np.ones(8, np.bool_))
        found = set_gauge(seed_model(state, Clock()))
    assert (found.bundle is not None) == (adjust == "full")
    assert (found.judged.adjusted_covariances is not None) == (adjust == "full")
    centers = found.images.centers
    again = state.gauge_rule.choose(np.arange(8), centers, None)  # what is told holds already
    assert again.scale == found.gauge.scale
    axes = np.eye(3) if found.gauge.axes is None else found.gauge.axes
    exact = 1e-4 if told is TURNED_PRIORS else 1e-9  # a robust fit is no fixed point after twenty rounds
    assert again.similarity.scale == pytest.approx(1.0, abs=exact)
    np.testing.assert_allclose(again.apply(centers), centers, atol=exact * np.ptp(centers))
    np.testing.assert_allclose(axes, TURN if told is TURNED_PRIORS else np.eye(3), atol=0.02)
    turned = TRUTH.rotations.transpose(0, 2, 1) @ found.images.rotations @ axes
    np.testing.assert_allclose(mean_rotation_l1(turned), np.eye(3), atol=1e-9)
    near = found.gauge.apply(state.placement.locations)
    assert np.abs(near - centers).max() < 0.01 * np.ptp(centers)


@pytest.fixture(scope="module")
def models():
    """The ring as two models of four cameras each, the second one in another world."""
    ids, halves = TRUTH.ids.tolist(), []
    for chosen in (ids[:4], ids[4:]):
        half = only(MODEL.reconstruction, chosen)
        if halves:
            half.transform(pycolmap.Sim3d(0.5, pycolmap.Rotation3d(TURN), np.ones(3)))
        halves.append(ModelPiece(label=f"model {len(halves)}", model=read_model(half)))
    return halves


@pytest.mark.parametrize("by", ["matches", "priors"])
def test_join_brings_models_into_the_world_of_the_first(models, by):
    priors = (
        []
        if by == "matches"
        else [made_priors(7.0 * TRUTH.centers[half]) for half in (slice(4), slice(4, 8))]
    )
    with view_of(DATABASE, TRUTH) as view:
        tied = tie_pieces(models, view.matches if by == "matches" else None, frozenset())
    (told,) = judge_joins(models, tied, priors)
    (group,) = merge_groups(models, tied, [told])
    assert ("position priors" in told.statement) == (by == "priors")
    assert list(group.world_from) == [0, 1]
    np.testing.assert_allclose(centers_of(group.reconstruction), TRUTH.centers, atol=2e-3)
