"""Which pairs an answer takes for right, and what is certain if they are.

A pair is taken for right if its posterior is above one half. If these pairs alone are parallel rigid, and the
program restricted to them is certified to have one optimum, nothing else enters: the answer is exact if their
directions are. If they are not rigid, some cameras stand where pairs taken for wrong, or nothing, hold them.
"""

from contextlib import suppress
from dataclasses import dataclass

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.rigidity import rigid_pieces
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import SolverOptions, SolverResult


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RightPairs:
    """The pairs that a placement takes for right, and the program restricted to them."""

    edges: IntArray
    """Their edges in the graph, ascending."""
    num_pairs: int
    """Pairs of the piece, right or wrong."""
    num_nodes: int
    """Nodes of the piece."""
    num_fixed: int
    """Nodes of the largest piece that these pairs alone make parallel rigid."""
    solved: SolverResult | None
    """The certified program restricted to them; None where it leaves nodes out, or was not solved."""

    @property
    def is_rigid(self) -> bool:
        """Whether these pairs alone are parallel rigid on all nodes."""
        return self.num_fixed == self.num_nodes

    @property
    def is_certain(self) -> bool:
        """Whether the restricted program is certified, with one optimum."""
        return self.solved is not None and self.solved.converged and self.solved.unique is True

    def statement(self) -> str:
        """Say what is certain, in a sentence."""
        taken = f"{len(self.edges):,} of {self.num_pairs:,} pairs are taken for right"
        if not self.is_rigid:
            return (
                f"{taken}; they alone fix {self.num_fixed:,} of {self.num_nodes:,} nodes, and "
                "too few of them hold the others"
            )
        if self.solved is None:
            return f"{taken}; they alone are parallel rigid"
        gap = f"{max(self.solved.gap, 0.0):.1e}"
        if self.is_certain:
            certified = f"has one optimum, certified to {gap}: exact if their directions are"
        else:
            certified = f"is certified to {gap}, but not to have one optimum"
        return f"{taken}; they alone are parallel rigid, and the program restricted to them {certified}"


@one_blas_thread()
def examine_right_pairs(placement: Placement, options: SolverOptions) -> RightPairs:
    """Return the pairs that a placement of free nodes takes for right, and the program on them alone.

    It is solved where the answer comes from other weights. Elsewhere the program of all pairs has its
    certificate, and a second solve would take as long as the first.
    """
    assert placement.groups is None
    edges, posterior = placement.edges, placement.refined.posterior
    right = edges[posterior > 0.5]
    graph, _ = placement.graph.restricted_to(right)
    num_fixed = max((len(piece.nodes) for piece in rigid_pieces(graph)), default=0)
    solved = None
    if num_fixed == len(placement.nodes):
        if len(right) == len(edges):
            solved = placement.certified
        elif placement.refined.reweighted is not None:
            with suppress(UnsolvableError):  # directions that cancel, or a factor too large
                solved = solve(graph, options)
    return RightPairs(
        edges=right,
        num_pairs=len(edges),
        num_nodes=len(placement.nodes),
        num_fixed=num_fixed,
        solved=solved,
    )
