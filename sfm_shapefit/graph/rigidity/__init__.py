"""Parallel rigidity: which pairs move together, which nodes the directions determine.

A view graph is parallel rigid in dimension d if its directions fix the positions of its nodes up to one
translation and one scale. For positions in general position this depends on the graph alone
(Whiteley 1996, "Some matroids from discrete applied geometry", section 8; Ozyesil and Singer 2015,
arXiv 1412.0165): let every pair stand for d - 1 copies of an edge (a direction gives d - 1
equations). A set of copies is independent if every k >= 2 nodes span at most d k - (d + 1) of
them, and n nodes are rigid if d n - (d + 1) independent copies join them. So the verdict is exact
and blind to noise; whether a rigid graph is well conditioned is another question.

Maximal rigid sets ("pieces") partition the *pairs*; two pieces share at most one node, a hinge.
They are found by uniting rigid sets, at first the single pairs:

1. The three pairs of a triangle unite: 3 (d - 1) >= 3 d - (d + 1), for every d >= 2.
2. Two sets that share two nodes unite, and so do three sets that meet two by two in three
   different nodes (the triangle again). A set grows by both rules in time linear in what it touches.
3. What is left goes to the (d, d + 1) pebble game (Lee and Streinu 2008, "Pebble game algorithms
   and sparse graphs"), where each set is replaced by a frame on the nodes it shares with others.

Step 3 decides everything that is open, so steps 1 and 2 need not be exhaustive, only right. The game
is played on the first few shared nodes, then on twice as many, and so on until all take part: a
rigid set of a part is rigid in the whole, and contracting it early keeps the last games small.
"""

from sfm_shapefit.graph.rigidity.pieces import (
    RigidPiece,
    is_parallel_rigid,
    parallel_rigid_pieces,
    rigid_pieces,
    rigid_pieces_of_groups,
)
from sfm_shapefit.graph.rigidity.reasons import left_out_reasons

__all__ = [
    "RigidPiece",
    "is_parallel_rigid",
    "left_out_reasons",
    "parallel_rigid_pieces",
    "rigid_pieces",
    "rigid_pieces_of_groups",
]
