"""What other pipelines call: `global_mapping`, as pycolmap has it, and `average_database`."""

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, database_in
from sfm_shapefit.pipeline.components import start_run
from sfm_shapefit.pipeline.execution import workers_of
from sfm_shapefit.pipeline.map import map_database, measure_run
from sfm_shapefit.pipeline.write import WriteOptions, deliver
from sfm_shapefit.scene.points import number_points

if TYPE_CHECKING:
    import pycolmap
    from distributed import Client

_TAKEN = {"num_threads": "threads", "min_num_matches": "min_matches", "min_model_size": "min_model_size"}
"""Options of pycolmap that have a counterpart here, and its name."""


def global_mapping(
    database_path: Path | str,
    image_path: Path | str,
    output_path: Path | str,
    options: "MapOptions | pycolmap.GlobalPipelineOptions | Mapping[str, Any] | None" = None,
) -> "dict[int, pycolmap.Reconstruction]":
    """Map a database as `pycolmap.global_mapping` and `pycolmap.incremental_mapping` do; one import changes.

        models = sfm_shapefit.global_mapping("database.db", "images", "sparse")

    Args:
        database_path: the COLMAP database with verified matches; it is never changed.
        image_path: folder of the images, which give points their colors and the report small pictures; ""
            for none.
        output_path: folder for the models 0, 1, ..., each with its report.html; empty, new, or an earlier
            output, which is replaced.
        options: `MapOptions`, or a mapping of some of them; defaults if None. From pycolmap's options
            `num_threads`, `min_num_matches` and `min_model_size` are taken; the others have no counterpart.

    Returns:
        The models by their numbers, the one with most cameras first; `map_database` returns them with the
        evidence for each.

    Raises:
        InputError: if the database cannot be used, or the output would replace something else.
        UnsolvableError: if no component of three images or more can be placed.
    """
    if isinstance(options, Mapping):
        options = MapOptions(**options)
    elif options is not None and not isinstance(options, MapOptions):
        options = _options_of(options)
    mapped = map_database(database_path, options)
    mapped = deliver(mapped, output_path, WriteOptions(overwrite=True, images=image_path))
    return {number: model.reconstruction for number, model in enumerate(mapped.models)}


def _options_of(theirs: "pycolmap.GlobalPipelineOptions") -> MapOptions:
    """Return the options of pycolmap that have a counterpart, where they are not its defaults."""
    usual = type(theirs)()
    values = {
        ours: getattr(theirs, name)
        for name, ours in _TAKEN.items()
        if getattr(theirs, name, None) != getattr(usual, name, None)
    }
    return MapOptions(**values)


def average_database(
    database: Path | str,
    options: MapOptions | None = None,
    *,
    progress: Progress | None = None,
    client: "Client | None" = None,
    **overrides: Any,
) -> "pycolmap.Reconstruction":
    """Average the rotations of a database; what `map_database` does before it places any camera.

        rotations = sfm_shapefit.average_database("database.db")
        found = sfm_shapefit.locate(rotations, "database.db", rotations=1.0)  # degrees that they may be off

    Args:
        database: as for `map_database`; it is never changed.
        options: settings, see `help(MapOptions)`; defaults if None.
        progress: called as stages advance.
        client: of dask.distributed, whose workers share out the pairs.
        **overrides: single options by name: `average_database(database, gravity="gravity.txt")`.

    Returns:
        The images of the largest component, registered with their rotations, all at the origin; no points.

    Raises:
        InputError: if the database cannot be used.
        UnsolvableError: if no three images have rotations that agree.
    """
    options = merge_options(options, MapOptions, overrides)
    path = database_in(Path(database))
    clock = Clock.of(progress, options.placement.solver.threads, workers_of(client, path))
    with closing(DatabaseFile(path)) as file:
        run, relative, *_ = measure_run(start_run(file, options, clock, None))
        reasons: dict[int, str] = {}
        components = list(run.average_images(relative, reasons))
        if not components:
            raise UnsolvableError(next(iter(reasons.values()), "no two images have a relative rotation"))
        _, members, averaging = max(components, key=lambda found: len(found[1]))
        images = run.pose(members, averaging.rotations)
        return SeededModel.of(run.read.template(images), images, number_points([]), None).reconstruction
