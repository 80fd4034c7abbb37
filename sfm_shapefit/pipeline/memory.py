"""How much memory `locate` and `map` take, told beforehand, and what is given up to stay below a limit.

The peak is that of the worst stage, for memory is handed back between stages. Every stage is linear in what
it works on: keypoints, matches, pairs, edges of the graph, and entries of the factor, which the symbolic
analysis knows beforehand. The bytes per item below were fitted to runs on seven sets of 25 to 10,000 images:
forecasts are 1.02 to 1.2 times the peaks, with a limit of 1,500 MB at 10,000 images, too.

The limit is looked at before anything is solved: with the counts of the database, for `map` with those of the
largest group that its pairs tie, and once the graph is known. What can be given up is listed in
`MEMORY_PLANS`, the cheapest first; the first that fits is taken.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.adjustment.run import FINE_TIMES, MOST_FRAMES, MOST_WHOLE
from sfm_shapefit.adjustment.solve import MANY_ENTRIES
from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.facts.command_options import InspectOptions, PlacingOptions
from sfm_shapefit.files.colmap.database import MOST_KEYPOINTS, PIXEL_BYTES
from sfm_shapefit.files.colmap.sorted_matches import MATCH_BYTES, MOST_MATCHES
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.laplacian.factor import analyze
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import are_sampled
from sfm_shapefit.placement.memory_plan import MEMORY_PLANS, MemoryPlan
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.scene.matches import KEPT_MATCHES, MOST_BESIDE_TRACKS
from sfm_shapefit.solver.solve import choose_method, plan_factor
from sfm_shapefit.tracks.thin_tracks import wanted_observations

if TYPE_CHECKING:
    from sfm_shapefit.facts.inspected import Forecast

_MB = 1e6  # bytes; as users count them
_STARTED_BYTES = 195e6  # bytes; the interpreter with all that `locate` imports
_KERNELS_BYTES = 50e6  # bytes; compiled code, thread pools, pages of the database
_READ_BYTES, _MODEL_BYTES, _COLOR_BYTES = 75.0, 55.0, 8.0
"""Bytes of a keypoint of the input: while it is read, afterwards, and once only its point's color is left."""
_SAMPLES = 96  # samples of each direction's error; two numbers each, see `judgement.correlated_errors`
_BLOCK = 9  # entries of a block of the factor; three coordinates by three
_OBSERVATIONS_OF_A_MATCH = 0.7  # observations for a match, if keypoints are more; .45 to .66 measured
_OBSERVATION_BYTES = 420.0  # bytes of an observation; its track, and its part of the normal equations
_DIVIDED_BYTES = 270.0  # the same where adjustments are divided: a part has normal equations at a time
_KEPT_BYTES, _ENTRY_BYTES = 75.0, 150.0
"""Bytes of an observation of few tracks, laid out; and of its equations beside."""
_OVERSHOT = 1.2  # observations of few tracks for each that an image wants; 1.13 measured
_THIN_PAIRS, _THIN_FACTOR = 1.9, 1.9
"""Pairs of cameras that meet in few tracks, for each of the graph; blocks of their factor, likewise."""
_ITERATIVE_BYTES = 40e3  # bytes of a camera; the factors of its blocks and of the coarse system
_AVERAGED_BLOCKS, _AVERAGED_FACTORS = 10.0, 1.2
"""Blocks that averaging holds for each pair; for each block of the factor too, with its update matrices."""
_UNKNOWNS, _DENSE_UNKNOWNS = 6, 3000  # unknowns of an adjusted camera; up to as many, their system is dense


@dataclass(frozen=True, slots=True, kw_only=True)
class Workload:
    """What a run has to work on."""

    num_images: int
    num_keypoints: int
    """Keypoints of all images."""
    num_pairs: int
    num_matches: int
    num_edges: int
    """Directions that are solved, those from cameras to points included."""
    num_nodes: int
    """Cameras and points that are solved."""
    num_sampled: int = 0
    """Directions whose errors are sampled; 0 where they count as independent."""
    has_points: bool = False
    """Whether 3D points join the graph."""
    factor_entries: int = 0
    """Blocks of the factor, its stack included; 0 where there is none."""
    adjusts: bool = False
    """Whether placed cameras are adjusted by their matches."""
    averages: bool = False
    """Whether rotations are averaged, and a first placement by them is adjusted on few tracks."""
    adjusts_bundle: bool = False
    """Whether the seed goes through bundle adjustment, which cannot be given up."""
    needs_factor: bool = False
    """Whether the factor cannot be given up, since the solve itself works with it."""


def forecast(work: Workload, plan: MemoryPlan = MEMORY_PLANS[0]) -> "Forecast":
    """Return what a run will take, if so much is given up for memory."""
    from sfm_shapefit.facts.inspected import Forecast  # here: few runs have a limit

    memory_mb = {stage: size / _MB for stage, size in _peaks(work, plan).items()}
    return Forecast(memory_mb=memory_mb, peak_mb=max(memory_mb.values()))


def choose_memory_plan(
    work: Workload, without_points: Workload, limit_mb: float, least: MemoryPlan = MEMORY_PLANS[0]
) -> MemoryPlan:
    """Return the cheapest plan, from `least` on, whose forecast stays below a limit.

    Raises:
        InputError: if none does; the message has the number needed.
    """
    needed = np.inf
    for plan in MEMORY_PLANS[MEMORY_PLANS.index(least) :]:
        needed = forecast(work if plan.points else without_points, plan).peak_mb
        if needed <= limit_mb:
            return plan
    raise InputError(
        f"this takes about {needed:.0f} MB even with every economy, more than max_memory_mb={limit_mb:.0f}; "
        f"raise it to {np.ceil(needed / 10.0) * 10.0:.0f} or more, or split the model"
    )


def keep_within_memory(
    measured: MeasuredGraph, work: Workload, options: PlacingOptions, least: MemoryPlan
) -> tuple[MemoryPlan, MeasuredGraph]:
    """Return what is given up, `least` or more, to stay below the limit of memory, and the graph then.

    `work` is all of it but for the graph.
    """
    if not options.memory.max_memory_mb:
        return least, measured
    bare = measured.without_points()
    full, less = (describe_work(graph, work, options.placement) for graph in (measured, bare))
    plan = choose_memory_plan(full, less, options.memory.max_memory_mb, least)
    return plan, measured if plan.points else bare


def describe_work(measured: MeasuredGraph, work: Workload, options: PlacementOptions) -> Workload:
    """Return the work that is left once the graph is known: its factor is planned, nothing is solved.

    `work` is all of it but for the graph.
    """
    graph, entries = measured.graph, 0
    needs_factor = measured.groups is not None
    if graph.num_edges:
        plan = plan_factor(measured)
        needs_factor = needs_factor or choose_method(graph, options.solver).method == "newton"
        max_bytes = np.inf if needs_factor else options.solver.factor_bytes
        if plan is not None and plan.num_bytes(graph.dimension, np.float64) <= max_bytes:
            entries = plan.num_bytes(1, np.uint8)
    return replace(
        work,
        num_edges=graph.num_edges,
        num_nodes=graph.num_nodes,
        num_sampled=graph.num_edges if work.num_sampled else 0,
        has_points=measured.num_points > 0,
        factor_entries=entries,
        needs_factor=needs_factor,
    )


def _peaks(work: Workload, plan: MemoryPlan) -> dict[str, float]:
    batch = 225.0 * min(plan.reading.batch, work.num_matches)
    model = 30e6 + (_COLOR_BYTES if work.num_matches else _MODEL_BYTES) * work.num_keypoints
    rays = min(24.0 * work.num_keypoints, plan.reading.rays_bytes)
    results = 350.0 * work.num_pairs + 3000.0 * work.num_images
    is_sorted = plan.reading.keeps and work.num_matches <= MOST_MATCHES
    in_memory = MATCH_BYTES * work.num_matches if is_sorted else 0.0
    if work.num_keypoints <= MOST_KEYPOINTS:
        in_memory += PIXEL_BYTES * work.num_keypoints
    throughout = _STARTED_BYTES + _KERNELS_BYTES + model + rays + results + in_memory
    reading = _STARTED_BYTES + 30e6 + _READ_BYTES * work.num_keypoints
    peaks = {
        "reading": throughout - rays if work.averages else reading,
        "measuring directions": throughout + batch,
    }
    if work.averages:
        blocks = 8.0 * _BLOCK * (_AVERAGED_BLOCKS * work.num_pairs + _AVERAGED_FACTORS * work.factor_entries)
        peaks["averaging rotations"] = throughout - rays + blocks
    if work.has_points and plan.points:
        peaks["building tracks"] = throughout + batch + 125.0 * work.num_keypoints
    samples = 16.0 * _SAMPLES * (work.num_sampled if plan.samples else 0)
    solving = 900.0 * work.num_edges + 3000.0 * work.num_nodes
    has_factor = plan.factor or work.needs_factor
    copies = 2.2 if work.needs_factor else 1.2
    factor = copies * 8.0 * _BLOCK * work.factor_entries if has_factor else 0.0
    moved = 8.0 * 3 * _SAMPLES * 3.0 * work.num_nodes if samples else 0.0
    is_kept = plan.reading.keeps and work.num_matches <= KEPT_MATCHES
    kept = 80.0 * work.num_matches if is_kept else 0.0
    peaks["placing"] = throughout + kept + solving + samples + moved + factor + 0.5 * batch
    tracks = 44.0 * work.num_keypoints + 0.5 * batch  # and the seed; very many matches stand in a file
    are_many = work.num_matches > MOST_BESIDE_TRACKS
    tracks += -in_memory if are_many else MATCH_BYTES * work.num_matches
    seeded = throughout + kept + 300.0 * work.num_edges + tracks
    if work.averages:
        observations, solving = _adjusted_thinly(work, plan)
        given_up = in_memory if are_many else 0.0
        solving += throughout - rays - given_up
        peaks["adjusting a first placement"] = solving + _KEPT_BYTES * observations
    if work.adjusts_bundle or (work.adjusts and plan.adjustment):
        observations = min(work.num_keypoints, _OBSERVATIONS_OF_A_MATCH * work.num_matches)
        size = _DIVIDED_BYTES if plan.divides else _OBSERVATION_BYTES
        adjusting = size * observations + _adjusted_cameras_bytes(work)
        peaks["adjusting"] = seeded + adjusting
    peaks["triangulating"] = seeded - rays
    return peaks


def _adjusted_thinly(work: Workload, plan: MemoryPlan) -> tuple[float, float]:
    """Return the observations of the few tracks that are adjusted, and the bytes of equations and factor.

    Many observations are not linearized while there is a factor; where divided, those of a part alone.
    """
    most = _OVERSHOT * wanted_observations(work.num_images, FINE_TIMES) * work.num_images
    observations = min(work.num_keypoints, _OBSERVATIONS_OF_A_MATCH * work.num_matches, most)
    entries, block = _ENTRY_BYTES * observations, 8.0 * _UNKNOWNS**2
    system = 2.0 * block * _THIN_PAIRS * work.num_pairs
    if plan.divides or work.num_images > MOST_WHOLE:
        return observations, system + _ITERATIVE_BYTES * work.num_images
    # The factor has numbers of 32 bits; up to so many frames one of 64 follows, with its selected inverse.
    copies = 2.0 if work.num_images <= MOST_FRAMES else 0.5
    solving = system + copies * block * _THIN_FACTOR * work.factor_entries
    return observations, max(entries, solving) if observations > MANY_ENTRIES else entries + solving


def _adjusted_cameras_bytes(work: Workload) -> float:
    """Return the bytes of the system of the cameras in an adjustment: blocks of pairs, and a factor.

    Beyond the size that is dense, its graph is about that of the pairs, and its factor that of the placement
    with blocks of another size.
    """
    unknowns = _UNKNOWNS * work.num_images
    blocks = 3.0 * 8.0 * _UNKNOWNS**2 * (work.num_pairs + work.num_images)
    entries = unknowns**2 if unknowns <= _DENSE_UNKNOWNS else 1.2 * _UNKNOWNS**2 * work.factor_entries
    return blocks + 8.0 * entries


def _read_work(source: MatchSource, options: PlacingOptions | InspectOptions) -> Workload:
    """Return what is known of the work before any direction is measured."""
    view, num_images = source.view, source.images.num_images
    return Workload(
        num_images=num_images,
        num_keypoints=source.matches.total_keypoints,
        num_pairs=view.num_pairs,
        num_matches=view.num_matches,
        num_edges=view.num_pairs,
        num_nodes=num_images,
        adjusts=options.placement.refines and options.freedom.adjusts_cameras(num_images),
        adjusts_bundle=options.freedom.adjust == "full",
    )


def see_within_limit(
    source: MatchSource, options: PlacingOptions, *, is_component: bool = False
) -> MatchSource:
    """Return the matches of a database with what is given up, by their counts, for the limit of memory.

    Images that are a component of `map` get a first placement. InputError as of `choose_memory_plan`.
    """
    if not options.memory.max_memory_mb or not source.has_database:
        return source
    bare, images = _read_work(source, options), source.images
    if is_component:
        entries = analyze(images.num_images, source.view.pairs).num_bytes(1, np.uint8)
        averages = options.freedom.adjust != "none"
        bare = replace(bare, averages=averages, adjusts=False, factor_entries=entries)
    work = replace(bare, has_points=options.nodes.uses_points(images.num_images))
    return source.at(images, choose_memory_plan(work, bare, options.memory.max_memory_mb))


def largest_group(source: MatchSource) -> IntArray:
    """Return the images of the largest group that pairs tie, ascending."""
    label_of = connected_components(source.images.num_images, source.view.pairs)
    return np.flatnonzero(label_of == np.bincount(label_of).argmax())


def count_work(
    source: MatchSource, directions: PairDirections, options: PlacingOptions | InspectOptions
) -> Workload:
    """Return the work to do, as far as it is known once the directions are measured."""
    num_usable, num_pairs = len(directions.usable()), len(directions.pairs)
    return replace(
        _read_work(source, options),
        num_pairs=num_pairs,
        num_matches=int(directions.num_matches.sum()),
        num_sampled=num_usable if source.memory_plan.samples and are_sampled(num_usable, num_pairs) else 0,
    )
