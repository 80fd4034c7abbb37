"""What other pipelines call: `global_mapping`, as pycolmap has it, and `average_database`."""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.paths import OF_DATABASE
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.base.wording import counted
from sfm_shapefit.commands.map import map_database
from sfm_shapefit.commands.write import WriteOptions, deliver
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.files.colmap.database_cameras import read_cameras
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, database_in
from sfm_shapefit.pipeline.components import start_run
from sfm_shapefit.pipeline.execution import workers_of
from sfm_shapefit.pipeline.mapping import measure_run
from sfm_shapefit.scene.points import number_points

if TYPE_CHECKING:
    import pycolmap
    from distributed import Client

    _PycolmapOptions = pycolmap.GlobalPipelineOptions | pycolmap.IncrementalPipelineOptions

_TAKEN = {"num_threads": "threads", "min_num_matches": "min_matches", "min_model_size": "min_model_size"}
"""Options of pycolmap that have a counterpart here, and its name."""

_WITHOUT_EFFECT = {
    *("num_threads", "random_seed", "use_gpu", "gpu_index", "image_path"),
    *("refine_sensor_from_rig", "constant_rigs", "fix_existing_frames"),
}
"""Options of pycolmap, wherever they stand, whose other value asks for what is so here anyway."""

_NOT_TAKEN = {
    "input_path": "no model is continued; `locate(model, database, fix='solved')` adds images to one",
    "next_image_callback": "images are placed all at once; `map_database` takes a `progress` function",
    "initial_image_pair_callback": "no first pair is chosen; `map_database` takes a `progress` function",
    "cancellation_token": "leave it out; an interrupt (Ctrl-C) ends the run",
}
"""Arguments of `pycolmap.incremental_mapping` that have no counterpart, and what to do instead."""


def global_mapping(
    database_path: Path | str,
    image_path: Path | str,
    output_path: Path | str,
    options: "MapOptions | _PycolmapOptions | Mapping[str, Any] | None" = None,
    **others: object,
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
            `num_threads`, `min_num_matches` and `min_model_size` are taken; where bundle adjustment is not to
            refine focal lengths, intrinsics are "held", distortion too, and where only extra parameters stay,
            "focal". `use_prior_position` and `use_gravity` take those of the database, `constant_cameras`
            keeps the intrinsics of all cameras. Seeds, GPUs, threads of single stages and sensors that stay
            in their rigs need nothing. A warning names all others that are not pycolmap's defaults: they have
            no effect.
        **others: further arguments of `pycolmap.incremental_mapping`, which must be empty.

    Returns:
        The models by their numbers, the one with most cameras first; `map_database` returns them with the
        evidence for each.

    Raises:
        InputError: if the database cannot be used, the output would replace something else, or pycolmap's
            options choose images by `image_names`, or some cameras by `constant_cameras`.
        UnsolvableError: if no component of three images or more can be placed.
        TypeError: for options of another function, or an argument that is not taken.
    """
    for name, value in others.items():
        if value or name not in _NOT_TAKEN:
            raise TypeError(
                f"global_mapping takes no {name}: {_NOT_TAKEN.get(name, 'it has no such argument')}"
            )
    priors = None
    if isinstance(options, Mapping):
        options = MapOptions(**options)
    elif options is not None and not isinstance(options, MapOptions):
        options, priors = _options_of(options, Path(database_path))
    mapped = map_database(database_path, options, priors=priors)
    mapped = deliver(mapped, output_path, WriteOptions(overwrite=True, images=image_path))
    return {number: model.reconstruction for number, model in enumerate(mapped.models)}


def _options_of(theirs: "_PycolmapOptions", database: Path) -> tuple[MapOptions, str | None]:
    """Return options, and where priors are, for those of pycolmap that are not its defaults."""
    if type(theirs).__name__ not in ("GlobalPipelineOptions", "IncrementalPipelineOptions"):
        raise TypeError(
            "options must be MapOptions(...), a mapping of some, or pycolmap's GlobalPipelineOptions or "
            f"IncrementalPipelineOptions, got a {type(theirs).__name__}"
        )
    usual = dict(_single_values(type(theirs)().todict()))
    changed = {name: one for name, one in _single_values(theirs.todict()) if str(one) != str(usual[name])}
    if "image_names" in changed:
        raise InputError("image_names is not taken: all images are mapped; give a database of these alone")
    values = {ours: changed.pop(name) for name, ours in _TAKEN.items() if name in changed}
    if fixed := {*changed.pop("constant_cameras", ()), *changed.pop("mapper.constant_cameras", ())}:
        _refuse_few_cameras(fixed, database)
        values["intrinsics"] = "held"
    if changed.pop("mapper.rotation_averaging.use_gravity", False):
        values["gravity"] = OF_DATABASE
    priors = OF_DATABASE if changed.pop("use_prior_position", False) else None
    ends = {name: name.rpartition(".")[2].removeprefix("ba_") for name in changed}
    kept = {"refine_focal_length", "refine_extra_params"} & {*ends.values()}
    if kept and not fixed:
        values["intrinsics"] = "held" if "refine_focal_length" in kept else "focal"
    lost = [f"{name}={changed[name]}" for name, end in ends.items() if end not in _WITHOUT_EFFECT | kept]
    if lost:
        said = f"these options of pycolmap have no effect: {', '.join(lost)}"
        warnings.warn(f"{said}; help(sfm_shapefit.MapOptions) says what there is instead", stacklevel=3)
    return MapOptions(**values), priors


def _refuse_few_cameras(fixed: set[int], database: Path) -> None:
    """Raise InputError if a database has cameras that are not to be fixed."""
    with closing(DatabaseFile(database_in(database))) as file:
        others = sorted(read_cameras(file).usable.keys() - fixed)
    if others:
        raise InputError(
            f"constant_cameras lacks {counted(len(others), 'camera')} of the database, such as {others[0]}, "
            "and intrinsics are held of all or of none; leave it out, and mark in the database what is "
            "calibrated (has_prior_focal_length): calibrated lenses stay by default"
        )


def _single_values(options: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _single_values(value, f"{within}{name}.")
        else:
            yield within + name, value


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
