"""Which pairs an answer takes for right, and what is certain if they are.

A pair is taken for right if its posterior is above one half. If these pairs alone are parallel rigid, and the
program restricted to them is certified to have one optimum, nothing else enters: the answer is exact if their
directions are. If they are not rigid, some cameras stand where pairs taken for wrong, or nothing, hold them.
"""

from contextlib import suppress
from typing import Annotated

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.record import Record
from sfm_shapefit.graph.rigidity import rigid_pieces
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import Solve, SolverOptions, SolverResult


class TakenForRight(Record):
    """What is certain if the pairs that the answer takes for right are right."""

    statement: Annotated[str, "All of it in a sentence."]
    num_right: Annotated[int, "Pairs of the largest piece whose posterior in pairs.csv is above one half."]
    num_fixed: Annotated[int, "Nodes of the largest piece that these pairs alone make parallel rigid."]
    rigid: Annotated[bool, "Whether these are all nodes that are placed."]
    solve: Annotated[
        Solve | None, "The certified program restricted to these pairs; null where they are not rigid."
    ]
    edges: IntArray
    """Their edges in the graph, ascending."""
    solved: SolverResult | None
    """The certified program restricted to them; None where it leaves nodes out, or was not solved."""


@one_blas_thread()
def examine_right_pairs(placement: Placement, options: SolverOptions) -> TakenForRight:
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
    num_nodes, taken = len(placement.nodes), f"{len(right):,} of {len(edges):,} pairs are taken for right"
    return TakenForRight(
        statement=f"{taken}; they alone {_say_certain(num_fixed, num_nodes, solved)}",
        num_right=len(right),
        num_fixed=num_fixed,
        rigid=num_fixed == num_nodes,
        solve=None if solved is None else solved.facts,
        edges=right,
        solved=solved,
    )


def _say_certain(num_fixed: int, num_nodes: int, solved: SolverResult | None) -> str:
    if num_fixed < num_nodes:
        return f"fix {num_fixed:,} of {num_nodes:,} nodes, and too few of them hold the others"
    if solved is None:
        return "are parallel rigid"
    certified = f"is certified to {max(solved.gap, 0.0):.1e}, but not to have one optimum"
    if solved.converged and solved.unique is True:
        certified = f"has one optimum, certified to {max(solved.gap, 0.0):.1e}: exact if their directions are"
    return f"are parallel rigid, and the program restricted to them {certified}"
