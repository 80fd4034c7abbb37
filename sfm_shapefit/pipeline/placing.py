"""Place cameras: 3D points and tracks take part where they hold what pairs do not."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from sfm_shapefit.base.arrays import hand_back_memory
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.judgement.measured_pairs import MeasuredPairs
from sfm_shapefit.judgement.verdicts import Hold, find_hold
from sfm_shapefit.pipeline.measure import add_evidence, build_graph
from sfm_shapefit.placement.fixed_and_rigged import FixedAndRigged
from sfm_shapefit.placement.place import Placement, place_pieces
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.refinement.starts import RefinedPlacement
from sfm_shapefit.scene.images import Images
from sfm_shapefit.solver.solver_options import reported
from sfm_shapefit.solver.splitting.linear import ONE_THREAD, Resources
from sfm_shapefit.tracks.structure_options import NodeOptions

_FITTING = 0.95  # share of pairs that agree with a placement; from here on no other is tried
_MOST_TRIED = 5_000  # nodes; more take seconds


def place_cameras(
    measured: MeasuredGraph,
    options: PlacementOptions,
    nodes: NodeOptions,
    clock: Clock,
    near: RefinedPlacement | None = None,
    *,
    certified: bool = True,
) -> Iterator[Placement]:
    """Place the rigid pieces of a graph; with offsets in groups, 3D points take part only if they are needed.

    Offsets do what 3D points do otherwise, and rays to far points let the convex starts collapse. So points
    take part with groups only if they are wanted always, or if cameras hang loose without them.
    """
    hand_back_memory()  # what the graph was made of is gone
    placed = partial(
        place_pieces, options=options, near=near, certified=certified, on_iteration=reported(clock.advance)
    )
    if not measured.has_scale or not measured.num_points or nodes.points == "always":
        yield from placed(measured)
        return
    first = second = None
    with suppress(UnsolvableError):
        first = next(placed(measured.without_points()))
    if first is None:
        yield next(placed(measured))
        return
    held = _count_held(first, options)
    if held < len(first.cameras):
        with suppress(UnsolvableError):
            second = next(placed(measured))
    yield first if second is None or _count_held(second, options) <= held else second


def may_be_checked(measured: MeasuredGraph) -> bool:
    """Return whether a graph with points may be placed by checked tracks too; large ones take time."""
    return measured.num_points > 0 and measured.graph.num_nodes <= _MOST_TRIED


class PlacingSetup(NamedTuple):
    """How the graphs of images are placed."""

    images: Images
    options: PlacementOptions
    nodes: NodeOptions
    clock: Clock
    near: RefinedPlacement | None = None

    def place(self, graph: MeasuredGraph, *, certified: bool = True) -> Iterator[Placement]:
        """Place the rigid pieces of a graph, see `place_cameras`."""
        return place_cameras(graph, self.options, self.nodes, self.clock, self.near, certified=certified)


def place_measured(setup: PlacingSetup, graph: MeasuredGraph, measured: MeasuredPairs) -> list[Placement]:
    """Return the pieces of a graph, or of that with checked points where more pairs agree with these.

    Samples of the errors of directions, which are large, are taken out of what was measured.
    """
    if measured.tracks is None:
        return list(setup.place(add_evidence(graph, measured)))
    copied = measured if measured.errors is None else replace(measured, errors=list(measured.errors))
    pieces = list(setup.place(add_evidence(graph, copied)))
    better = _place_by_checked(setup, pieces[0], measured)
    return pieces if better is None else list(setup.place(add_evidence(better[0], measured)))


def place_first(setup: PlacingSetup, rigid: FixedAndRigged, measured: MeasuredPairs) -> Placement:
    """Return the largest piece of what was measured, by locations that are only a start."""
    graph = rigid.apply(build_graph(setup.images, measured, setup.nodes))
    placement = next(setup.place(graph, certified=False))
    if measured.checks and may_be_checked(graph):
        better = _place_by_checked(setup, placement, measured)
        placement = placement if better is None else better[1]
    return placement


def _place_by_checked(
    setup: PlacingSetup, usual: Placement, measured: MeasuredPairs
) -> tuple[MeasuredGraph, Placement] | None:
    """Return the graph with the points of checked tracks, and its placement, if more pairs agree with that.

    It is tried only where the usual placement leaves pairs over: few pairs need the points of all tracks.
    """
    if _count_agreeing(usual) >= _FITTING * usual.num_pairs:
        return None
    graph = build_graph(setup.images, measured, setup.nodes, checked=True)
    with suppress(UnsolvableError):
        other = next(setup.place(graph, certified=False))
        if _count_agreeing(other) > _count_agreeing(usual):
            return graph, other
    return None


def _count_agreeing(placement: Placement) -> int:
    return int(placement.agreement.agrees[placement.pairs].sum())


def _count_held(placement: Placement, options: PlacementOptions) -> int:
    """Return how many of the placed cameras do not hang loose.

    Whether the agreeing pairs tie them is not enough: in the park of fisheyes (kerry-park) they do, and hold
    18 of 48 cameras so loosely that points are needed.
    """
    return measure_hold(placement, Resources.of(options.solver)).conditioning.causes.count(None)


@one_blas_thread()  # as `judge`, which asks the same where the cameras stay
def measure_hold(placement: Placement, resources: Resources = ONE_THREAD) -> Hold:
    """Return how well the agreeing pairs hold the placed cameras."""
    hand_back_memory()  # what the solve took
    part, refined = placement.measured_part(), placement.refined
    return find_hold(part, refined.locations, placement.agreement, refined.reset_nodes, resources)
