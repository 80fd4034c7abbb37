"""Two models joined by a similarity: right where the evidence is more than enough, else refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import (
    Similarity,
    compose,
    invert,
    median_spread,
    normalized,
    rotation_angles_deg,
)
from sfm_shapefit.placement.join import Ties, join_by_matches, join_by_priors, place_by_priors
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.known_positions import KnownPositions

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
TRUTH = Similarity(scale=2.5, rotation=TURN, translation=np.array([3.0, -1.0, 4.0]))
NOISE = 5e-4


def make_ties(seed, truth=TRUTH, *, pairs=6, known="both", noise=NOISE):
    """Matches of pairs of images, ten each; `known` says which models have their points."""
    rng = np.random.default_rng(seed)
    k = 10 * pairs
    pair = np.repeat(np.arange(pairs), 10)
    eyes = rng.normal(size=(2, pairs, 3))[:, pair]
    eyes[1, :, 0] += 3.0
    points = rng.normal(size=(k, 3)) + 8.0 * np.eye(3)[1]
    rays = normalized(normalized(points - eyes) + noise * rng.standard_normal((2, k, 3)))
    into = invert(truth)
    rows = np.arange(k) % 3
    has = [rows != 0, rows != 1] if known == "either" else [np.full(k, known == "both")] * 2
    own = points + noise * rng.standard_normal((2, k, 3))
    return Ties(
        eyes_first=eyes[0],
        eyes_second=into.apply(eyes[1]),
        rays_first=rays[0],
        rays_second=rays[1] @ truth.rotation,
        points_first=np.where(has[0][:, None], own[0], np.nan),
        points_second=np.where(has[1][:, None], into.apply(own[1]), np.nan),
        pairs=pair,
        tolerances=np.full(k, 8.0 * noise),
    )


def concatenated(*parts):
    ties = Ties(*map(np.concatenate, zip(*parts, strict=True)))
    counts = np.cumsum([0, *(len(np.unique(part.pairs)) for part in parts)])
    pairs = [part.pairs + count for part, count in zip(parts, counts, strict=False)]
    return ties._replace(pairs=np.concatenate(pairs))


def turns_of(truth, seed, count=6):
    """What pairs suggest: the truth to a degree or so."""
    noise = Rotation.from_rotvec(0.01 * np.random.default_rng(seed).standard_normal((count, 3)))
    return noise.as_matrix() @ truth.rotation


@pytest.mark.parametrize("known", ["both", "either", "none"])
def test_matches_join_two_models_and_say_how_surely(known):
    """The errors of many draws are what the jackknife says."""
    ratios = []
    for seed in range(8):
        ties = make_ties(seed, known=known)
        centers = ties.eyes_second
        join = join_by_matches(ties, turns_of(TRUTH, seed), centers)
        off = compose(join.first_from_second, invert(TRUTH))
        assert abs(np.log(off.scale)) < 0.02
        assert rotation_angles_deg(off.rotation) < 1.0
        errors = join.first_from_second.apply(centers) - TRUTH.apply(centers)
        ratios.append(np.median(np.linalg.norm(errors, axis=1)) / join.center_sigma)
        assert join.agreeing.mean() > 0.9
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_wrong_pairs_among_right_ones_do_not_pull():
    wrong = make_ties(1, pairs=2, known="either")
    order = np.random.default_rng(0).permutation(len(wrong.pairs))
    wrong = wrong._replace(rays_second=wrong.rays_second[order], points_second=wrong.points_second[order])
    right = make_ties(0, pairs=8, known="either")
    join = join_by_matches(concatenated(right, wrong), turns_of(TRUTH, 0), right.eyes_second)
    assert rotation_angles_deg(join.first_from_second.rotation @ TURN.T) < 0.2
    assert not join.agreeing[len(right.pairs) :].any()
    assert "of 8 of 10 pairs" in join.evidence


def test_two_explanations_are_refused():
    """A thing that stands there twice: some pairs want the model at the one, some at the other."""
    half = Similarity(scale=1.0, rotation=np.diag([-1.0, 1.0, -1.0]), translation=np.array([9.0, 0.0, 0.0]))
    other = compose(half, TRUTH)
    turns = np.concatenate([turns_of(TRUTH, 0), turns_of(other, 1)])
    for rivals in (6, 3):
        ties = concatenated(make_ties(0, pairs=6), make_ties(1, other, pairs=rivals))
        with pytest.raises(UnsolvableError, match=rf"6 pairs of .* agree on one, {rivals} on another"):
            join_by_matches(ties, turns, ties.eyes_second)


def test_too_little_and_inconsistent_evidence_is_refused():
    turns = turns_of(TRUTH, 0)
    with pytest.raises(UnsolvableError, match="20 matches of 2 pairs"):
        join_by_matches(make_ties(0, pairs=2), turns, np.eye(3))
    ties = make_ties(0)
    mixed = ties._replace(rays_second=np.random.default_rng(0).permutation(ties.rays_second))
    mixed = mixed._replace(points_second=np.full_like(ties.points_second, np.nan))
    with pytest.raises(UnsolvableError, match=r"no more than .* agree on one join"):
        join_by_matches(mixed, turns, ties.eyes_second)


def test_an_uncertain_join_is_refused():
    ties = make_ties(0, pairs=3, known="none", noise=0.005)
    with pytest.raises(UnsolvableError, match=r"the scale between them is known to \d+% only"):
        join_by_matches(ties, turns_of(TRUTH, 0), ties.eyes_second)


def priors_for(centers, world_from, sigma, seed):
    positions = world_from.apply(centers)
    positions = positions + sigma * np.random.default_rng(seed).standard_normal(positions.shape)
    information = np.tile(sigma**-2 * np.eye(3), (len(centers), 1, 1))
    known = KnownPositions(np.arange(len(centers)), positions, information)
    return place_by_priors(centers, PositionPriors(known=known, statement="made"))


def test_priors_join_two_models_and_say_how_surely():
    rng = np.random.default_rng(5)
    first_to_world = Similarity(scale=7.0, rotation=TURN.T, translation=np.array([100.0, 0.0, 5.0]))
    ratios = []
    for seed in range(8):
        first, second = rng.normal(size=(2, 20, 3))
        one = priors_for(first, first_to_world, 0.05, 10 + seed)
        two = priors_for(second, compose(first_to_world, TRUTH), 0.05, 30 + seed)
        join = join_by_priors(one, two)
        errors = join.first_from_second.apply(second) - TRUTH.apply(second)
        ratios.append(np.median(np.linalg.norm(errors, axis=1)) / join.center_sigma)
        assert join.center_sigma < 0.02 * median_spread(TRUTH.apply(second))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_priors_that_are_few_on_a_line_or_too_rough_join_nothing():
    rng = np.random.default_rng(6)
    centers = rng.normal(size=(20, 3))
    good = priors_for(centers, TRUTH, 0.01, 0)
    with pytest.raises(UnsolvableError, match="needs 4 in each"):
        join_by_priors(good, priors_for(centers[:3], TRUTH, 0.01, 1))
    line = np.linspace(0.0, 5.0, 20)[:, None] * [1.0, 0.5, 0.2]
    with pytest.raises(UnsolvableError, match=r"rough|line"):
        join_by_priors(good, priors_for(line, TRUTH, 0.01, 2))
    with pytest.raises(UnsolvableError, match=r"rough|only"):
        join_by_priors(good, priors_for(centers, TRUTH, 0.5, 3))
