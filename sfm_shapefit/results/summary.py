"""locate.json: the answer in plain values, schema version first."""

from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.colmap.adjustment import Adjusted
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.refinement.starts import Finish
from sfm_shapefit.results.result import GraphResult, LocateResult, all_names
from sfm_shapefit.results.rows import piece_rows
from sfm_shapefit.results.tables import IN_MEMORY, SCHEMA_VERSION, PieceRow, solve_summary
from sfm_shapefit.results.warnings import graph_warnings

_SOLVER_SCALE = "solver: the weighted mean length along the directions is 1, the centroid 0"
_QUANTILES = (25, 50, 75, 90)
_ANGLES_DEG = (1, 2, 5, 10, 30, 90)


def summary(found: LocateResult) -> dict[str, Any]:
    """Return what stands in locate.json: plain values, schema version first."""
    placement = found.placement
    num_unusable = len(found.directions.pairs) - placement.num_pairs
    return {
        "schema_version": SCHEMA_VERSION,
        "inputs": {
            "model": str(found.inputs.folder or IN_MEMORY),
            "database": found.inputs.database and str(found.inputs.database),
            "directions": found.inputs.statement,
        },
        "options": asdict(found.options),
        "num_images": len(all_names(found)),
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
        "rigid_groups": _groups_summary(found),
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
        "warnings": list(graph_warnings(placement)),
        "versions": _versions(),
    }


def _groups_summary(found: LocateResult) -> dict[str, int] | None:
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


def _pieces_of(found: LocateResult) -> list[PieceRow]:
    solved = [(0, found.gauge.statement, int(np.sum(found.kept)))]
    solved += [(p.placement.piece, p.gauge.statement, int(np.sum(p.kept))) for p in found.further]
    return piece_rows(found.placement, solved)


def _not_trusted(found: LocateResult) -> dict[str, str]:
    """Return the reason for each camera that is left out because it is not trusted."""
    placement = found.placement
    return {
        placement.graph.name_of(int(placement.cameras[k])): placement.assessment.reasons[k]
        for k in np.flatnonzero(~found.kept).tolist()
    }


def _loose_groups(placement: Placement) -> list[dict[str, Any]]:
    """Return the groups of cameras that are rigid by the graph but loose by the geometry."""
    return [
        {
            "cameras": [placement.graph.name_of(int(placement.cameras[k])) for k in group.cameras.tolist()],
            "cause": group.cause.value,
        }
        for group in placement.assessment.loose_groups
    ]


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


def _adjustment_summary(adjusted: Adjusted) -> dict[str, Any]:
    return {
        "converged": adjusted.converged,
        "iterations": adjusted.iterations,
        "initial_error_px": adjusted.initial_error_px,
        "final_error_px": adjusted.final_error_px,
    }


def _versions() -> dict[str, str]:
    others = ("pycolmap", "numpy", "scipy", "clarabel")
    return {"sfm_shapefit": __version__} | {name: version(name) for name in others}
