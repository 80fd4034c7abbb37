"""Parts of every noun: a part of a part is a part, all of it is itself, and nothing that is said changes.

`say` tells what a noun says of each of its members, by the numbers that the members had in the whole: so a
part must say the same of those that it has. Images have such tests of their own, in tests/scene.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.scene.given import ControlPoints, Gravity, PositionPriors
from sfm_shapefit.scene.images import Frames, Sensors
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import ObservedTracks
from sfm_shapefit.tracks.node_tracks import Tracks
from tests.problems import all_pairs

N = 9  # members of each noun
_NO_LENSES = np.arange(1)  # the freedom of lenses that is alike for all


def freedom_of(noun, frames):
    """The freedom of some frames, whose lenses are all alike."""
    return noun.of(frames, _NO_LENSES)


class Noun(NamedTuple):
    make: Callable[[np.random.Generator], Any]
    part: Callable[[Any, np.ndarray], Any]
    """Of a noun and some of its members, ascending."""
    say: Callable[[Any, np.ndarray], dict[int, Any]]
    """Of a noun and the numbers in the whole of the members that it has."""


def plain(value):
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def columns(kind, part, shapes, **others):
    """A noun whose arrays have a row for each member, of any numbers; `shapes` are those of a row."""

    def make(rng):
        return kind(**{name: rng.integers(0, 99, (N, *shape)) for name, shape in shapes.items()}, **others)

    def say(noun, members):
        return {m: [plain(getattr(noun, name)[k]) for name in shapes] for k, m in enumerate(members.tolist())}

    return Noun(make, part, say)


def lists(kind, part, shapes, own=()):
    """A noun with one to four rows for each member, and some arrays with one."""

    def make(rng):
        offsets = np.append(0, np.cumsum(rng.integers(1, 5, N)))
        given = {name: rng.integers(0, 99, (offsets[-1], *shape)) for name, shape in shapes.items()}
        return kind(offsets=offsets, **given, **{name: rng.integers(0, 99, N) for name in own})

    def say(noun, members):
        said = {}
        for k, m in enumerate(members.tolist()):
            rows = slice(noun.offsets[k], noun.offsets[k + 1])
            said[m] = [getattr(noun, name)[rows].tolist() for name in shapes]
            said[m] += [getattr(noun, name)[k].tolist() for name in own]
        return said

    return Noun(make, part, say)


def of_some(kind, part, shapes):
    """A noun that says something of some members only, by their `indices`."""

    def make(rng):
        indices = np.flatnonzero(rng.random(N) < 0.6)
        given = [rng.integers(0, 99, (len(indices), *shape)).astype(float) for shape in shapes.values()]
        return kind(indices, *given)

    def say(noun, members):
        values = zip(*(getattr(noun, name).tolist() for name in shapes), strict=True)
        return dict(zip(members[noun.indices].tolist(), values, strict=True))

    return Noun(make, part, say)


def control_points(rng):
    points, images = np.nonzero(rng.random((4, N)) < 0.5)
    return ControlPoints(
        names=tuple("abcd"),
        positions=rng.standard_normal((4, 3)),
        is_check=rng.random(4) < 0.5,
        points=points,
        images=images,
        pixels=rng.random((len(points), 2)),
        statement="made",
    )


def say_marks(noun, members):
    marks = {}
    for point, image, pixel in zip(noun.points, members[noun.images], noun.pixels, strict=True):
        marks.setdefault(int(image), []).append((noun.names[point], pixel.tolist()))
    return marks


def labels(rng):
    return np.unique(rng.integers(0, 4, N), return_inverse=True)[1]


def say_apart(label, columns, noun, members):
    """What columns say of each member, and who is not with it."""
    apart = getattr(noun, label)[:, None] != getattr(noun, label)
    return {
        m: ([getattr(noun, name)[k].tolist() for name in columns], set(members[apart[k]].tolist()))
        for k, m in enumerate(members.tolist())
    }


def measured(rng):
    """Seven cameras and four points, whose N edges come in any order; the group of nodes 5 and 6 stays."""
    edges = rng.permutation([*rng.permutation(all_pairs(7))[: N - 3].tolist(), (0, 7), (3, 8), (5, 9)])
    v = normalized(rng.standard_normal((N, 3)))
    return MeasuredGraph(
        ViewGraph(11, edges, v, rng.uniform(0.5, 2.0, N), names=[f"n{k}" for k in range(11)]),
        covariance=rng.random((N, 1, 1)) * np.eye(2),
        evidence=Evidence(
            contradicting=np.array([(1, 4), (0, 3), (2, 6)]),
            errors=rng.standard_normal((N, 5, 2)),
        ),
        num_points=4,
        groups=RigidGroups(group_of=[0, 1, 1, 0, 2, 3, 3, 4, 5, 6, 7], offsets=rng.random((11, 3))),
        fixed_group=3,
    )


def say_edges(noun, members):
    """By edge, and by the names of its nodes."""
    graph, evidence, groups = noun.graph, noun.evidence, noun.groups
    arrays = (graph.directions, graph.weights, noun.covariance, evidence.errors)
    said = {}
    for k, (edge, ends) in enumerate(zip(members.tolist(), graph.edges, strict=True)):
        nodes = [
            (graph.names[end], end < noun.num_cameras, groups.offsets[end].tolist(),
             groups.group_of[end] == noun.fixed_group)
            for end in ends.tolist()
        ]  # fmt: skip
        said[edge] = (nodes, len(set(groups.group_of[ends])), [array[k].tolist() for array in arrays])
    return said


def given_poses(rng):
    return GivenPoses(rng.random((N, 3, 3)), rng.random(N) < 0.5, KNOWN.make(rng))


def say_given(noun, members):
    at = KNOWN.say(noun.centers, members)
    own = zip(noun.rotations.tolist(), noun.fixed.tolist(), strict=True)
    return {m: (value, at.get(m)) for m, value in zip(members.tolist(), own, strict=True)}


KNOWN = of_some(KnownPositions, KnownPositions.among, {"positions": (3,), "information": (3, 3)})
PAIRS = {"pairs": (2,), "num_matches": ()}
NOUNS = {
    "known positions": KNOWN,
    "position priors": Noun(
        lambda rng: PositionPriors(known=KNOWN.make(rng), statement="made"),
        PositionPriors.of,
        lambda noun, members: KNOWN.say(noun.known, members),
    ),
    "gravity": of_some(Gravity, Gravity.of, {"directions": (3,), "sigmas": ()}),
    "control points": Noun(control_points, ControlPoints.of, say_marks),
    "rigid groups": Noun(
        lambda rng: RigidGroups(group_of=labels(rng), offsets=rng.random((N, 3))),
        RigidGroups.restricted_to,
        partial(say_apart, "group_of", ["offsets"]),
    ),
    "sensors": Noun(
        lambda rng: Sensors(
            rotations=rng.random((N, 3, 3)),
            translations=rng.random((N, 3)),
            rig_of=labels(rng),
            is_reference=rng.random(N) < 0.5,
        ),
        Sensors.part,
        partial(say_apart, "rig_of", ["rotations", "translations", "is_reference"]),
    ),
    "measured graph": Noun(measured, lambda noun, members: noun.part(members)[0], say_edges),
    "given poses": Noun(given_poses, GivenPoses.of, say_given),
    "freedom": columns(
        Freedom, lambda noun, frames: noun.of(frames, _NO_LENSES), {"pull_rad": (), "doubt_rad": ()}
    ),
    "frames": columns(Frames, Frames.part, {"ids": (), "rotations": (3, 3), "centers": (3,)}),
    "relative rotations": columns(
        RelativeRotations,
        RelativeRotations.subset,
        PAIRS | {"rotations": (3, 3), "information": (3, 3), "weight_shares": ()},
    ),
    "pair directions": columns(
        PairDirections,
        PairDirections.subset,
        PAIRS
        | {"directions": (3,), "status": (), "num_inliers": (), "num_rivals": (), "covariance": (2, 2)}
        | dict.fromkeys(("cheirality_fraction", "median_residual_px", "parallax_deg"), ()),
    ),
    "averaged rotations": columns(
        AveragedRotations,
        AveragedRotations.subset,
        {"rotations": (3, 3)}
        | dict.fromkeys(("registered", "sigmas_deg", "agreements", "best_agreements"), ()),
        share=0.5,
        num_pairs=3,
    ),
    "tracks": lists(Tracks, Tracks.subset, {"cameras": (), "rays": (3,)}),
    "observed tracks": lists(
        ObservedTracks,
        ObservedTracks.subset,
        {"cameras": (), "keypoints": (), "pixels": (2,), "on_plane": (2,)},
        own=["ids"],
    ),
    "points": lists(
        Points,
        lambda noun, members: noun.taken(np.isin(noun.points_seen(), members)),
        {"images": (), "keypoints": ()},
        own=["xyz", "ids", "errors_px"],
    ),
}


def among(said, members):
    """What is said of a member in a part: of who is apart, only those who are in it."""
    return (said[0], said[1] & set(members)) if isinstance(said[-1], set) else said


@pytest.mark.parametrize("name", NOUNS)
@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), data=st.data())
def test_a_part_of_a_part_is_a_part_and_says_the_same_of_what_it_has(name, seed, data):
    noun, everyone = NOUNS[name], np.arange(N)
    whole = noun.make(np.random.default_rng(seed))
    chosen = np.array(sorted(data.draw(st.sets(st.sampled_from(everyone.tolist()), min_size=1))))
    fewer = np.array(sorted(data.draw(st.sets(st.integers(0, len(chosen) - 1), min_size=1))))
    said, part = noun.say(whole, everyone), noun.part(whole, chosen)
    for one, members in (
        (noun.part(whole, everyone), everyone),
        (part, chosen),
        (noun.part(part, fewer), chosen[fewer]),
    ):
        kept = {m: among(value, members.tolist()) for m, value in said.items() if m in members}
        assert noun.say(one, members) == kept


def test_what_contradicts_stays_while_both_of_its_cameras_do_and_a_fixed_group_while_one_of_its_nodes_does():
    whole = measured(np.random.default_rng(0))
    for node in range(11):
        part, nodes = whole.part(np.flatnonzero((whole.graph.edges != node).all(axis=1)))
        assert part.graph.names == tuple(f"n{k}" for k in nodes)
        both = np.isin(whole.evidence.contradicting, nodes).all(axis=1)
        np.testing.assert_array_equal(nodes[part.evidence.contradicting], whole.evidence.contradicting[both])
        assert (part.fixed_group is not None) == bool({5, 6} & set(nodes.tolist()))
        assert part.num_points == np.sum(nodes >= 7)


def test_freedom_of_some_frames_is_found_again_among_all():
    own = Freedom(pull_rad=np.array([0.1, 0.7, 0.2]), doubt_rad=np.array([0.0, 0.0, 0.3]))
    found = own.among(np.array([4, 5, 9]), 10).of(np.array([5, 8, 9]), _NO_LENSES)
    assert found.pull_rad.tolist() == [0.7, 0.1, 0.2]
    assert found.doubt_rad.tolist() == [0.0, 0.0, 0.3]
    assert own.singled_out().tolist() == [False, True, True]
    for pull_rad in (0.0, np.inf, None, 0.1):
        one = Freedom(pull_rad=pull_rad)
        assert one.among(np.array([4, 5]), 10).of(np.array([5, 9]), _NO_LENSES).pull_rad == pull_rad
        assert one.holds_rotations == (pull_rad == 0.0)
