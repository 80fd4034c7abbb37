"""Why cameras are outside the largest rigid piece, in words."""

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.graph.rigidity.pieces import RigidPiece
from sfm_shapefit.graph.viewgraph import ViewGraph


def left_out_reasons(graph: ViewGraph, pieces: list[RigidPiece]) -> dict[int, str]:
    """Return why each camera outside the largest of the `rigid_pieces` is not determined with it, by index.

    One of: "no pair"; "another component"; "pendant: joined by a single pair to NAME"; "another rigid piece,
    hinged at NAME, ..."; "not rigidly tied to the largest piece". Hinges shared with the largest piece are
    named if there are any, else all hinges of the camera's piece. Without names in the graph, NAME is "camera
    K".
    """
    placed = np.zeros(graph.num_nodes, dtype=np.bool_)
    if pieces:
        placed[pieces[0].nodes] = True
    degree, component = graph.degrees(), graph.components()
    main = component[pieces[0].nodes[0]] if pieces else -1
    neighbor = np.empty(graph.num_nodes, dtype=np.int64)  # the only one, where there is one
    neighbor[graph.edges.T] = graph.edges[:, ::-1].T
    home = _large_piece_of(graph.num_nodes, pieces)

    reasons: dict[int, str] = {}
    for camera in np.flatnonzero(~placed).tolist():
        if degree[camera] == 0:
            reasons[camera] = "no pair"
        elif component[camera] != main:
            reasons[camera] = "another component"
        elif degree[camera] == 1:
            reasons[camera] = f"pendant: joined by a single pair to {_name(graph, int(neighbor[camera]))}"
        else:
            hinges = _hinges_of(camera, int(home[camera]), pieces, placed)
            reasons[camera] = "not rigidly tied to the largest piece"
            if hinges:
                names = ", ".join(_name(graph, hinge) for hinge in hinges)
                reasons[camera] = f"another rigid piece, hinged at {names}"
    return reasons


def _large_piece_of(num_nodes: int, pieces: list[RigidPiece]) -> IntArray:
    """Return the first piece of at least 3 cameras that holds each camera (n,), or -1."""
    home = np.full(num_nodes, -1, dtype=np.int64)
    for k in reversed(range(len(pieces))):
        if len(pieces[k].nodes) >= 3:
            home[pieces[k].nodes] = k
    return home


def _hinges_of(camera: int, home: int, pieces: list[RigidPiece], placed: BoolArray) -> list[int]:
    """Return the hinges to name for a camera of piece `home`: the placed ones if any, never itself."""
    if home < 0:
        return []
    hinges = pieces[home].hinges
    to_largest = hinges[placed[hinges]]
    return [int(h) for h in (to_largest if len(to_largest) else hinges) if h != camera]


def _name(graph: ViewGraph, camera: int) -> str:
    return graph.name_of(camera) if graph.names else f"camera {camera}"
