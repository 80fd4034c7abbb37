"""Which cameras are trusted: against wrong rotations, self-supporting groups, false pairs everywhere."""

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.bodies import find_bodies
from sfm_shapefit.judgement.trust import PairFit, judge_cameras
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.placement.conditioning import condition
from sfm_shapefit.solver.program import differences
from tests.problems import make_evidence


def clean(n, seed, density=0.6):
    """Locations, a random graph and its exact directions."""
    rng = np.random.default_rng(seed)
    t = rng.standard_normal((n, 3))
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < density])
    return t, edges, normalized(differences(t, edges))


def test_a_group_that_agrees_only_with_itself_is_not_trusted():
    t, edges, v = clean(30, 1)
    group = edges < 7
    crossing = group.any(axis=1) & ~group.all(axis=1)
    rng = np.random.default_rng(1)
    v[crossing] = normalized(rng.standard_normal((int(crossing.sum()), 3)))
    support = np.where(group.all(axis=1), 1500, 30)  # its own pairs have most of all matches
    evidence = make_evidence(len(edges), support)
    found = assess(MeasuredGraph(ViewGraph(30, edges, v), evidence=evidence), t)
    assert found.trust[:7].max() < 0.3
    assert found.trust[7:].min() > 0.9
    assert "rotation" in found.reasons[0]


def test_pairs_without_a_direction_speak_against_their_cameras_too():
    t, edges, v = clean(20, 2)
    against = np.array([(3, k) for k in range(20) if k != 3 and [min(3, k), max(3, k)] not in edges.tolist()])
    own = int(np.sum(edges == 3))
    evidence = make_evidence(len(edges), 30, against, 200 * own // len(against))
    found = assess(MeasuredGraph(ViewGraph(20, edges, v), evidence=evidence), t)
    assert np.argmin(found.trust) == 3
    assert found.trust[3] < 0.5
    assert np.delete(found.trust, 3).min() > 0.6


def test_in_a_clean_graph_or_where_pairs_are_wrong_everywhere_nobody_is_blamed():
    t, edges, v = clean(40, 3)
    evidence = make_evidence(len(edges))
    found = assess(MeasuredGraph(ViewGraph(40, edges, v), evidence=evidence), t)
    assert found.trust.min() > 0.99
    assert set(found.reasons) == {""}
    rng = np.random.default_rng(3)
    bad = rng.random(len(edges)) < 0.35
    v[bad] = normalized(rng.standard_normal((int(bad.sum()), 3)))
    assert assess(MeasuredGraph(ViewGraph(40, edges, v), evidence=evidence), t).trust.min() > 0.7


def test_false_pairs_between_all_cameras_do_not_drown_the_true_ones():
    t, edges, v = clean(40, 4, density=0.3)
    against = np.sort(np.random.default_rng(4).integers(40, size=(3 * len(edges), 2)), axis=1)
    against = against[against[:, 0] != against[:, 1]]
    evidence = make_evidence(len(edges), 60, against, 60)
    assert assess(MeasuredGraph(ViewGraph(40, edges, v), evidence=evidence), t).trust.min() > 0.6


def judged(n, seed, wrong_share, leverages_of_5):
    """The trust of n cameras held well, pairs wrong at random but for those of camera 5."""
    t, edges, v = clean(n, seed)
    own = (edges == 5).any(axis=1)
    wrong = (np.random.default_rng(seed).random(len(edges)) < wrong_share) & ~own
    angles, sigmas = np.where(wrong, 1.0, 1e-3), np.full((n, 3), 1e-6)
    leverages = np.where(own, leverages_of_5, 0.1)
    held = condition(t, edges, ~wrong, sigmas, n)
    fit = PairFit(angles, np.full(len(edges), 1e-3), leverages)
    return judge_cameras(MeasuredGraph(ViewGraph(n, edges, v)), t, fit, sigmas, held).trust


def test_pairs_that_nothing_checks_are_no_evidence_and_without_any_that_of_the_scene_counts():
    trust = judged(30, 5, 0.0, 1.0)
    assert trust[5] == pytest.approx(2.0 / 3.0, abs=0.05)  # the prior, over 3/4 of nearly 1
    assert np.delete(trust, 5).min() > 0.99
    assert judged(30, 5, 0.0, 0.3)[5] > 0.99
    assert judged(30, 5, 0.0, np.nan)[5] == pytest.approx(trust[5])  # outside of what is rigid
    trust = judged(40, 6, 0.3, 1.0)  # about 0.7 of the votes agree: 2/3 of that
    assert trust[5] == pytest.approx(0.47, abs=0.06)
    assert np.median(trust) > 0.99


def test_one_pair_of_thousands_of_matches_does_not_outvote_the_others():
    t, edges, v = clean(20, 7)
    own = np.flatnonzero((edges == 3).any(axis=1))
    v[own[1:]] = normalized(np.random.default_rng(7).standard_normal((len(own) - 1, 3)))
    support = np.full(len(edges), 100)
    support[own[0]] = 100_000
    evidence = make_evidence(len(edges), support)
    assert assess(MeasuredGraph(ViewGraph(20, edges, v), evidence=evidence), t).trust[3] < 0.5


def test_bodies_join_while_more_speaks_for_it_than_against():
    pairs = np.array([(0, 1), (1, 2), (3, 4), (2, 3), (0, 4)])
    for last, joined in ((-2.0, [0] * 5), (-4.0, [0] * 3 + [1] * 2)):
        assert find_bodies(5, pairs, np.array([9.0, 8.0, 7.0, 3.0, last])).tolist() == joined
