"""Covariances of the cameras at an adjustment's answer, points and lenses eliminated, in a stated gauge.

The reduced system S is the information of all nodes in units of noise_px^-2. Where a similarity is free
(`gauge`), S N = 0 on its motions N. K is S with as many diagonal entries raised as there are free motions, at
coordinates of two frames that tell these motions apart: regular, and as sparse as S. Then

    cov = noise_px^2 Z K^-1 Z^T,        Z = I - N (F^T N)^-1 F^T

is the covariance with F^T x = 0 (the S-transformation: Baarda 1973, "S-transformations and criterion
matrices"; Triggs et al. 2000, section 9). F are the centers' parts of N: the best similarity of the centers
to the true ones is the identity, as in the gauge of `adjust`. Frames that are known far worse than others
have no part in F: each would lend its own errors to all. Nor have those that stand far outside, if the others
are known better without them: by its lever, a single one decides turn and scale. Blocks of K^-1 are selected
entries; K^-1 F takes one solve for each of the at most seven motions.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.gauge import free_similarities, small_similarities
from sfm_shapefit.adjustment.layout import SLOTS, Layout, lay_out
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.reduced_factor import InvertedFactor, ReducedFactor, choose_factor
from sfm_shapefit.adjustment.schur import ReducedSystem, eliminate_points
from sfm_shapefit.adjustment.solve import linearize_all, values_of
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import INSIDE, distances_in_spreads
from sfm_shapefit.base.scipy_parts import dgeqp3
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.laplacian.selected import regauged
from sfm_shapefit.scene.lens import FOCAL_LENGTHS

# Shares added to the diagonal, tried in turn; what nothing holds becomes large, not singular.
_RIDGES = (0.0, 1e-12, 1e-10, 1e-8)
# Median sizes; a frame of larger standard deviation may not decide the gauge, and rounds in which such leave.
_LOOSE, _LOOSENING_ROUNDS = 5.0, 20
_COLLINEAR = 1e-10  # least eigenvalue of the centers' motions, relative to the largest; rounding leaves less


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameCovariances:
    """Covariances of frames and lenses, right observations having `noise_px` of independent noise."""

    centers: FloatArray
    """(n, 3, 3) in squared units of the world, world axes; 0 for fixed frames, NaN where no point is seen."""
    rotations: FloatArray
    """(n, 3, 3) in rad^2, axes of the camera (the rig); 0 also for held rotations."""
    deciding: BoolArray
    """(n,) frames relative to whose similarity these covariances are."""
    lens_sigmas: FloatArray
    """(l, 8) standard deviations of the values of each lens; 0 for what is held."""
    sensor_sigmas: FloatArray
    """(s, 6) standard deviations of the center of each free sensor, units of the world, and of its rotation,
    in rad, along axes of its rig; those of a baseline that keeps its length are along and across it."""


def estimate_covariances(
    problem: AdjustmentProblem,
    options: AdjustmentOptions | None = None,
    *,
    deciding: BoolArray | None = None,
    of_shape: bool = False,
    **overrides: Any,
) -> FrameCovariances:
    """Return the covariances of the frames at the minimum that a problem stands at.

    They are those of the linearized problem with the weights of the loss, and know of the noise of
    observations and of the priors only: not of wrong calibration, nor of noise that observations share.

    Args:
        problem: `Adjusted.problem`.
        options: as it was adjusted with.
        deciding: (n,) frames that decide the gauge; those that are not known far worse than most if None.
        of_shape: whether the scale is taken off too where something holds it, as offsets in rigs do.
        **overrides: single options by name.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity.
    """
    options = merge_options(options, AdjustmentOptions, overrides)
    system = ground_system(problem, options)
    if of_shape:
        system = system.without_scale(problem)
    blocks = system.factor.inverse_blocks()
    nodes = system.seen_nodes() if deciding is None else system.layout.node_of_frame[deciding]
    if system.free.size:
        moved_to = partial(regauged, blocks, system.factor.solve, system.motions)
        if deciding is None:
            nodes = system.steady_nodes(lambda dual: np.einsum("naa->n", moved_to(dual)[:, :3, :3]))
        blocks = moved_to(_dual(system.motions, nodes))
    blocks *= options.noise_px**2
    layout = system.layout
    return FrameCovariances(
        centers=system.by_frame(blocks[:, :3, :3]),
        rotations=system.by_frame(blocks[:, 3:, 3:]),
        deciding=np.isin(layout.node_of_frame, nodes),
        lens_sigmas=_by_lens(layout, blocks),
        sensor_sigmas=np.sqrt(np.einsum("saa->sa", blocks[layout.node_of_sensor])),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundedSystem:
    """The reduced system at a minimum, made regular and factored, and the motions that nothing holds."""

    layout: Layout
    factor: InvertedFactor
    inverses: FloatArray
    """(k, 6) inverses of the points' blocks, packed."""
    free: FloatArray
    """(7, f) basis of the small similarities that nothing holds."""
    motions: FloatArray
    """(N, 6, f) how these move the nodes."""
    unseen: BoolArray
    """(n,) frames that see no point."""
    far: BoolArray
    """(N,) whether a node is of a frame that stands far outside the others."""

    def solve(self, right: FloatArray, *, gauge: bool = True) -> FloatArray:
        """Return Z K^-1 of right sides (N, 6, r); K^-1 alone without the gauge."""
        moved = self.factor.solve(np.ascontiguousarray(right))
        if not (gauge and self.free.size):
            return moved
        moved_to = partial(self._regauge, moved)
        nodes = self.steady_nodes(lambda dual: np.sum(moved_to(dual)[:, :3] ** 2, axis=(1, 2)))
        return moved_to(_dual(self.motions, nodes))

    def _regauge(self, moved: FloatArray, dual: FloatArray) -> FloatArray:
        """Return moves (N, 6, r) less the motions that a dual reads off them."""
        return np.asarray(moved - self.motions @ np.einsum("nai,nar->ir", dual, moved))

    def without_scale(self, problem: AdjustmentProblem) -> "GroundedSystem":
        """Return the same with a gauge that takes off the scaling of the centers too, whatever holds it."""
        if self.free[-1].any():
            return self
        free = np.column_stack([self.free, np.eye(len(self.free))[:, -1]])
        return replace(self, free=free, motions=_motions(problem, self.layout, free, self.unseen))

    def seen_nodes(self) -> IntArray:
        """Return the nodes of frames that move and are seen."""
        nodes = self.layout.node_of_frame
        return np.asarray(nodes[(nodes >= 0) & ~self.unseen])

    def steady_nodes(self, variances_in: Callable[[FloatArray], FloatArray]) -> IntArray:
        """Return the nodes of frames that are not known far worse than most, in the gauge of themselves.

        Args:
            variances_in: returns the variance of each node, (N,), in the gauge that a dual reads off.
        """

        def sizes_of(own: IntArray, deciding: IntArray) -> FloatArray:
            return np.sqrt(np.maximum(variances_in(_dual(self.motions, deciding))[own], 0.0))

        nodes = self.seen_nodes()
        near = nodes[~self.far[nodes]]
        if 3 <= len(near) < len(nodes):
            with_far, without = (np.median(sizes_of(near, deciding)) for deciding in (nodes, near))
            nodes = near if without < with_far else nodes
        least = max(3, len(nodes) // 2)
        for _ in range(_LOOSENING_ROUNDS):
            sizes = sizes_of(nodes, nodes)
            steady = nodes[sizes <= _LOOSE * np.median(sizes)]
            if len(steady) == len(nodes) or len(steady) < least:
                break
            nodes = steady
        return nodes

    def by_frame(self, blocks: FloatArray) -> FloatArray:
        """Put blocks of the nodes (N, ...) in the places of their frames: 0 if fixed, NaN if unseen."""
        found = np.zeros((len(self.unseen), *blocks.shape[1:]))
        moves = self.layout.node_of_frame >= 0
        found[moves] = blocks[self.layout.node_of_frame[moves]]
        found[self.unseen] = np.nan
        return found


def ground_system(problem: AdjustmentProblem, options: AdjustmentOptions) -> GroundedSystem:
    """Return the reduced system at the minimum that a problem stands at, regular and factored.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity.
    """
    layout = lay_out(problem, options)
    workers = Workers(options.threads)
    normal = linearize_all(problem, layout, values_of(problem), options, workers)
    unseen = np.zeros(problem.num_frames, np.bool_)
    own = layout.node_of_frame >= 0
    unseen[own] = ~np.einsum("naa->na", normal.nodes)[layout.node_of_frame[own], :3].any(axis=1)
    system = eliminate_points(layout, normal, 0.0, workers)
    workers.close()
    free = free_similarities(problem, options)
    motions = _motions(problem, layout, free, unseen)
    far = np.zeros(layout.num_nodes, np.bool_)
    far[layout.node_of_frame[own]] = distances_in_spreads(problem.centers, problem.centers)[own] > INSIDE
    factor = choose_factor(layout, options)
    if free.size:
        _ground(system, motions, _two_nodes(problem, layout, unseen))
    _factor(factor, system)
    return GroundedSystem(
        layout=layout,
        factor=factor,
        inverses=system.inverses,
        free=free,
        motions=motions,
        unseen=unseen,
        far=far,
    )


def motions_read_by(system: GroundedSystem) -> FloatArray:
    """Return F (F^T N)^-1, (N, 6, f), of all frames that move and are seen."""
    return _dual(system.motions, system.seen_nodes())


def _motions(problem: AdjustmentProblem, layout: Layout, free: FloatArray, unseen: BoolArray) -> FloatArray:
    """Return N (N, 6, f) at the nodes; lenses do not take part, nor do frames that nothing sees."""
    moves = small_similarities(problem.rotations, problem.centers, problem.centers.mean(axis=0)) @ free
    motions = np.zeros((layout.num_nodes, SLOTS, free.shape[1]))
    taking = (layout.node_of_frame >= 0) & ~unseen
    motions[layout.node_of_frame[taking]] = moves[taking]
    return motions * layout.active[:, :, None]


def _two_nodes(problem: AdjustmentProblem, layout: Layout, unseen: BoolArray) -> IntArray:
    """Return the nodes of two frames that observations see: one in the middle, one well apart from it."""
    frames = np.flatnonzero((layout.node_of_frame >= 0) & ~unseen)
    arms = np.linalg.norm(problem.centers[frames] - np.median(problem.centers[frames], axis=0), axis=1)
    first = frames[np.argsort(arms, kind="stable")[: 1 + len(arms) // 2][-1:]]
    apart = np.linalg.norm(problem.centers[frames] - problem.centers[first], axis=1)
    second = frames[np.argsort(apart, kind="stable")[: 1 + (3 * len(apart)) // 4][-1:]]
    nodes: IntArray = layout.node_of_frame[np.concatenate([first, second])]
    return nodes


def _ground(system: ReducedSystem, motions: FloatArray, nodes: IntArray) -> None:
    """Double a diagonal entry of the given nodes for each motion, chosen to distinguish the motions."""
    count = motions.shape[2]
    seen_there = motions[nodes].reshape(-1, count)
    largest = np.abs(motions).max(axis=(0, 1))
    _, order, *_ = dgeqp3((seen_there / np.where(largest > 0.0, largest, 1.0)).T)  # it counts from 1
    rows, slots = np.divmod(order[:count] - 1, SLOTS)
    system.diagonal[nodes[rows], slots, slots] *= 2.0


def _factor(factor: ReducedFactor, system: ReducedSystem) -> None:
    """Factor the system, with the smallest ridge that lets it be factored."""
    entries = np.einsum("naa->na", system.diagonal)
    given = entries.copy()
    for ridge in _RIDGES:
        entries[:] = given * (1.0 + ridge)
        try:
            factor.refactor(system)
            return
        except UnsolvableError:
            if ridge == _RIDGES[-1]:
                raise


def _dual(motions: FloatArray, nodes: IntArray) -> FloatArray:
    """Return F (F^T N)^-1, (N, 6, f), which reads the motions off the centers of some nodes.

    UnsolvableError if these nodes do not tell the motions, as where all stand at one place.
    """
    dual, own = np.zeros_like(motions), motions[nodes]
    dual[nodes, :3] = own[:, :3]
    gram = np.einsum("nai,naj->ij", dual, motions)
    try:
        if np.linalg.eigvalsh(gram)[0] < _COLLINEAR * np.linalg.eigvalsh(gram)[-1]:
            turning = np.sum(own[:, 3:] ** 2)
            if turning == 0.0:  # rotations are held, and other frames stand far from these
                dual[nodes] = np.linalg.pinv(own.reshape(-1, own.shape[2]), 1e-15).T.reshape(own.shape)
                return dual
            dual[nodes, 3:] = own[:, 3:] * np.sum(own[:, :3] ** 2) / turning
            gram = np.einsum("nai,naj->ij", dual, motions)
        read: FloatArray = dual @ np.linalg.inv(gram)
    except np.linalg.LinAlgError:
        raise UnsolvableError("its cameras are not apart where the adjustment has them") from None
    return read


def focal_shares(problem: AdjustmentProblem, known: FrameCovariances) -> FloatArray:
    """Return the standard deviations (l,) of focal lengths as shares of them; 0 for what is held."""
    sigmas = known.lens_sigmas[:, FOCAL_LENGTHS]
    values = np.array([lens.values()[FOCAL_LENGTHS] for lens in problem.lenses])
    return np.asarray((sigmas / values).max(axis=1))


def _by_lens(layout: Layout, blocks: FloatArray) -> FloatArray:
    """Return the standard deviations of all parameters of all lenses from the blocks of their nodes."""
    sigmas = np.zeros(layout.lens_slots.shape)
    lens, value = np.nonzero(layout.lens_slots >= 0)
    slot = layout.lens_slots[lens, value]
    sigmas[lens, value] = np.sqrt(blocks[layout.node_of_lens[lens], slot, slot])
    return sigmas
