"""What the surfaces of a rendered scene look like: painted pictures, full of corners and blobs.

A feature detector asks for structure at every scale and for nothing that appears twice. So every picture is
stones of many sizes over clouded ground, and facades have windows on top, each with its own reflections.
"""

import cv2
import numpy as np

from sfm_shapefit.synthetic.layouts import ByteArray

_STONE_AREA_PX = 700  # pixels of the picture per stone; about 26 across


def ground_texture(height_px: int, width_px: int, rng: np.random.Generator) -> ByteArray:
    """Return a picture (height, width, 3) of stones on a clouded ground."""
    tint = rng.uniform(90.0, 165.0) + rng.uniform(-18.0, 18.0, 3)
    picture = _clouds(height_px, width_px, tint, rng)
    _draw_stones(picture, height_px * width_px // _STONE_AREA_PX, rng)
    return picture


def facade_texture(height_px: int, width_px: int, story_px: int, rng: np.random.Generator) -> ByteArray:
    """Return a picture (height, width, 3) of a wall with a window about every `story_px`, both ways."""
    picture = ground_texture(height_px, width_px, rng)
    rows, columns = max(round(height_px / story_px), 1), max(round(width_px / story_px), 1)
    for row in range(rows):
        for column in range(columns):
            top = int((row + rng.uniform(0.15, 0.25)) * height_px / rows)
            left = int((column + rng.uniform(0.15, 0.25)) * width_px / columns)
            height, width = (rng.uniform(0.45, 0.6, 2) * story_px).astype(int).tolist()
            _draw_window(picture[top : top + height, left : left + width], rng)
    return picture


def _clouds(height_px: int, width_px: int, tint: np.ndarray, rng: np.random.Generator) -> ByteArray:
    """Return a picture of smooth noise at four scales around a color."""
    field = np.zeros((height_px, width_px))
    for cell_px, gray in ((128, 18.0), (32, 14.0), (8, 10.0), (3, 8.0)):
        coarse = gray * rng.standard_normal((height_px // cell_px + 2, width_px // cell_px + 2))
        field += cv2.resize(coarse, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(field[:, :, None] + tint, 0.0, 255.0), dtype=np.uint8)


def _draw_stones(picture: ByteArray, count: int, rng: np.random.Generator) -> None:
    """Paint ellipses and tilted rectangles of 2 to 40 pixels over a picture, small ones more often."""
    height_px, width_px = picture.shape[:2]
    size = 2.0 * 20.0 ** (rng.random(count) ** 2)
    at = rng.uniform([0.0, 0.0], [width_px, height_px], (count, 2))
    aspect, tilt_deg = rng.uniform(0.4, 1.0, count), rng.uniform(0.0, 180.0, count)
    color = np.clip(rng.uniform(20.0, 235.0, (count, 1)) + rng.uniform(-25.0, 25.0, (count, 3)), 0.0, 255.0)
    for k, round_one in enumerate((rng.random(count) < 0.5).tolist()):
        box = (at[k].tolist(), (float(size[k]), float(size[k] * aspect[k])), float(tilt_deg[k]))
        if round_one:
            cv2.ellipse(picture, box, color[k].tolist(), thickness=-1, lineType=cv2.LINE_AA)
        else:
            corners = np.round(cv2.boxPoints(box)).astype(np.int32)
            cv2.fillConvexPoly(picture, corners, color[k].tolist(), lineType=cv2.LINE_AA)


def _draw_window(pane: ByteArray, rng: np.random.Generator) -> None:
    """Paint a frame, dark glass with reflections and two bars into a part of a picture."""
    height_px, width_px = pane.shape[:2]
    if min(height_px, width_px) < 8:
        return
    frame_px = max(min(height_px, width_px) // 12, 1)
    pane[:] = rng.integers(190, 245, size=3)
    glass = pane[frame_px:-frame_px, frame_px:-frame_px]
    glass[:] = rng.integers(20, 80, size=3)
    _draw_stones(glass, max(glass.shape[0] * glass.shape[1] // 400, 3), rng)
    for x in rng.uniform(0.3, 0.7, 1) * width_px:
        pane[:, int(x) : int(x) + frame_px] = rng.integers(180, 245, size=3)
    for y in rng.uniform(0.3, 0.7, 1) * height_px:
        pane[int(y) : int(y) + frame_px, :] = rng.integers(180, 245, size=3)
