"""Photographs of textured surfaces through a lens with distortion: images of which everything is known.

Drawing goes backwards through the lens: every sample of the image is undistorted to a ray (OpenCV), and the
ray meets the nearest triangle. With the corners of a triangle in camera axes as the columns of V, and a ray
r = (x, y, 1),

    z r = V b,  b >= 0,  sum b = 1     so     b = z V^-1 r   and   1 / z = sum(V^-1 r):

the ray meets the triangle if V^-1 r >= 0, and the nearest triangle is that of the largest sum. This holds for
triangles that pass behind the camera too, so nothing is clipped; and because every sample has a ray of its
own, the drawn lens is the stated one to rounding, not a resampled approximation. Pictures are read between
the two mipmap levels next to the size of a sample, and 2 x 2 samples make a pixel.

The same rays give the surface point of any pixel, `surface_points`: so it is known of every match whether it
is right. Source of the projection: Olano and Greer, Triangle scan conversion using 2D homogeneous
coordinates (1997).

Conventions are COLMAP's: x_cam = R x_world + t with t = -R C; pixels count from the image's top left corner,
so that the first pixel's center is (0.5, 0.5).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.synthetic.layouts import ByteArray, SceneCameras, lay_out_scene, state_rotations
from sfm_shapefit.synthetic.scene_options import RenderOptions, SceneOptions
from sfm_shapefit.synthetic.surfaces import Surfaces, make_surfaces

_SAMPLES = 2  # samples of a pixel along either side; smooths edges
_RAY_SLACK = 1e-6  # share of a ray; far below the spacing of rays, far above rounding
_NEAREST_DEPTH_M = 0.05  # meters; a triangle that comes nearer is drawn without bounds
_SKY = ((200.0, 214.0, 235.0), (120.0, 158.0, 216.0))  # at the horizon and above; too smooth for features
_OF_POINTS_ONLY = (
    *("num_points", "pixel_noise_px", "wrong_match_fraction", "corrupted_pair_fraction"),
    *("max_pairs_per_image", "max_matches_per_pair"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedScene(SceneCameras):
    """Cameras and the surfaces before them; `draw_image` takes the photographs."""

    render: RenderOptions
    """How it is drawn."""
    surfaces: Surfaces
    """What is photographed."""

    @property
    def distortion(self) -> FloatArray:
        """(4,) k1, k2, p1, p2 of OpenCV; COLMAP's RADIAL has the first two."""
        return np.array([self.render.radial_k1, self.render.radial_k2, 0.0, 0.0])


def make_rendered_scene(options: SceneOptions, render: RenderOptions | None = None) -> RenderedScene:
    """Set up cameras and surfaces; nothing is drawn yet.

    Cameras stand where those of `make_scene` stand for the same options.

    Raises:
        InputError: if the shape has no surfaces, if the lens folds the image over itself, or if an option of
            made-up keypoints is given: a rendered scene's are detected, and err as they do.
    """
    for name in _OF_POINTS_ONLY:
        if getattr(options, name) != getattr(SceneOptions, name):
            raise InputError(
                f"{name} belongs to made-up keypoints and pairs, but those of images are found by COLMAP;"
                " leave it out, or make the scene without images"
            )
    render = render or RenderOptions()
    rngs = np.random.default_rng(options.seed).spawn(6)  # the streams of `make_scene`
    layout, rigs = lay_out_scene(options, rngs[0])
    surface_rng = np.random.default_rng([options.seed, 1])
    scene = RenderedScene(
        options=options,
        render=render,
        rotations=layout.rotations,
        centers=layout.centers,
        stated_rotations=state_rotations(layout.rotations, rigs, options, rngs[5]),
        rigs=rigs,
        surfaces=make_surfaces(options.shape, len(rigs.rig_of_frame), render.repeated_fraction, surface_rng),
    )
    _refuse_folding(scene)
    return scene


def draw_image(scene: RenderedScene, image: int, canvas: "Canvas | None" = None) -> ByteArray:
    """Return one photograph, (height, width, 3) red, green, blue: a function of options and index alone."""
    rng = np.random.default_rng([scene.options.seed, 2, image])
    height, width = scene.options.image_height, scene.options.image_width
    samples = _shade(scene, image, canvas or Canvas.of(scene))
    pixels = samples.reshape(height, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))
    pixels *= 1.0 + scene.render.exposure_spread * rng.standard_normal()
    pixels += scene.render.gray_noise * rng.standard_normal(pixels.shape)
    return np.asarray(np.clip(np.rint(pixels), 0.0, 255.0), dtype=np.uint8)


def encode_images(scene: RenderedScene) -> Iterator[bytes]:
    """Yield all photographs, each as the content of a JPEG file."""
    canvas = Canvas.of(scene)
    for image in range(len(scene.centers)):
        bgr = np.ascontiguousarray(draw_image(scene, image, canvas)[:, :, ::-1])
        done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, scene.render.jpeg_quality])
        if not done:
            raise InputError(f"OpenCV cannot encode image {image} as JPEG; install it with JPEG support")
        yield data.tobytes()


def surface_points(scene: RenderedScene, image: int, xy: FloatArray) -> FloatArray:
    """Return the (k, 3) points in world axes that pixels (k, 2) of an image show; NaN where it is sky."""
    rays = _undistort(scene, xy).reshape(1, -1, 2)
    triangles = _facing_triangles(scene, image)
    bounds = np.tile(np.array([0, 1, 0, rays.shape[1]], dtype=np.int64), (len(triangles.rows), 1))
    _, inverse_depth = _nearest_triangles(rays, triangles.inverse, bounds)
    depth = 1.0 / np.where(inverse_depth[0] > 0.0, inverse_depth[0], np.nan)
    in_camera = np.column_stack([rays[0], np.ones(rays.shape[1])]) * depth[:, None]
    return np.asarray(in_camera @ scene.rotations[image] + scene.centers[image])


def project_distorted(scene: RenderedScene, image: int, points: FloatArray) -> FloatArray:
    """Return the (k, 2) pixels of points (k, 3) in front of a camera, hidden or not."""
    in_camera = (points - scene.centers[image]) @ scene.rotations[image].T
    zero = np.zeros(3)
    xy = cv2.projectPoints(in_camera, zero, zero, scene.calibration, scene.distortion)[0]
    return np.asarray(xy, dtype=np.float64).reshape(-1, 2)


def _refuse_folding(scene: RenderedScene) -> None:
    """Raise InputError unless the distorted radius grows with the true one out to the image's corners."""
    size = scene.options.image_width, scene.options.image_height
    corner = 0.5 * float(np.hypot(*size)) / scene.options.focal_length_px
    radius = np.linspace(0.0, 2.0 * corner, 400)
    k1, k2 = scene.render.radial_k1, scene.render.radial_k2
    distorted = radius * (1.0 + k1 * radius**2 + k2 * radius**4)
    reached = np.flatnonzero(distorted > 1.02 * corner)
    last = int(reached[0]) if len(reached) else len(radius) - 1
    if len(reached) == 0 or (np.diff(distorted[: last + 1]) <= 0.0).any():
        raise InputError(
            f"a lens with k1 = {k1} and k2 = {k2} folds an image of this size over itself;"
            " choose smaller ones or a longer focal length"
        )


def _undistort(scene: RenderedScene, xy: FloatArray) -> FloatArray:
    """Return the (k, 2) rays (x, y, 1) in camera axes of distorted pixels (k, 2)."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    pixels = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 1, 2)
    if len(pixels) == 0:
        return np.empty((0, 2))
    lens = pixels, scene.calibration, scene.distortion
    if (undistort := getattr(cv2, "undistortPointsIter", None)) is not None:  # so OpenCV 4 calls it
        rays = undistort(*lens, np.eye(3), np.eye(3), criteria)
    else:
        rays = cv2.undistortPoints(*lens, criteria=criteria)
    return np.asarray(rays, dtype=np.float64).reshape(-1, 2)


class _Triangles(NamedTuple):
    rows: IntArray
    """(k,) in the surfaces."""
    corners: FloatArray
    """(k, 3, 3) in camera axes."""
    inverse: FloatArray
    """(k, 3, 3) V^-1."""


def _facing_triangles(scene: RenderedScene, image: int) -> _Triangles:
    in_camera = (scene.surfaces.corners - scene.centers[image]) @ scene.rotations[image].T
    v = np.ascontiguousarray(in_camera.swapaxes(1, 2))
    volume = np.linalg.det(v)
    size = np.prod(np.linalg.norm(in_camera, axis=2), axis=1)
    facing = np.flatnonzero((volume < -1e-12 * size) & (in_camera[:, :, 2].max(axis=1) > _NEAREST_DEPTH_M))
    return _Triangles(facing, in_camera[facing], np.linalg.inv(v[facing]))


def _bounds(corners: FloatArray, rays: FloatArray) -> IntArray:
    """Return the samples (k, 4) first and last row, first and last column that each triangle can cover.

    A triangle in front of the camera is bounded by its corners. A triangle that passes behind it has no
    bounds unless it lies wholly beyond one side of the image, where the bounds are empty.
    """
    depth = corners[:, :, 2]
    ahead = np.asarray((depth > _NEAREST_DEPTH_M).all(axis=1))
    bounds = np.empty((len(corners), 4), dtype=np.int64)
    for axis, first in ((1, 0), (0, 2)):  # rows from y, columns from x
        at = corners[:, :, axis]
        # Least and largest ray of each row or column, made monotone: the bounds only grow by that.
        least = np.minimum.accumulate(rays[:, :, axis].min(axis=axis)[::-1])[::-1]
        largest = np.maximum.accumulate(rays[:, :, axis].max(axis=axis))
        beyond = (at < least[0] * depth).all(axis=1) | (at > largest[-1] * depth).all(axis=1)
        slope = at / np.where(ahead[:, None], depth, 1.0)
        low = np.searchsorted(largest, slope.min(axis=1) - _RAY_SLACK, side="left")
        high = np.searchsorted(least, slope.max(axis=1) + _RAY_SLACK, side="right")
        bounds[:, first] = np.where(ahead, low, 0)
        bounds[:, first + 1] = np.where(beyond, 0, np.where(ahead, high, len(least)))
    return bounds


@kernel
def _nearest_triangles(
    rays: FloatArray, inverse: FloatArray, bounds: IntArray
) -> tuple[npt.NDArray[np.int32], FloatArray]:
    """Return the nearest triangle of each ray, -1 for none, and the inverse of its depth."""
    rows, columns = rays.shape[:2]
    nearest = np.full((rows, columns), -1, dtype=np.int32)
    inverse_depth = np.zeros((rows, columns))
    for k in range(len(inverse)):
        m = inverse[k]
        for r in range(bounds[k, 0], bounds[k, 1]):
            for c in range(bounds[k, 2], bounds[k, 3]):
                x, y = rays[r, c, 0], rays[r, c, 1]
                b0 = m[0, 0] * x + m[0, 1] * y + m[0, 2]
                b1 = m[1, 0] * x + m[1, 1] * y + m[1, 2]
                b2 = m[2, 0] * x + m[2, 1] * y + m[2, 2]
                total = b0 + b1 + b2
                slack = -1e-9 * total  # so that no ray slips through between two triangles
                if b0 >= slack and b1 >= slack and b2 >= slack and total > inverse_depth[r, c]:
                    inverse_depth[r, c] = total
                    nearest[r, c] = k
    return nearest, inverse_depth


class Canvas(NamedTuple):
    """What all photographs of a scene share: rays of the samples, and the pictures of `_mipmaps`."""

    rays: FloatArray
    pyramid: ByteArray
    levels: IntArray

    @classmethod
    def of(cls, scene: RenderedScene) -> "Canvas":
        """Return the canvas of a scene."""
        size = _SAMPLES * scene.options.image_height, _SAMPLES * scene.options.image_width
        y, x = (np.indices(size).reshape(2, -1) + 0.5) / _SAMPLES
        rays = _undistort(scene, np.stack([x, y], axis=1)).reshape(*size, 2)
        return cls(rays, *_mipmaps(scene.surfaces.textures))


def _shade(scene: RenderedScene, image: int, canvas: Canvas) -> npt.NDArray[np.float32]:
    """Return the colors (rows, columns, 3) of the samples of an image, 0 to 255."""
    rays, pyramid, levels = canvas
    triangles = _facing_triangles(scene, image)
    nearest, _ = _nearest_triangles(rays, triangles.inverse, _bounds(triangles.corners, rays))
    up = rays @ scene.rotations[image][:2, 2] + scene.rotations[image][2, 2]
    height = np.clip(up / np.sqrt(1.0 + np.sum(rays**2, axis=2)), 0.0, 1.0)[:, :, None]
    colors: npt.NDArray[np.float32] = (_SKY[0] + height * np.subtract(_SKY[1], _SKY[0])).astype(np.float32)
    # Texture coordinates over inverse depth are linear in the ray: rows (u / z, v / z, 1 / z).
    rows = triangles.rows
    texels = np.concatenate([scene.surfaces.texels[rows], np.ones((len(rows), 3, 1))], axis=2)
    img_from_ray = np.einsum("kca,kcb->kab", texels, triangles.inverse)
    texture, brightness = scene.surfaces.texture[rows], scene.surfaces.brightness[rows]
    _paint(colors, rays, nearest, img_from_ray, texture, brightness, pyramid, levels)
    return colors


def _mipmaps(textures: tuple[ByteArray, ...]) -> tuple[ByteArray, IntArray]:
    """Return all pictures at all levels in one array, and (num, levels, 3) offset, height, width of each.

    Each level halves the one before, down to a few pixels; where a picture has fewer levels than another,
    its last one stands for those.
    """
    pieces, table, offset = [], [], 0
    for texture in textures:
        rows, picture = [], texture
        while True:
            rows.append((offset, *picture.shape[:2]))
            pieces.append(picture.ravel())
            offset += picture.size
            if min(picture.shape[:2]) < 8:
                break
            size = (picture.shape[1] // 2, picture.shape[0] // 2)
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        table.append(rows)
    depth = max(len(rows) for rows in table)
    padded = [rows + [rows[-1]] * (depth - len(rows)) for rows in table]
    return np.concatenate(pieces), np.array(padded, dtype=np.int64)


@kernel
def _paint(
    colors: npt.NDArray[np.float32],
    rays: FloatArray,
    nearest: npt.NDArray[np.int32],
    img_from_ray: FloatArray,
    texture: IntArray,
    brightness: FloatArray,
    pyramid: ByteArray,
    levels: IntArray,
) -> None:
    """Write the color of each sample that shows a triangle."""
    rows, columns = nearest.shape
    for r in range(rows):
        for c in range(columns):
            k = nearest[r, c]
            if k < 0:
                continue
            u, v = _picture_position(img_from_ray[k], rays[r, c])
            right = c + 1 if c + 1 < columns else c - 1
            below = r + 1 if r + 1 < rows else r - 1
            u_right, v_right = _picture_position(img_from_ray[k], rays[r, right])
            u_below, v_below = _picture_position(img_from_ray[k], rays[below, c])
            area = abs((u_right - u) * (v_below - v) - (v_right - v) * (u_below - u))
            level = 0.5 * np.log2(max(area, 1.0))
            fine = min(int(level), levels.shape[1] - 1)
            coarse = min(fine + 1, levels.shape[1] - 1)
            weight = min(level - fine, 1.0)
            for a in range(3):
                sharp = _bilinear(pyramid, levels[texture[k]], fine, u, v, a)
                blurred = _bilinear(pyramid, levels[texture[k]], coarse, u, v, a)
                colors[r, c, a] = brightness[k] * ((1.0 - weight) * sharp + weight * blurred)


@inner_kernel
def _picture_position(img_from_ray: FloatArray, ray: FloatArray) -> tuple[float, float]:
    """Return where in the picture of a triangle its plane is met by a ray."""
    x, y = ray[0], ray[1]
    u = img_from_ray[0, 0] * x + img_from_ray[0, 1] * y + img_from_ray[0, 2]
    v = img_from_ray[1, 0] * x + img_from_ray[1, 1] * y + img_from_ray[1, 2]
    w = img_from_ray[2, 0] * x + img_from_ray[2, 1] * y + img_from_ray[2, 2]
    return u / w, v / w


@inner_kernel
def _bilinear(pyramid: ByteArray, levels: IntArray, level: int, u: float, v: float, channel: int) -> float:
    """Return one color of a picture that repeats for ever, at a position in pixels of its first level."""
    offset, height, width = levels[level, 0], levels[level, 1], levels[level, 2]
    x = u * width / levels[0, 2] - 0.5
    y = v * height / levels[0, 1] - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    left, right = x0 % width, (x0 + 1) % width
    top, bottom = y0 % height, (y0 + 1) % height
    above = (1.0 - fx) * pyramid[offset + 3 * (top * width + left) + channel]
    above += fx * pyramid[offset + 3 * (top * width + right) + channel]
    below = (1.0 - fx) * pyramid[offset + 3 * (bottom * width + left) + channel]
    below += fx * pyramid[offset + 3 * (bottom * width + right) + channel]
    color: float = (1.0 - fy) * above + fy * below
    return color
