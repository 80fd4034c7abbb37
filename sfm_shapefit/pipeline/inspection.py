"""`inspect`: a view graph diagnosed without solving, by the same steps as `locate` takes."""

from pathlib import Path
from typing import TYPE_CHECKING

from sfm_shapefit.colmap.model import read_model
from sfm_shapefit.diagnosis import Inspection, Theory, diagnose, theory_of
from sfm_shapefit.directions import DirectionStatus
from sfm_shapefit.errors import InputError
from sfm_shapefit.forecast import forecast, measure_speed
from sfm_shapefit.formats import read_graph
from sfm_shapefit.formats.models import is_model_file
from sfm_shapefit.options import LocateOptions
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.economy import known_workload
from sfm_shapefit.pipeline.measurement import evidence_of, joint_graph, measure_directions, view_graph
from sfm_shapefit.pipeline.rigid_bodies import rigs_statement
from sfm_shapefit.pipeline.sources import choose_inputs, open_source

if TYPE_CHECKING:
    import pycolmap


def inspect(
    source: "pycolmap.Reconstruction | Path | str",
    database: Path | str | None = None,
    options: LocateOptions | None = None,
    *,
    theory: bool = False,
    progress: Progress | None = None,
) -> Inspection:
    """Diagnose a model's view graph, or a bare one, without solving: what `locate` would do, and why.

    Args:
        source: a reconstruction or a model folder as for `locate`, or the text file of a bare graph.
        database: as for `locate`; a bare graph has none.
        options: how it would be placed; defaults if None.
        theory: also compute the constants of the recovery theorems at the model's centres.
        progress: called as stages advance.

    Returns:
        Where directions come from and what becomes of the pairs; `diagnosis` with components, rigid pieces,
        hinges, weak cameras, the share of wrong pairs and the plan of the solve. `as_dict()` has all of it.

    Raises:
        InputError, UnsolvableError: as `locate`, if there is not even a view graph. One that cannot be placed
            is diagnosed; `diagnosis.obstacle` says why.
    """
    options = options or LocateOptions()
    if isinstance(source, Path | str) and Path(source).is_file() and not is_model_file(source):
        if database is not None:
            raise InputError(f"{source} is a bare graph, which has no database; leave out one of the two")
        return _inspect_graph(Path(source), options, theory=theory)
    clock = Clock(progress) if progress else Clock()
    with clock("read"):
        model = read_model(source)
        inputs = choose_inputs(source, database, options.directions)
    with open_source(model, inputs) as matches:
        with clock("directions"):
            directions = measure_directions(matches, options, clock)
        with clock("diagnosis"):
            joint = joint_graph(matches, directions, options)
            pairs = view_graph(model, directions)
            return Inspection(
                directions=inputs.statement,
                num_images=len(model.reconstruction.images),
                statuses={status.value: count for status, count in directions.counts().items()},
                points=options.points_statement(model.num_images, joint.num_points),
                diagnosis=diagnose(
                    joint.graph,
                    options.for_placement(),
                    joint.num_cameras,
                    evidence_of(directions).contradicting,
                ),
                theory=theory_of(pairs, model.centers, options.num_threads()) if theory else None,
                expected=forecast(
                    known_workload(matches, directions, joint, options), matches.economy, measure_speed()
                ),
                rigs=rigs_statement(model, joint),
            )


def _inspect_graph(path: Path, options: LocateOptions, *, theory: bool) -> Inspection:
    """Diagnose the bare graph of a text file."""
    graph = read_graph(path)
    return Inspection(
        directions=f"as given in {path}",
        num_images=graph.num_cameras,
        statuses={DirectionStatus.USABLE.value: graph.num_edges},
        points="no: a bare graph has no matches",
        diagnosis=diagnose(graph, options.for_placement()),
        theory=Theory(conditions=None, statement="left out: a bare graph has no centres") if theory else None,
    )
