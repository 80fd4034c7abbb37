"""`inspect`: a view graph diagnosed without solving, by the same steps as `locate` takes."""

from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.command_options import InspectOptions
from sfm_shapefit.facts.inspected import Inspection
from sfm_shapefit.files.colmap.listed_poses import is_list, read_source
from sfm_shapefit.files.colmap.model import ModelSource
from sfm_shapefit.files.graph_text import read_graph
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.pipeline.conventions import naming_convention
from sfm_shapefit.pipeline.doubts import confirm_rotations
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source, read_left_out
from sfm_shapefit.pipeline.measure import MeasureRequest, add_evidence, build_graph, measure, wants_points
from sfm_shapefit.pipeline.memory import count_work, describe_work, forecast
from sfm_shapefit.placement.diagnosis import diagnose
from sfm_shapefit.placement.fixed_and_rigged import find_fixed_and_rigged
from sfm_shapefit.scene.images import Images
from sfm_shapefit.solver.tied import largest_tied


def inspect(
    source: ModelSource,
    database: Path | str | None = None,
    *,
    options: InspectOptions | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> Inspection:
    """Diagnose a model's view graph, or a bare one, without solving: what `locate` would do, and why.

    Args:
        source: as for `locate`, or the text file of a bare graph.
        database: as for `locate`; a bare graph has none.
        options: how it would be placed; defaults if None.
        **overrides: single options by name.
        progress: called as stages advance.

    Returns:
        Where directions come from and what becomes of the pairs; `diagnosis` with components, rigid pieces,
        hinges, weak cameras, the share of wrong pairs and the plan of the solve. `summary()` has all of it.

    Raises:
        InputError, UnsolvableError: as `locate`, if there is not even a view graph. One that cannot be placed
            is diagnosed; `diagnosis.obstacle` says why.
    """
    options = merge_options(options, InspectOptions, overrides)
    if isinstance(source, Path | str) and _is_graph(Path(source), database):
        if database is not None:
            raise InputError(f"{source} is a bare graph, which has no database; leave out one of the two")
        graph = read_graph(source)
        return Inspection(
            directions=f"as given in {source}",
            num_images=graph.num_nodes,
            statuses={DirectionStatus.USABLE.value: graph.num_edges},
            points="no: a bare graph has no matches",
            diagnosis=diagnose(graph, options.placement),
        )
    clock = Clock.of(progress, options.placement.solver.threads)
    with clock("read"):
        model, _ = read_source(source, database, rotations_suffice=True)
        inputs = choose_inputs(source, database, options.source.directions)
        inputs = read_left_out(inputs, model.images.names, options.directions.without)
    images = model.images
    with open_source(model, inputs) as matches:
        with clock("directions"):
            wanted = MeasureRequest(tracks=wants_points(matches, options.nodes))
            measured = measure(matches, options.directions, clock, wanted)
            directions = measured.directions
        with clock("diagnosis"), naming_convention(matches, clock.threads):
            with_points = add_evidence(build_graph(images, measured, options.nodes), measured)
            grouped = find_fixed_and_rigged(images).apply(with_points)
            work = describe_work(grouped, count_work(matches, directions, options), options.placement)
            confirmed = confirm_rotations(matches, directions, clock.threads)
            return Inspection(
                directions=matches.inputs.statement,
                num_images=len(model.image_names),
                statuses={status.value: count for status, count in directions.counts().items()},
                points=options.nodes.points_statement(images.num_images, with_points.num_points),
                diagnosis=diagnose(with_points, options.placement, confirmed),
                expected=forecast(work, matches.memory_plan),
                rigs=rigs_statement(images, grouped),
                warnings=(*model.notes, *matches.matches.notes),
            )


def _is_graph(source: Path, database: Path | str | None) -> bool:
    """Return whether a source is a bare graph; a table is a trajectory if a database has its matches."""
    may_be_graph = not is_list(source) or (source.suffix.lower() in {".txt", ".csv"} and database is None)
    return source.is_file() and may_be_graph


def rigs_statement(images: Images, measured: MeasuredGraph) -> str:
    """Say how many frames there are, and how many of them the pairs tie to one another."""
    groups, edges = measured.groups, measured.graph.edges
    if groups is None:
        return "none: every image is a frame of its own"
    frames = f"{len(images.frames.ids)} frames of {images.num_images} images"
    if not measured.has_scale:
        return f"{frames}; no pair sees two cameras of a frame that are apart, so their scale is open"
    sizes = measured.cameras_per_group
    tied = int(np.sum(sizes[largest_tied(edges, groups, sizes)] > 0))
    return f"{frames}, of which the pairs tie {tied} in metric scale; the pieces below take images one by one"
