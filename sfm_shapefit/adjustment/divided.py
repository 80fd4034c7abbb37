"""An adjustment whose points are divided among parts, each laid out by itself: here, or by a cluster.

A point is eliminated from the observations of its own alone. So with a part b of the points each, the system
of the nodes is a sum,

    S = sum_b S_b,    S_b = (1 + mu) U_b - sum_{p in b} W_p^T V_p^-1 W_p,

and whoever has the observations of a part can tell S_b, over the nodes that see it. Points belong to the part
of their first camera; the frames are halved by their centers until a part has few. Into how many follows from
the number of frames, and parts are added in their order. So the answer is the same to the bit, whoever makes
which part, here or elsewhere, and however often. From that of the whole it differs by the rounding of sums.

A part is a function of the problem at the start, and its equations are one of the part and of where all
stands. What a worker loses is made again by another one. The blocks of a point's entries, most of the memory
of an adjustment, are made for each step twice, and never kept.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.layout import SLOTS, Layout, Nodes, lay_out, number_nodes
from sfm_shapefit.adjustment.lone_points import settle_points
from sfm_shapefit.adjustment.priors import add_priors
from sfm_shapefit.adjustment.problem import AdjustmentProblem, Rig
from sfm_shapefit.adjustment.residuals import NormalEquations, Values, linearize
from sfm_shapefit.adjustment.schur import ReducedSystem, eliminate_points, invert_points, step_points
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IndexArray, IntArray, distinct
from sfm_shapefit.base.executors import Crew
from sfm_shapefit.laplacian.operators import Workers, group_by

_FRAMES_OF_A_PART = 250  # frames; a part has some hundred thousand observations, sent once: a few MB


class Pass(NamedTuple):
    """How a part is linearized."""

    loss_scale_px: float | None
    least_curvature: float
    """See `linearize`."""
    damping: float
    threads: int


class _Share(NamedTuple):
    """What of the whole a part has, ascending each: points, frames, cameras, lenses, and nodes."""

    points: IntArray
    frames: IntArray
    cameras: IndexArray
    lenses: IntArray
    nodes: IntArray

    def of(self, values: Values) -> Values:
        return Values(
            rotations=values.rotations[self.frames],
            centers=values.centers[self.frames],
            points=values.points[self.points],
            lenses=values.lenses[self.lenses],
            sensor_rotations=values.sensor_rotations[self.cameras],
            sensor_translations=values.sensor_translations[self.cameras],
        )


@dataclass(slots=True, kw_only=True, eq=False)
class Equations:
    """The normal equations of a part or of all, points eliminated; gradients, not right-hand sides."""

    diagonal: FloatArray
    """(N, 6, 6) blocks of S."""
    pairs: FloatArray
    """(P, 6, 6) blocks of S."""
    right: FloatArray
    """(N, 6) right-hand side of S."""
    curvatures: FloatArray
    """(N, 6) diagonal of U, without damping."""
    gradients: FloatArray
    """(N, 6)"""
    largest: float
    """Largest square of a point's gradient over its curvature, see `solve`."""

    def add(self, part: "Equations", nodes: IntArray, pairs: IntArray) -> None:
        """Add a part that has so numbered nodes and pairs."""
        for whole, own, rows in (
            (self.diagonal, part.diagonal, nodes),
            (self.pairs, part.pairs, pairs),
            (self.right, part.right, nodes),
            (self.curvatures, part.curvatures, nodes),
            (self.gradients, part.gradients, nodes),
        ):
            whole[rows] += own
        self.largest = max(self.largest, part.largest)

    def system(self, active: BoolArray) -> ReducedSystem:
        """Return the system, unknowns (N, 6) held that are not active, or on which nothing depends."""
        np.einsum("naa->na", self.diagonal)[(self.curvatures == 0.0) | ~active] += 1.0
        return ReducedSystem(
            diagonal=self.diagonal, pairs=self.pairs, right=self.right, inverses=np.empty((0, 6))
        )


class Stepped(NamedTuple):
    """A part after a step of the nodes and of its points."""

    points: FloatArray
    """(k, 3)"""
    cost: float
    """px^2"""
    predicted: FloatArray
    """(2,) sums over points: curvature by the square of the step, and gradient by the step."""


class Parts:
    """The observations of an adjustment, divided among parts that a crew has."""

    def __init__(self, problem: AdjustmentProblem, options: AdjustmentOptions, crew: Crew) -> None:
        """Divide the points and lay out each part."""
        self._crew, nodes = crew, number_nodes(problem, options)
        self._problem, self._noise_px = problem, options.noise_px
        self._shares, self._parts = list[_Share](), list[Any]()
        how = replace(options, threads=crew.threads_of_task)
        for share, part, numbers in _divide(problem, nodes):  # one at a time, for memory
            self._shares.append(share)
            self._parts += crew.keep(lay_out, [part], [how], [numbers])
        self.layout, self._rows = self._join(problem, options, nodes)

    def _join(
        self, problem: AdjustmentProblem, options: AdjustmentOptions, nodes: Nodes
    ) -> tuple[Layout, list[IntArray]]:
        """Return the layout of the nodes, without any point, and where each part's pairs stand in it."""
        count = len(nodes.active)
        found = zip(self._crew.stream(_pairs_of, self._parts), self._shares, strict=True)
        keys = [share.nodes[pairs] @ np.array([count, 1]) for pairs, share in found]
        every = distinct(np.concatenate(keys))
        none = np.zeros(problem.num_points, dtype=np.bool_)
        bare = lay_out(problem.of_points(none), options, nodes)
        pairs = np.stack(np.divmod(every, count), axis=1)
        first = np.searchsorted(pairs[:, 0], np.arange(count + 1))
        return replace(bare, pairs=pairs, first_pair=first), [np.searchsorted(every, own) for own in keys]

    def linearize(self, values: Values, how: Pass) -> Equations:
        """Return the equations of all observations, damped."""
        size, num_pairs = self.layout.num_nodes, len(self.layout.pairs)
        total = Equations(
            diagonal=np.zeros((size, SLOTS, SLOTS)),
            pairs=np.zeros((num_pairs, SLOTS, SLOTS)),
            right=np.zeros((size, SLOTS)),
            curvatures=np.zeros((size, SLOTS)),
            gradients=np.zeros((size, SLOTS)),
            largest=0.0,
        )
        own, same = (share.of(values) for share in self._shares), [how] * len(self._shares)
        parts = self._crew.stream(_linearize_part, self._parts, own, same)
        for part, share, rows in zip(parts, self._shares, self._rows, strict=True):
            total.add(part, share.nodes, rows)
        normal = NormalEquations(
            nodes=np.zeros_like(total.diagonal),
            node_gradients=np.zeros_like(total.right),
            **dict.fromkeys(("links", "points", "point_gradients", "entries"), np.empty(0)),
        )
        add_priors(self._problem, self.layout, values, self._noise_px, normal)
        diagonal = np.einsum("naa->na", normal.nodes)
        total.curvatures += diagonal
        diagonal *= 1.0 + how.damping
        total.diagonal += normal.nodes
        total.gradients += normal.node_gradients
        total.right -= normal.node_gradients
        return total

    def step(
        self, before: Values, after: Values, steps: FloatArray, how: Pass, settling: int
    ) -> tuple[FloatArray, float, FloatArray]:
        """Return points (k, 3) after a step, their cost, and the sums of what they should gain.

        Args:
            before: where equations were made, as `how` says.
            after: where the step of the nodes (N, 6) leads, but for the points.
            steps: that.
            how: as of `linearize`.
            settling: steps of each point by itself then.
        """
        shares, points, cost, predicted = self._shares, before.points.copy(), 0.0, np.zeros(2)
        found = self._crew.stream(
            _step_part,
            self._parts,
            (share.of(before) for share in shares),
            (share.of(after) for share in shares),
            (steps[share.nodes] for share in shares),
            [how] * len(shares),
            [settling] * len(shares),
        )
        for part, share in zip(found, shares, strict=True):
            points[share.points] = part.points
            cost, predicted = cost + part.cost, predicted + part.predicted
        return points, cost, predicted

    def settle(self, values: Values, how: Pass, steps: int) -> tuple[FloatArray, float]:
        """Return points (k, 3) after some steps of each by itself, and their cost; see `settle_points`."""
        points, cost, count = values.points.copy(), 0.0, len(self._shares)
        own = (share.of(values) for share in self._shares)
        found = self._crew.stream(_settle_part, self._parts, own, [how] * count, [steps] * count)
        for (moved, part_cost), share in zip(found, self._shares, strict=True):
            points[share.points] = moved
            cost += part_cost
        return points, cost


def _divide(problem: AdjustmentProblem, nodes: Nodes) -> Iterator[tuple[_Share, AdjustmentProblem, Nodes]]:
    """Yield each part that sees anything: what of the whole it has, its problem, and its nodes."""
    count = -(-problem.num_frames // _FRAMES_OF_A_PART)
    part_of_frame, seen = _halve(problem.centers, count), problem.points_seen
    first = np.full(problem.num_points, problem.num_cameras)
    np.minimum.at(first, seen, problem.cameras_seeing)
    part_of_frame = np.append(part_of_frame, 0)  # what nobody sees is the first one's
    part_of_point = part_of_frame[np.append(problem.rig.frame_of_camera, problem.num_frames)[first]]
    place = np.empty(problem.num_points, dtype=np.int64)
    (first_point, points), (begins, rows) = (
        group_by(of, count) for of in (part_of_point, part_of_point[seen])
    )
    for k in range(count):
        own, observed = points[first_point[k] : first_point[k + 1]], rows[begins[k] : begins[k + 1]]
        if len(observed):
            place[own] = np.arange(len(own))
            yield _part_of(problem, nodes, own, observed, place)


def _part_of(
    problem: AdjustmentProblem, nodes: Nodes, points: IntArray, observed: IntArray, place: IntArray
) -> tuple[_Share, AdjustmentProblem, Nodes]:
    """Return a part of a problem by its points and observations; `place` has each point's place in it."""
    rig = problem.rig
    cameras, camera_of = np.unique(problem.cameras_seeing[observed], return_inverse=True)
    frames, frame_of = np.unique(rig.frame_of_camera[cameras], return_inverse=True)
    lenses, lens_of = np.unique(problem.lens_of_camera[cameras], return_inverse=True)
    sensors = rig.free_sensor_of_camera[cameras]
    of_frame, of_lens = nodes.node_of_frame[frames], nodes.node_of_lens[lenses]
    seeing = distinct(np.concatenate([of_frame, of_lens, nodes.node_of_sensor[sensors[sensors >= 0]]]))
    seeing = seeing[seeing >= 0]
    number = np.full(len(nodes.active) + 1, -1)  # the last of which is that of none
    number[seeing] = np.arange(len(seeing))
    own = replace(
        problem,
        rotations=problem.rotations[frames],
        centers=problem.centers[frames],
        points=problem.points[points],
        cameras_seeing=camera_of,
        points_seen=place[problem.points_seen[observed]],
        pixels=problem.pixels[observed],
        lenses=[problem.lenses[k] for k in lenses.tolist()],
        lens_of_camera=lens_of,
        rig=Rig(
            frame_of_camera=frame_of,
            rotations=rig.rotations[cameras],
            translations=rig.translations[cameras],
            free_sensor_of_camera=sensors,
        ),
        fixed=problem.fixed[frames],
        rotation_prior=None,
        center_prior=None,
        lens_prior=None,
    )
    numbers = nodes._replace(
        node_of_frame=number[of_frame],
        node_of_lens=number[of_lens],
        node_of_sensor=number[nodes.node_of_sensor],
        active=nodes.active[seeing],
        lens_slots=nodes.lens_slots[lenses],
    )
    return _Share(points, frames, cameras, lenses, seeing), own, numbers


def _halve(centers: FloatArray, count: int) -> IntArray:
    """Return the part of each frame (n,), of so many: halves along the longest axis, and halves of these."""
    parts, waiting = np.empty(len(centers), dtype=np.int64), [(np.arange(len(centers)), 0, count)]
    while waiting:
        rows, first, number = waiting.pop()
        if number == 1:
            parts[rows] = first
            continue
        axis = int(np.argmax(np.ptp(centers[rows], axis=0)))
        order, below = rows[np.argsort(centers[rows, axis], kind="stable")], number // 2
        cut = len(rows) * below // number
        waiting += [(order[:cut], first, below), (order[cut:], first + below, number - below)]
    return parts


def _pairs_of(part: Layout) -> IntArray:
    return part.pairs


def _linearize_part(part: Layout, values: Values, how: Pass) -> Equations:
    workers = Workers(how.threads)
    normal = linearize(part, values, how.loss_scale_px, workers, how.least_curvature)
    system = eliminate_points(part, normal, how.damping, workers)
    workers.close()
    curvatures = np.einsum("naa->na", normal.nodes)
    np.einsum("naa->na", system.diagonal)[(curvatures == 0.0) | ~part.active] -= 1.0  # see `system`
    return Equations(
        diagonal=system.diagonal,
        pairs=system.pairs,
        right=system.right,
        curvatures=curvatures,
        gradients=normal.node_gradients,
        largest=largest_share(normal.points[:, [0, 3, 5]], normal.point_gradients),
    )


def _step_part(
    part: Layout, before: Values, after: Values, steps: FloatArray, how: Pass, settling: int
) -> Stepped:
    workers = Workers(how.threads)
    normal = linearize(part, before, how.loss_scale_px, workers, how.least_curvature)
    moves = step_points(part, normal, invert_points(normal, how.damping), steps, workers)
    diagonal = normal.points[:, [0, 3, 5]]
    predicted = np.array([np.sum(diagonal * moves**2), np.sum(normal.point_gradients * moves)])
    del normal
    moved = replace(after, points=before.points + moves)
    points, cost = settle_points(part, moved, how.loss_scale_px, workers, settling)
    workers.close()
    return Stepped(points, cost, predicted)


def _settle_part(part: Layout, values: Values, how: Pass, steps: int) -> tuple[FloatArray, float]:
    workers = Workers(how.threads)
    found = settle_points(part, values, how.loss_scale_px, workers, steps)
    workers.close()
    return found


def largest_share(diagonal: FloatArray, gradients: FloatArray) -> float:
    """Return the largest square of a gradient over its curvature."""
    squares = np.divide(gradients**2, diagonal, out=np.zeros_like(gradients), where=diagonal > 0.0)
    return float(squares.max(initial=0.0))
