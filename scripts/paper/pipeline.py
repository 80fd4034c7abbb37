"""Where the package stands in a pipeline: `python scripts/figure.py pipeline --out docs/pipeline.png`."""

import argparse

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

STEPS = (
    ("images", ""),
    ("matches", "COLMAP, hloc"),
    ("rotations", "averaging, a sensor,\na COLMAP model"),
    ("sfm_shapefit", "positions, points,\na verdict"),
    ("bundle adjustment", "COLMAP, Ceres"),
)
OURS, OTHERS, EDGE, GRAY = "#2a9d5c", "#f1f3f5", "#adb5bd", "#495057"
WIDTH, HEIGHT, GAP = 2.0, 0.62, 0.55


def run(_args: argparse.Namespace) -> Figure:
    """Draw a box per step, ours in color, and what makes it below."""
    figure, axes = plt.subplots(figsize=(12, 1.55), dpi=100)
    for k, (name, maker) in enumerate(STEPS):
        left, ours = k * (WIDTH + GAP), name == "sfm_shapefit"
        box = FancyBboxPatch(
            (left, 0.0), WIDTH, HEIGHT, boxstyle="round,pad=0.06", fc=OURS if ours else OTHERS, ec=EDGE
        )
        axes.add_patch(box)
        middle = left + WIDTH / 2.0
        axes.text(middle, HEIGHT / 2.0, name, ha="center", va="center", size=13, color="w" if ours else "k")
        axes.text(middle, -0.18, maker, ha="center", va="top", size=10, color=GRAY)
        if k:
            axes.annotate(
                "",
                (left - 0.1, HEIGHT / 2.0),
                (left - GAP + 0.1, HEIGHT / 2.0),
                arrowprops={"arrowstyle": "->"},
            )
    left, right = 2.0 * (WIDTH + GAP), 4.0 * (WIDTH + GAP) - GAP
    axes.plot([left, left, right, right], [0.78, 0.9, 0.9, 0.78], color=EDGE, lw=1.2)
    axes.text((left + right) / 2.0, 0.98, "map: both, from matches alone", ha="center", size=10, color=GRAY)
    axes.set_xlim(-0.2, len(STEPS) * (WIDTH + GAP) - GAP + 0.2)
    axes.set_ylim(-0.85, HEIGHT + 0.55)
    axes.axis("off")
    figure.tight_layout(pad=0.2)
    return figure
