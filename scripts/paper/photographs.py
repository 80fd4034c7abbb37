"""The photographs of the tutorial: eight of the sixteen, as `synth --images` draws them."""

import argparse

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from make_data import SCENES
from sfm_shapefit.synthetic import draw_image, make_rendered_scene
from sfm_shapefit.synthetic.rendering import Canvas

BUNDLED = SCENES["photographed"]
SHOWN = range(0, 16, 2)


def run(_args: argparse.Namespace) -> Figure:
    """Return the picture."""
    scene = make_rendered_scene(BUNDLED.scene, BUNDLED.render)
    canvas = Canvas.of(scene)
    picture, axes = plt.subplots(2, 4, figsize=(10.0, 3.9), dpi=64, layout="constrained")
    for axis, k in zip(axes.flat, SHOWN, strict=True):
        axis.imshow(draw_image(scene, k, canvas))
        axis.set_title(f"{k + 1:04d}.jpg", fontsize=8)
        axis.axis("off")
    return picture
