"""Memory told beforehand: limits that are kept, refused with the number needed, and what is given up."""

import re
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit import InputError
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.shared_errors import estimate_center_errors
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.facts.command_options import LocateOptions
from sfm_shapefit.graph.groups import separate
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import analyze
from sfm_shapefit.pipeline.memory import (
    Workload,
    choose_memory_plan,
    describe_work,
    forecast,
    keep_within_memory,
)
from sfm_shapefit.placement.memory_plan import MEMORY_PLANS
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.solver.solver_options import NO_FACTOR
from sfm_shapefit.synthetic import random_graph_problem
from tests.adjustment.made import disturb
from tests.adjustment.test_iterative import make_wall
from tests.scenes import RING

WORK = Workload(
    num_images=1000,
    num_keypoints=1_000_000,
    num_pairs=100_000,
    num_matches=2_000_000,
    num_edges=120_000,
    num_nodes=20_000,
    num_sampled=120_000,
    has_points=True,
    factor_entries=5_000_000,
    adjusts=True,
)
BARE = replace(WORK, num_edges=100_000, num_nodes=1000, has_points=False, factor_entries=2_000_000)


@pytest.mark.parametrize("name", [field.name for field in fields(Workload) if field.name != "needs_factor"])
def test_neither_a_cheaper_economy_nor_less_work_needs_more_memory(name):
    peaks = [forecast(WORK, economy).peak_mb for economy in MEMORY_PLANS]
    assert peaks == sorted(peaks, reverse=True)
    assert peaks[0] > 2.0 * peaks[-1]
    more = replace(
        WORK,
        **{
            name: {"has_points": True, "adjusts": True, "averages": True, "adjusts_bundle": True}.get(
                name, 2 * getattr(WORK, name)
            )
        },
    )
    for economy, peak in zip(MEMORY_PLANS, peaks, strict=True):
        assert forecast(more, economy).peak_mb >= peak


def test_the_cheapest_economy_that_fits_is_taken_or_the_number_that_is_enough_is_told():
    for k, economy in enumerate(MEMORY_PLANS):
        limit = forecast(WORK if economy.points else BARE, economy).peak_mb
        chosen = choose_memory_plan(WORK, BARE, limit)
        assert MEMORY_PLANS.index(chosen) <= k
        assert forecast(WORK if chosen.points else BARE, chosen).peak_mb <= limit
    assert choose_memory_plan(WORK, BARE, np.inf, MEMORY_PLANS[2]) is MEMORY_PLANS[2]  # given up already
    with pytest.raises(InputError, match="raise it to") as refused:
        choose_memory_plan(WORK, BARE, 100.0)
    needed = float(re.search(r"raise it to (\d+)", str(refused.value)).group(1))
    assert choose_memory_plan(WORK, BARE, needed) is MEMORY_PLANS[-1]


def loop_graph(num_nodes=400):
    """Cameras on a loop, each with its next twenty: a factor of half a megabyte."""
    edges = np.array([(i, (i + k) % num_nodes) for i in range(num_nodes) for k in range(1, 21)])
    return ViewGraph(num_nodes, np.sort(edges, axis=1), np.tile([1.0, 0.0, 0.0], (len(edges), 1)))


PLACEMENT = PlacementOptions()
LOOP_WORK = Workload(
    num_images=400,
    num_keypoints=0,
    num_pairs=8000,
    num_matches=0,
    num_edges=8000,
    num_nodes=400,
    adjusts=True,
)


def limited_to(limit_mb, **options):
    """Options with a limit of memory."""
    return LocateOptions(max_memory_mb=int(limit_mb), **options)


def describe(measured, work, options=PLACEMENT):
    """What there is to do with a graph."""
    return describe_work(measured, work, options)


def test_the_factor_is_given_up_only_where_the_solve_does_not_need_it_and_then_nothing_is_refined():
    graph = loop_graph()
    plain, grouped = MeasuredGraph(graph), MeasuredGraph(graph, groups=separate(400, 3))
    split, newton = PlacementOptions(solver="admm"), PlacementOptions(solver="newton")
    for measured, options in ((plain, newton), (grouped, split), (grouped, newton)):
        work = describe(measured, LOOP_WORK, options)
        assert work.needs_factor
        peaks = [forecast(work, economy).peak_mb for economy in MEMORY_PLANS[-2:]]
        assert peaks[0] == peaks[1]  # so that it is never chosen
    full = describe(plain, LOOP_WORK, split)
    assert full.factor_entries > 0
    assert not full.needs_factor
    least = forecast(full, MEMORY_PLANS[-1]).peak_mb
    assert forecast(full, MEMORY_PLANS[-2]).peak_mb > least
    limited = limited_to(np.ceil(least), solver="admm")
    economy, kept = keep_within_memory(plain, LOOP_WORK, limited, MEMORY_PLANS[0])
    assert economy is MEMORY_PLANS[-1]
    assert kept is plain
    changed = economy.limit(split)
    assert changed == PlacementOptions(solver="admm", factor_memory_mb=NO_FACTOR, refine=False)
    assert MEMORY_PLANS[-2].limit(split) is split
    assert "neither refined" in economy.statement


def test_points_that_are_given_up_are_in_the_graph_no_more():
    # 5,000 of the edges are of points: more than a megabyte, in which limits are given
    problem = random_graph_problem(200, 0.5, sigma=0.01, seed=1)
    measured = MeasuredGraph(ViewGraph(200, problem.edges, problem.directions), num_points=60)
    work = Workload(
        num_images=140,
        num_keypoints=0,
        num_pairs=1,
        num_matches=10_000_000,
        num_edges=1,
        num_nodes=140,
        adjusts=True,
    )
    limit = forecast(describe(measured.without_points(), work), MEMORY_PLANS[3]).peak_mb
    economy, kept = keep_within_memory(measured, work, limited_to(np.ceil(limit)), MEMORY_PLANS[0])
    assert not economy.points
    assert kept.num_points == 0
    assert keep_within_memory(measured, work, limited_to(0), MEMORY_PLANS[0])[1] is measured


def test_an_adjustment_is_forecast_and_given_up_but_not_the_one_that_was_asked_for():
    crowded = replace(WORK, num_matches=20_000_000, num_keypoints=20_000_000)
    peaks = {economy.adjustment: forecast(crowded, economy).peak_mb for economy in MEMORY_PLANS}
    assert set(forecast(crowded).memory_mb) - set(forecast(replace(crowded, adjusts=False)).memory_mb) == {
        "adjusting"
    }
    # Each of 14 million observations has an entry of 144 bytes at least, among much else.
    assert peaks[True] > peaks[False] + 14 * 144
    asked = replace(crowded, adjusts_bundle=True)
    assert forecast(asked, MEMORY_PLANS[-1]).peak_mb > 14 * 144
    measured = MeasuredGraph(loop_graph())
    last = [economy for economy in MEMORY_PLANS if economy.adjustment][-1]
    needed = forecast(describe(measured, crowded), last).peak_mb
    economy = keep_within_memory(measured, crowded, limited_to(needed - 1), MEMORY_PLANS[0])[0]
    assert "not adjusted" in economy.statement
    assert not economy.adjustment
    assert keep_within_memory(measured, crowded, limited_to(10**6), MEMORY_PLANS[0])[0].adjustment


@pytest.fixture(scope="module")
def workspaces(rig_drive):
    """Models with a database: plain, and of rigs."""
    return {"plain": RING / "sparse" / "0", "rigs": rig_drive[1] / "sparse" / "0"}


@pytest.mark.parametrize("kind", ["plain", "rigs"])
def test_locate_keeps_a_limit_or_names_the_one_that_can_be_kept_and_a_large_one_changes_nothing(
    workspaces, kind
):
    with pytest.raises(InputError, match="more than max_memory_mb=100; raise it") as refused:
        sfm_shapefit.locate(workspaces[kind], max_memory_mb=100)
    needed = int(re.search(r"raise it to (\d+)", str(refused.value)).group(1))
    # The counts of the database alone do not know the graph, whose part is a few megabytes here.
    limits = (needed + 30, 9000, 0)
    found, limited, usual = (sfm_shapefit.locate(workspaces[kind], max_memory_mb=limit) for limit in limits)
    assert len(found.placement.cameras) == len(usual.placement.cameras)
    assert found.placement.refined.finish.refined
    assert np.isfinite(found.placement.assessment.sigmas).all()
    np.testing.assert_array_equal(limited.placement.locations, usual.placement.locations)
    assert limited.warnings == usual.warnings


def test_map_refuses_a_limit_before_anything_is_measured_and_keeps_the_one_that_it_names():
    heard = []
    with pytest.raises(InputError, match="more than max_memory_mb=100; raise it") as refused:
        sfm_shapefit.map_database(RING, max_memory_mb=100, progress=lambda stage, *_: heard.append(stage))
    assert set(heard) == {"read"}
    needed = int(re.search(r"raise it to (\d+)", str(refused.value)).group(1))
    found = sfm_shapefit.map_database(RING, max_memory_mb=needed + 30)  # the graph takes a few megabytes
    assert found.models[0].kept.all()


def adjust_few_tracks(size):
    """A problem of so many frames, adjusted, and how well its centers are known."""
    problem = disturb(make_wall(size), np.random.default_rng(1), center=0.01, point=0.01)
    options = AdjustmentOptions(max_iterations=2, linear_solver="sparse", threads=1)
    tracemalloc.start()
    estimate_center_errors(adjust(problem, options).problem, options, 0.0)
    taken_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return problem, taken_mb


def test_an_adjustment_on_few_tracks_takes_what_is_forecast():
    adjust_few_tracks((4, 5))  # kernels that are compiled take memory, too
    problem, taken_mb = adjust_few_tracks((15, 20))
    layout = lay_out(problem, AdjustmentOptions())
    observed, entries = problem.num_observations, analyze(300, layout.pairs).num_bytes(1, np.uint8)
    # As many keypoints as observations, and pairs and blocks of a factor so many that as many are forecast.
    nothing = Workload(num_images=300, num_keypoints=0, num_pairs=0, num_matches=0, num_edges=0, num_nodes=0)
    nothing = replace(nothing, averages=True)
    counts = {"num_keypoints": observed, "num_matches": 2 * observed}
    work = replace(nothing, **counts, num_pairs=len(layout.pairs) // 2, factor_entries=entries // 2)
    full, empty = (forecast(one).memory_mb["adjusting a first placement"] for one in (work, nothing))
    # The forecast has .95 of these pairs and of this factor, two copies of it; the inverse takes
    # as much as the factor, and what else there is next to nothing.
    assert 0.9 * taken_mb < full - empty < 1.3 * taken_mb


@pytest.mark.parametrize("kind", ["plain", "rigs"])
def test_what_is_given_up_is_what_the_warning_says(workspaces, kind):
    full = sfm_shapefit.inspect(workspaces[kind]).expected
    for limit in range(int(full.peak_mb) - 1, 200, -5):
        try:
            found = sfm_shapefit.locate(workspaces[kind], max_memory_mb=limit)
        except InputError:
            break
        statement = next(
            text for text in found.warnings if text.startswith(f"to stay below max_memory_mb={limit}, ")
        )
        assert found.placement.measured.evidence.errors is None  # the largest arrays are not kept
        assert ("not adjusted" in statement) == (found.adjustment is None)
        assert ("neither refined" in statement) == (not found.placement.refined.finish.refined)
    else:
        pytest.fail("no limit was refused")
