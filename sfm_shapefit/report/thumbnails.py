"""Small pictures of the images of a model, for the report; so small that all together stay within a limit."""

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.paths import file_of, refuse_no_folder

MAX_BYTES = 4_000_000  # bytes of all pictures of a page as base64; with more it opens slowly
_WIDEST_PX = 320  # pixels, longer side of a picture; the page shows none larger
_NARROWEST_PX = 64  # pixels, longer side of a picture; nothing is seen in smaller ones
_QUALITY = 72  # percent, JPEG's own scale; its blocks are hardly seen in small pictures
_BYTES_PER_PIXEL = 0.25  # bytes of a JPEG of this quality per pixel; an estimate that only chooses the size
_BASE64 = 4.0 / 3.0  # characters per byte of base64; it holds six bits each


def read_thumbnails(folder: Path, names: Sequence[str], trust: FloatArray) -> dict[int, str]:
    """Return data URLs of small JPEG pictures by row of the names, but for rows without a readable image.

    Args:
        folder: where the images are, under their names.
        names: as the model has them, from strangers: one that leads out of the folder is left out.
        trust: of the images; the least trusted come first, in case that not all fit into `MAX_BYTES`.

    Raises:
        InputError: if the folder is none.
    """
    refuse_no_folder(folder)
    rows = np.lexsort((trust, np.isnan(trust))).tolist()
    files = {row: path for row in rows if (path := file_of(folder, names[row])) is not None}
    budget = MAX_BYTES / _BASE64 / max(len(files), 1)
    width = float(np.clip(np.sqrt(budget / _BYTES_PER_PIXEL / 0.75), _NARROWEST_PX, _WIDEST_PX))
    found, total = {}, 0
    for row, path in files.items():
        picture = _shrink(path, round(width))
        if picture is None:
            continue
        total += round(_BASE64 * len(picture)) + 30
        if total > MAX_BYTES:
            break
        found[row] = f"data:image/jpeg;base64,{base64.b64encode(picture).decode('ascii')}"
    return found


def _shrink(path: Path, width: int) -> bytes | None:
    """Return a JPEG of at most this width and height, as COLMAP sees the image; None if it is none."""
    import cv2

    # Large ones are read at an eighth of their size, which takes a fraction of the time.
    for reduced in (cv2.IMREAD_REDUCED_COLOR_8, cv2.IMREAD_REDUCED_COLOR_2, cv2.IMREAD_COLOR):
        # Pixels are counted as they are stored, whatever the camera says of its orientation.
        image = cv2.imread(str(path), reduced | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            return None
        if max(image.shape[:2]) >= width:
            break
    assert image is not None
    scale = min(width / max(image.shape[:2]), 1.0)
    size = [max(round(scale * side), 1) for side in image.shape[1::-1]]
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    done, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return encoded.tobytes() if done else None
