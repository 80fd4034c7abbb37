"""Every option of a placement with plain graphs, rigs, fixed cameras and priors: obeyed or refused."""

import numpy as np
import pytest

from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.base.settings import homes_of
from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.warnings import quality_warnings
from sfm_shapefit.graph.groups import separate
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.placement.gauge import prior_gauge
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_refinement import pull_to_priors
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solver_options import NO_FACTOR, Status
from sfm_shapefit.synthetic import random_graph_problem
from tests.problems import made_priors, no_mixture, rig_problem

NUM_FRAMES, SENSORS = 12, 3
N = NUM_FRAMES * SENSORS


def measure(kind, wrong=0.2, other=None):
    """A measured graph of 36 cameras, a share of its pairs wrong: at random, or as other places have them."""
    share = wrong if other is None else 0.0
    graph, groups, t = rig_problem(7, NUM_FRAMES, SENSORS, share, noise=0.003)
    rng = np.random.default_rng(7)
    v = graph.directions.copy()
    if other is not None:
        bad = rng.random(len(v)) < wrong
        v[bad] = normalized(normalized(differences(other, graph.edges)) + 0.003 * rng.normal(size=v.shape))[
            bad
        ]
    fixed = 0 if kind == "fixed" else None
    given = {"rigs": groups, "fixed": separate(N, 3).with_fixed(np.arange(N) < 8, t)}
    return MeasuredGraph(ViewGraph(N, graph.edges, v), groups=given.get(kind), fixed_group=fixed)


# Another value of each option, and what must then be so of the placement, given that with the defaults.
OPTIONS = {
    "solver": ("admm", lambda found, _: found.certified.method == "admm"),
    "tol": (1e-2, lambda found, usual: found.certified.iterations < usual.certified.iterations),
    "max_iterations": (1, lambda found, _: found.certified.status is Status.MAX_ITERATIONS),
    "uniqueness": (
        False,
        lambda found, usual: (found.certified.unique, usual.certified.unique) == (None, True),
    ),
    "factor_memory_mb": (
        NO_FACTOR,
        lambda found, _: not found.refined.finish.refined and np.isnan(found.assessment.sigmas).all(),
    ),
    # The answer does not depend on it, by contract.
    "threads": (2, lambda found, usual: np.array_equal(found.locations, usual.locations)),
    "objective": (
        "lud",
        lambda found, _: found.refined.finish.start == "LUD" and "as asked" in found.refined.finish.reason,
    ),
    "refine": (False, lambda found, usual: usual.refined.finish.refined and not found.refined.finish.refined),
}
REFUSED_BY_GROUPS = {
    "solver": "no solver admm",
    "factor_memory_mb": "factor over .* groups takes",
}


@pytest.fixture(scope="module", params=["plain", "rigs", "fixed"])
def usual(request) -> tuple[str, MeasuredGraph, Placement]:
    measured = measure(request.param)
    return request.param, measured, place(measured)


def test_the_table_has_every_option():
    assert set(OPTIONS) == set(homes_of(PlacementOptions))


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_is_obeyed_or_refused_in_one_sentence(usual, name):
    kind, measured, placement = usual
    value, holds = OPTIONS[name]
    options = PlacementOptions(**{name: value})
    if kind != "plain" and name in REFUSED_BY_GROUPS:
        with pytest.raises((InputError, UnsolvableError), match=REFUSED_BY_GROUPS[name]):
            place(measured, options)
        return
    assert holds(place(measured, options), placement)


def test_the_conic_solver_knows_groups():
    assert place(measure("rigs"), PlacementOptions(solver="conic")).certified.method == "conic"


@pytest.mark.parametrize("kind", ["rigs", "fixed"])
def test_groups_are_placed_without_the_refinement_where_only_its_factor_would_be_too_large(kind):
    found = place(measure(kind), solver="conic", factor_memory_mb=0)  # LUD's takes no limit
    assert not found.refined.finish.refined
    assert "the factor for that would be too large" in found.refined.finish.reason


def test_iterations_are_recorded_told_and_can_be_cancelled(usual):
    _, measured, placement = usual
    assert [info.iteration for info in placement.history] == list(
        range(1, placement.certified.iterations + 1)
    )
    assert placement.history[-1].objective == pytest.approx(placement.certified.objective, abs=1e-8)
    told = []

    def cancel(info):
        told.append(info)
        return len(told) < 2

    cancelled = place(measured, on_iteration=cancel)
    assert cancelled.certified.status is Status.CANCELLED
    assert len(told) == len(cancelled.history) == 2
    assert all(info.limit >= 2 for info in told)


def test_rejected_pairs_that_agree_on_another_placement_are_warned_of(usual):
    kind, _, placement = usual
    other = 4.0 * np.random.default_rng(8).normal(size=(N, 3))
    found = place(measure(kind, 0.3, other))
    assert placement.second_configuration is None
    assert found.second_configuration is not None
    assert any("agree with one another" in sentence for sentence in quality_warnings(found))


@pytest.fixture(scope="module")
def reset() -> tuple[Placement, np.ndarray]:
    """A placement whose refinement threw cameras out, and the positions of all."""
    problem = random_graph_problem(40, 0.5, sigma=0.01, seed=4)
    t = problem.locations
    order = np.argsort(t[:, 0])
    # Each of two nearly parallel pairs sees camera 40 from a wrong side.
    added = np.array([[order[5], 40], [order[-5], 40]])
    v = normalized(np.array([[0.02, 0.0, -1.0], [-0.02, 0.0, -1.0]]))
    v = np.concatenate([normalized(differences(t, problem.edges)), v])
    v = normalized(v + 0.003 * np.random.default_rng(4).standard_normal(v.shape))
    with no_mixture():
        placement = place(ViewGraph(41, np.concatenate([problem.edges, added]), v))
    assert placement.refined.reset_nodes.tolist() == [40]
    return placement, np.concatenate([t, [[0.0, 0.0, 1.0]]])


def pull(placement, priors, **options):
    gauge = prior_gauge(placement.locations, priors)
    pulled = pull_to_priors(placement, gauge, priors, PlacementOptions(**options))
    return pulled._replace(placement=judge(pulled.placement, PlacementOptions(**options)))


def test_a_camera_that_was_put_back_stays_undetermined_after_priors_pulled_the_others(reset):
    placement, positions = reset
    pulled, gauge, *_ = pull(placement, made_priors(positions, 0.01, np.arange(40)))
    assert "the priors moved cameras by" in gauge.statement
    assert np.isinf(pulled.assessment.sigmas[40]).all()
    assert pulled.assessment.trust[40] == 0.0
    assert pulled.assessment.reasons[40] == placement.assessment.reasons[40]
    assert "leave its distance open" in pulled.assessment.reasons[40]
    assert pulled.refined.reset_nodes.tolist() == [40]


def test_a_camera_that_was_put_back_is_determined_where_its_prior_holds_it(reset):
    placement, positions = reset
    gauge = prior_gauge(placement.locations, made_priors(positions, 0.01, np.arange(40)))
    positions = np.concatenate([positions[:40], gauge.apply(placement.locations)[40:]])
    held = pull(placement, made_priors(positions, 0.01))
    assert held.placement.refined.reset_nodes.tolist() == []
    positions[40] += 100.0
    lost = pull(placement, made_priors(positions, 0.01))
    assert lost.placement.refined.reset_nodes.tolist() == [40]


def test_what_the_rejected_pairs_agree_on_is_asked_anew_after_priors_pulled():
    other = 4.0 * np.random.default_rng(8).normal(size=(N, 3))
    placement = place(measure("plain", 0.3, other))
    pulled = pull(placement, made_priors(placement.locations, 0.01)).placement
    assert placement.second_configuration is not None
    assert pulled.second_configuration is not None
    assert pulled.second_configuration is not placement.second_configuration


def test_priors_do_not_pull_with_a_larger_factor_than_is_allowed(reset):
    placement, positions = reset
    with pytest.raises(UnsolvableError, match="more than the 0 MB allowed for one"):
        pull(placement, made_priors(positions, 0.01, np.arange(40)), factor_memory_mb=NO_FACTOR)
