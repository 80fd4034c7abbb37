"""`locate`: from known rotations and matches to a seeded COLMAP model, the path of the data in one page.

Each stage is one function from values to a new value; the input is never changed.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.colmap.adjustment import bundle_adjust
from sfm_shapefit.colmap.database import MatchDatabase, find_database, open_database
from sfm_shapefit.colmap.matches import MatchBatch
from sfm_shapefit.colmap.model import PosedModel, read_model, track_matches, with_turned_cameras
from sfm_shapefit.colmap.seed import build_seed
from sfm_shapefit.colmap.structure import TrackSource, colored, correspondence_graph, triangulate
from sfm_shapefit.diagnosis import Inspection, Theory, diagnose, theory_of
from sfm_shapefit.directions import (
    CONTRADICTIONS,
    DirectionStatus,
    PairDirections,
    concatenate,
    estimate_directions,
    from_relative_poses,
)
from sfm_shapefit.epipolar import RayMatches
from sfm_shapefit.errors import InputError, UnsolvableError
from sfm_shapefit.evaluation import Evaluation, evaluate_poses
from sfm_shapefit.formats import read_graph
from sfm_shapefit.gauge import Gauge, choose_gauge
from sfm_shapefit.options import LocateOptions, Source
from sfm_shapefit.placement import Placement, place, place_further
from sfm_shapefit.results import (
    FurtherPiece,
    GraphResult,
    Inputs,
    LocateResult,
    quality_warnings,
    trust_warnings,
)
from sfm_shapefit.robust.options import PlacementOptions
from sfm_shapefit.robust.shared_noise import NUM_SAMPLES, sample_direction_errors
from sfm_shapefit.robust.trust import Evidence
from sfm_shapefit.rotations import refine_rotations
from sfm_shapefit.tracks import JointGraph, build_tracks, covering_set, join_points
from sfm_shapefit.viewgraph import ViewGraph

if TYPE_CHECKING:
    import pycolmap

_REFINEMENT_ROUNDS = 2
_REFINEMENT_RESIDUAL_DEG = 5.0  # of a direction; beyond it no error of rotations is to blame
_REFINEMENT_MATCHES = 4_000_000  # in all; 200 MB
_MATCHES_PER_PAIR = (50, 2000)  # at least and at most; more were no better on any real scene
_CHECK_ROTATIONS = "check that the rotations and intrinsics belong to these matches"
_FEWEST_KEPT = 3  # cameras; fewer trusted ones are no result
_MAX_SAMPLED_PAIRS = 100_000  # beyond, standard deviations take the pairs as independent
_ADVICE = {
    DirectionStatus.TOO_FEW_MATCHES: "match more, or lower min_inliers",
    DirectionStatus.FEW_INLIERS: "match more, or lower min_inliers",
    DirectionStatus.NO_PARALLAX: "cameras that only turn cannot be placed; use images from different places",
}
"""What to do where no pair has a direction, by the most frequent reason."""

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the work done so far and the work in all."""


def locate(
    reconstruction: "pycolmap.Reconstruction | Path | str",
    database: Path | str | None = None,
    options: LocateOptions | None = None,
    progress: Progress | None = None,
) -> LocateResult:
    """Place the cameras of a model whose rotations and intrinsics are known.

    Args:
        reconstruction: a pycolmap.Reconstruction or a model folder; neither is changed, and its camera
            centres never place a camera.
        database: the COLMAP database with the inlier matches. Without it, `database.db` is looked for in
            the model's folder, its parent and its grandparent; failing that the model's tracks serve.
        options: settings; defaults if None.
        progress: called as stages advance.

    Raises:
        InputError: if the model or the database cannot be used; the message says what to do.
        UnsolvableError: if no pair has a usable direction, or the directions determine nothing.

    Source of the program: Hand, Lee, Voroninski (2015), arXiv 1506.01437.
    """
    options = options or LocateOptions()
    clock = _Clock(progress or (lambda _stage, _done, _total: None))
    with ExitStack() as resources:
        with clock("read"):
            model = read_model(reconstruction)
            inputs = _choose_inputs(reconstruction, database, options.directions)
            matches = None
            if inputs.database is not None:
                matches = resources.enter_context(open_database(inputs.database, model))
        turned_deg = None
        if options.refine_rotations:
            with clock("rotations"):
                model, turned_deg = _refined_rotations(model, inputs, options, clock)
                if inputs.database is not None:
                    matches = resources.enter_context(open_database(inputs.database, model))
        with clock("directions"):
            directions = _measure_directions(model, matches, inputs.source, options, clock)
        with clock("solve"):
            joint = _joint_graph(model, matches, directions, options)
            errors = shared_errors(model, matches, directions, inputs.source, options)
            evidence = _with_points(evidence_of(directions, errors), joint)
            placement = place(
                joint.graph, options.for_placement(), joint.covariance, evidence, joint.num_cameras
            )
            kept = _trusted(placement, options.min_trust)
            locations = placement.locations[kept]
            gauge = choose_gauge(locations, model.centers[placement.cameras[kept]], options.scale)
        with clock("further pieces"):
            further = _further_pieces(model, matches, placement, joint, evidence, options)
        with clock("structure"):
            centers = gauge.similarity.apply(locations)
            seed, tracks = _seed_and_tracks(model, matches, placement, (kept, centers), clock.advance)
            adjusted = None
            if not options.bundle_adjust:  # which triangulates at the seed's poses itself
                seeded = triangulate(seed, tracks, options.for_structure())
        if options.bundle_adjust:
            with clock("bundle adjustment"):
                adjusted = bundle_adjust(seed, tracks, options.for_structure())
                seeded = adjusted.reconstruction
        if matches is not None:  # points of the model's own tracks have their colours already
            with clock("colours"):
                seeded = colored(seeded, model.reconstruction)
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
        warnings=tuple(_warnings(matches, placement, kept, gauge, seeded.num_points3D())),
        turned_deg=turned_deg,
        further=further,
    )


@dataclass(slots=True)
class _Clock:
    """Measures stages and passes their progress on."""

    progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    stage: str = ""

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        self.stage = stage
        self.progress(stage, 0, 1)
        start = time.perf_counter()
        yield
        self.seconds[stage] = time.perf_counter() - start
        self.progress(stage, 1, 1)

    def advance(self, done: int, total: int) -> None:
        """Report progress inside the current stage."""
        self.progress(self.stage, done, total)


def _choose_inputs(
    reconstruction: "pycolmap.Reconstruction | Path | str", database: Path | str | None, source: Source
) -> Inputs:
    """Decide where directions come from, and say how."""
    folder = Path(reconstruction) if isinstance(reconstruction, Path | str) else None
    if source == "tracks":
        if database is not None:
            raise InputError("directions from tracks use no database; leave out one of the two")
        return Inputs(
            folder=folder, database=None, source=source, statement="the model's own tracks, as asked"
        )
    path = Path(database) if database is not None else folder and find_database(folder)
    if path is None:
        if source != "auto":
            raise InputError(f"directions from {source} need a database; give one with --database")
        statement = "the model's own tracks; no database.db was given or found beside the model"
        return Inputs(folder=folder, database=None, source="tracks", statement=statement)
    what = "stored relative poses" if source == "relative-poses" else "inlier matches"
    statement = f"{what} of {path}" + (" (found beside the model)" if database is None else "")
    chosen: Source = "relative-poses" if source == "relative-poses" else "matches"
    return Inputs(folder=folder, database=path, source=chosen, statement=statement)


def _measure_directions(
    model: PosedModel, matches: MatchDatabase | None, source: Source, options: LocateOptions, clock: _Clock
) -> PairDirections:
    """Return the direction of every pair that the source has."""
    if matches is not None and source == "relative-poses":
        poses = matches.relative_poses()
        if len(poses.pairs) == 0:
            raise UnsolvableError("the database has no stored relative pose; use directions from matches")
        return from_relative_poses(
            poses.pairs,
            (poses.rotations, poses.translations),
            model.rotations,
            poses.num_inliers,
            options.for_directions(),
        )
    batches = track_matches(model, 1) if matches is None else matches.iter_matches(1)
    total = model.num_images if matches is None else matches.num_pairs
    parts: list[PairDirections] = []
    for batch in batches:
        focal_lengths = model.focal_lengths_px[batch.pairs].min(axis=1)
        parts.append(
            estimate_directions(
                batch.pairs,
                batch.offsets,
                batch.rays_i,
                batch.rays_j,
                1.0 / focal_lengths,
                options.for_directions(),
                threads=options.num_threads(),
            )
        )
        clock.advance(sum(len(part.pairs) for part in parts), total)
    if not parts:
        raise UnsolvableError(
            "no two posed images share matches; match the images, or give the database that has their matches"
        )
    return concatenate(parts)


def _view_graph(model: PosedModel, directions: PairDirections) -> ViewGraph:
    """Return the graph of the usable directions; it has at least one edge."""
    usable = directions.usable()
    if len(usable) == 0:
        counts = directions.counts()
        reasons = ", ".join(f"{count} {status.value}" for status, count in counts.items())
        raise UnsolvableError(
            f"none of the {len(directions.pairs)} pairs has a usable direction ({reasons}); "
            f"{_ADVICE.get(next(iter(counts)), _CHECK_ROTATIONS)}"
        )
    return ViewGraph(
        model.num_images,
        directions.pairs[usable],
        directions.directions[usable],
        directions.weights()[usable],
        names=model.names,
    )


def _joint_graph(
    model: PosedModel, matches: MatchDatabase | None, directions: PairDirections, options: LocateOptions
) -> JointGraph:
    """Return the view graph, with 3D points as further nodes if the options want them."""
    graph, covariance = _view_graph(model, directions), directions.covariance[directions.usable()]
    if not options.uses_points(model.num_images):
        return JointGraph(graph=graph, covariance=covariance, num_cameras=model.num_images)
    batches = track_matches(model, 1) if matches is None else matches.iter_matches(1)
    pixel_angles = 1.0 / model.focal_lengths_px
    tracks = build_tracks(batches, directions, pixel_angles, options.inlier_threshold_px)
    chosen = tracks.subset(covering_set(tracks, model.num_images))
    return join_points(graph, covariance, chosen, pixel_angles)


def shared_errors(
    model: PosedModel,
    matches: MatchDatabase | None,
    directions: PairDirections,
    source: Source,
    options: LocateOptions,
) -> FloatArray | None:
    """Return samples of the usable directions' errors, which share keypoints; None if not known."""
    usable = directions.usable()
    if source == "relative-poses" or len(usable) > _MAX_SAMPLED_PAIRS:
        return None
    row_of = {tuple(pair): k for k, pair in enumerate(directions.pairs.tolist())}
    errors = np.zeros((len(directions.pairs), NUM_SAMPLES, 2))
    for batch in track_matches(model, 1) if matches is None else matches.iter_matches(1):
        rows = np.array([row_of[tuple(pair)] for pair in batch.pairs.tolist()], dtype=np.int64)
        errors[rows] = sample_direction_errors(
            batch.pairs,
            batch.offsets,
            batch.keypoints,
            (batch.rays_i, batch.rays_j),
            1.0 / model.focal_lengths_px[batch.pairs].min(axis=1),
            directions.directions[rows],
            directions.covariance[rows],
            1.4826 * directions.median_residual_px[rows],
            options.inlier_threshold_px,
        )
    return errors[usable]


def evidence_of(directions: PairDirections, errors: FloatArray | None = None) -> Evidence:
    """Return what the matches say of the cameras beyond the usable directions."""
    usable = directions.usable()
    against = [k for k, status in enumerate(directions.status) if status in CONTRADICTIONS]
    return Evidence(
        support=directions.num_matches[usable],
        contradicting=directions.pairs[against].reshape(-1, 2),
        contradicting_support=directions.num_matches[against],
        errors=errors,
    )


def _with_points(evidence: Evidence, joint: JointGraph) -> Evidence:
    """Return the evidence with a row for each direction to a point: one match, errors of their own."""
    own = joint.covariance[len(evidence.support) :]
    support = np.concatenate([evidence.support, np.ones(len(own), dtype=np.int64)])
    if evidence.errors is None:
        return replace(evidence, support=support)
    draws = np.random.default_rng(0).standard_normal((len(own), *evidence.errors.shape[1:]))
    sigmas = np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    errors = np.concatenate([evidence.errors, sigmas[:, None, :] * draws])
    return replace(evidence, support=support, errors=errors)


def _trusted(placement: Placement, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def _refined_rotations(
    model: PosedModel, inputs: Inputs, options: LocateOptions, clock: _Clock
) -> tuple[PosedModel, FloatArray]:
    """Return the model with refined rotations, and by how many degrees each camera turned, shape (n,).

    Directions need rotations and the refinement needs centres: cameras are placed, rotations refined, and
    both once more, for with better rotations more pairs have a direction. What a camera may turn is
    always judged against its given rotation.
    """
    turns = np.tile(np.eye(3), (model.num_images, 1, 1))
    turned, turned_deg = model, np.zeros(model.num_images)
    for repeat in range(_REFINEMENT_ROUNDS):
        with ExitStack() as resources:
            given, current = (
                None
                if inputs.database is None
                else resources.enter_context(open_database(inputs.database, m))
                for m in (model, turned)
            )
            directions = _measure_directions(turned, current, inputs.source, options, clock)
            joint = _joint_graph(turned, current, directions, options)
            placement = place(
                joint.graph, options.for_placement(), joint.covariance, num_cameras=joint.num_cameras
            )
            residuals = placement.assessment.residuals_deg[placement.pairs]
            near = placement.edges[placement.pairs[residuals <= _REFINEMENT_RESIDUAL_DEG]]
            rays = _rays_of_pairs(model, given, directions.usable()[near], placement.cameras)
        refined = refine_rotations(rays, placement.locations, turns[placement.cameras] if repeat else None)
        turns[placement.cameras], turned_deg[placement.cameras] = refined.turns, refined.angles_deg
        turned = with_turned_cameras(model, turns)
    return turned, turned_deg


def _rays_of_pairs(
    model: PosedModel, matches: MatchDatabase | None, rows: IntArray, cameras: IntArray
) -> RayMatches:
    """Return matches of some pairs, evenly picked where a pair has too many.

    Args:
        model: the images.
        matches: the database, or None for the model's own tracks.
        rows: (k,) ascending positions of the pairs among all pairs with matches.
        cameras: (n,) ascending images that become cameras 0 to n - 1; they hold all ends of the pairs.
    """
    limit = int(np.clip(_REFINEMENT_MATCHES // max(len(rows), 1), *_MATCHES_PER_PAIR))
    parts, first = [], 0
    for batch in track_matches(model, 1) if matches is None else matches.iter_matches(1):
        chosen = rows[(rows >= first) & (rows < first + len(batch.pairs))] - first
        first += len(batch.pairs)
        counts = np.diff(batch.offsets)[chosen]
        picked = [
            start + np.arange(min(count, limit)) * count // min(count, limit)
            for start, count in zip(batch.offsets[chosen].tolist(), counts.tolist(), strict=True)
        ]
        kept = np.concatenate([np.zeros(0, dtype=np.int64), *picked])
        pairs = batch.pairs[chosen]
        angles = 1.0 / model.focal_lengths_px[pairs].min(axis=1)
        parts.append((pairs, np.minimum(counts, limit), batch.rays_i[kept], batch.rays_j[kept], angles))
    pairs, counts, rays_i, rays_j, angles = (np.concatenate(column) for column in zip(*parts, strict=True))
    return RayMatches(
        pairs=np.searchsorted(cameras, pairs),
        offsets=np.append(0, np.cumsum(counts)),
        rays_i=rays_i,
        rays_j=rays_j,
        pixel_angles=angles,
    )


def _seed_and_tracks(
    model: PosedModel,
    matches: MatchDatabase | None,
    placement: Placement,
    located: tuple[BoolArray, FloatArray],
    advance: Callable[[int, int], None] | None = None,
) -> "tuple[pycolmap.Reconstruction, TrackSource]":
    """Return the model with its cameras moved, and the tracks to triangulate at their new poses.

    `located` says which of the placement's cameras are kept, and where those are in the output's units.
    """
    kept, centers = located
    placed = np.zeros(model.num_images, dtype=np.bool_)
    placed[placement.cameras[kept]] = True
    all_centers = np.full((model.num_images, 3), np.nan)
    all_centers[placement.cameras[kept]] = centers
    if matches is None:
        return build_seed(model, placed, all_centers), model.reconstruction
    seed = build_seed(model, placed, all_centers, matches.keypoints)
    among = (
        placement.cameras if placement.piece else None
    )  # a further piece is small: read no more than it needs
    batches = _without_pairs(matches.iter_matches(1, among=among), placement.rejected_pairs)
    if advance is not None:
        batches = _counted(batches, matches.num_pairs, advance)
    return seed, correspondence_graph(seed, model.image_ids, batches)


def _further_pieces(
    model: PosedModel,
    matches: MatchDatabase | None,
    placement: Placement,
    joint: JointGraph,
    evidence: Evidence,
    options: LocateOptions,
) -> tuple[FurtherPiece, ...]:
    """Return the further rigid pieces with their seeded models, each in the gauge "unit" of its own."""
    found = []
    for placed in place_further(placement, options.for_placement(), joint.covariance, evidence):
        kept = _trusted(placed, options.min_trust)
        locations = placed.locations[kept]
        gauge = choose_gauge(locations, np.zeros_like(locations), "unit")
        located = kept, gauge.similarity.apply(locations)
        seed, tracks = _seed_and_tracks(model, matches, placed, located)
        if options.bundle_adjust:
            seeded = bundle_adjust(seed, tracks, options.for_structure()).reconstruction
        else:
            seeded = triangulate(seed, tracks, options.for_structure())
        if matches is not None:
            seeded = colored(seeded, model.reconstruction)
        found.append(
            FurtherPiece(
                placement=placed,
                kept=kept,
                gauge=gauge,
                reconstruction=seeded,
                image_ids=model.image_ids[placed.cameras],
            )
        )
    return tuple(found)


def _without_pairs(batches: Iterator[MatchBatch], rejected: IntArray) -> Iterator[MatchBatch]:
    """Empty the match lists of the rejected pairs (k, 2): their directions contradict the solution."""
    unwanted = {(min(i, j), max(i, j)) for i, j in rejected.tolist()}
    for batch in batches:
        dropped: BoolArray = np.array(
            [tuple(pair) in unwanted for pair in batch.pairs.tolist()], dtype=np.bool_
        )
        counts = np.diff(batch.offsets)
        kept = np.repeat(~dropped, counts)
        yield MatchBatch(
            pairs=batch.pairs[~dropped],
            offsets=np.concatenate([[0], np.cumsum(counts[~dropped])]),
            keypoints=batch.keypoints[kept],
            rays_i=batch.rays_i[kept],
            rays_j=batch.rays_j[kept],
        )


def _counted(
    batches: Iterator[MatchBatch], total: int, advance: Callable[[int, int], None]
) -> Iterator[MatchBatch]:
    """Report progress while batches are consumed."""
    done = 0
    for batch in batches:
        yield batch
        done += len(batch.pairs)
        advance(done, total)


def _warnings(
    matches: MatchDatabase | None, placement: Placement, kept: BoolArray, gauge: Gauge, num_points: int
) -> Iterator[str]:
    """Yield what the user should know beyond the tables."""
    yield from quality_warnings(placement)
    yield from trust_warnings(placement, kept)
    if gauge.warning:
        yield gauge.warning
    if num_points == 0:
        yield "no 3D point could be triangulated; bundle adjustment has nothing to start from"
    if matches is not None and matches.unmatched_names:
        names = matches.unmatched_names
        yield f"{len(names)} images of the model are not in the database, {names[0]} for one"


def solve_graph_file(path: Path | str, options: PlacementOptions | None = None) -> GraphResult:
    """Place the nodes of a bare view graph by the same steps as `locate`: pieces, solve, verdicts.

    Args:
        path: a text file, see `formats.read_graph`.
        options: settings; defaults if None.

    Raises:
        InputError: if the file is malformed; the message names the line.
        UnsolvableError: if the directions determine nothing.
    """
    options = options or PlacementOptions()
    clock = _Clock(lambda _stage, _done, _total: None)
    with clock("read"):
        graph = read_graph(path)
    with clock("solve"):
        placement = place(graph, options)
    with clock("further pieces"):
        further = tuple(place_further(placement, options))
    return GraphResult(
        path=Path(path), options=options, placement=placement, further=further, timings_s=clock.seconds
    )


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

    Raises:
        InputError, UnsolvableError: as `locate`, if there is not even a view graph. One that cannot be placed
            is diagnosed; `diagnosis.obstacle` says why.
    """
    options = options or LocateOptions()
    if isinstance(source, Path | str) and Path(source).is_file():
        if database is not None:
            raise InputError(f"{source} is a bare graph, which has no database; leave out one of the two")
        return _inspect_graph(Path(source), options, theory=theory)
    clock = _Clock(progress or (lambda _stage, _done, _total: None))
    with ExitStack() as resources:
        with clock("read"):
            model = read_model(source)
            inputs = _choose_inputs(source, database, options.directions)
            matches = None
            if inputs.database is not None:
                matches = resources.enter_context(open_database(inputs.database, model))
        with clock("directions"):
            directions = _measure_directions(model, matches, inputs.source, options, clock)
        with clock("diagnosis"):
            joint = _joint_graph(model, matches, directions, options)
            pairs = _view_graph(model, directions)
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


def evaluate(
    reconstruction: "pycolmap.Reconstruction | Path | str",
    reference: "pycolmap.Reconstruction | Path | str",
    thresholds: Sequence[float] = (),
) -> Evaluation:
    """Return position and rotation errors of a model against a reference, after robust alignment.

    Args:
        reconstruction, reference: reconstructions or model folders; cameras are matched by name.
        thresholds: position errors, in the reference's units, at which recall is wanted too.

    Raises:
        InputError: if a model cannot be read, or they have fewer than three cameras in common.
    """
    model = read_model(reconstruction, poses_only=True)
    truth = read_model(reference, poses_only=True)
    return evaluate_poses(
        model.names,
        model.rotations,
        model.centers,
        truth.names,
        truth.rotations,
        truth.centers,
        thresholds=thresholds,
    )
