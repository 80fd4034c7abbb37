"""What the benchmarks measure and how they judge it, on figures that are known."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from benchmarks import coherent, endtoend, graphs, real, rigs, scale, solver, trust
from benchmarks import map as mapping
from harness.graphs import GraphSpec, draw, relative_error
from harness.process import Timed
from harness.record import verdict
from harness.scenes import rotation_errors_deg
from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_rig_drive
from sfm_shapefit.synthetic.workspace import write_workspace

CASTLE = real.SCENES["castle-P30"]


def missed(*rows):
    return [check.name for row in rows for check in row.checks if not check.met]


def errors(mean=0.03, missing=0):
    return real.Errors(median=0.018, mean=mean, max=0.08, num_missing=missing)


def test_the_section_of_real_scenes_puts_the_limits_beside_the_figures_and_counts_missing_cameras():
    row = real.judge(real.DELIVERED, CASTLE, errors(0.0205), CASTLE.limits, {"placed": "30 of 30"})
    text = real.BENCHMARK.section([row])
    assert "**2 of 2 limits met.**" in text
    cells = "| castle-P30 (m) | 0.0180 / 0.0205 / 0.0800 | 30 of 30 |"
    assert f"{cells} median up to 0.0184, mean up to 0.0208 | met |" in text
    row = real.judge(real.DELIVERED, CASTLE, errors(0.04, missing=2), CASTLE.limits, {})
    assert row["median / mean / max"] == "0.0180 / 0.0400 / 0.0800 (2 missing)"
    assert verdict(row.checks) == "**missed**: mean 0.0400 > 0.0208"


def test_the_better_setting_of_a_mapper_is_bold_and_a_further_scene_is_raced_against_it():
    def run(mapper, error, setting="chosen"):
        return mapping.Outcome(mapper, setting, 1.0, 1.0, {"a": error, "b": error})

    ours = [run(mapping.OURS[0], 1.0), run(mapping.OURS[1], 1.16)]
    peers = [run("global", 1.0, "15"), run("global", 2.0, "30"), run("incremental", 3.0, "15")]
    rows = mapping.judge("further: street", ours, peers)
    assert [row["mapper"] for row in rows[2:]] == ["**global**", "global", "**incremental**"]
    assert missed(*rows) == ["mean error / better peer"]
    rows = mapping.judge("fountain-P11", [run(name, 0.0022) for name in mapping.OURS], peers)
    assert missed(*rows) == ["median", "placed"] * 2


SMALL = GraphSpec(family="er2", n=14, sigma=0.02, q=0.1)


def test_a_rival_is_tightened_until_it_is_as_good_as_promised():
    problem = draw(SMALL)
    graph = problem.view_graph
    best = solver.solve_ours(graph, 1e-12)
    asked = []

    def sloppy(tol):
        asked.append(tol)
        return best.locations * [1.0, 1.0, 1.0 + 3e4 * tol], None, 1  # the excess goes with the square

    found = solver.tune("sloppy", sloppy, graph, problem.locations, best.dual_bound)
    assert found.excess <= solver.TOL
    assert len(asked) >= 2
    assert found.tolerance == min(asked)  # the loosest that suffices is the last that was tried


@pytest.mark.parametrize(
    ("sigma", "cvxpy_s", "direct_s", "gap", "met"),
    [
        (0.0, 0.055, 0.025, 1e-9, [True, True, True]),
        (0.0, 0.054, 0.024, 1e-9, [True, False, False]),
        (0.05, 0.035, 0.012, 1e-9, [True, True, True]),  # other limits with noise
        (0.05, 0.055, 0.025, 2e-8, [False, True, True]),  # fast, and not certified
    ],
)
def test_ratios_have_a_limit_per_size_and_noise(sigma, cvxpy_s, direct_s, gap, met):
    contenders = [
        solver.Contender(name, 1e-8, (Timed(None, seconds, seconds),), gap=gap)
        for name, seconds in (
            ("ours", 0.001),
            ("cvxpy", cvxpy_s * (1 + 1e-12)),
            ("direct", direct_s * (1 + 1e-12)),
        )
    ]
    spec = GraphSpec(family="er2", n=100, sigma=sigma, q=0.25)
    rows = solver.judge(spec, 9, contenders)
    assert [check.met for row in rows for check in row.checks] == met


def test_only_a_real_graph_of_cameras_alone_is_held_to_the_limit_of_time():
    assert missed(solver.judge_real({"points": 0}, 1e-9, 12, 50.0)) == ["ms"]
    assert missed(solver.judge_real({"points": 0}, 1e-9, 12, 30.0)) == []
    assert missed(solver.judge_real({"points": 250}, 1e-9, 12, 50.0)) == []


def test_close_is_where_the_objective_stays():
    assert scale.find_settled([3.0, 1.0, 2.0, 1.0, 1.0], 1.5) == 4
    assert scale.find_settled([1.0, 1.0], 1.5) == 1
    for objectives in ([1.0, 2.0], [1.0, math.nan], []):
        assert scale.find_settled(objectives, 1.5) is None


def test_the_limits_of_scale_are_judged_in_hindsight_and_only_with_a_certificate():
    spec = GraphSpec(family="geo", n=10_000, degree=40.0, sigma=0.01)
    problem = scale.Problem(spec, 1e-6, close_s=0.5, certified_s=3.0, memory_mb=900.0, gap=1e-6)
    took = {"pairs": 9, "total, s": 2.0, "CPU, s": 2.5, "peak": 500.0, "before": 300.0, "error": 1e-3}

    def judged(seconds, objectives, gap=1e-7, asked="auto"):
        solved = {"method": "admm", "method_reason": "", "status": "", "objective": 1.0, "gap": gap}
        trace = list(zip(objectives, seconds, strict=True))
        solved["equality_residual"] = 0.0
        return scale.judge(problem, asked, solved, trace, (1.0, 1.0 - 1e-6), took)

    good = judged([0.1, 0.4, 0.9], [2.0, 1.00005, 1.0])
    assert (good["iterations"], good["to 1e-4, s"]) == ("2 / 3", 0.4)
    assert good["certificate, s"] == pytest.approx(1.1)
    assert missed(good) == []
    late = judged([0.1, 0.4, 0.9], [2.0, 1.0002, 1.0], gap=2e-6)
    assert missed(late) == ["to 1e4 s", "certified s", "gap"]  # fast, and not certified
    assert judged([0.1], [1.0], asked="admm").checks == []


def test_rigid_pieces_and_single_pairs_are_told_apart(monkeypatch):
    edges = np.array([[0, 1], [0, 2], [1, 2], [2, 3], [3, 4], [3, 5], [4, 5]])  # two triangles and a bridge
    monkeypatch.setattr(scale, "call", lambda _function, _spec: edges)
    found = scale.search(GraphSpec(family="geo", n=6))
    assert (found["pairs"], found["pieces; single pairs"]) == (7, "2; 1")
    assert not found.checks  # there are limits for large graphs only
    assert not scale.search(GraphSpec(family="er", n=6)).checks


CHAIN = graphs.QUICK["seqv-60"]


def test_the_oracle_is_where_the_sum_of_squares_is_stationary_and_one_right_direction_does_not_stop_it():
    one = graphs.draw_graph(CHAIN, 0)
    t = graphs.oracle(one)
    right = one.right > 0.0
    edges, v = one.graph.edges[right], one.graph.directions[right]

    def cost(x):
        d = x[edges[:, 0]] - x[edges[:, 1]]
        return np.sum((d / np.linalg.norm(d, axis=1)[:, None] - v) ** 2)

    rng = np.random.default_rng(0)
    for _ in range(5):
        shift = 1e-4 * rng.standard_normal(t.shape)
        # At a minimum both ways lead up; elsewhere the linear part, of either sign, is the larger one.
        assert cost(t + shift) > cost(t) < cost(t - shift)
    assert relative_error(t, one.truth) > 1e-4  # and it has left the truth
    single = one.right.copy()
    single[np.flatnonzero((one.graph.edges == 7).any(axis=1))[1:]] = 0.0
    t = graphs.oracle(dataclasses.replace(one, right=single))
    np.testing.assert_array_equal(t[7], one.truth[7])


def trial(**changes):
    values = dict.fromkeys(("shapefit", "lud", "placed", "oracle"), 0.01)
    values |= {"over_oracle": 1.0, "mean_over_median": 1.2, "kept": 9, "seconds": 1.0}
    return graphs.Trial(**(values | changes))


def test_medians_are_checked_and_the_worst_mean_over_median():
    problem = dataclasses.replace(CHAIN, below_lud=True, seconds=2.0, error=0.05)

    def judged(*trials):
        return missed(graphs.judge("made", problem, trials))

    assert judged(trial(), trial(over_oracle=9.0, placed=9.0, seconds=9.0), trial()) == []
    assert judged(trial(), trial(mean_over_median=3.1), trial()) == ["mean / median"]
    worse = trial(placed=0.06, over_oracle=1.4, seconds=3.0)
    assert judged(worse, worse) == ["/ oracle", "error", "placed against LUD", "seconds"]


def test_a_broken_answer_without_a_warning_and_a_warning_without_a_cause_are_missed_limits():
    assert coherent.breaking_share({0.0: 0.01, 0.1: 0.3, 0.2: 0.1, 0.3: 0.5, 0.4: 1.0}) == 0.3
    assert coherent.breaking_share({0.0: 0.01, 0.5: coherent.BROKEN}) is None
    values = {"shapefit": 0.01, "lud": 0.01, "placed_false": 1.4, "contradicting": 0.0}
    right = coherent.Trial(placed=0.01, warned=True, **values)
    wrong = coherent.Trial(placed=1.0, warned=False, **values)
    clean = coherent.judge("small", 0.0, [right])
    corrupted = coherent.judge("small", 0.4, [wrong, right])
    assert verdict(clean.checks) == "**missed**: false alarms 1.00 > 0"
    assert verdict(corrupted.checks) == "**missed**: warned 0 < 1.00"
    assert "| small | never | never | 0.4 |" in coherent.BENCHMARK.section([clean, corrupted])


def test_the_area_under_the_curve_counts_pairs_in_order_and_ties_half():
    bad = np.array([True, False, False, True])
    assert trust.area_under_curve(np.array([0.1, 0.5, 0.9, 0.5]), bad) == pytest.approx(3.5 / 4)
    assert trust.area_under_curve(np.array([0.9, 0.5, 0.1, 0.95]), bad) == 0.0


def test_errors_are_taken_after_shift_and_scale_and_those_of_rotations_after_the_best_common_turn():
    rng = np.random.default_rng(0)
    truth, sigmas = rng.standard_normal((20, 3)), np.ones((20, 3))
    np.testing.assert_allclose(trust.error_ratios(3.0 * truth + 1.0, truth, sigmas), 0.0, atol=1e-12)
    sigmas[4] = np.inf
    moved = truth.copy()
    moved[4] += 100.0  # a camera that nothing holds neither counts nor disturbs the others
    np.testing.assert_allclose(trust.error_ratios(moved, truth, sigmas), 0.0, atol=1e-12)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    theirs = np.tile(np.eye(3), (5, 1, 1))
    ours = theirs @ turn
    ours[2] = np.diag([-1.0, -1.0, 1.0]) @ ours[2]
    model = SimpleNamespace(names=("a", "b", "c", "d", "e"), rotations=ours)
    reference = SimpleNamespace(names=("e", "d", "c", "b"), rotations=theirs[:4])
    errors = rotation_errors_deg(model, reference)
    np.testing.assert_allclose(errors, [np.nan, 0.0, 180.0, 0.0, 0.0], atol=1e-5)


def test_scale_and_errors_are_those_of_the_model(tmp_path):
    drive = make_rig_drive(SceneOptions(num_images=12, num_points=300, min_matches=8))
    write_workspace(drive, tmp_path / "w", WorkspaceOptions(model="rotations"))
    model = pycolmap.Reconstruction(tmp_path / "w" / "truth")
    exact = rigs.compare(drive, model, 1.0)
    assert exact.num_images == 12
    assert exact.scale_error == pytest.approx(0.0, abs=1e-12)
    assert exact.errors_m.max() < 1e-9
    turn = pycolmap.Rotation3d(np.array([0.0, 0.6, 0.0, 0.8]))
    model.transform(pycolmap.Sim3d(1.01, turn, np.array([5.0, -2.0, 1.0])))
    larger = rigs.compare(drive, model, 1.0)
    assert larger.scale_error == pytest.approx(0.01, rel=1e-6)
    size = np.linalg.norm(drive.centers - drive.centers.mean(axis=0), axis=1)
    np.testing.assert_allclose(larger.errors_m, 0.01 * size, rtol=1e-6)
    worse = larger._replace(num_images=11)
    names = ("placed", "scale", f"mean / {rigs.HELD}", f"mean / {rigs.FREE}")
    runs = {rigs.MAP: worse, rigs.MAP_ADJUSTED: exact, rigs.HELD: exact, rigs.FREE: exact}
    assert missed(*rigs.judge("pair", runs))[:4] == list(names)


def test_stages_are_added_up_and_have_an_exponent_forecasts_a_factor_and_the_largest_limits():
    stages = endtoend.Stages()
    for stage in ("read", "solve", "solve", "read", "end"):
        stages(stage)
    assert list(stages.found) == ["imports", "read", "solve"]
    assert all(used.wall_s >= 0.0 and used.peak_mb > 10.0 for used in stages.found.values())
    assert "| 1.50 |" in endtoend.BENCHMARK.section([located(100, 2.0), located(400, 16.0)])
    short = endtoend.BENCHMARK.section([located(100, 0.2), located(400, 1.6)])
    assert "| - |" in short  # too short to tell
    beside = endtoend.judge({**located(100, 1.0).cells}, 120.0, located(100, 1.0)["stages"], {"solve": 0.25})
    assert "| solve | 1.00 / 0.25 = 4x |" in endtoend.BENCHMARK.section([beside])
    assert "a scalar product" not in short
    assert missed(located(100, 1.0)) == []
    assert missed(located(100, 1.0, forecast_mb=72.5)) == ["forecast off by"]
    assert [check.name for check in located(endtoend.LARGEST, 1.0).checks] == ["forecast off by", "s", "MB"]


def located(size, cpu_s, forecast_mb=120.0):
    cells = {"scene": f"facade{size}", "images": size, "matches": 3000 * size}
    used = endtoend.Usage(wall_s=1.0, cpu_s=cpu_s, peak_mb=100.0)
    return endtoend.judge(cells, forecast_mb, {"solve": used})
