"""The README's picture: `python scripts/figure.py courtyard --out docs/courtyard.png`.

The bundled courtyard from above: on the left what `locate` is given (a direction per pair, a quarter of
them wrong), on the right what it returns, colored by verdict.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import sfm_shapefit

SCENE = Path(__file__).parents[2] / "data_synthetic" / "courtyard"
INLIER, OUTLIER, CAMERA, POINT = "#2a9d5c", "#d1495b", "#1d3557", "#a0a0a0"
STUB_M = 1.5
"""Length at which directions are drawn; they have none."""


def run(_args: argparse.Namespace) -> Figure:
    """Locate the cameras of the courtyard and draw two plans, of what is given and of what is found."""
    found = sfm_shapefit.locate(SCENE / "truth", SCENE / "database.db")
    figure, (given, solved) = plt.subplots(1, 2, figsize=(11, 4.9), dpi=110, sharex=True, sharey=True)
    images = [found.reconstruction.image(i) for i in found.model.image_ids.tolist()]
    centers = np.array([image.projection_center() for image in images])
    forward = np.array([image.cam_from_world().rotation.matrix()[2] for image in images])
    placement, inliers = found.placement, found.placement.assessment.inliers[found.placement.pairs]
    edges = placement.graph.edges[placement.edges[placement.pairs]]
    directions = placement.graph.directions[placement.edges[placement.pairs]]

    for (i, j), v in zip(edges, directions, strict=True):
        for start, end in ((centers[i], centers[i] - STUB_M * v), (centers[j], centers[j] + STUB_M * v)):
            given.plot(*zip(start[:2], end[:2], strict=True), color="#6c757d", lw=0.8, alpha=0.8)
    given.set_title(f"given: {len(images)} rotations, {len(edges)} directions, 44 of them wrong")

    points = np.array([point.xyz for point in found.reconstruction.points3D.values()])
    solved.scatter(points[:, 0], points[:, 1], s=1.5, color=POINT, linewidths=0)
    order = np.argsort(~inliers, kind="stable")
    for e in order:
        i, j = edges[e]
        color = INLIER if inliers[e] else OUTLIER
        ends = np.stack([centers[i], centers[j]])
        solved.plot(ends[:, 0], ends[:, 1], color=color, lw=0.7, alpha=0.55 if color == INLIER else 0.9)
    rejected = int(np.sum(~inliers))
    for color, label in ((INLIER, "agrees with the solution"), (OUTLIER, "contradicts it")):
        solved.plot([], [], color=color, label=label)
    solved.legend(loc="lower center", bbox_to_anchor=(0.5, 0.08), ncols=2, fontsize=8)
    solved.set_title(
        f"found: {len(placement.cameras)} cameras, {rejected} pairs rejected, {len(points)} points"
    )

    for axes in (given, solved):
        axes.quiver(*centers[:, :2].T, *forward[:, :2].T, color=CAMERA, width=0.006, scale=22, zorder=5)
        axes.scatter(*centers[:, :2].T, s=16, color=CAMERA, zorder=6)
        axes.set_aspect("equal")
        axes.set_xlim(-13, 13)
        axes.set_ylim(-10.2, 10.2)
        axes.set_xlabel("x [m]")
    given.set_ylabel("y [m]")
    figure.tight_layout()
    return figure
