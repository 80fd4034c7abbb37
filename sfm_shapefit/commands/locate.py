"""`locate`: from known rotations and matches to a seeded COLMAP model.

Each stage is one function from values to a new value; the input is never changed.
"""

from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.command_options import LocateOptions, pull_of_rotations
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.files.colmap.known import read_fixed_images, read_known
from sfm_shapefit.files.colmap.listed_poses import read_source
from sfm_shapefit.files.colmap.model import ModelSource
from sfm_shapefit.files.colmap.template import template_of
from sfm_shapefit.pipeline.conventions import naming_convention, tell_convention
from sfm_shapefit.pipeline.execution import workers_of
from sfm_shapefit.pipeline.inputs import RunInputs, choose_inputs, open_matches, read_left_out, see_matches
from sfm_shapefit.pipeline.intrinsics import choose_intrinsics
from sfm_shapefit.pipeline.memory import see_within_limit
from sfm_shapefit.pipeline.remedies import make_model
from sfm_shapefit.placement.gauge_rule import between_images

if TYPE_CHECKING:
    from distributed import Client

_ROUGH_RAD = np.radians(0.3)  # radians; directions of pairs are not measured by rotations farther off
_NOT_CORRECTED = "rough rotations beside fixed images are not corrected; --fix needs better ones"


def locate(
    reconstruction: ModelSource,
    database: Path | str | None = None,
    *,
    options: LocateOptions | None = None,
    progress: Progress | None = None,
    priors: Path | str | None = None,
    client: "Client | None" = None,
    **overrides: Any,
) -> LocateResult:
    """Place the cameras of a model whose rotations and intrinsics are known.

        rotations = pycolmap.Reconstruction("sparse/0")
        found = sfm_shapefit.locate(rotations, "database.db")
        pycolmap.bundle_adjustment(found.reconstruction)        # a new model; the input is untouched
        found.write("out")                                      # the model, tables, and report.html

    Args:
        reconstruction: a pycolmap.Reconstruction, a result or a model folder; or the file of a list of poses,
            transforms.json or a trajectory, of images of the database. Nothing of it is changed, and its
            camera centers never place a camera.
        database: the COLMAP database with the inlier matches. Without it, `database.db` or `colmap.db` is
            looked for in the model's folder, its parent and its grandparent; failing that the model's tracks
            serve.
        options: settings, see `help(LocateOptions)`; defaults if None.
        **overrides: single options by name: `locate(model, min_trust=0.0)`.
        progress: called as stages advance, with the stage, the work done and the work in all.
        priors: a table of position priors, see `files.colmap.priors`, the folder of the images, whose EXIF
            data have them, or "database" for its own pose priors.
        client: of dask.distributed; its workers, which must see the file of the database, share the work,
            with the same answer to the bit. None: all is done here.

    Returns:
        `reconstruction`, the model: cameras that are placed, and the points that they triangulate;
        `cameras` and `pairs`, a row each with trust, standard deviation, residual and verdict; `certified`,
        the optimum with its certificate; `warnings`, a sentence each; `gauge`, `further` pieces, `timings_s`.

    Raises:
        InputError: if the model or the database cannot be used; the message says what to do.
        UnsolvableError: if no pair has a usable direction, or the directions determine nothing.
        WorkerError: if a worker does not see the database, or a task failed again and again.

    Source of the program: Hand, Lee, Voroninski (2015), arXiv 1506.01437.
    """
    options = merge_options(options, LocateOptions, overrides)
    clock = Clock.of(progress, options.placement.solver.threads)
    with ExitStack() as stack:
        with clock("read"):
            model, listed = read_source(reconstruction, database, rotations_suffice=True)
            given = model.images
            inputs = choose_inputs(reconstruction, database, options.source.directions)
            inputs = read_left_out(inputs, given.names, options.directions.without)
            gauge = between_images(options.gauge, given.names, "the model has no posed image")
            options = replace(options, gauge=gauge)
            if options.freedom.rigs == "free" and not given.has_rigs:
                raise InputError("the model has no rig of several cameras to refine; leave out rigs=free")
            opened, inputs = open_matches(model, inputs)
            clock.cluster = workers_of(client, inputs.database)
            matches = stack.enter_context(closing(opened))
            wanted = options.freedom.intrinsics
            images, intrinsics = choose_intrinsics(given, matches, wanted, inputs.left_out, listed)
            files = {"control_points": gauge.control_points, "scale_bars": gauge.scale_bars}
            known = read_known(images, matches.file, priors, **files)
            fixed = read_fixed_images(model, options.fix)
            has_database = matches.file is not None
            template = template_of(model, matches.num_keypoints > 0 if has_database else None)
            notes = (*model.notes, *matches.notes)
            del model  # whose points and keypoints are large
            source = see_within_limit(see_matches(matches, images, inputs), options)
        pull_rad = pull_of_rotations(options.rotations)
        is_rough = pull_rad is not None and _ROUGH_RAD <= pull_rad < np.inf
        if is_rough and fixed.any():
            is_rough, notes = False, (_NOT_CORRECTED, *notes)
        run_inputs = RunInputs(
            options=options,
            template=template,
            images=images,
            intrinsics=intrinsics,
            fixed=fixed,
            pull_rad=np.inf if is_rough else pull_rad,
            rough_rad=pull_rad if is_rough else None,
            scale=options.gauge.scale,
            distances=options.gauge.known_distance,
            known=known,
        )
        with naming_convention(source, clock.threads):
            result = tell_convention(make_model(run_inputs, source, clock), source, clock.threads)
        return replace(result, warnings=(*notes, *result.warnings)) if notes else result
