"""What `locate` returns, and its files: the seeded model, `locate.json`, `cameras.csv`, `pairs.csv`.

Further parallel-rigid pieces stand in `pieces/1`, `pieces/2`, ...: a seeded model and a `cameras.csv` each.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.colmap.adjustment import Adjusted
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.colmap.seed import write_model
from sfm_shapefit.directions import DirectionStatus, PairDirections
from sfm_shapefit.gauge import Gauge
from sfm_shapefit.options import LocateOptions, Source
from sfm_shapefit.output import MARKER, atomic_folder
from sfm_shapefit.placement import SMALLEST_PIECE, Placement, count_large
from sfm_shapefit.report import (
    SCHEMA_VERSION,
    CameraRow,
    PairRow,
    PieceRow,
    solve_summary,
    write_json,
    write_rows,
)
from sfm_shapefit.rigidity import RigidPiece, left_out_reasons
from sfm_shapefit.robust.finish import Finish
from sfm_shapefit.robust.options import PlacementOptions
from sfm_shapefit.robust.verdicts import Verdict
from sfm_shapefit.solver.options import SolverResult, Status
from sfm_shapefit.viewgraph import ViewGraph

if TYPE_CHECKING:
    import pycolmap

_ALARMING_SHARE = 0.5  # of pairs that contradict the solution
_ALARMING_LEVEL_DEG = 5.0
_UNCERTAIN_SHARE = 0.05  # standard deviation of a camera, of the extent of all
_UNCHECKED = "no other pair checks it: the solution bends to fit it"
_NOT_SOLVED = "free: its directions determine no placement"
_SOLVER_SCALE = "solver: the weighted mean length along the directions is 1, the centroid 0"


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What `locate` worked from."""

    folder: Path | None
    """The model folder; None for a reconstruction in memory."""
    database: Path | None
    """The database whose matches were used, if any."""
    source: Source
    """Where the directions came from; never "auto"."""
    statement: str
    """How that choice was made, for the user."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocateResult:
    """The seeded model and the evidence for it: that of piece 0, the largest, and `further` ones."""

    reconstruction: "pycolmap.Reconstruction"
    """A new reconstruction: placed cameras and triangulated points; other images are unregistered."""
    inputs: Inputs
    options: LocateOptions
    model: PosedModel
    """The input as read, with refined rotations if those were asked for; camera k below is its image k."""
    directions: PairDirections
    """All pairs that were looked at, with their support."""
    placement: Placement
    """The view graph of all cameras and usable directions (edge e is row `directions.usable()[e]`), its
    largest rigid piece solved, and the evidence for it, in the solver's units."""
    kept: BoolArray
    """Which of the placement's cameras are in the output; the others are not trusted enough."""
    gauge: Gauge
    """From the solver's units to the output's."""
    adjusted: Adjusted | None
    """How bundle adjustment went, if it was asked for; its model is `reconstruction`, uncoloured."""
    timings_s: dict[str, float]
    """Wall-clock seconds per stage."""
    warnings: tuple[str, ...]
    """What the user should know, a sentence each."""
    turned_deg: FloatArray | None = None
    """(n,) by how much each rotation of the input was refined, exactly 0 where it was kept; None if
    rotations were not to be refined."""
    further: "tuple[FurtherPiece, ...]" = ()
    """The further rigid pieces of three cameras or more, each with a scale of its own."""

    @property
    def solve(self) -> SolverResult:
        """The certified solve of the largest rigid piece."""
        return self.placement.solve

    @property
    def pieces(self) -> list[RigidPiece]:
        """The parallel-rigid pieces of the view graph, largest first."""
        return self.placement.pieces

    @property
    def cameras(self) -> list[CameraRow]:
        """One row per image of the input: the posed ones by id, then those without a rotation."""
        image_ids = self.model.image_ids[self.placement.cameras]
        centers = _centers_of(self.reconstruction, image_ids, self.kept)
        solved_pieces = [piece.placement for piece in self.further]
        rows = camera_rows(self.placement, centers, self.gauge.similarity.scale, solved_pieces)
        for camera, reason in _without_direction(self.directions, self.placement.graph).items():
            rows[camera] = replace(rows[camera], reason=reason)
        unposed = sorted(set(_all_names(self)) - set(self.model.names))
        return rows + [CameraRow(name=name, reason="the input has no rotation for it") for name in unposed]

    @property
    def pairs(self) -> list[PairRow]:
        """One row per pair that was looked at, usable or not, in the order of pairs."""
        support = self.directions.num_inliers[self.directions.usable()]
        usable = iter(pair_rows(self.placement, support, [piece.placement for piece in self.further]))
        names = self.model.names
        return [
            next(usable)
            if status is DirectionStatus.USABLE
            else PairRow(name1=names[i], name2=names[j], support=support, reason=status.value)
            for (i, j), status, support in zip(
                self.directions.pairs.tolist(),
                self.directions.status,
                self.directions.num_inliers.tolist(),
                strict=True,
            )
        ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FurtherPiece:
    """A rigid piece beside the largest: directions do not say how large it is, nor where it stands."""

    placement: Placement
    """Its solution; `placement.piece` is its number."""
    kept: BoolArray
    """Which of the placement's cameras are in its model; the others are not trusted enough."""
    gauge: Gauge
    """From the solver's units to those of its model, a unit of its own."""
    reconstruction: "pycolmap.Reconstruction"
    """Its seeded model."""
    image_ids: IntArray
    """(k,) the images of the placement's cameras."""

    @property
    def cameras(self) -> list[CameraRow]:
        """One row per camera of the piece."""
        centers = _centers_of(self.reconstruction, self.image_ids, self.kept)
        return own_camera_rows(self.placement, centers, self.gauge.similarity.scale)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphResult:
    """A bare view graph, placed. Locations are in the solver's units, centroid 0."""

    path: Path
    """The graph's file."""
    options: PlacementOptions
    placement: Placement
    further: tuple[Placement, ...]
    """The further rigid pieces of three nodes or more, each with a scale of its own."""
    timings_s: dict[str, float]
    """Wall-clock seconds per stage."""

    @property
    def cameras(self) -> list[CameraRow]:
        """One row per node."""
        return camera_rows(self.placement, self.placement.locations, 1.0, self.further)

    @property
    def pairs(self) -> list[PairRow]:
        """One row per edge."""
        support = np.zeros(self.placement.num_pairs, dtype=np.int64)
        return pair_rows(self.placement, support, self.further)


def _centers_of(
    reconstruction: "pycolmap.Reconstruction", image_ids: IntArray, kept: BoolArray
) -> FloatArray:
    """Return the centres (k, 3) of images, NaN for those that are not kept."""
    centers = np.full((len(kept), 3), np.nan)
    centers[kept] = [reconstruction.image(i).projection_center() for i in image_ids[kept].tolist()]
    return centers


def camera_rows(
    placement: Placement, centers: FloatArray, scale: float, further: Sequence[Placement] = ()
) -> list[CameraRow]:
    """Return one row per camera of a placed graph.

    Args:
        placement: the graph and its solution.
        centers: (k, d) centres of the placed cameras in the output's units; NaN for those that are left out
            because they are not trusted.
        scale: the output's units in one unit of the solver.
        further: the other pieces that are solved; the rows of their cameras say where they stand.
    """
    graph = placement.graph
    homes = _home_pieces(placement)
    reasons = _with_folders(left_out_reasons(graph, placement.pieces), further)
    degrees = np.bincount(graph.edges[: placement.num_pairs].ravel(), minlength=placement.num_cameras)
    rows = [
        CameraRow(
            name=_name(graph, camera), piece=homes[camera], degree=degree, reason=reasons.get(camera, "")
        )
        for camera, degree in enumerate(degrees.tolist())
    ]
    for camera, row in zip(
        placement.cameras.tolist(), own_camera_rows(placement, centers, scale), strict=True
    ):
        rows[camera] = replace(row, degree=rows[camera].degree)
    return rows


def own_camera_rows(placement: Placement, centers: FloatArray, scale: float) -> list[CameraRow]:
    """Return the rows of the cameras of the piece that is solved; arguments as of `camera_rows`."""
    graph, assessment = placement.graph, placement.assessment
    inside = graph.edges[placement.edges[placement.pairs]]
    degrees = np.bincount(inside.ravel(), minlength=graph.num_cameras)
    sigmas = scale * assessment.sigmas
    rows = []
    for k, camera in enumerate(placement.cameras.tolist()):
        kept = bool(np.isfinite(centers[k]).all())
        trust, reason = float(assessment.trust[k]), assessment.reasons[k]
        rows.append(
            CameraRow(
                name=_name(graph, camera),
                placed=kept,
                reason=reason if kept else f"not trusted ({trust:.2f}): {reason}",
                piece=placement.piece,
                center=tuple(centers[k].tolist()) if kept else (),
                degree=int(degrees[camera]),
                trust=trust,
                sigma=tuple(sigmas[k].tolist()),
            )
        )
    return rows


def _with_folders(reasons: dict[int, str], further: Sequence[Placement]) -> dict[int, str]:
    """Add to the reason for which a camera is left out in which further pieces it stands."""
    homes: dict[int, list[str]] = {}
    for placement in further:
        for camera in placement.cameras.tolist():
            homes.setdefault(camera, []).append(_folder(placement.piece))
    return {
        camera: f"{reason}; see {', '.join(homes[camera])}" if camera in homes else reason
        for camera, reason in reasons.items()
    }


def _folder(piece: int) -> str:
    """Return where a piece stands in the output."""
    return f"pieces/{piece}" if piece else "."


def pair_rows(placement: Placement, support: IntArray, further: Sequence[Placement] = ()) -> list[PairRow]:
    """Return one row per pair of cameras.

    Args:
        placement: the graph and its largest piece.
        support: (m,) the pairs' number of inlier matches.
        further: the other pieces that are solved; their pairs are judged by them.
    """
    graph = placement.graph
    judged: dict[int, tuple[Placement, int, float]] = {}
    for piece in (placement, *further):
        dual_norms = np.linalg.norm(piece.solve.dual, axis=1) / graph.weights[piece.edges]
        judged |= {edge: (piece, e, dual_norms[e]) for e, edge in enumerate(piece.edges.tolist())}
    rows = []
    for edge, (i, j) in enumerate(graph.edges[: placement.num_pairs].tolist()):
        row = PairRow(
            name1=_name(graph, i),
            name2=_name(graph, j),
            direction=tuple(graph.directions[edge].tolist()),
            support=int(support[edge]),
            weight=float(graph.weights[edge]),
        )
        if edge not in judged:
            rows.append(replace(row, reason="outside the pieces that are solved"))
            continue
        piece, e, dual_norm = judged[edge]
        assessment = piece.assessment
        verdict = assessment.verdict(e)
        rows.append(
            replace(
                row,
                residual_deg=float(assessment.residuals_deg[e]),
                dual_norm=float(dual_norm),
                leverage=float(assessment.leverages[e]),
                verdict=verdict.value,
                reason=_UNCHECKED if verdict is Verdict.UNDETERMINED else "",
            )
        )
    return rows


def piece_rows(placement: Placement, solved: Sequence[tuple[int, str, int]]) -> list[PieceRow]:
    """Return one row per parallel-rigid piece of three cameras or more, and for the largest.

    Args:
        placement: the graph and its largest piece.
        solved: number, scale and number of placed cameras of each piece that is solved.
    """
    facts = {number: (scale, num_placed) for number, scale, num_placed in solved}
    large = max(count_large(placement.pieces, placement.num_cameras), 1)
    rows = []
    for k, piece in enumerate(placement.pieces[:large]):
        scale, num_placed = facts.get(k, (_NOT_SOLVED, 0))
        hinges = piece.hinges[piece.hinges < placement.num_cameras]
        rows.append(
            PieceRow(
                num_cameras=int(np.sum(piece.cameras < placement.num_cameras)),
                scale=scale,
                hinges=[_name(placement.graph, hinge) for hinge in hinges.tolist()],
                folder=_folder(k) if k in facts else "",
                num_placed=num_placed,
            )
        )
    return rows


def _pieces_of(found: LocateResult) -> list[PieceRow]:
    solved = [(0, found.gauge.statement, int(np.sum(found.kept)))]
    solved += [(p.placement.piece, p.gauge.statement, int(np.sum(p.kept))) for p in found.further]
    return piece_rows(found.placement, solved)


def summary(found: LocateResult) -> dict[str, Any]:
    """Return what stands in locate.json: plain values, schema version first."""
    placement = found.placement
    num_unusable = len(found.directions.pairs) - placement.num_pairs
    return {
        "schema_version": SCHEMA_VERSION,
        "inputs": {
            "model": str(found.inputs.folder or "in memory"),
            "database": found.inputs.database and str(found.inputs.database),
            "directions": found.inputs.statement,
        },
        "options": asdict(found.options),
        "num_images": len(_all_names(found)),
        "num_placed": int(np.sum(found.kept)),
        "not_trusted": _not_trusted(found),
        "num_pairs": len(found.directions.pairs),
        "num_pairs_rejected": num_unusable + len(placement.rejected_pairs),
        "pairs": {status.name.lower(): count for status, count in found.directions.counts().items()}
        | {"outlier": len(placement.rejected_pairs)},
        "num_points": found.reconstruction.num_points3D(),
        "mean_reprojection_error_px": found.reconstruction.compute_mean_reprojection_error(),
        "num_points_as_nodes": int(np.sum(placement.nodes >= placement.num_cameras)),
        "residual_level_deg": placement.assessment.level_deg,
        "loose_groups": _loose_groups(placement),
        "scale": found.gauge.statement,
        "pieces": [asdict(row) for row in _pieces_of(found)],
        "solve": solve_summary(found.solve),
        "finish": _finish_summary(placement.finish),
        "rotation_refinement": _refinement_summary(found.turned_deg),
        "bundle_adjustment": found.adjusted and _adjustment_summary(found.adjusted),
        "timings_s": found.timings_s,
        "warnings": list(found.warnings),
        "versions": _versions(),
    }


def graph_summary(found: GraphResult) -> dict[str, Any]:
    """Return what stands in the locate.json of a bare graph."""
    placement = found.placement
    return {
        "schema_version": SCHEMA_VERSION,
        "inputs": {"graph": str(found.path)},
        "options": asdict(found.options),
        "dimension": placement.graph.dimension,
        "num_images": placement.graph.num_cameras,
        "num_placed": len(placement.cameras),
        "num_pairs": placement.num_pairs,
        "num_pairs_rejected": len(placement.rejected_pairs),
        "residual_level_deg": placement.assessment.level_deg,
        "loose_groups": _loose_groups(placement),
        "pieces": [
            asdict(row)
            for row in piece_rows(
                placement,
                [(p.piece, _SOLVER_SCALE, len(p.cameras)) for p in (placement, *found.further)],
            )
        ],
        "solve": solve_summary(placement.solve),
        "finish": _finish_summary(placement.finish),
        "timings_s": found.timings_s,
        "warnings": list(quality_warnings(placement)),
        "versions": _versions(),
    }


def quality_warnings(placement: Placement) -> Iterator[str]:
    """Yield what the user should know about a solution, a sentence each."""
    if placement.solve.status is not Status.CONVERGED:
        yield f"the solve is not certified to the tolerance: {placement.solve.status.value}"
    if placement.solve.unique is False:
        yield "other placements may fit as well: the certificate does not prove the optimum unique"
    level = placement.assessment.level_deg
    if level > _ALARMING_LEVEL_DEG:
        yield f"the directions are {level:.0f} deg off the solution; do not trust it without a look"
    yield from _collapse(placement.finish)
    yield from _uncertain_cameras(placement)
    share = len(placement.rejected_pairs) / max(len(placement.pairs), 1)
    if share > _ALARMING_SHARE:
        yield f"{share:.0%} of the pairs contradict the solution; do not trust it without a look"


def _collapse(finish: Finish) -> Iterator[str]:
    """Yield a warning where the two convex programs disagree about lengths."""
    if not finish.collapsed:
        return
    assert finish.disagreement is not None
    yield (
        f"ShapeFit and LUD disagree about lengths (by {finish.disagreement:.0%}), as they do on long chains "
        f"and under heavy corruption; kept: {finish.start}"
        + ("" if finish.refined else ", unrefined; --objective auto refines both and compares")
    )


def _not_trusted(found: LocateResult) -> dict[str, str]:
    """Return the reason for each camera that is left out because it is not trusted."""
    placement = found.placement
    return {
        _name(placement.graph, int(placement.cameras[k])): placement.assessment.reasons[k]
        for k in np.flatnonzero(~found.kept).tolist()
    }


def _loose_groups(placement: Placement) -> list[dict[str, Any]]:
    """Return the groups of cameras that are rigid by the graph but loose by the geometry."""
    return [
        {
            "cameras": [_name(placement.graph, int(placement.cameras[k])) for k in group.cameras.tolist()],
            "cause": group.cause.value,
        }
        for group in placement.assessment.loose_groups
    ]


def trust_warnings(placement: Placement, kept: BoolArray) -> Iterator[str]:
    """Yield which cameras are left out for want of trust, if any are."""
    lost = np.flatnonzero(~kept)
    if len(lost):
        worst = int(lost[np.argmin(placement.assessment.trust[lost])])
        name, reason = (
            _name(placement.graph, int(placement.cameras[worst])),
            placement.assessment.reasons[worst],
        )
        yield (
            f"{len(lost)} cameras are left out because they are not trusted, above all {name} ({reason}); "
            "--min-trust 0 keeps them"
        )


def _uncertain_cameras(placement: Placement) -> Iterator[str]:
    """Yield a warning that names the least certain camera, if any is uncertain."""
    extent = float(np.linalg.norm(np.ptp(placement.locations, axis=0)))
    largest = placement.assessment.sigmas[: len(placement.cameras)].max(axis=1)
    uncertain = int(np.sum(largest > _UNCERTAIN_SHARE * extent))
    if np.isnan(largest).any():
        yield "standard deviations are left out: the graph is too large, or too loose, for their factor"
    if uncertain and len(placement.cameras) >= SMALLEST_PIECE:
        worst = _name(placement.graph, int(placement.cameras[np.argmax(largest)]))
        yield (
            f"{uncertain} cameras are uncertain by more than {_UNCERTAIN_SHARE:.0%} of the extent, "
            f"above all {worst}; see sigma and trust in cameras.csv"
        )


def write_result(
    found: LocateResult, out: Path | str, *, overwrite: bool = False, protect: Sequence[Path | str] = ()
) -> None:
    """Write the seeded model and its tables into a folder that appears whole or not at all.

    Args:
        found: what `locate` returned.
        out: the folder to be made.
        overwrite: replace an earlier output of this package.
        protect: paths that `out` must not be or contain, beside the inputs of `found`.

    Raises:
        InputError: if the folder exists, cannot be written, or would hit a protected path.
    """
    inputs = [path for path in (found.inputs.folder, found.inputs.database) if path is not None]
    with atomic_folder(out, overwrite=overwrite, protect=[*inputs, *protect]) as folder:
        write_model(found.reconstruction, folder)
        _write_tables(found, summary(found), folder)
        for piece in found.further:
            subfolder = folder / _folder(piece.placement.piece)
            subfolder.mkdir(parents=True)
            write_model(piece.reconstruction, subfolder)
            write_rows(piece.cameras, CameraRow, 3, subfolder / "cameras.csv")


def write_graph_result(found: GraphResult, out: Path | str, *, overwrite: bool = False) -> None:
    """Write the tables of a bare graph like `write_result`; there is no model."""
    with atomic_folder(out, overwrite=overwrite, protect=[found.path]) as folder:
        _write_tables(found, graph_summary(found), folder)
        for piece in found.further:
            subfolder = folder / _folder(piece.piece)
            subfolder.mkdir(parents=True)
            rows = own_camera_rows(piece, piece.locations, 1.0)
            write_rows(rows, CameraRow, piece.graph.dimension, subfolder / "cameras.csv")


def _write_tables(found: LocateResult | GraphResult, facts: dict[str, Any], folder: Path) -> None:
    dimension = found.placement.graph.dimension
    write_rows(found.cameras, CameraRow, dimension, folder / "cameras.csv")
    write_rows(found.pairs, PairRow, dimension, folder / "pairs.csv")
    write_json(facts, folder / MARKER)


def _versions() -> dict[str, str]:
    others = ("pycolmap", "numpy", "scipy", "clarabel")
    return {"sfm_shapefit": __version__} | {name: version(name) for name in others}


def _name(graph: ViewGraph, camera: int) -> str:
    return str(camera) if graph.names is None else graph.names[camera]


def _all_names(found: LocateResult) -> list[str]:
    """Return the names of all images of the input, posed or not."""
    return [image.name for image in found.model.reconstruction.images.values()]


def _home_pieces(placement: Placement) -> list[int | None]:
    """Return the first piece of three cameras or more that holds each camera, or the largest."""
    homes: list[int | None] = [None] * placement.graph.num_cameras
    large = max(count_large(placement.pieces, placement.num_cameras), 1)
    for k in reversed(range(large)):
        for camera in placement.pieces[k].cameras.tolist():
            homes[camera] = k
    return homes


def _without_direction(directions: PairDirections, graph: ViewGraph) -> dict[int, str]:
    """Say, for the cameras none of whose pairs has a usable direction, what became of their pairs."""
    causes: dict[int, Counter[str]] = {c: Counter() for c in np.flatnonzero(graph.degrees() == 0).tolist()}
    for pair, status in zip(directions.pairs.tolist(), directions.status, strict=True):
        for camera in pair:
            if camera in causes:
                causes[camera][status.value] += 1
    reasons = dict.fromkeys(causes, "no matches with any posed image")
    for camera, counter in causes.items():
        for cause, count in counter.most_common(1):
            total = counter.total()
            reasons[camera] = f"no usable direction in {total} pairs, most often ({count}): {cause}"
    return reasons


def _finish_summary(finish: Finish) -> dict[str, Any]:
    lud = finish.lud
    return {
        "start": finish.start,
        "refined": finish.refined,
        "reason": finish.reason,
        "disagreement": finish.disagreement,
        "costs": finish.costs,
        "levels_deg": list(finish.levels_deg),
        "moved_median": finish.moved[0],
        "moved_max": finish.moved[1],
        "num_turned_pairs": finish.num_turned_pairs,
        "num_put_back": finish.num_put_back,
        "lud": lud
        and {
            "objective": lud.objective,
            "dual_bound": lud.dual_bound,
            "equality_residual": lud.equality_residual,
            "iterations": lud.iterations,
        },
    }


def _adjustment_summary(adjusted: Adjusted) -> dict[str, Any]:
    return {
        "converged": adjusted.converged,
        "iterations": adjusted.iterations,
        "initial_error_px": adjusted.initial_error_px,
        "final_error_px": adjusted.final_error_px,
    }


def _refinement_summary(turned_deg: FloatArray | None) -> dict[str, Any] | None:
    if turned_deg is None:
        return None
    changed = turned_deg[turned_deg > 0.0]
    return {
        "num_updated": len(changed),
        "num_kept": len(turned_deg) - len(changed),
        "median_change_deg": float(np.median(changed)) if len(changed) else 0.0,
        "max_change_deg": float(changed.max(initial=0.0)),
    }
