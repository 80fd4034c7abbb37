"""`map_database`: rotations averaged from the matches, then `locate`, component by component.

    images and matches -> relative rotations -> components -> averaged rotations
        -> first placement -> rotations and centers adjusted on few tracks -> locate -> models

Images that the averaging drops form components of their own.
"""

from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.facts.map_result import MapResult, tell_joins
from sfm_shapefit.facts.map_warnings import lost_bars, lost_distances, map_warnings
from sfm_shapefit.files.colmap.database_pairs import explain_no_pairs
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, database_in
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.components import start_run
from sfm_shapefit.pipeline.execution import workers_of
from sfm_shapefit.pipeline.mapping import make_models
from sfm_shapefit.pipeline.model_joins import join_mapped
from sfm_shapefit.scene.given import Known

if TYPE_CHECKING:
    from distributed import Client


def map_database(
    database: Path | str,
    options: MapOptions | None = None,
    *,
    progress: Progress | None = None,
    priors: Path | str | Known | None = None,
    client: "Client | None" = None,
    **overrides: Any,
) -> MapResult:
    """Place the images of a COLMAP database: average rotations, then `locate`, for each component.

    Args:
        database: with keypoints and two-view geometries, or the folder that holds it as database.db; it is
            never changed. Intrinsics are the database's.
        options: settings, see `help(MapOptions)`; defaults if None.
        **overrides: single options by name: `map_database(database, adjust="full")`.
        progress: called as stages advance.
        priors: a table of position priors, as of `locate`, or what was read of all files already.
            Components with fewer than two keep the scale "unit", and so do those, with a warning, whose
            priors coincide or contradict the cameras.
        client: of dask.distributed, whose workers share the work, as of `locate`. None: all is done here.

    Returns:
        `models`, most cameras first, each as `locate` returns it, with the rotations that it started from as
        its `averaging`; `left_out`, the reason for each image in no model; `warnings` of the run,
        beside those of each model. Cameras, pairs, verdict and report are those of the first model.

    Raises:
        InputError: if the database cannot be used; the message says what to do.
        UnsolvableError: if no component of three images or more can be placed.
        WorkerError: if a worker does not see the database, or a task failed again and again.
    """
    options = merge_options(options, MapOptions, overrides)
    path = database_in(Path(database))
    clock = Clock.of(progress, options.placement.solver.threads, workers_of(client, path))
    with closing(DatabaseFile(path)) as file:
        return map_opened(file, options, clock, priors)


def map_opened(
    file: DatabaseFile, options: MapOptions, clock: Clock, priors: Path | str | Known | None = None
) -> MapResult:
    """Do what `map_database` does, with a database that is open."""
    run, relative, videos, models, reasons = make_models(start_run(file, options, clock, priors))
    path = file.path
    if not models:
        raise UnsolvableError(_explain_failure(file, relative, reasons))
    with clock("join") if options.join == "safe" else nullcontext():
        joins, joined, join_warnings = join_mapped(models, run)
    left_out = {**run.read.left_out} | {
        name: reasons[frame]
        for name, frame in zip(run.images.names, run.frame_of_image.tolist(), strict=True)
        if frame in reasons
    }
    result = MapResult(
        database=path,
        options=options,
        models=tuple(models),
        joins=joins,
        joined=joined,
        num_images=run.images.num_images + len(run.read.left_out),
        num_pairs=len(relative.pairs),
        num_video_frames=videos.num_frames,
        left_out=left_out,
        timings_s=clock.seconds,
        warnings=(
            *file.notes,
            *(run.known.priors.notes if run.known.priors is not None else ()),
            *map_warnings(run.read.rigs.incomplete, models),
            *join_warnings,
            *lost_distances(run.options.gauge.known_distance, models, joined),
            *lost_bars(run.known.bars, models, joined),
        ),
    )
    return tell_joins(result)


def _explain_failure(file: DatabaseFile, relative: RelativeRotations, reasons: dict[int, str]) -> str:
    if len(relative.pairs) == 0:
        return explain_no_pairs(file) or (
            f"no pair of images in {file.path} has {LEAST_MATCHES} inlier matches and a relative rotation; "
            "match the images and verify them geometrically first"
        )
    causes = list(reasons.values())
    most = max(set(causes), key=lambda cause: (causes.count(cause), cause))
    return f"no component of {file.path} can be placed; for most images: {most}"
