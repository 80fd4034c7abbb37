"""Rotation averaging on made graphs: exact, robust, as good as the pairs allow, honest, certified."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

import sfm_shapefit
from harness.scenes import errors_deg
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.rotations import annealing, averaging_system, averaging_uncertainty, dual_certificate
from sfm_shapefit.rotations.annealing import Linearized
from sfm_shapefit.rotations.average import average_relative_rotations, average_rotations, check_pairs
from sfm_shapefit.rotations.averaging_system import plan_system
from sfm_shapefit.rotations.averaging_uncertainty import estimate_sigmas, residual_variance
from sfm_shapefit.rotations.dual_certificate import certify_rotations
from sfm_shapefit.synthetic import box_graph_problem, expander_graph_problem, ring_graph_problem
from sfm_shapefit.synthetic.rotation_graphs import rotation_problem
from tests.repeated_scenes import four_alike_sides

FAMILIES = {
    "ring": ring_graph_problem(300, 12.0, seed=1),
    "box": box_graph_problem(300, 16.0, seed=2),
    "expander": expander_graph_problem(300, 20.0, seed=3),
}


def made(family, **options):
    graph = FAMILIES[family].view_graph
    return rotation_problem(graph.num_nodes, graph.edges, **options)


def average(problem):
    return average_relative_rotations(len(problem.rotations), problem.relative)


def covariances(problem):
    """Covariances (n, 3, 3) in world axes, relative to the mean, of least squares on the right pairs."""
    right = problem.relative.subset(~problem.wrong)
    n, (i, j) = len(problem.rotations), right.pairs.T
    at_j = problem.rotations[j]
    blocks = at_j.transpose(0, 2, 1) @ right.information @ at_j
    matrix = np.zeros((n, 3, n, 3))
    for sign, a, b in ((1, i, i), (1, j, j), (-1, i, j), (-1, j, i)):
        np.add.at(matrix, (a, slice(None), b), sign * blocks)
    common = np.tile(np.eye(3), (n, n)) / n  # onto turns of all cameras alike, which no pair tells
    full = (np.linalg.inv(matrix.reshape(3 * n, 3 * n) + common) - common).reshape(n, 3, n, 3)
    return full[np.arange(n), :, np.arange(n)]


def test_threads_that_share_the_pairs_change_no_bit():
    graph = ring_graph_problem(600, 18.0, seed=4).view_graph
    problem = rotation_problem(graph.num_nodes, graph.edges, noise=0.01)
    given = problem.relative.pairs, problem.relative.rotations, problem.relative.information
    assert len(given[0]) > 5_000  # a thread takes as many at once
    one, three = (average_rotations(*given, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(three.rotations, one.rotations)
    np.testing.assert_array_equal(three.sigmas_deg, one.sigmas_deg)


@pytest.mark.parametrize("family", FAMILIES)
def test_exact_pairs_give_the_exact_rotations_in_spite_of_wrong_ones(family):
    problem = made(family, noise=0.0)
    answer = average(problem)
    assert answer.registered.all()
    assert answer.certified
    # A common turn, and rounding that adds up along at most 300 pairs: 300 eps rad are 4e-12 deg.
    assert errors_deg(answer.rotations, problem.rotations).max() < 1e-9
    weights = problem.relative.weight_shares * np.sqrt(problem.relative.num_matches)
    sound = problem.relative.are_sound()
    assert answer.share == pytest.approx(weights[sound & ~problem.wrong].sum() / weights[sound].sum())


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("seed", [1, 2])
def test_errors_are_those_of_least_squares_on_the_right_pairs_and_sigmas_say_so(family, seed):
    problem = made(family, seed=seed)
    answer = average(problem)
    errors = errors_deg(answer.rotations, problem.rotations)
    expected = np.degrees(np.sqrt(np.trace(covariances(problem), axis1=1, axis2=2) / 3.0))
    # The loss costs 2 %, the floor of the pairs' variances 6 %; 900 components, on a ring a tenth of them
    # independent, give the root mean square to 1 / sqrt(2 * 90) = 8 %: three of these.
    assert np.sqrt(np.mean(errors**2) / 3.0) < 1.32 * np.sqrt(np.mean(expected**2))
    ratio = np.sqrt(np.mean((errors / answer.sigmas_deg) ** 2) / 3.0)
    assert 0.76 < ratio < 1.24
    # The residual scale comes from 2,000 pairs, to 2 %; weights and wrong pairs of the last system differ.
    assert answer.sigmas_deg == pytest.approx(expected, rel=0.35)
    assert np.median(answer.sigmas_deg / expected) == pytest.approx(1.0, abs=0.12)


def test_sigmas_follow_the_noise_and_not_the_stated_information():
    answers = [average(made("box", noise=noise, wrong_share=0.0)) for noise in (1.0, 2.0)]
    ratio = np.median(answers[1].sigmas_deg / answers[0].sigmas_deg)
    assert ratio == pytest.approx(2.0, rel=0.1)  # the median of 2,400 residuals is good to 2 %


@pytest.mark.parametrize("family", FAMILIES)
def test_without_a_factor_answers_are_the_same_and_sigmas_nearly(family, monkeypatch):
    problem = made(family)
    factored = average(problem)
    planned = averaging_system.plan_system

    def without_factor(*args):
        system = planned(*args)
        system.plan, system.factors_blocks, system.is_expander = None, False, True
        return system

    for module in (averaging_uncertainty, sfm_shapefit.rotations.average):
        monkeypatch.setattr(module, "plan_system", without_factor)
    iterated = average(problem)
    assert iterated.certified
    # The last right side is solved to 1e-4 of itself, far below the sigmas of .05 to .3 deg.
    difference = errors_deg(iterated.rotations, factored.rotations)
    assert (difference < 0.1 * factored.sigmas_deg).all()
    # 16 samples of three components: variances to sqrt(2 / 48) = 20 %, sigmas to 10 %; none beyond four. On a
    # ring all cameras share the slowest modes, so that the median is no better.
    assert iterated.sigmas_deg == pytest.approx(factored.sigmas_deg, rel=0.4)
    assert np.median(iterated.sigmas_deg / factored.sigmas_deg) == pytest.approx(
        1.0, abs=0.3 if family == "ring" else 0.1
    )


def test_a_camera_whose_strongest_pair_is_false_is_moved_to_what_most_of_its_pairs_say():
    problem = made("expander", wrong_share=0.0)
    relative = problem.relative
    own = np.flatnonzero((relative.pairs == 7).any(axis=1))
    relative.rotations[own[0]] = (
        Rotation.from_rotvec([0.0, 0.0, 3.0]).as_matrix() @ relative.rotations[own[0]]
    )
    relative.num_matches[own[0]] = 100_000
    weights = relative.weight_shares * relative.num_matches
    answer = average_rotations(relative.pairs, relative.rotations, relative.information, weights=weights)
    errors = errors_deg(answer.rotations, problem.rotations)
    assert errors.max() < 5.0 * answer.sigmas_deg.max()


def test_a_camera_of_false_pairs_alone_is_named_and_its_sigma_is_large():
    problem = made("box", wrong_share=0.0)
    relative = problem.relative
    own = (relative.pairs == 5).any(axis=1)
    relative.rotations[own] = Rotation.random(
        int(own.sum()), random_state=np.random.default_rng(1)
    ).as_matrix()
    answer = average(problem)
    assert list(np.flatnonzero(answer.unsettled)) == [5]
    assert answer.agreements[5] < 0.5 < np.delete(answer.agreements, 5).min()
    assert answer.sigmas_deg[5] > 2.0 * np.median(answer.sigmas_deg)
    assert np.delete(errors_deg(answer.rotations, problem.rotations), 5).max() < 1.0


def test_the_most_consistent_of_several_averagings_is_kept():
    """Of 49 pairs between two halves 42 have few matches, and agree on a turn by 90 degrees.

    Neither the first nor the last of the answers that are tried has most of what was matched.
    """
    problem = rotation_problem(14, np.column_stack(np.triu_indices(14, 1)), wrong_share=0.0)
    relative = problem.relative
    false = np.flatnonzero((relative.pairs < 7).sum(axis=1) == 1)[:42]
    i, j = relative.pairs[false].T
    turn = Rotation.from_rotvec([0.0, 0.0, np.pi / 2.0]).as_matrix()
    relative.rotations[false] = problem.rotations[j] @ turn @ problem.rotations[i].transpose(0, 2, 1)
    relative.num_matches[:] = 100
    relative.num_matches[false] = 16
    answer = average(problem)
    assert answer.certified
    assert answer.num_tried > 1
    assert answer.num_pairs > 0.9 * len(relative.pairs)
    assert errors_deg(answer.rotations, problem.rotations).max() == pytest.approx(90.0, abs=1.0)


def streets_tied_by_weak_pairs(seed):
    """Six streets of six cameras in a row: six right pairs of few matches between two, one wrong of many."""
    rng, k = np.random.default_rng(seed), np.arange(36) // 6
    truth = Rotation.random(36, random_state=rng)
    pairs = np.column_stack(np.triu_indices(36, 1))
    apart = k[pairs[:, 1]] - k[pairs[:, 0]]
    inside, far = np.flatnonzero(apart == 0), np.flatnonzero(apart > 1)
    between = [rng.choice(np.flatnonzero((apart == 1) & (k[pairs[:, 0]] == b)), 7, False) for b in range(5)]
    weak, strong = np.concatenate([rows[:6] for rows in between]), np.array([rows[6] for rows in between])
    wrong = np.concatenate([strong, rng.choice(far, 30, False)])
    matches = np.full(len(pairs), 60)
    matches[weak], matches[strong] = 20, 300
    noise = Rotation.from_rotvec(np.radians(0.2) * rng.standard_normal((len(pairs), 3)))
    relative = (noise * truth[pairs[:, 1]] * truth[pairs[:, 0]].inv()).as_matrix()
    relative[wrong] = Rotation.random(len(wrong), random_state=rng).as_matrix()
    used = np.concatenate([inside, weak, wrong])
    return pairs[used], relative[used], matches[used], truth.as_matrix()


@pytest.mark.parametrize("seed", [0, 1])
def test_counts_are_set_aside_where_a_few_pairs_of_many_matches_turn_whole_streets(seed):
    pairs, relative, matches, truth = streets_tied_by_weak_pairs(seed)
    answer = average_rotations(pairs, relative, weights=matches)
    assert answer.counts_mislead
    assert "without numbers of matches" in answer.statement
    # 0.2 deg a pair and axis; a street hangs on six pairs, five of them in a row, and each camera on five.
    assert errors_deg(answer.rotations, truth).max() < 2.0


@pytest.mark.parametrize("seed", [1, 2])
def test_counts_are_kept_where_more_pairs_close_in_a_folded_scene(seed):
    scene = four_alike_sides(0.5, seed)
    answer = average_rotations(scene.graph.edges, scene.relative, weights=scene.num_matches)
    folded = average_rotations(scene.graph.edges, scene.relative)
    right = scene.num_matches == scene.num_matches.max()
    assert folded.share > np.mean(right) + 0.1
    assert not answer.counts_mislead
    assert errors_deg(answer.rotations, scene.rotations).max() < 1.0  # 0.1 deg a pair, some 14 a camera


def test_a_common_turn_turns_the_answer_and_other_numbers_and_orders_of_pairs_change_nothing():
    problem = made("box")
    pairs, rotations = problem.relative.pairs, problem.relative.rotations
    information = problem.relative.information
    n, rng = len(problem.rotations), np.random.default_rng(4)
    answer = average_rotations(pairs, rotations, information)
    order = rng.permutation(len(pairs))
    shuffled = average_rotations(pairs[order], rotations[order], information[order], threads=3)
    assert np.array_equal(shuffled.rotations, answer.rotations)
    assert np.array_equal(shuffled.sigmas_deg, answer.sigmas_deg)
    # Pairs turned around: R^T, whose error is in axes of camera i.
    back = rotations.transpose(0, 2, 1)
    turned = average_rotations(pairs[:, ::-1], back, back @ information @ rotations)
    assert errors_deg(turned.rotations, answer.rotations).max() < 1e-7
    numbers = rng.permutation(n)
    renamed = average_rotations(numbers[pairs], rotations, information)
    assert errors_deg(renamed.rotations[numbers], answer.rotations).max() < 1e-4
    # Axes of the cameras turned, each in its own way: R_ij becomes Q_j R_ij Q_i^T, H becomes Q_j H Q_j^T.
    q = Rotation.random(n, random_state=rng).as_matrix()
    i, j = pairs.T
    seen = average_rotations(
        pairs,
        q[j] @ rotations @ q[i].transpose(0, 2, 1),
        q[j] @ information @ q[j].transpose(0, 2, 1),
    )
    assert errors_deg(q.transpose(0, 2, 1) @ seen.rotations, answer.rotations).max() < 1e-4
    assert seen.sigmas_deg == pytest.approx(answer.sigmas_deg, rel=1e-4)


def test_the_largest_of_several_components_is_answered():
    problem = rotation_problem(7, np.array([(0, 1), (1, 2), (0, 2), (2, 3), (4, 5), (5, 6)]), wrong_share=0.0)
    answer = average(problem)
    assert list(answer.registered) == [True] * 4 + [False] * 3
    assert np.array_equal(answer.rotations[4:], np.tile(np.eye(3), (3, 1, 1)))
    assert np.isnan(answer.sigmas_deg[4:]).all()
    assert errors_deg(answer.rotations[:4], problem.rotations[:4]).max() < 3.0


def test_one_pair_and_bridges_are_followed_and_their_sigmas_are_those_given():
    sigma = np.radians(0.5)
    information = np.tile(np.eye(3) / sigma**2, (2, 1, 1))
    rotations = Rotation.from_rotvec([[0.1, 0.2, 0.3], [2.0, 0.0, 1.0]]).as_matrix()
    pair = average_rotations([(0, 1)], rotations[:1], information[:1])
    assert pair.rotations[1] @ pair.rotations[0].T == pytest.approx(rotations[0], abs=1e-12)
    chain = average_rotations([(0, 1), (2, 1)], rotations, information)
    assert chain.rotations[1] @ chain.rotations[2].T == pytest.approx(rotations[1], abs=1e-12)
    # Two cameras are each half of the difference off their mean. In a chain of three, the middle one is off
    # by a third of the sum of both differences, the outer ones by (2, 1) / 3 of them; c is that of the loss.
    added = np.hypot(0.5, 0.05) * np.sqrt(0.823)
    assert pair.sigmas_deg == pytest.approx([added / 2.0] * 2)
    assert chain.sigmas_deg == pytest.approx(added * np.sqrt([5.0, 2.0, 5.0]) / 3.0)
    assert pair.certified
    assert chain.certified


def test_one_image_needs_no_pair():
    answer = average_rotations(np.zeros((0, 2), dtype=int), np.zeros((0, 3, 3)), num_images=1)
    assert (answer.share, list(answer.registered), list(answer.sigmas_deg)) == (1.0, [True], [0.0])


EYE = np.eye(3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([(0, 1), (1, 0)], [EYE, EYE]), r"pair 1 \(1, 0\) is given twice"),
        (([(0, 0)], [EYE]), r"pair 0 \(0, 0\) must join two different images"),
        (([(-1, 0)], [EYE]), r"pair 0 \(-1, 0\) must join two different images"),
        (([(0, 1)], [2.0 * EYE]), "has no rotation matrix"),
        (([(0, 1)], [-EYE]), "has no rotation matrix"),
        (([(0, 1)], [np.nan * EYE]), "rotations must be finite"),
        (([(0, 1)], EYE), r"rotations have shape \(3, 3\); 1 pairs need \(1, 3, 3\)"),
        (([(0, 1)], "rotations"), "rotations must be numbers"),
        (([(0.0, 1.0)], [EYE]), "pairs must be an integer array"),
        (([(0, 1)], [EYE], [-EYE]), "not symmetric and positive definite"),
        (([(0, 1)], [EYE], [EYE + np.eye(3, k=1)]), "not symmetric and positive definite"),
        ((np.zeros((0, 2), dtype=int), np.zeros((0, 3, 3))), "without relative rotations"),
    ],
)
def test_bad_input_is_refused_with_a_sentence(arguments, message):
    with pytest.raises(InputError, match=message):
        average_rotations(*arguments)


def test_bad_weights_and_too_few_images_are_refused():
    with pytest.raises(InputError, match="weight that is not positive"):
        average_rotations([(0, 1)], [EYE], weights=[0.0])
    with pytest.raises(InputError, match=r"of 0\.\.1"):
        average_rotations([(0, 2)], [EYE], num_images=2)


def ring_turned_around(extra_turns, n=24, noise_deg=0.2):
    """A cycle whose pairs all say a turn of 0, and cameras that turn around `extra_turns` times along it."""
    rng = np.random.default_rng(0)
    pairs = np.sort(np.stack([np.arange(n), np.roll(np.arange(n), -1)], axis=1), axis=1)
    noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(n, 3))).as_matrix()
    given = check_pairs(pairs, noise, None, None, n)
    angles = 2.0 * np.pi * extra_turns * np.arange(n) / n
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_quat()
    system = plan_system(n, given.pairs, given.supports, 1)
    return system, given.measured, turns


@pytest.mark.parametrize("lanczos", [False, True])
def test_the_global_minimum_is_certified_and_a_ring_turned_once_around_is_not(lanczos):
    found = []
    for extra_turns in (0, 1):
        system, measured, turns = ring_turned_around(extra_turns)
        if lanczos:
            system.is_expander, system.plan = True, None
        found.append(certify_rotations(system, measured, np.ones(len(measured)), turns))
    good, local = found
    assert good.certified
    assert good.lower_bound == pytest.approx(good.cost, rel=1e-5)
    assert not local.certified
    assert local.lower_bound == -np.inf
    # 24 pairs, each 15 deg off: |E - I|^2 = 4 (1 - cos 15 deg); the noise adds a hundredth.
    assert local.cost == pytest.approx(24 * 4.0 * (1.0 - np.cos(np.radians(15.0))), rel=0.02)
    assert local.cost > 100.0 * good.cost
    # It is a stationary point near where it began, not the global minimum.
    assert local.distance_deg < 5.0


def test_the_lower_bound_holds_for_other_rotations():
    problem = made("expander")
    relative = problem.relative.subset(~problem.wrong)
    given = check_pairs(relative.pairs, relative.rotations, None, None, 300)
    system = plan_system(300, given.pairs, given.supports, 1)
    truth = Rotation.from_matrix(problem.rotations).as_quat()
    found = certify_rotations(system, given.measured, np.ones(len(given.pairs)), truth)
    i, j = relative.pairs.T
    gaps = relative.rotations - problem.rotations[j] @ problem.rotations[i].transpose(0, 2, 1)
    assert found.certified
    assert found.lower_bound <= found.cost <= np.sum(gaps**2)


def test_residuals_that_say_nothing_leave_the_given_information():
    assert residual_variance(np.array([1.0, 3.0]), np.array([1.0, 0.95])) == 1.0
    # 40,000 lengths of three normal components of deviation 2: the median is good to 1 %.
    lengths = 2.0 * np.linalg.norm(np.random.default_rng(0).normal(size=(40_000, 3)), axis=1)
    assert residual_variance(np.sqrt(0.5) * lengths, np.full(40_000, 0.5)) == pytest.approx(4.0, rel=0.04)


def test_triangles_that_close_raise_a_pair_and_others_lower_it():
    pairs = np.array([(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (3, 4)])
    problem = rotation_problem(5, pairs, wrong_share=0.0, noise=0.0)
    problem.relative.rotations[4] = Rotation.from_rotvec([2.0, 0.0, 0.0]).as_matrix()
    given = check_pairs(pairs, problem.relative.rotations, None, None, 5)
    shares = annealing.closing_shares(given, plan_system(5, pairs, np.ones(6), 1))
    # With one triangle that counts as closed and one that does not: 2/3, 1/3, and 1/2 without any.
    assert shares == pytest.approx([2 / 3, 2 / 3, 1 / 2, 1 / 3, 1 / 3, 1 / 2], abs=2e-3)


def test_blocks_without_a_factor_are_those_of_the_matrix():
    problem = made("box", wrong_share=0.0)
    pairs, n = problem.relative.pairs, 300
    blocks = problem.relative.information
    system = plan_system(n, pairs, np.ones(len(pairs)), 1)
    right = np.random.default_rng(0).normal(size=(n, 3))
    right -= right.mean(axis=0)
    x = system.solve_blocks(blocks, right, 1e-9)
    assert system.block_operator(blocks)(x) == pytest.approx(right, abs=1e-6)
    rows = [3 * pairs[:, a, None, None] + np.arange(3)[:, None] + np.zeros((1, 3), dtype=int) for a in (0, 1)]
    columns = [r.transpose(0, 2, 1) - np.arange(3)[:, None] * 0 for r in rows]
    matrix = sum(
        sign * coo_array((blocks.ravel(), (rows[a].ravel(), columns[b].ravel())), shape=(3 * n, 3 * n))
        for sign, a, b in ((1, 0, 0), (1, 1, 1), (-1, 0, 1), (-1, 1, 0))
    ).tocsc()
    ridge = averaging_system.RIDGE * matrix.diagonal().mean()
    matrix.setdiag(matrix.diagonal() + ridge)
    assert splu(matrix).solve(right.ravel()).reshape(n, 3) == pytest.approx(x, rel=1e-5, abs=1e-12)


def test_the_answer_shows_itself_in_one_line_and_in_plain_values():
    answer = average(made("ring"))
    assert repr(answer).startswith("<AveragedRotations: rotations of 300 of 300 images, ")
    facts = answer.summary()
    assert facts["certified"] is True
    assert facts["num_unsettled"] == 0
    assert facts["median_sigma_deg"] == pytest.approx(np.median(answer.sigmas_deg))
    assert "proved to be the best for the pairs that are kept" in facts["statement"]
    assert dual_certificate.__doc__ is not None


def test_what_rests_on_an_estimated_eigenvalue_is_not_called_proved(monkeypatch):
    def by_lanczos(system, *arrays):
        system.is_expander, system.plan = True, None
        return certify_rotations(system, *arrays)

    monkeypatch.setattr("sfm_shapefit.rotations.average.certify_rotations", by_lanczos)
    answer = average(made("box", wrong_share=0.0))
    assert answer.certified
    assert "which is no proof" in answer.statement
    assert "proved" not in answer.statement


@pytest.mark.parametrize("weight", [0.0, 1e-18])
def test_images_that_hang_on_pairs_of_no_weight_have_no_sigma(weight):
    pairs = np.array([(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (3, 4), (2, 5), (4, 5)])
    given = check_pairs(pairs, np.tile(np.eye(3), (8, 1, 1)), None, None, None)
    is_loose = (given.pairs >= 4).sum(axis=1) == 1
    blocks = np.where(is_loose, weight, 1.0)[:, None, None] * np.eye(3)
    system = plan_system(6, given.pairs, np.ones(8), 1)
    sigmas = estimate_sigmas(given, system, Linearized(blocks, np.ones(8)))
    assert np.isfinite(sigmas).tolist() == [True] * 4 + [False] * 2


@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_three_right_pairs_turn_a_block_that_more_wrong_ones_tie_elsewhere(seed):
    rng, n = np.random.default_rng(seed), 18
    truth, block = Rotation.random(n, random_state=rng).as_matrix(), np.arange(n) // 6
    every = np.column_stack(np.triu_indices(n, 1))
    inside = block[every[:, 0]] == block[every[:, 1]]
    cross = rng.permutation(every[~inside])
    ties = [np.flatnonzero((block[cross] == ends).all(axis=1))[:3] for ends in ((0, 1), (1, 2))]
    wrong = np.delete(cross, np.concatenate(ties), axis=0)[:20]
    pairs = np.concatenate([every[inside], *(cross[rows] for rows in ties), wrong])
    noise = Rotation.from_rotvec(np.radians(0.1) * rng.standard_normal((len(pairs), 3))).as_matrix()
    measured = noise @ truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    measured[-20:] = Rotation.random(20, random_state=rng).as_matrix()
    # Three pairs of .1 deg hold a block to a tenth; a wrong pair would turn it by tens of degrees.
    assert errors_deg(average_rotations(pairs, measured).rotations, truth).max() < 1.0
