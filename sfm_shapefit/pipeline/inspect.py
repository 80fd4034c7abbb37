"""`inspect`: a view graph diagnosed without solving, by the same steps as `locate` takes."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.options import LocateOptions
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.graph_text import read_graph
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.doubts import confirm_rotations
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
from sfm_shapefit.pipeline.measure import (
    Wanted,
    add_evidence,
    build_graph,
    count_work,
    measure,
    wants_points,
)
from sfm_shapefit.pipeline.memory import Forecast, describe_work, forecast
from sfm_shapefit.pipeline.rigs import group_frames, rigs_statement
from sfm_shapefit.placement.diagnosis import Diagnosis, diagnose

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Inspection(Displayed):
    """All that `inspect` reports."""

    directions: str
    """Where directions come from, and why."""
    num_images: int
    """Images or nodes of the input, with a rotation or without."""
    statuses: dict[str, int]
    """How many pairs have a usable direction, and why others have none."""
    points: str
    """Whether 3D points join the view graph, and why."""
    diagnosis: Diagnosis
    expected: Forecast | None = None
    """The memory that `locate` will take; None for a bare graph."""
    rigs: str = "none: every image is a frame of its own"
    """How many frames there are, and how many of them the pairs tie to one another in metric scale."""

    def summary(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        facts = asdict(self)
        if self.expected is not None:
            facts["expected"] |= {"peak_mb": self.expected.peak_mb}
        return facts

    def _headline(self) -> str:
        obstacle = self.diagnosis.obstacle
        return f"{self.num_images} images, {obstacle or 'which can be placed'}"


def inspect(
    source: "pycolmap.Reconstruction | Path | str",
    database: Path | str | None = None,
    *,
    options: LocateOptions | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> Inspection:
    """Diagnose a model's view graph, or a bare one, without solving: what `locate` would do, and why.

    Args:
        source: a reconstruction or a model folder as for `locate`, or the text file of a bare graph.
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
    options = merge_options(options, LocateOptions, overrides)
    if isinstance(source, Path | str) and Path(source).is_file():
        if database is not None:
            raise InputError(f"{source} is a bare graph, which has no database; leave out one of the two")
        graph = read_graph(source)
        return Inspection(
            directions=f"as given in {source}",
            num_images=graph.num_nodes,
            statuses={DirectionStatus.USABLE.value: graph.num_edges},
            points="no: a bare graph has no matches",
            diagnosis=diagnose(graph, options),
        )
    clock = Clock.of(progress)
    with clock("read"):
        model = read_model(source)
        inputs = choose_inputs(source, database, options.directions)
    with open_source(model, inputs) as matches:
        with clock("directions"):
            measured = measure(matches, options, clock, Wanted(tracks=wants_points(matches, options)))
            directions = measured.directions
        with clock("diagnosis"):
            with_points = add_evidence(build_graph(model, measured), measured)
            grouped = group_frames(model, with_points)
            work = describe_work(count_work(matches, directions), grouped, options)
            return Inspection(
                directions=inputs.statement,
                num_images=len(model.reconstruction.images),
                statuses={status.value: count for status, count in directions.counts().items()},
                points=options.points_statement(model.num_images, with_points.num_points),
                diagnosis=diagnose(with_points, options, confirm_rotations(matches, directions, options)),
                expected=forecast(work, matches.economy),
                rigs=rigs_statement(model, grouped),
            )
