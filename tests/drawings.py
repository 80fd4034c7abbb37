"""Scenes to be drawn, made without solving anything: a ring of cameras around points, some pairs wrong."""

from dataclasses import fields, replace

import numpy as np

from sfm_shapefit.facts.model import ModelFacts, ModelInputs
from sfm_shapefit.facts.placed import Delivered, KeyFigures, LooseGroup, Piece
from sfm_shapefit.facts.tables import CameraRow, MethodScores, PairRow, Table
from sfm_shapefit.files.colmap.seed import PickedPoints
from sfm_shapefit.judgement.reasons import Grade, ModelVerdict
from sfm_shapefit.judgement.support import EvidenceShares
from sfm_shapefit.refinement.starts import Finish
from sfm_shapefit.report.drawing import Poses, build_drawing
from sfm_shapefit.solver.solver_options import Solve

UNDETERMINED_EVERY, NO_DIRECTION_EVERY, WRONG_EVERY = 50, 30, 7


def make_drawing(num_cameras=25, num_pairs=120, num_points=500, names=None, seed=0):
    """Return a drawing and what is told of it."""
    rng = np.random.default_rng(seed)
    names = names or [f"images/IMG_{k:05d}.jpg" for k in range(num_cameras)]
    centers, rotations = _ring(num_cameras, rng)
    cameras = [
        CameraRow(
            name=names[k],
            placed=k != num_cameras - 1,
            reason="no two pairs tie it to the others" if k == num_cameras - 1 else "",
            piece=0,
            center=tuple(centers[k]) if k != num_cameras - 1 else (),
            degree=8,
            trust=float(np.clip(1.1 - rng.exponential(0.12), 0, 1)) if k != num_cameras - 1 else float("nan"),
            sigma=tuple(rng.uniform(0.001, 0.02, 3)),
            correlation=(0.6, -0.3, 0.1),
        )
        for k in range(num_cameras)
    ]
    pairs = [_pair(e, names, centers, rng) for e in range(num_pairs)]
    history = [(k, 0.02 + 0.5 * 0.3**k, 0.02 - 0.2 * 0.3**k) for k in range(1, 12)]
    drawing = draw(cameras, pairs, certified=centers + rng.normal(0, 0.01, centers.shape))
    drawing = replace(drawing, history=tuple(history))
    halves = np.tile([0.6, 0.45], (num_cameras, 1))
    poses = Poses(
        rotations=rotations,
        centers=centers + rng.normal(0, 0.3, centers.shape),
        half_sizes=halves,
    )
    points = PickedPoints(
        xyz=rng.normal(0, 2.0, (num_points, 3)) * [1, 0.6, 1],
        colors=rng.integers(60, 220, (num_points, 3)).astype(np.uint8),
        num_all=3 * num_points,
        lengths=rng.integers(2, 12, num_points),
        errors_px=rng.gamma(2.0, 0.3, num_points),
    )
    pairs = replace(drawing.pairs, input_deg=drawing.pairs.residuals_deg * rng.lognormal(1.0, 0.5, num_pairs))
    drawing = replace(
        drawing,
        cameras=replace(drawing.cameras, poses=poses),
        points=points,
        pairs=pairs,
        input_is_aligned=True,
    )
    return replace(drawing, axes=np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), frustum_depth=0.3), _facts(
        names
    )


def table_of(rows, kind, dimension=3):
    """Return rows as a table; an empty vector is one of which nothing is known."""
    names = [item.name for item in fields(kind)]
    columns = {name: [getattr(row, name) for row in rows] for name in names}
    for values in columns.values():
        width = max((len(value) for value in values if isinstance(value, tuple)), default=0)
        values[:] = [(float("nan"),) * width if value == () else value for value in values]
    known = {
        name: values for name, values in columns.items() if name == names[0] or any(map(np.size, values))
    }
    return Table(kind, dimension, known)


def draw(cameras, pairs, dimension=3, **more):
    """Return the drawing of rows."""
    return build_drawing(table_of(cameras, CameraRow, dimension), table_of(pairs, PairRow, dimension), **more)


def _ring(n, rng):
    """Return centers and cam_from_world rotations of cameras that look inwards, y down."""
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    centers = np.stack([8 * np.cos(angles), rng.normal(0, 0.2, n), 8 * np.sin(angles)], axis=1)
    forward = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    right = np.cross(np.tile([0.0, 1.0, 0.0], (n, 1)), forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return centers, np.stack([right, np.cross(forward, right), forward], axis=1)


def _pair(e, names, centers, rng):
    n = len(names)
    i = e % n
    j = (i + 1 + e // n) % n
    wrong, undetermined = e % WRONG_EVERY == 0, e % UNDETERMINED_EVERY == 1
    if e % NO_DIRECTION_EVERY == 2:
        return PairRow(name1=names[i], name2=names[j], support=9, reason="too few matches")
    baseline = centers[i] - centers[j]
    direction = baseline / (np.linalg.norm(baseline) or 1.0)
    support, weight = int(rng.lognormal(4.5, 0.8)) + 15, float(rng.uniform(0.2, 1))
    return PairRow(
        name1=names[i],
        name2=names[j],
        direction=tuple(direction),
        support=support,
        residual_deg=float(rng.uniform(5, 160) if wrong else rng.lognormal(-2.5, 0.8)),
        scores=MethodScores(
            weight=weight, dual_norm=float(rng.uniform(0, 1)), leverage=float(rng.uniform(0, 0.9))
        ),
        verdict="undetermined" if undetermined else "outlier" if wrong else "inlier",
        reason="no other pair checks it" if undetermined else "",
    )


def _facts(names):
    n, start = len(names), "LUD"
    return ModelFacts(
        inputs=ModelInputs(
            model="project/sparse/0", database="project/database.db", directions="inlier matches"
        ),
        verdict=ModelVerdict(grade=Grade.LOOK, cameras=(names[0],), reasons=()),
        options={"solver": "auto", "refine": True, "scale": "input", "min_trust": 0.25},
        num_images=n,
        num_placed=n - 1,
        figures=KeyFigures(
            pair_error_deg=0.08,
            pair_error_px=1.4,
            sigma=0.015,
            sigma_of_extent=0.0007,
            sigma_unit="in the input's units",
        ),
        num_pairs=120,
        num_pairs_rejected=18,
        sigma_of="adjusted: noise, rotations, calibration; relative to the model's mean position",
        residual_level_deg=0.07,
        residuals_deg={},
        pieces=[
            Piece(num_cameras=n, scale="input", hinges=[names[0]], folder=".", num_placed=n - 1),
            Piece(num_cameras=4, scale="unit", hinges=[names[0]], folder="pieces/1", num_placed=4),
        ],
        loose_groups=[LooseGroup(cameras=list(names[:2]), cause="two agreeing pairs or fewer hold it")],
        delivered=Delivered(
            statement="ShapeFit's optimum is certified to 3.0e-09; delivered: that optimum",
            from_certified_median=0.0,
            from_certified_max=0.0,
        ),
        solve=Solve(
            status="converged",
            objective=0.02,
            dual_bound=0.02,
            gap=3e-9,
            equality_residual=0.0,
            unique=True,
            iterations=9,
            seconds=0.1,
            method="newton",
            method_reason="small",
        ),
        finish=Finish(
            reweighted=None,
            start=start,
            refined=True,
            reason="the better one",
            disagreement=None,
            costs={start: 1.0},
            levels_deg=[0.1],
            moved_median=0.0,
            moved_max=0.0,
            num_turned_pairs=0,
            num_put_back=0,
            lud=None,
        ),
        timings_s={"read": 0.11, "directions": 0.4, "solve": 0.3, "structure": 0.5},
        warnings=["3 cameras are uncertain by more than 5% of the extent"],
        versions={"sfm_shapefit": "0.1.0", "pycolmap": "4.2.1"},
        not_trusted={},
        few_points={},
        pairs={"usable": 102, "outlier": 18},
        num_contradicting=0,
        agreement=EvidenceShares(pairs=0.8, observations=None, contradicting=None),
        num_points=500,
        mean_reprojection_error_px=0.62,
        num_points_as_nodes=0,
        scale="input: scale and origin of the input's centers",
        scale_sigma=None,
        known_distances=(),
        wrong_priors={},
        control_points=(),
        datum=None,
        rigid_groups=None,
        intrinsics=(),
        refined_rigs=(),
        scale_bars=(),
        lengths=None,
        line_sigma=None,
        num_doubtful_pairs=0,
        loops=(),
        adjustment=None,
        lens_errors=None,
        rotation_refinement=None,
        bundle_adjustment=None,
        join=None,
    )
