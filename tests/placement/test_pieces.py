"""Pieces joined in one world: right where the evidence is more than enough, else refused with the reason."""

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
from sfm_shapefit.placement.coinciding import count_coinciding
from sfm_shapefit.placement.join import UNTIED, PieceJoin, join_pieces
from sfm_shapefit.placement.piece_program import Residuals, Standing, misses_px
from sfm_shapefit.placement.piece_ties import PieceCameras, PieceTies
from sfm_shapefit.placement.prior_join import join_by_priors, place_by_priors
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.matches import RayMatches

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
TRUTH = Similarity(scale=2.5, rotation=TURN, translation=np.array([3.0, -1.0, 4.0]))
PIXEL = 1e-3
NUM_CAMERAS = 6
ELSEWHERE = Similarity(scale=1.0, rotation=np.eye(3), translation=np.array([0.0, 1.5, 0.5]))


class Drawn:
    """Pieces of six cameras about a cloud of points; the world of the first is the truth."""

    def __init__(self, seed, num_pieces=2, *, metric=False):
        self.rng = np.random.default_rng(seed)
        self.piece_of = np.repeat(np.arange(num_pieces), NUM_CAMERAS)
        angles = 0.25 * np.arange(len(self.piece_of))
        away = 6.0 + 0.5 * self.rng.random(len(angles))
        self.centers = np.stack([np.cos(angles), np.sin(angles), 0.3 * self.rng.random(len(angles))], axis=1)
        self.centers *= away[:, None]
        forward = normalized(-self.centers)
        right = normalized(np.cross(forward, [0.0, 0.0, 1.0]))
        self.rotations = np.stack([right, np.cross(forward, right), forward], axis=1)
        self.worlds = [Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))]
        for k in range(1, num_pieces):
            turn = Rotation.random(random_state=seed + k).as_matrix()
            scale = 1.0 if metric else float(np.exp(self.rng.normal()))
            self.worlds.append(Similarity(scale=scale, rotation=turn, translation=self.rng.normal(size=3)))
        self.is_metric = np.full(num_pieces, metric)
        self.pairs, self.rays, self.points, self.is_shared = [], [], [], []
        self.clouds = (np.zeros((0, 3)),) * num_pieces

    def show(self, count=400, *, common=0.5):
        """Let each piece have so many points, some of them those of all."""
        same = 1.0 - 2.0 * self.rng.random((count, 3))
        own = 1.0 - 2.0 * self.rng.random((len(self.worlds), count, 3))
        own[:, : round(common * count)] = same[: round(common * count)]
        noisy = own + 0.5 * PIXEL * self.rng.standard_normal(own.shape)
        self.clouds = tuple(invert(world).apply(one) for world, one in zip(self.worlds, noisy, strict=True))

    def see(self, v, w, count=30, *, known=True, moved=None, turned=False, spread=1.0):
        """Let two cameras see the same points; `moved`: the second piece stands elsewhere for this pair."""
        points = spread * self.rng.normal(size=(count, 3))
        there = points if moved is None else invert(moved).apply(points)
        rays, own = [], []
        for end, at in ((v, points), (w, there)):
            world = self.worlds[self.piece_of[end]]
            ray = normalized(at - self.centers[end]) @ self.rotations[end].T
            rays.append(normalized(ray + 0.5 * PIXEL * self.rng.standard_normal(ray.shape)))
            own.append(invert(world).apply(at) if known else np.full((count, 3), np.nan))
        if turned:  # matches of nothing
            rays[1], own[1] = self.rng.permutation(rays[1]), self.rng.permutation(own[1])
        self.pairs.append((v, w))
        self.rays.append(rays)
        self.points.append(np.stack(own, axis=1))
        self.is_shared.append(False)

    def see_some(self, first, second, count, **how):
        """Let so many pairs of cameras of two pieces, of different images, see the same points."""
        for k in range(count):
            self.see(first * NUM_CAMERAS + k % NUM_CAMERAS, second * NUM_CAMERAS + (k + k // 6) % 6, **how)

    def share(self, v, w):
        """Make a camera of a second piece the same image as one of the first."""
        self.centers[w], self.rotations[w] = self.centers[v], self.rotations[v]
        self.see(v, w, 40)
        rays, points = self.rays[-1], self.points[-1]
        rays[1] = rays[0]
        points[::2, 0], points[1::2, 1] = np.nan, np.nan
        self.is_shared[-1] = True

    def cameras(self):
        inverse = [invert(world) for world in self.worlds]
        turns = np.stack([self.worlds[g].rotation for g in self.piece_of])
        centers = [inverse[g].apply(c[None])[0] for g, c in zip(self.piece_of, self.centers, strict=True)]
        return PieceCameras(
            piece_of=self.piece_of,
            rotations=self.rotations @ turns,
            centers=np.array(centers),
            is_metric=self.is_metric,
            points=self.clouds,
        )

    def join(self):
        counts = [len(own) for own in self.points]
        matches = RayMatches(
            pairs=np.array(self.pairs, dtype=np.int64).reshape(-1, 2),
            offsets=np.append(0, np.cumsum(counts)).astype(np.int64),
            rays_i=np.concatenate([np.zeros((0, 3)), *(one for one, _ in self.rays)]),
            rays_j=np.concatenate([np.zeros((0, 3)), *(two for _, two in self.rays)]),
            pixel_angles=np.full(len(counts), PIXEL),
        )
        points = np.concatenate([np.zeros((0, 2, 3)), *self.points])
        return join_pieces(
            self.cameras(),
            PieceTies(matches=matches, points=points, is_shared=np.array(self.is_shared, bool)),
        )

    def off(self, join, by=None):
        """Relative error of the scale, degrees of the turn, and distance of the middle, of a join."""
        truth = self.worlds[join.piece] if by is None else compose(by, self.worlds[join.piece])
        truth = compose(invert(self.worlds[join.to]), truth)
        centers = self.cameras().centers_of(join.piece)
        apart = np.linalg.norm(join.to_from_piece.apply(centers) - truth.apply(centers), axis=1)
        turn = rotation_angles_deg(join.to_from_piece.rotation @ truth.rotation.T)
        return abs(np.log(join.to_from_piece.scale / truth.scale)), float(turn), float(np.median(apart))


def is_right(drawn, join):
    scale, turn, apart = drawn.off(join)
    return not join.reason and scale < 0.003 and turn < 0.2 and apart < 0.03


def test_misses_are_angles_to_points_and_distances_from_planes_in_pixels():
    rng, count = np.random.default_rng(0), 40
    standing = Standing(
        scales=np.array([1.0, 2.0, 0.5]), turns=Rotation.random(3, random_state=0).as_matrix(),
        middles=rng.normal(size=(3, 3)),
    )  # fmt: skip
    pieces = np.stack([np.arange(count) % 3, (np.arange(count) + 1) % 3], axis=1)
    eyes, targets = rng.normal(size=(2, count, 3))
    looks, others = normalized(rng.normal(size=(2, count, 3)))
    others[::2] = np.nan
    found = misses_px(
        Residuals(pieces, np.zeros(count, int), eyes, looks, targets, others, np.full(count, PIXEL)), standing
    )
    for k, (i, j) in enumerate(pieces):
        eye, target = (
            standing.scales[g] * standing.turns[g] @ x + standing.middles[g]
            for g, x in ((i, eyes[k]), (j, targets[k]))
        )
        across, look = normalized(target - eye), standing.turns[i] @ looks[k]
        expected = np.linalg.norm(across - look)
        if k % 2:
            other = standing.turns[j] @ others[k]
            sines = [np.linalg.norm(np.cross(across, ray)) for ray in (look, other)]
            expected = abs(np.linalg.det([look, other, across])) / min(sines)
        assert found[k] == pytest.approx(expected / PIXEL, rel=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_pieces_are_joined_and_say_how_surely(known):
    ratios = []
    for seed in range(4):
        drawn = Drawn(seed)
        drawn.see_some(0, 1, 6, known=known)
        join = drawn.join()[1]
        assert is_right(drawn, join) or (not known and not join.reason)
        assert join.evidence == "6 of 6 pairs of images between them"
        ratios.append(drawn.off(join)[2] / join.center_sigma)
    assert 0.02 < np.sqrt(np.mean(np.square(ratios))) < 3.0


def test_wrong_pairs_do_not_pull_even_where_most_are_wrong():
    for seed in range(3):
        drawn = Drawn(seed)
        drawn.see_some(0, 1, 6)
        drawn.see_some(0, 1, 12, turned=True)
        join = drawn.join()[1]
        assert is_right(drawn, join)
        assert join.agreeing.tolist() == list(range(6))
        assert not len(join.rivals)


def test_few_right_pairs_whose_turns_are_poorly_known_are_found_by_one_of_them_alone():
    """Narrow pairs vote for no turn within degrees, and sound wrong ones each for another."""
    drawn = Drawn(1)
    for k in range(4):
        drawn.see(k, NUM_CAMERAS + k, 10, spread=0.4)
    for k in range(4):
        turn = Rotation.random(random_state=100 + k).as_matrix()
        false = Similarity(scale=1.0, rotation=turn, translation=drawn.rng.normal(size=3))
        drawn.see(k, NUM_CAMERAS + k, moved=false)
    join = drawn.join()[1]
    assert not join.reason
    assert join.agreeing.tolist() == list(range(4))
    assert drawn.off(join)[2] < 0.1


def test_pieces_in_a_chain_each_have_their_scale():
    drawn = Drawn(3, 4)
    for first, second in ((0, 1), (1, 2), (2, 3)):
        drawn.see_some(first, second, 4)
        drawn.see_some(first, second, 2, turned=True)
    joins = drawn.join()
    assert sorted(joins) == [1, 2, 3]
    assert {join.to for join in joins.values()} == {0}
    assert all(is_right(drawn, join) for join in joins.values())


def test_metric_pieces_keep_their_scale():
    drawn = Drawn(4, metric=True)
    drawn.see_some(0, 1, 5)
    join = drawn.join()[1]
    assert join.to_from_piece.scale == 1.0
    assert is_right(drawn, join)
    assert join.scale_sigma == 0.0


def test_shared_images_count_as_two_pairs_each():
    drawn = Drawn(5)
    drawn.share(0, 6)
    assert "it needs 3" in drawn.join()[1].reason
    drawn.share(4, 10)
    join = drawn.join()[1]
    assert is_right(drawn, join)
    assert join.evidence.endswith("2 by images that both have")


def test_two_explanations_are_refused_and_named():
    """A thing that stands there twice: some pairs want the piece at the one place, some at the other."""
    for rivals in (6, 3):
        drawn = Drawn(6)
        drawn.see_some(0, 1, 6)
        drawn.see_some(0, 1, rivals, moved=ELSEWHERE)
        join = drawn.join()[1]
        assert "two joins are possible" in join.reason
        assert len(join.agreeing) + len(join.rivals) == 6 + rivals
        assert len({*join.agreeing.tolist()} & {*join.rivals.tolist()}) == 0


@pytest.mark.parametrize(("right", "false"), [(6, 3), (3, 6), (4, 9)])
def test_points_that_no_pair_used_say_which_of_two_joins_is_right(right, false):
    drawn = Drawn(11)
    drawn.see_some(0, 1, right)
    drawn.see_some(0, 1, false, moved=ELSEWHERE)
    drawn.show()
    join = drawn.join()[1]
    assert is_right(drawn, join)
    assert join.rivals.tolist() == list(range(right, right + false))


def test_points_that_no_pair_used_betray_a_join_that_all_other_pairs_want():
    drawn = Drawn(12)
    drawn.see_some(0, 1, 1)
    drawn.see_some(0, 1, 5, moved=ELSEWHERE)
    drawn.show()
    join = drawn.join()[1]
    assert "1 of 6 pairs of images between them agree" in join.reason
    assert join.rivals.tolist() == [1, 2, 3, 4, 5]


def test_points_betray_two_false_joins_by_the_one_pair_that_is_right():
    """Most pairs agree on the one, the next most on the other; the right pair is asked by itself."""
    third = Similarity(
        scale=1.0,
        rotation=Rotation.from_euler("xyz", [0.3, 1.0, -0.5]).as_matrix(),
        translation=np.array([-2.0, 1.5, 3.0]),
    )
    drawn = Drawn(20)
    drawn.see_some(0, 1, 1)
    drawn.see_some(0, 1, 6, moved=ELSEWHERE)
    drawn.see_some(0, 1, 2, moved=third)
    drawn.show()
    join = drawn.join()[1]
    assert "1 of 9 pairs of images between them agree" in join.reason
    assert join.rivals.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]


def test_points_that_shrink_to_a_spot_coincide_with_one_alone():
    points = np.random.default_rng(17).random((200, 3))
    spot = points[:1] + 1e-6 * points
    same = Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))
    assert count_coinciding(points, points, same) == 200
    assert count_coinciding(points, spot, same) == count_coinciding(spot, points, same) <= 1


def test_points_stand_in_for_one_pair_that_is_missing():
    drawn = Drawn(15)
    drawn.see_some(0, 1, 2)
    assert "it needs 3" in drawn.join()[1].reason
    drawn.show()
    join = drawn.join()[1]
    assert is_right(drawn, join)
    assert join.evidence == "2 of 2 pairs of images between them, and points that coincide"
    of_one = Drawn(15)
    for w in range(NUM_CAMERAS, NUM_CAMERAS + 3):
        of_one.see(0, w)
    assert "are all of one image" in of_one.join()[1].reason
    of_one.show()
    assert is_right(of_one, of_one.join()[1])
    alone = Drawn(15)
    alone.see_some(0, 1, 1)
    alone.show()
    assert "it needs 3" in alone.join()[1].reason


def test_points_of_matches_that_a_join_used_do_not_speak_for_it():
    """What the false pairs match is one thing in both pieces where they place them."""
    drawn = Drawn(13)
    drawn.see_some(0, 1, 6)
    for k in range(2):
        drawn.see(k, NUM_CAMERAS + k, 12, moved=ELSEWHERE)
    seen = np.concatenate(drawn.points)
    drawn.clouds = (seen[:, 0], seen[:, 1])
    assert "two joins are possible" in drawn.join()[1].reason
    drawn.clouds = (np.zeros((0, 3)), np.zeros((0, 3)))
    assert "two joins are possible" in drawn.join()[1].reason


def test_points_that_coincide_nowhere_say_nothing():
    drawn = Drawn(14)
    drawn.see_some(0, 1, 6)
    drawn.see_some(0, 1, 4, moved=ELSEWHERE)
    drawn.show(common=0.02)
    assert "two joins are possible" in drawn.join()[1].reason


def test_a_rival_between_two_pieces_is_overcome_by_a_third():
    drawn = Drawn(7, 3)
    for first, second in ((0, 1), (0, 2), (1, 2)):
        drawn.see_some(first, second, 6)
    drawn.see_some(1, 2, 3, moved=ELSEWHERE)
    joins = drawn.join()
    assert all(is_right(drawn, join) for join in joins.values())
    assert joins[2].rivals.tolist() == [18, 19, 20]


@pytest.mark.parametrize(
    ("pairs", "reason"),
    [
        (
            [(0, 6), (1, 7)],
            "2 of 2 pairs of images between them agree on one join, and it needs 3",
        ),
        ([(0, 6), (0, 7), (0, 8)], "are all of one image"),
        ([], UNTIED),
    ],
)
def test_too_little_evidence_is_refused(pairs, reason):
    drawn = Drawn(8)
    for v, w in pairs:
        drawn.see(v, w)
    join = drawn.join()[1]
    assert reason in (join.reason if isinstance(join, PieceJoin) else join)


def test_inconsistent_evidence_is_refused():
    drawn = Drawn(9)
    drawn.see_some(0, 1, 8, turned=True)
    join = drawn.join()[1]
    assert join.reason if isinstance(join, PieceJoin) else join


def test_a_piece_that_nothing_ties_does_not_keep_others_apart():
    drawn = Drawn(10, 3)
    drawn.see_some(1, 2, 5)
    joins = drawn.join()
    assert joins[1] == UNTIED
    assert joins[2].to == 1
    assert is_right(drawn, joins[2])


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
        join = join_by_priors((0, one), (1, two))
        errors = join.to_from_piece.apply(second) - TRUTH.apply(second)
        ratios.append(np.median(np.linalg.norm(errors, axis=1)) / join.center_sigma)
        assert join.center_sigma < 0.02 * median_spread(TRUTH.apply(second))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_priors_that_are_few_on_a_line_or_too_rough_join_nothing():
    rng = np.random.default_rng(6)
    centers = rng.normal(size=(20, 3))
    good = priors_for(centers, TRUTH, 0.01, 0)
    with pytest.raises(UnsolvableError, match="needs 4 in each"):
        join_by_priors((0, good), (1, priors_for(centers[:3], TRUTH, 0.01, 1)))
    line = np.linspace(0.0, 5.0, 20)[:, None] * [1.0, 0.5, 0.2]
    with pytest.raises(UnsolvableError, match=r"rough|line"):
        join_by_priors((0, good), (1, priors_for(line, TRUTH, 0.01, 2)))
    with pytest.raises(UnsolvableError, match=r"rough|only"):
        join_by_priors((0, good), (1, priors_for(centers, TRUTH, 0.5, 3)))
