"""locate.json: the answer in plain values, schema version first."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.facts.grade import ModelVerdict
from sfm_shapefit.facts.json_types import (
    BundleAdjustment,
    EarthDatum,
    GraphSummary,
    JudgedModel,
    KnownDistance,
    LocateSummary,
    LoopOfVideo,
    Lud,
    PlacementAdjustment,
    PlacementSummary,
    RigidGroups,
    RotationRefinement,
    Solve,
)
from sfm_shapefit.facts.key_figures import NOISE_ONLY, SOLVER_UNITS, UNITS, key_figures
from sfm_shapefit.facts.rows import piece_rows
from sfm_shapefit.facts.tables import IN_MEMORY, SCHEMA_VERSION
from sfm_shapefit.facts.warnings import graph_warnings
from sfm_shapefit.judgement.judged import Judged

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.facts.options import KnownDistance as ToldDistance
    from sfm_shapefit.facts.result import GraphResult, LocateResult, Loop

_SOLVER_SCALE = "solver: the weighted mean length along the directions is 1, the centroid 0"
_QUANTILES = (25, 50, 75, 90)
_ANGLES_DEG = (1, 2, 5, 10, 30, 90)


def summarize_model(found: "LocateResult") -> LocateSummary:
    """Return what stands in locate.json."""
    placement, model = found.placement, found.reconstruction
    solved = [(0, found.gauge.statement, int(np.sum(found.kept)))]
    solved += [(p.placement.piece, p.gauge.statement, int(np.sum(p.kept))) for p in found.further]
    num_unusable = len(found.directions.pairs) - placement.num_pairs
    focal_length_px = float(np.median(found.model.focal_lengths_px))
    return {
        **_summarize(found, solved, found.warnings, (focal_length_px, UNITS[found.gauge.scale])),
        "num_images": len(found.image_names),
        "num_placed": model.num_reg_images(),
        "num_pairs": len(found.directions.pairs),
        "num_pairs_rejected": num_unusable + len(placement.rejected_pairs),
        "inputs": {
            "model": str(found.inputs.folder or IN_MEMORY),
            "database": None if found.inputs.database is None else str(found.inputs.database),
            "directions": found.inputs.statement,
        },
        "not_trusted": {
            placement.graph.name_of(int(placement.cameras[k])): placement.assessment.reasons[k]
            for k in np.flatnonzero(~found.kept).tolist()
            if int(placement.cameras[k]) not in found.few_points
        },
        "few_points": {found.model.names[camera]: count for camera, count in found.few_points.items()},
        "pairs": {status.name.lower(): count for status, count in found.directions.counts().items()}
        | {"outlier": len(placement.rejected_pairs)},
        "agreement": {
            "pairs": _number(found.agreeing_pairs),
            "observations": _number(found.agreeing_observations),
            "contradicting": _number(found.contradicting_observations),
        },
        "num_points": model.num_points3D(),
        "mean_reprojection_error_px": model.compute_mean_reprojection_error(),
        "num_points_as_nodes": int(np.sum(placement.nodes >= placement.num_cameras)),
        "scale": found.gauge.statement,
        "scale_sigma": found.gauge.scale_sigma,
        "known_distances": told_distances(found.options.known_distance, found.reconstruction),
        "control_points": list(found.control_points),
        "datum": None if found.gauge.datum is None else cast("EarthDatum", found.gauge.datum._asdict()),
        "rigid_groups": _summarize_groups(found),
        "intrinsics": found.intrinsics.rows(model),
        "refined_rigs": list(found.rigs),
        "line_sigma": found.line_sigma,
        "num_doubtful_pairs": len(found.doubtful_pairs),
        "loops": [_summarize_loop(loop) for loop in found.loops],
        "adjustment": _summarize_adjustment(found),
        "rotation_refinement": _summarize_rotations(found.turned_deg),
        "bundle_adjustment": _pick(BundleAdjustment, found.adjusted),
        "join": found.join,
    }


def told_verdict(verdict: ModelVerdict) -> JudgedModel:
    """Return a verdict as JSON has it."""
    return {
        "grade": verdict.grade.value,
        "statement": verdict.statement,
        "cameras": list(verdict.cameras),
        "reasons": list(verdict.reasons),
    }


def told_distances(known: Sequence["ToldDistance"], model: "pycolmap.Reconstruction") -> list[KnownDistance]:
    """Return the distances that were told, each with what a model has."""
    named = {name for one in known for name in one[:2]}
    images = model.images.values() if named else ()
    centers = {i.name: i.projection_center() for i in images if i.name in named and i.has_pose}
    return [
        {
            "first": first,
            "second": second,
            "known": float(distance),
            "found": float(np.linalg.norm(centers[first] - centers[second]))
            if first in centers and second in centers
            else None,
        }
        for first, second, distance in known
    ]


def summarize_graph(found: "GraphResult") -> GraphSummary:
    """Return what stands in the locate.json of a bare graph."""
    placement = found.placement
    solved = [(p.piece, _SOLVER_SCALE, len(p.cameras)) for p in (placement, *found.further)]
    return {
        **_summarize(found, solved, graph_warnings(placement), (math.nan, SOLVER_UNITS)),
        "inputs": {"graph": str(found.path), "directions": found.statement},
        "dimension": placement.graph.dimension,
    }


def _summarize(
    found: "LocateResult | GraphResult",
    solved: list[tuple[int, str, int]],
    warnings: Iterable[str],
    measures: tuple[float, str],
) -> PlacementSummary:
    """Return what can be said of any placement, nodes counted as images.

    `solved` is as of `piece_rows`; `measures` are the focal length in pixels and the unit of positions.
    """
    placement, refined = found.placement, found.placement.refined
    residuals = residuals_deg(placement)
    others = ("pycolmap", "numpy", "scipy", "clarabel")
    return {
        "schema_version": SCHEMA_VERSION,
        "verdict": told_verdict(found.verdict),
        "options": asdict(found.options),
        "num_images": placement.graph.num_nodes,
        "num_placed": len(placement.cameras),
        "figures": key_figures(found.cameras, residuals["quantile_50"], *measures),
        "num_pairs": placement.num_pairs,
        "num_pairs_rejected": len(placement.rejected_pairs),
        "sigma_of": sigma_of(placement),
        "residual_level_deg": placement.assessment.level_deg,
        "residuals_deg": residuals,
        "loose_groups": [
            {
                "cameras": [placement.graph.name_of(c) for c in placement.cameras[group.cameras].tolist()],
                "cause": group.cause.value,
            }
            for group in placement.assessment.loose_groups
        ],
        "pieces": piece_rows(placement, solved),
        "delivered": {
            "statement": found.departure.statement,
            "from_certified_median": found.departure.median,
            "from_certified_max": found.departure.largest,
        },
        "solve": cast("Solve", placement.certified.summary()),
        "finish": {
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
            "lud": _pick(Lud, refined.lud),
        },
        "timings_s": found.timings_s,
        "warnings": list(warnings),
        "versions": {"sfm_shapefit": __version__} | {name: version(name) for name in others},
    }


def sigma_of(placement: Judged) -> str:
    """Say what the standard deviations of the cameras know of, and what they are relative to."""
    if placement.adjusted_covariances is None:
        return f"{NOISE_ONLY}; relative to the centroid and scale of the cameras that are held"
    held = ~placement.adjusted_covariances.any(axis=(1, 2))
    relative = f"{int(held.sum())} fixed cameras" if held.any() else "the model's mean position and scale"
    return f"adjusted: noise, rotations, calibration; relative to {relative}"


def _number(value: float) -> float | None:
    """Return a number that JSON has."""
    return value if math.isfinite(value) else None


def _pick(kind: Any, source: object) -> Any:
    """Return the values of a typed dictionary's keys, which are attributes of a source; None of None."""
    return None if source is None else {key: getattr(source, key) for key in kind.__annotations__}


def residuals_deg(placement: Judged) -> dict[str, float]:
    """Return quantiles of the placed pairs' residuals in degrees, and the shares that lie beyond angles."""
    residuals = placement.assessment.residuals_deg[placement.pairs]
    facts = {f"quantile_{q}": float(np.quantile(residuals, q / 100.0)) for q in _QUANTILES}
    return facts | {f"share_beyond_{angle}": float(np.mean(residuals > angle)) for angle in _ANGLES_DEG}


def _summarize_groups(found: "LocateResult") -> RigidGroups | None:
    """Return what moved together; None where each camera moves by itself."""
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


def _summarize_adjustment(found: "LocateResult") -> PlacementAdjustment | None:
    """Return how the placement was adjusted; None if it stayed as it was found."""
    if found.adjustment is None:
        return None
    weight, errors = found.adjustment.weight, found.adjustment.errors
    return {
        "statement": found.adjustment.statement,
        "rotations": "held" if weight.hold else "free" if weight.sigma_rad is None else "weighted",
        "rotation_sigma_deg": None if weight.sigma_rad is None else math.degrees(weight.sigma_rad),
        "chance_deg": None if errors is None else math.degrees(errors.chance_rad),
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


def _summarize_loop(loop: "Loop") -> LoopOfVideo:
    """Return a loop of a video in plain values."""
    facts = asdict(loop) | {"first": list(loop.first), "second": list(loop.second)}
    return cast("LoopOfVideo", facts)
