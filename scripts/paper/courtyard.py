"""The README's picture: `python scripts/figure.py courtyard --out docs/courtyard.png`.

The bundled courtyard before and after `locate`. Before, all centers are 0, and nothing has a position: the
cameras' viewing directions start at one point, and the pairs are drawn as a matrix of the images. After, the
cameras and points stand where `locate` put them, seen from above.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pycolmap
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import sfm_shapefit
from sfm_shapefit.base.geometry import fit_similarity_l1

SCENE = Path(__file__).parents[2] / "data_synthetic" / "courtyard"
INLIER, OUTLIER, CAMERA, POINT, GIVEN = "#2a9d5c", "#d1495b", "#1d3557", "#a0a0a0", "#6c757d"


def run(_args: argparse.Namespace) -> Figure:
    """Locate the cameras of the courtyard; draw what is given and what is found."""
    given = pycolmap.Reconstruction(SCENE / "sparse" / "0")
    found = sfm_shapefit.locate(given, SCENE / "database.db")
    figure, (rotations, pairs, after) = plt.subplots(
        1, 3, figsize=(12, 4.3), dpi=100, width_ratios=(0.8, 0.8, 1.4)
    )
    _draw_rotations(rotations, given)
    _draw_pairs(pairs, found)
    _draw_scene(after, found)
    rotations.set_xlim(-1.1, 1.1)
    rotations.set_ylim(-1.1, 1.1)
    rotations.axis("off")
    for axes in (rotations, pairs, after):
        axes.set_aspect("equal")
        axes.title.set_fontsize(10)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.97))
    return figure


def _draw_rotations(axes: Axes, given: pycolmap.Reconstruction) -> None:
    """Draw where the cameras of the input look, from the one point where they all stand."""
    images = given.images.values()
    centers = np.array([image.projection_center() for image in images])
    assert not centers.any()
    forward = np.array([image.cam_from_world().rotation.matrix()[2] for image in images])
    axes.quiver(*centers[:, :2].T, *forward[:, :2].T, color=CAMERA, width=0.008, scale=2.4)
    axes.set_title(f"given: {len(centers)} rotations\n(every position is 0)")


def _draw_pairs(axes: Axes, found: sfm_shapefit.LocateResult) -> None:
    """Draw which images have matches with which, in the order of their names."""
    names = {name: k for k, name in enumerate(sorted(row.name for row in found.cameras))}
    pairs = np.array([(names[pair.name1], names[pair.name2]) for pair in found.pairs])
    both = np.concatenate([pairs, pairs[:, ::-1]])
    axes.scatter(*both.T, s=22, marker="s", color=GIVEN, linewidths=0)
    axes.set_xlim(-1, len(names))
    axes.set_ylim(len(names), -1)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlabel("image")
    axes.set_ylabel("image")
    wrong = sum(pair.verdict == "outlier" for pair in found.pairs)
    axes.set_title(f"given: matches of {len(found.pairs)} pairs,\n{wrong} of them wrong (nobody says which)")


def _draw_scene(axes: Axes, found: sfm_shapefit.LocateResult) -> None:
    """Draw cameras, points and the verdict on each pair, in the units of the truth."""
    truth = pycolmap.Reconstruction(SCENE / "truth")
    model = found.reconstruction
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    centers = {name: image.projection_center() for name, image in placed.items()}
    exact = np.array([truth.find_image_with_name(name).projection_center() for name in centers])
    onto = fit_similarity_l1(np.array(list(centers.values())), exact)
    at = dict(zip(centers, onto.apply(np.array(list(centers.values()))), strict=True))
    points = onto.apply(np.array([point.xyz for point in model.points3D.values()]))
    axes.scatter(points[:, 0], points[:, 1], s=1.5, color=POINT, linewidths=0)
    for pair in sorted(found.pairs, key=lambda pair: pair.verdict == "outlier"):
        wrong = pair.verdict == "outlier"
        ends = np.array([at[pair.name1], at[pair.name2]])
        axes.plot(
            ends[:, 0], ends[:, 1], color=OUTLIER if wrong else INLIER, lw=0.7, alpha=0.9 if wrong else 0.5
        )
    there = np.array(list(at.values()))
    forward = np.array([image.cam_from_world().rotation.matrix()[2] for image in placed.values()])
    forward = forward @ onto.rotation.T
    axes.quiver(*there[:, :2].T, *forward[:, :2].T, color=CAMERA, width=0.006, scale=22, zorder=5)
    axes.scatter(*there[:, :2].T, s=16, color=CAMERA, zorder=6)
    for color, label in ((INLIER, "agrees"), (OUTLIER, "contradicts")):
        axes.plot([], [], color=color, label=label)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.9), ncols=2, fontsize=8)
    axes.set_xlim(-13, 13)
    axes.set_ylim(-10.2, 10.2)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(f"found: {len(at)} positions, {len(points)} points,\na verdict on every pair")
