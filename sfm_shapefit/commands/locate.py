"""`locate`: from known rotations and matches to a seeded COLMAP model, the path of the data in one page.

Each stage is one function from values to a new value; the input is never changed.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.arrays import BoolArray
from sfm_shapefit.colmap.model import read_model
from sfm_shapefit.commands.stages.clock import Clock, Progress
from sfm_shapefit.commands.stages.economy import within_memory
from sfm_shapefit.commands.stages.gauge_choice import chosen_gauge, read_priors
from sfm_shapefit.commands.stages.inputs import MatchSource, choose_inputs, open_source
from sfm_shapefit.commands.stages.measure import (
    evidence_of,
    joint_graph,
    measure_directions,
    shared_errors,
    with_points,
)
from sfm_shapefit.commands.stages.rigs import placed, rigid_gauge, rigid_parts
from sfm_shapefit.commands.stages.rotations import refined_rotations
from sfm_shapefit.commands.stages.seed import further_pieces, seeded_model, trusted
from sfm_shapefit.directions.pair_directions import PairDirections
from sfm_shapefit.options import LocateOptions
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_refinement import pulled
from sfm_shapefit.results import LocateResult, match_warnings, quality_warnings, trust_warnings
from sfm_shapefit.settings import merge_options

if TYPE_CHECKING:
    import pycolmap


def locate(
    reconstruction: "pycolmap.Reconstruction | Path | str",
    database: Path | str | None = None,
    *,
    options: LocateOptions | None = None,
    progress: Progress | None = None,
    priors: Path | str | None = None,
    executor: Executor | None = None,
    **overrides: Any,
) -> LocateResult:
    """Place the cameras of a model whose rotations and intrinsics are known.

        rotations = pycolmap.Reconstruction("sparse/0")
        found = sfm_shapefit.locate(rotations, "database.db")
        pycolmap.bundle_adjustment(found.reconstruction)        # a new model; the input is untouched
        sfm_shapefit.write_result(found, "out")                 # the model, tables, and report.html

    Args:
        reconstruction: a pycolmap.Reconstruction or a model folder, or a model file of Bundler, openMVG or
            OpenSfM; nothing of it is changed, and its camera centres never place a camera.
        database: the COLMAP database with the inlier matches. Without it, `database.db` is looked for in
            the model's folder, its parent and its grandparent; failing that the model's tracks serve.
        options: settings, see `help(LocateOptions)`; defaults if None.
        **overrides: single options by name: `locate(model, min_trust=0.0)`.
        progress: called as stages advance, with the stage, the work done and the work in all.
        priors: a table of position priors, see `colmap.priors.table_priors`; the database's own pose priors
            serve if the scale is "prior" and there is no table.
        executor: shares out the pairs of a database among its workers, which must see its file, or a model's
            own tracks, with the same answer to the bit. None: all is done here.

    Returns:
        `reconstruction`, the seeded model: cameras placed, points triangulated, all else unregistered;
        `cameras` and `pairs`, a row each with trust, standard deviation, residual and verdict; `certified`,
        the optimum with its certificate; `warnings`, a sentence each; `gauge`, `further` pieces, `timings_s`.

    Raises:
        InputError: if the model or the database cannot be used; the message says what to do.
        UnsolvableError: if no pair has a usable direction, or the directions determine nothing.

    Source of the program: Hand, Lee, Voroninski (2015), arXiv 1506.01437.
    """
    options = merge_options(options, LocateOptions, overrides)
    clock = Clock(progress) if progress else Clock()
    with clock("read"):
        model = read_model(reconstruction)
        inputs = choose_inputs(reconstruction, database, options.directions)
        known = read_priors(model, inputs, options, priors)
        rigid = rigid_parts(model, options, has_priors=known is not None)
    turned_deg = None
    if options.refine_rotations:
        with clock("rotations"):
            model, turned_deg = refined_rotations(model, inputs, options, clock)
    with open_source(model, inputs, options.max_memory_mb) as opened:
        with clock("directions"):
            directions = measure_directions(opened, options, clock, executor)
        with clock("solve"):
            joint = joint_graph(opened, directions, options)
            source, joint, options = within_memory(opened, directions, joint, options)
            evidence = with_points(evidence_of(directions, shared_errors(source, directions, options)), joint)
            placement = placed(joint, rigid, evidence, options, clock)
            kept = trusted(placement, options.min_trust) | rigid.fixed[placement.cameras]
            gauge = rigid_gauge(
                model, placement, rigid, kept, lambda: chosen_gauge(model, placement, kept, options, known)
            )
            if known is not None and options.refine_with_priors:
                placement, gauge = pulled(placement, gauge, known, joint.covariance, evidence)
                kept = trusted(placement, options.min_trust)
        with clock("further pieces"):
            further = further_pieces(source, placement, joint, evidence, options)
        seeded, adjusted = seeded_model(source, placement, kept, gauge, options, clock, rigid.fixed, executor)
        warnings = tuple(_warnings(source, directions, placement, kept, gauge, seeded.num_points3D()))
    return LocateResult(
        reconstruction=seeded,
        inputs=inputs,
        options=options,
        model=model,
        directions=directions,
        placement=placement,
        kept=kept,
        gauge=gauge,
        adjusted=adjusted,
        timings_s=clock.seconds,
        warnings=warnings,
        turned_deg=turned_deg,
        further=further,
        fixed=rigid.fixed,
    )


def _warnings(
    source: MatchSource,
    directions: PairDirections,
    placement: Placement,
    kept: BoolArray,
    gauge: Gauge,
    num_points: int,
) -> Iterator[str]:
    """Yield what the user should know beyond the tables."""
    yield from match_warnings(directions)
    yield from quality_warnings(placement)
    yield from trust_warnings(placement, kept)
    if gauge.warning:
        yield gauge.warning
    if source.economy.statement:
        yield f"to stay below max_memory_mb, {source.economy.statement}"
    if num_points == 0:
        yield "no 3D point could be triangulated; bundle adjustment has nothing to start from"
    if source.database is not None and source.database.unmatched_names:
        names = source.database.unmatched_names
        yield f"{len(names)} images of the model are not in the database, {names[0]} for one"
