"""The photographs of the tutorial: eight of the sixteen, as `synth --images` draws them."""

import argparse

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from sfm_shapefit.synthetic import RenderOptions, SceneOptions, draw_image, make_rendered_scene

SCENE = SceneOptions(
    shape="courtyard",
    num_images=16,
    max_keypoints_per_image=500,
    image_width=640,
    image_height=480,
    focal_length_px=480.0,
    seed=1,
)
SHOWN = range(0, 16, 2)


def run(_args: argparse.Namespace) -> Figure:
    """Return the picture."""
    scene = make_rendered_scene(SCENE, RenderOptions(repeated_fraction=0.2))
    picture, axes = plt.subplots(2, 4, figsize=(10.0, 3.9), dpi=64, layout="constrained")
    for axis, k in zip(axes.flat, SHOWN, strict=True):
        axis.imshow(draw_image(scene, k))
        axis.set_title(f"{k + 1:04d}.jpg", fontsize=8)
        axis.axis("off")
    return picture
