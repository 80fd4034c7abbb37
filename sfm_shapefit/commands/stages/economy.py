"""What a run will take, known once its graph is; and the graph that fits into the memory allowed."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.commands.stages.inputs import MatchSource
from sfm_shapefit.commands.stages.measure import samples_errors, without_points
from sfm_shapefit.commands.stages.memory import Workload, choose_economy
from sfm_shapefit.directions.pair_directions import PairDirections
from sfm_shapefit.directions.tracks import JointGraph
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.ordering import best_order
from sfm_shapefit.laplacian.symbolic import plan_factorisation
from sfm_shapefit.options import LocateOptions
from sfm_shapefit.solver.splitting.linear import predict_factor
from sfm_shapefit.viewgraph import ViewGraph


def known_workload(
    source: MatchSource, directions: PairDirections, joint: JointGraph, options: LocateOptions
) -> Workload:
    """Return what there is to do once the graph is known: its factor is planned, nothing is solved."""
    entries, flops = _factor(joint.graph, options.factor_memory_mb * 1_000_000)
    return replace(
        source.workload(),
        num_pairs=len(directions.pairs),
        num_matches=int(directions.num_matches.sum()),
        num_edges=joint.graph.num_edges,
        num_nodes=joint.graph.num_nodes,
        num_sampled=joint.graph.num_edges if samples_errors(source, directions) else 0,
        has_points=joint.num_points > 0,
        factor_entries=entries,
        factor_flops=flops,
    )


def within_memory(
    source: MatchSource, directions: PairDirections, joint: JointGraph, options: LocateOptions
) -> tuple[MatchSource, JointGraph, LocateOptions]:
    """Return the three as they stay below `options.max_memory_mb`; as they are, if that is no limit.

    Raises:
        InputError: with the number needed, if there is no way.
    """
    if not options.max_memory_mb:
        return source, joint, options
    economy = choose_economy(known_workload(source, directions, joint, options), options.max_memory_mb)
    if not economy.points:
        joint = without_points(joint)
    if not economy.factor:
        options = replace(options, factor_memory_mb=1)
    return replace(source, economy=economy), joint, options


def _factor(graph: ViewGraph, max_bytes: int) -> tuple[int, float]:
    """Return the blocks of a graph's factor with its stack, and its flops; 0 where it would be too large."""
    if graph.num_edges == 0 or predict_factor(graph).tree is None:
        return 0, 0.0
    neighbours = adjacency(graph.num_nodes, np.ascontiguousarray(graph.edges))
    plan = plan_factorisation(neighbours, np.ascontiguousarray(graph.edges), best_order(neighbours))
    if plan.num_bytes(graph.dimension, np.float64) > max_bytes:
        return 0, 0.0
    return plan.num_bytes(1, np.uint8), plan.flops
