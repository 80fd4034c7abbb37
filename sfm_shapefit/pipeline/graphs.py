"""`solve GRAPH`: a bare view graph placed by the same steps as `locate`."""

from pathlib import Path

from sfm_shapefit.formats import read_graph
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.placement import place, place_further
from sfm_shapefit.results import GraphResult
from sfm_shapefit.robust.options import PlacementOptions


def solve_graph_file(path: Path | str, options: PlacementOptions | None = None) -> GraphResult:
    """Place the nodes of a bare view graph by the same steps as `locate`: pieces, solve, verdicts.

    Args:
        path: a text file, see `formats.read_graph`.
        options: settings; defaults if None.

    Raises:
        InputError: if the file is malformed; the message names the line.
        UnsolvableError: if the directions determine nothing.
    """
    options = options or PlacementOptions()
    clock = Clock()
    with clock("read"):
        graph = read_graph(path)
    with clock("solve"):
        placement = place(graph, options)
    with clock("further pieces"):
        further = tuple(place_further(placement, options))
    return GraphResult(
        path=Path(path), options=options, placement=placement, further=further, timings_s=clock.seconds
    )
