"""What is said of a view graph before anything is solved."""

import json

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit import UnsolvableError, synthetic
from sfm_shapefit.commands.place import place
from sfm_shapefit.files.graph_text import graph_text
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.placement.conditioning import direction_spread
from sfm_shapefit.placement.diagnosis import diagnose
from sfm_shapefit.refinement.placement_options import PlacementOptions
from tests.models import turned
from tests.problems import all_pairs, exact_graph, turn
from tests.program import run
from tests.scenes import COURTYARD, RING, copied, fingerprint

FAMILIES = {
    "random": lambda **how: synthetic.random_graph_problem(60, **how),
    "sparse": lambda **how: synthetic.random_graph_problem(100, 0.2, **how),
    "expander": lambda **how: synthetic.expander_graph_problem(150, 30, **how),
    "box": lambda **how: synthetic.box_graph_problem(150, **how),
    "trajectory": lambda **how: synthetic.trajectory_graph_problem(150, **how),
    "community": lambda **how: synthetic.community_graph_problem(200, **how),
}


def test_pieces_hinges_and_components_are_counted_and_named():
    t = np.random.default_rng(0).standard_normal((11, 3))
    edges = all_pairs(5) + all_pairs((4, 5, 6)) + [(0, 7)] + all_pairs((8, 9, 10))
    seen = diagnose(exact_graph(t, edges))
    assert seen.components == (8, 3)
    assert [(piece.num_cameras, piece.hinges) for piece in seen.pieces] == [(5, ("4",)), (3, ("4",)), (3, ())]
    assert seen.left_out["7"] == "pendant: joined by a single pair to camera 0"
    assert seen.left_out["8"] == "another component"
    assert set(seen.left_out) == {"5", "6", "7", "8", "9", "10"}
    assert seen.weak == ()


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_the_share_of_wrong_pairs_is_estimated_up_to_a_half(family, sigma):
    for q, off in ((0.0, 0.01), (0.2, 0.03), (0.4, 0.06), (0.5, 0.09)):  # the documented bounds
        problem = FAMILIES[family](sigma=sigma, q=q, seed=3)
        graph = problem.view_graph
        assert diagnose(graph).corruption.share == pytest.approx(problem.corrupted.mean(), abs=off)


def test_only_pairs_in_triangles_say_something_of_corruption():
    t = np.random.default_rng(1).standard_normal((6, 3))
    square = [(0, 1), (1, 2), (2, 3), (0, 3)]
    assert diagnose(exact_graph(t[:4], square)).corruption.share is None
    with_triangle = [*square, (3, 4), (3, 5), (4, 5)]
    corruption = diagnose(exact_graph(t, with_triangle)).corruption
    assert (corruption.num_checked, corruption.share) == (3, 0.0)


def test_a_camera_seen_in_one_direction_only_is_weak_and_named_so_a_wrong_pair_or_not():
    t = np.random.default_rng(2).standard_normal((10, 3))
    t[9] = [0.0, 0.0, 60.0]
    graph = exact_graph(t, all_pairs(10))
    (weak,) = diagnose(graph).weak
    assert (weak.name, weak.num_pairs) == ("9", 9)
    assert "nearly parallel" in weak.reasons[0]
    v = graph.directions.copy()
    v[(graph.edges == (0, 9)).all(axis=1)] = [1.0, 0.0, 0.0]
    assert [camera.name for camera in diagnose(ViewGraph(10, graph.edges, v)).weak] == ["9"]
    (weak,) = diagnose(exact_graph(t, [*all_pairs(9), (0, 9), (1, 9)])).weak
    assert [reason.split(":")[0] for reason in weak.reasons] == [
        "two pairs or fewer hold it",
        "the directions that hold it are nearly parallel",
    ]


def test_a_camera_of_contradicting_matches_is_weak():
    t = np.random.default_rng(3).standard_normal((8, 3))
    graph = exact_graph(t, [pair for pair in all_pairs(8) if pair not in {(0, 7), (1, 7), (2, 7), (3, 7)}])
    against = np.array([(0, 7), (1, 7), (2, 7), (3, 7)])
    evidence = Evidence(contradicting=against)
    assert diagnose(graph).weak == ()
    (weak,) = diagnose(MeasuredGraph(graph, evidence=evidence)).weak
    assert weak.name == "7"
    assert "matches of 4 further pairs contradict the rotations" in weak.reasons[0]


def test_rays_to_points_hold_a_camera_too():
    t = np.random.default_rng(4).standard_normal((9, 3))
    edges = all_pairs(5) + [(0, 5), (1, 5)] + [(k, p) for p in (6, 7, 8) for k in (0, 2, 3, 5)]
    seen = diagnose(MeasuredGraph(exact_graph(t, edges), num_points=3))
    assert (seen.num_cameras, seen.num_points, seen.num_pairs) == (6, 3, 12)
    assert seen.weak == ()
    assert [camera.name for camera in diagnose(exact_graph(t[:6], edges[:12])).weak] == ["5"]


def test_the_spread_of_directions_is_zero_when_parallel_and_one_when_even():
    v = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    ends = np.array([(0, 1), (0, 1), (2, 3), (2, 3), (2, 3)])
    np.testing.assert_allclose(direction_spread(5, ends, v), [0.0, 0.0, 1.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("method", ["auto", "admm"])
def test_the_plan_is_what_a_placement_does_and_says_what_becomes_of_the_starts(method):
    problem = synthetic.random_graph_problem(30, seed=5, sigma=0.01)
    graph = problem.view_graph
    options = PlacementOptions(solver=method, tol=1e-4)
    plan, done = diagnose(graph, options).plan, place(graph, options)
    assert plan.solver == done.certified.method
    assert done.certified.method_reason.startswith(plan.solver_reason)
    assert plan.second_start == (done.refined.finish.lud is not None)
    said = {
        "better is kept, refined": PlacementOptions(),
        "better is kept, unrefined": PlacementOptions(refine=False),
        "as it is, as asked": PlacementOptions(objective="shapefit"),
        "kept, as asked, refined": PlacementOptions(objective="lud"),
    }
    for words, asked in said.items():
        assert words in diagnose(graph, asked).plan.finish
    pair = exact_graph(problem.locations[:2], [(0, 1)])
    assert "no second start" in diagnose(pair).plan.finish


def test_inspect_says_what_locate_would_do_and_changes_nothing(tmp_path):
    scene = copied(COURTYARD, tmp_path)
    before = fingerprint(tmp_path)
    result = run("inspect", scene / "sparse" / "0")
    text = " ".join(result.stdout.replace("\N{BOX DRAWINGS LIGHT VERTICAL}", " ").split())
    assert result.exit_code == 0, result.output
    for words in (
        "found beside the model",
        "176: usable",
        "tracks join as nodes",
        "1 (of 25 cameras)",
        "newton:",
    ):
        assert words in text
    assert fingerprint(tmp_path) == before


def test_inspect_sees_as_many_wrong_pairs_as_locate_rejects():
    seen = sfm_shapefit.inspect(COURTYARD / "sparse" / "0").diagnosis
    assert seen.corruption.share == pytest.approx(44 / 176, abs=0.05)  # self-consistent in part: too low


def test_a_right_camera_before_a_repeated_facade_is_not_weak():
    """7 of the 10 pairs of 0007.jpg contradict their triangles, and its own relative rotations do not."""
    seen = sfm_shapefit.inspect(COURTYARD / "sparse" / "0", COURTYARD / "database.db")
    assert seen.diagnosis.weak == ()
    assert seen.diagnosis.corruption.share > 0.1


def test_a_turned_camera_is_named():
    model = turned(COURTYARD / "sparse" / "0", ["0010.jpg"], turn([0.0, 1.0, 0.0], 20.0))
    seen = sfm_shapefit.inspect(model, COURTYARD / "database.db")
    told = {camera.name for camera in seen.diagnosis.weak} | set(seen.diagnosis.left_out)
    assert told == {"0010.jpg"}


def test_json_has_the_same_content():
    names = ("--input_path", RING / "sparse" / "0", "--database_path", RING / "database.db")
    facts = json.loads(run("inspect", *names, "--json").stdout)
    assert facts["num_images"] == facts["diagnosis"]["num_cameras"] == 8
    assert facts["diagnosis"]["plan"]["solver"] == "newton"
    never = json.loads(run("inspect", *names, "--json", "--points", "never").stdout)
    assert never["points"] == "no, as asked"
    assert never["diagnosis"]["num_points"] == 0 < facts["diagnosis"]["num_points"]


def test_a_bare_graph_is_diagnosed_too_and_refused_if_it_cannot_be_placed(tmp_path):
    t, graph = np.random.default_rng(8).standard_normal((6, 3)), tmp_path / "graph.txt"
    graph.write_text(graph_text(exact_graph(t, [*all_pairs(5), (0, 5)])))
    result = run("inspect", graph, code=0)
    assert "5: pendant" in result.stdout
    run("inspect", graph, "--database", RING / "database.db", code=3)
    run("inspect", tmp_path / "nowhere", code=3)
    run("inspect", code=2)
    (tmp_path / "options.toml").write_text("min_inlier_ratio = 7")
    run("inspect", graph, "--config", tmp_path / "options.toml", code=2)
    graph.write_text(graph_text(exact_graph(t[:5], [(k, (k + 1) % 5) for k in range(5)])))
    result = run("inspect", graph, "--json", code=4)
    facts = json.loads(result.stdout)["diagnosis"]
    assert "tie no three cameras" in facts["obstacle"]
    assert facts["obstacle"] in result.stderr
    assert facts["plan"] is None
    assert len(facts["left_out"]) == 5


@pytest.mark.parametrize(
    ("num_against", "cure"), [(2, "match more pairs"), (3, "these are wrong, or of another scene")]
)
def test_few_directions_beside_many_contradicted_rotations_ask_for_the_scene(num_against, cure):
    t = np.random.default_rng(8).standard_normal((6, 3))
    against = np.array([(0, 2), (1, 3), (2, 4)])[:num_against]
    measured = MeasuredGraph(exact_graph(t, [(0, 1), (1, 2)]), evidence=Evidence(contradicting=against))
    assert cure in diagnose(measured).obstacle


def test_a_model_without_usable_directions_is_refused_as_by_locate():
    with pytest.raises(UnsolvableError, match="none of the"):
        sfm_shapefit.inspect(RING / "sparse" / "0", min_inliers=100_000)
