"""locate.json: the answer in plain values, schema version first."""

from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, cast

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.colmap.adjustment import Adjusted
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.refinement.starts import RefinedPlacement
from sfm_shapefit.results import json_types
from sfm_shapefit.results.json_types import (
    BundleAdjustment,
    GraphSummary,
    LocateSummary,
    LooseGroup,
    Piece,
    RigidGroups,
    RotationRefinement,
    Solve,
)
from sfm_shapefit.results.rows import piece_rows
from sfm_shapefit.results.tables import IN_MEMORY, SCHEMA_VERSION
from sfm_shapefit.results.warnings import graph_warnings

if TYPE_CHECKING:
    from sfm_shapefit.results.result import GraphResult, LocateResult

_SOLVER_SCALE = "solver: the weighted mean length along the directions is 1, the centroid 0"
_QUANTILES = (25, 50, 75, 90)
_ANGLES_DEG = (1, 2, 5, 10, 30, 90)


def summarize_model(found: "LocateResult") -> LocateSummary:
    """Return what stands in locate.json: plain values, schema version first."""
    placement = found.placement
    num_unusable = len(found.directions.pairs) - placement.num_pairs
    return {
        "schema_version": SCHEMA_VERSION,
        "inputs": {
            "model": str(found.inputs.folder or IN_MEMORY),
            "database": None if found.inputs.database is None else str(found.inputs.database),
            "directions": found.inputs.statement,
        },
        "options": asdict(found.options),
        "num_images": len(found.image_names),
        "num_placed": found.reconstruction.num_reg_images(),
        "not_trusted": _not_trusted(found),
        "num_pairs": len(found.directions.pairs),
        "num_pairs_rejected": num_unusable + len(placement.rejected_pairs),
        "pairs": {status.name.lower(): count for status, count in found.directions.counts().items()}
        | {"outlier": len(placement.rejected_pairs)},
        "num_points": found.reconstruction.num_points3D(),
        "mean_reprojection_error_px": found.reconstruction.compute_mean_reprojection_error(),
        "num_points_as_nodes": int(np.sum(placement.nodes >= placement.num_cameras)),
        "num_pairs_filtered": len(placement.dropped),
        "residual_level_deg": placement.assessment.level_deg,
        "residuals_deg": residuals_deg(placement),
        "loose_groups": _loose_groups(placement),
        "scale": found.gauge.statement,
        "rigid_groups": _summarize_groups(found),
        "pieces": _pieces_of(found),
        "solve": cast("Solve", found.certified.summary()),
        "finish": _summarize_finish(placement.refined),
        "rotation_refinement": _summarize_rotations(found.turned_deg),
        "bundle_adjustment": None if found.adjusted is None else _summarize_adjustment(found.adjusted),
        "timings_s": found.timings_s,
        "warnings": list(found.warnings),
        "versions": _versions(),
    }


def summarize_graph(found: "GraphResult") -> GraphSummary:
    """Return what stands in the locate.json of a bare graph."""
    placement = found.placement
    return {
        "schema_version": SCHEMA_VERSION,
        "inputs": {"graph": str(found.path), "directions": found.statement},
        "options": asdict(found.options),
        "dimension": placement.graph.dimension,
        "num_images": placement.graph.num_nodes,
        "num_placed": len(placement.cameras),
        "num_pairs": placement.num_pairs,
        "num_pairs_rejected": len(placement.rejected_pairs),
        "num_pairs_filtered": len(placement.dropped),
        "residual_level_deg": placement.assessment.level_deg,
        "residuals_deg": residuals_deg(placement),
        "loose_groups": _loose_groups(placement),
        "pieces": _describe_pieces(
            placement, [(p.piece, _SOLVER_SCALE, len(p.cameras)) for p in (placement, *found.further)]
        ),
        "solve": cast("Solve", placement.certified.summary()),
        "finish": _summarize_finish(placement.refined),
        "timings_s": found.timings_s,
        "warnings": list(graph_warnings(placement)),
        "versions": _versions(),
    }


def _summarize_groups(found: "LocateResult") -> RigidGroups | None:
    """Return what moved together: frames of rigs, and fixed cameras; None where each camera moves by
    itself."""
    placement = found.placement
    if placement.groups is None:
        return None
    cameras = placement.groups.group_of[: placement.num_cameras]
    pairs = placement.graph.edges[: placement.num_pairs]
    return {
        "num_groups": len(np.unique(cameras)),
        "num_placed": len(np.unique(cameras[placement.cameras[found.kept]])),
        "num_fixed": 0 if found.fixed is None else int(np.sum(found.fixed)),
        "num_inner_pairs": int(np.sum(~placement.groups.joins(pairs))),
    }


def residuals_deg(placement: Placement) -> dict[str, float]:
    """Return quantiles of the placed pairs' residuals in degrees, and the shares that lie beyond angles."""
    residuals = placement.assessment.residuals_deg[placement.pairs]
    facts = {f"quantile_{q}": float(np.quantile(residuals, q / 100.0)) for q in _QUANTILES}
    return facts | {f"share_beyond_{angle}": float(np.mean(residuals > angle)) for angle in _ANGLES_DEG}


def _pieces_of(found: "LocateResult") -> list[Piece]:
    solved = [(0, found.gauge.statement, int(np.sum(found.kept)))]
    solved += [(p.placement.piece, p.gauge.statement, int(np.sum(p.kept))) for p in found.further]
    return _describe_pieces(found.placement, solved)


def _describe_pieces(placement: Placement, solved: list[tuple[int, str, int]]) -> list[Piece]:
    """Return the pieces of three cameras or more; arguments as of `piece_rows`."""
    return [cast("Piece", asdict(row)) for row in piece_rows(placement, solved)]


def _not_trusted(found: "LocateResult") -> dict[str, str]:
    """Return the reason for each camera that is left out because it is not trusted."""
    placement = found.placement
    return {
        placement.graph.name_of(int(placement.cameras[k])): placement.assessment.reasons[k]
        for k in np.flatnonzero(~found.kept).tolist()
    }


def _loose_groups(placement: Placement) -> list[LooseGroup]:
    """Return the groups of cameras that are rigid by the graph but loose by the geometry."""
    return [
        {
            "cameras": [placement.graph.name_of(int(placement.cameras[k])) for k in group.cameras.tolist()],
            "cause": group.cause.value,
        }
        for group in placement.assessment.loose_groups
    ]


def _summarize_finish(refined: RefinedPlacement) -> json_types.Finish:
    lud = refined.lud
    return {
        "start": refined.start,
        "refined": refined.is_refined,
        "reason": refined.reason,
        "disagreement": refined.disagreement,
        "costs": refined.costs,
        "levels_deg": list(refined.levels_deg),
        "moved_median": refined.moved[0],
        "moved_max": refined.moved[1],
        "num_turned_pairs": refined.num_turned_pairs,
        "num_put_back": len(refined.reset_nodes),
        "lud": None
        if lud is None
        else {
            "objective": lud.objective,
            "dual_bound": lud.dual_bound,
            "equality_residual": lud.equality_residual,
            "iterations": lud.iterations,
        },
    }


def _summarize_rotations(turned_deg: FloatArray | None) -> RotationRefinement | None:
    if turned_deg is None:
        return None
    changed = turned_deg[turned_deg > 0.0]
    return {
        "num_updated": len(changed),
        "num_kept": len(turned_deg) - len(changed),
        "median_change_deg": float(np.median(changed)) if len(changed) else 0.0,
        "max_change_deg": float(changed.max(initial=0.0)),
    }


def _summarize_adjustment(adjusted: Adjusted) -> BundleAdjustment:
    return {
        "converged": adjusted.converged,
        "iterations": adjusted.iterations,
        "initial_error_px": adjusted.initial_error_px,
        "final_error_px": adjusted.final_error_px,
    }


def _versions() -> dict[str, str]:
    others = ("pycolmap", "numpy", "scipy", "clarabel")
    return {"sfm_shapefit": __version__} | {name: version(name) for name in others}
