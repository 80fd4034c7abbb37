"""Pictures and models without distortion, as splatting and dense reconstruction take them. A door to OpenCV.

A lens becomes one pinhole, or faces where it sees more than one holds: panoramas the six of a cube, fisheyes
two or four that are turned aside and overlap in the middle. Principal points are in the middle of the
pictures, since 3DGS takes them to be there. Faces of one picture are a rig. Masks go the same way.
"""

import itertools
import math
import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import file_of
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.lenses import lens_of, rays_of
from sfm_shapefit.files.colmap.picture_colors import Rgb, read_picture
from sfm_shapefit.files.colmap.points import points2d_of, points_of
from sfm_shapefit.files.colmap.quiet import quiet_log, quiet_stderr
from sfm_shapefit.files.colmap.reconstructions import add_point, arrays_of, bytes_of_name, name_of
from sfm_shapefit.scene.points import Points

# Radians off the axis, in the middle of a side: there, a pinhole stretches pixels outward by 1 / cos^2 = 4.
_WIDEST = math.radians(60.0)
_HALF_FACE = math.radians(45.0)  # radians, half the angle of view of a face; four close a circle
_NARROWEST = 0.5  # share of that; a smaller face that keeps within its picture is none
_CUBE = {
    "front": (0, 0),
    "right": (90, 0),
    "back": (180, 0),
    "left": (-90, 0),
    "up": (0, 90),
    "down": (0, -90),
}
_SAME_PX = 1.0  # pixels off the middle; a principal point no farther off is there
_WRITTEN = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"}  # suffixes of pictures; others become .png
_MAPS_AT_ONCE = 6  # tables of where pixels come from; each takes 8 bytes a pixel
_MASK = ".png"  # behind the name of an image: that of its mask, as COLMAP and who trains splats have it
_HALF = 128  # level up to 255; a pixel of a mask that was made smaller is what most of its parts are
_JPEG_QUALITY = 95  # percent, JPEG's own scale; blocks are not seen

Maps = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]


class Pinhole(NamedTuple):
    """What of a lens's pictures becomes one picture."""

    name: str
    """Name of the face; empty where it is the only one."""
    camera: pycolmap.Camera
    turn: FloatArray
    """(3, 3) from axes of the lens to its own."""
    is_same: bool = False
    """Whether pixels stay where they are."""
    full_size: tuple[int, int] = (0, 0)
    """Width and height before the picture was made smaller; zeros if it was not."""

    def within(self, longest_px: int) -> "Pinhole":
        """Return the same with a picture whose longer side has at most so many pixels; -1 for any number."""
        size = self.camera.width, self.camera.height
        if longest_px < 0 or max(size) <= longest_px:
            return self
        small = pycolmap.Camera(self.camera.todict())
        small.rescale(longest_px / max(size))
        return self._replace(camera=small, full_size=size)

    @property
    def full(self) -> pycolmap.Camera:
        """The camera before the picture was made smaller."""
        if not any(self.full_size):
            return self.camera
        full = pycolmap.Camera(self.camera.todict())
        full.rescale(*self.full_size)
        return full

    def project(self, rays: FloatArray) -> FloatArray:
        """Return the pixels (k, 2) of rays (k, 3) in axes of the lens; NaN beyond the picture."""
        xy = np.array(self.camera.img_from_cam(np.ascontiguousarray(rays @ self.turn.T))).reshape(-1, 2)
        with np.errstate(invalid="ignore"):
            inside = ((xy >= 0.0) & (xy <= [self.camera.width, self.camera.height])).all(axis=1)
        xy[~inside] = np.nan
        return xy


def pinholes_of(camera: pycolmap.Camera, longest_px: int = -1) -> list[Pinhole]:
    """Return what pictures through a lens become, with longer sides of at most so many pixels, -1 for any.

    Raises:
        InputError: if the size of the pictures is not known.
    """
    if not (camera.width and camera.height):
        size = f"{camera.width} x {camera.height} pixels"
        raise InputError(f"camera {camera.camera_id} is of {size}; give it the size of its pictures")
    return [pinhole.within(longest_px) for pinhole in _pinholes_of(camera)]


def _pinholes_of(camera: pycolmap.Camera) -> list[Pinhole]:
    lens = lens_of(camera)
    if lens.is_panorama:
        size = 2 * round(lens.focal_px)  # as fine in the middle as the panorama is
        return [Pinhole(name, *_face(size, np.ones(2), *at)) for name, at in _CUBE.items()]
    width, height = camera.width, camera.height
    sides = np.array([[0, height / 2], [width, height / 2], [width / 2, 0], [width / 2, height]], dtype=float)
    rays = rays_of(lens, sides)
    off = np.nan_to_num(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), nan=np.pi / 2)
    across, along = np.minimum(off.reshape(2, 2).min(axis=1), np.pi / 2).tolist()
    if lens.is_plane or max(across, along) <= _WIDEST:
        return [_whole(camera)]
    return _turned_faces(camera, across, along)


def _whole(camera: pycolmap.Camera) -> Pinhole:
    """Return a lens without distortion, as pycolmap has it, cut to have its principal point in the middle."""
    made = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    center, size = np.array(made.params[2:]), np.array([made.width, made.height])
    if camera.is_undistorted() and np.abs(center - size / 2).max() <= _SAME_PX:
        return Pinhole("", made, np.eye(3), is_same=True)
    width, height = (2 * np.floor(np.minimum(center, size - center)).astype(int)).tolist()
    made.width, made.height = width, height
    made.params = [*made.params[:2], width / 2, height / 2]
    return Pinhole("", made, np.eye(3))


def _turned_faces(camera: pycolmap.Camera, across: float, along: float) -> list[Pinhole]:
    """Return faces of a lens that sees so far off its axis, in radians, to left and right, above and below.

    Each is as large as it can be without pixels that the picture lacks.
    """
    yaw, pitch = np.degrees(np.maximum(np.array([across, along]) - _HALF_FACE, 0.0))
    turns = [("right", yaw, 0.0), ("left", -yaw, 0.0)] * (across > _WIDEST)
    turns += [("up", 0.0, pitch), ("down", 0.0, -pitch)] * (along > _WIDEST)
    shape = np.minimum(1.0, np.tan(np.minimum([across, along], _HALF_FACE)))
    faces = []
    for name, *at in turns:
        for share in np.arange(1.0, _NARROWEST, -0.02):
            face = Pinhole(name, *_face(2 * round(camera.mean_focal_length()), share * shape, *at))
            if _lies_inside(camera, face):
                faces.append(face)
                break
    return faces or [_whole(camera)]


def _face(size: int, shape: FloatArray, yaw: float, pitch: float) -> tuple[pycolmap.Camera, FloatArray]:
    """Return a face with the focal length size / 2, and its turn, right and up in degrees.

    `shape` (2,) is half its width and height at distance 1.
    """
    turn = Rotation.from_euler("yx", [yaw, pitch], degrees=True).as_matrix().T
    width, height = (2 * np.floor(size / 2 * shape).astype(int)).tolist()
    params = [size / 2, size / 2, width / 2, height / 2]
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params), turn


def _maps_of(camera: pycolmap.Camera, pinhole: Pinhole) -> Maps:
    """Return where the pixels of a picture, before it is made smaller, come from, as OpenCV counts them."""
    pinhole = pinhole._replace(camera=pinhole.full)
    width, height = pinhole.camera.width, pinhole.camera.height
    maps = np.empty((height, width, 2), dtype=np.float32)
    for y in range(height):  # all at once would take ten times the memory
        maps[y] = _sources(camera, pinhole, np.arange(width), np.full(width, y))
    return maps[..., 0], maps[..., 1]


def _lies_inside(camera: pycolmap.Camera, pinhole: Pinhole) -> bool:
    width, height = pinhole.camera.width, pinhole.camera.height
    x, y = np.arange(width), np.arange(height)
    across, along = np.r_[x, x, 0 * y, 0 * y + width - 1], np.r_[0 * x, 0 * x + height - 1, y, y]
    sources = _sources(camera, pinhole, across, along)
    return bool(((sources >= 0.0) & (sources <= [camera.width - 1, camera.height - 1])).all())


def _sources(camera: pycolmap.Camera, pinhole: Pinhole, x: IntArray, y: IntArray) -> FloatArray:
    """Return where pixels (k,) come from, (k, 2), counted from centers of pixels; outside if from nowhere."""
    rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], axis=1)
    rays[:, :2] = (rays[:, :2] - pinhole.camera.params[2:]) / pinhole.camera.params[:2]
    xy = camera.img_from_cam(np.ascontiguousarray(rays @ pinhole.turn), check_cheirality=False)
    return np.nan_to_num(np.asarray(xy) - 0.5, nan=-9.0)


class Flat(NamedTuple):
    """An image of a model, and the pictures that it becomes."""

    image: pycolmap.Image
    name: str
    file: Path
    camera: pycolmap.Camera
    pinholes: Sequence[Pinhole]
    names: Sequence[str]
    """Names of the pictures, one for each pinhole."""


def flats_of(
    model: pycolmap.Reconstruction, folder: Path, longest_px: int = -1
) -> tuple[list[Flat], list[str]]:
    """Return what posed images with a picture in a folder become, by name, and the names of the others.

    Longer sides of pictures have so many pixels at most, -1 for any number.
    """
    flats, others, taken = list[Flat](), list[str](), set[str]()
    pinholes = cache(lambda camera_id: pinholes_of(model.camera(camera_id), longest_px))
    for name, image_id in sorted((name_of(model.image(i)), i) for i in model.reg_image_ids()):
        image, file = model.image(image_id), file_of(folder, name)
        if file is None:
            others.append(name)
            continue
        own = pinholes(image.camera_id)
        flats.append(Flat(image, name, file, model.camera(image.camera_id), own, _names(name, own, taken)))
    return flats, others


def _names(name: str, pinholes: Sequence[Pinhole], taken: set[str]) -> list[str]:
    """Return names in one folder, where 3DGS looks for them; `taken` has those in use, and gets these."""
    stem, suffix = os.path.splitext(name.replace("/", "_").replace("\\", "_"))
    suffix = suffix if suffix.lower() in _WRITTEN else ".png"
    names = [f"{stem}_{pinhole.name}{suffix}" if pinhole.name else f"{stem}{suffix}" for pinhole in pinholes]
    if not taken.isdisjoint(names):
        return _names(f"{stem}_{suffix}", pinholes, taken)
    taken.update(names)
    return names


def mask_of(masks: Path, name: str) -> Path | None:
    """Return the mask of an image as COLMAP looks for it; None if it has none."""
    own = name if name.lower().endswith(".png") else ""
    return file_of(masks, f"{name}{_MASK}") or (file_of(masks, own) if own else None)


def write_flats(flats: Sequence[Flat], out: Path, threads: int, masks: Path | None = None) -> Iterator[str]:
    """Write pictures, and yield for each image why it could not be done; empty where it was done.

    Args:
        flats: what images become.
        out: a folder that has folders `images` and, if there are masks, `masks`.
        threads: images that are at work at once.
        masks: folder of the masks; an image that has none gets a white one.

    Raises:
        InputError: if a picture cannot be written.
    """
    flat_of = {flat.camera.camera_id: flat for flat in flats}

    @lru_cache(_MAPS_AT_ONCE)
    def maps_of(camera_id: int, k: int) -> Maps:
        return _maps_of(flat_of[camera_id].camera, flat_of[camera_id].pinholes[k])

    def write(flat: Flat) -> str:
        picture, mask = read_picture(flat.file), None if masks is None else _read_mask(flat, masks)
        why = _fault_of(picture, flat.camera, "picture") or (masks and _fault_of(mask, flat.camera, "mask"))
        if why or picture is None:
            return why or ""
        for k, (pinhole, name) in enumerate(zip(flat.pinholes, flat.names, strict=True)):
            maps = partial(maps_of, flat.camera.camera_id, k)
            is_whole = pinhole.is_same and not any(pinhole.full_size)
            if is_whole and flat.file.suffix == Path(name).suffix:
                shutil.copyfile(flat.file, out / "images" / name)
            else:
                edge = cv2.BORDER_WRAP if flat.camera.is_spherical() else cv2.BORDER_REPLICATE
                _write_picture(_drawn(picture, pinhole, maps, cv2.INTER_CUBIC, edge), out / "images" / name)
            if mask is not None:
                edge = cv2.BORDER_WRAP if flat.camera.is_spherical() else cv2.BORDER_CONSTANT
                seen = _drawn(mask, pinhole, maps, cv2.INTER_NEAREST, edge) >= _HALF
                _write_picture(_black_or_white(seen), out / "masks" / f"{name}{_MASK}")
        return ""

    with quiet_log(), quiet_stderr(), ThreadPoolExecutor(threads) as pool:
        yield from pool.map(write, flats)


def _read_mask(flat: Flat, masks: Path) -> Rgb | None:
    """Return 255 where an image is to be used, 0 where its mask is black; None if that cannot be read."""
    file = mask_of(masks, flat.name)
    if file is None:
        return np.full((flat.camera.height, flat.camera.width), 255, np.uint8)
    read = read_picture(file)
    return None if read is None else _black_or_white(read.any(axis=2))


def _black_or_white(is_used: npt.NDArray[np.bool_] | np.bool_) -> Rgb:
    return np.where(is_used, 255, 0).astype(np.uint8)


def _fault_of(picture: Rgb | None, camera: pycolmap.Camera, what: str) -> str:
    """Return why a picture cannot be used; empty if it can."""
    if picture is None:
        return f"unreadable {what}"
    is_fitting = picture.shape[:2] == (camera.height, camera.width)
    return "" if is_fitting else f"{what} of another size than its camera's"


def _drawn(picture: Rgb, pinhole: Pinhole, maps: Callable[[], Maps], how: int, edge: int) -> Rgb:
    """Return what a pinhole sees of a picture."""
    seen = picture if pinhole.is_same else cv2.remap(picture, *maps(), how, borderMode=edge)
    if any(pinhole.full_size):
        seen = cv2.resize(seen, (pinhole.camera.width, pinhole.camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(seen, dtype=np.uint8)


def _write_picture(pixels: Rgb, file: Path) -> None:
    bitmap = pycolmap.Bitmap.from_array(pixels)
    bitmap.set_jpeg_quality(_JPEG_QUALITY)
    if not bitmap.write(os.fsencode(file)):
        raise InputError(f"{file} cannot be written; check the free space")


def flatten_model(model: pycolmap.Reconstruction, flats: Sequence[Flat]) -> pycolmap.Reconstruction:
    """Return the model of the pictures that images become, in the same world; other images are left out.

    An observation goes to the first picture that shows it; a point stays if two pictures see it.
    """
    made, by_id = pycolmap.Reconstruction(), {flat.image.image_id: flat for flat in flats}
    flat_of = {flat.camera.camera_id: flat for flat in flats}
    camera_ids, image_ids = _new_ids(flat_of), _new_ids(by_id)
    for (camera_id, k), new_id in camera_ids.items():
        camera = pycolmap.Camera(flat_of[camera_id].pinholes[k].camera.todict())
        camera.camera_id = new_id
        made.add_camera(camera)
    moved = {rig_id: _add_rig(made, rig, flat_of, camera_ids) for rig_id, rig in sorted(model.rigs.items())}
    points, keypoints = _share_points(model, by_id)
    frames = defaultdict[int, list[pycolmap.Image]](list)
    for (i, k), xy in keypoints.items():
        ids = {"image_id": image_ids[i, k], "camera_id": camera_ids[by_id[i].camera.camera_id, k]}
        image = pycolmap.Image(name=bytes_of_name(by_id[i].names[k]), keypoints=xy, **ids)
        image.frame_id = by_id[i].image.frame_id
        frames[image.frame_id].append(image)
    for frame_id, images in sorted(frames.items()):
        before: Any = model.frame(frame_id)
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=before.rig_id)
        for image in images:
            frame.add_data_id(image.data_id)
        frame.rig_from_world = moved[before.rig_id] * before.rig_from_world
        made.add_frame(frame)
        for image in images:
            made.add_image(image)
        made.register_frame(frame_id)
    colors = np.array([model.point3D(i).color for i in points.ids.tolist()], dtype=np.uint8).reshape(-1, 3)
    _add_points(made, np.array([image_ids[key] for key in keypoints]), points, colors)
    made.update_point_3d_errors()
    return made


def _add_points(
    made: pycolmap.Reconstruction, image_ids: IntArray, points: Points, colors: npt.NDArray[np.uint8]
) -> None:
    """Add points to a model; their observations index its images (i,) by these ids."""
    seen = list(zip(image_ids[points.images].tolist(), points.keypoints.tolist(), strict=True))
    for point_id, own, xyz, color in zip(
        points.ids.tolist(), points.slices(), points.xyz, colors, strict=True
    ):
        add_point(made, point_id, xyz, color, seen[own])


def _sensor_id(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=camera_id)


def _new_ids(flats: Mapping[int, Flat]) -> dict[tuple[int, int], int]:
    """Return ids of the parts of what has an id: the first keeps its own, others get new ones."""
    fresh = itertools.count(max(flats) + 1)
    return {(i, k): next(fresh) if k else i for i in sorted(flats) for k in range(len(flats[i].pinholes))}


def _add_rig(
    made: pycolmap.Reconstruction,
    rig: pycolmap.Rig,
    flat_of: Mapping[int, Flat],
    camera_ids: Mapping[tuple[int, int], int],
) -> Any:
    """Add the rig of what cameras become, the first part as reference; return its pose in the old one."""
    views: list[tuple[pycolmap.sensor_t, Any]] = []
    for camera_id in sorted(flat_of, key=lambda k: (not rig.is_ref_sensor(_sensor_id(k)), k)):
        sensor = _sensor_id(camera_id)
        if rig.has_sensor(sensor):
            pose: Any = pycolmap.Rigid3d() if rig.is_ref_sensor(sensor) else rig.sensor_from_rig(sensor)
            for k, pinhole in enumerate(flat_of[camera_id].pinholes):
                turn = pycolmap.Rigid3d(pycolmap.Rotation3d(pinhole.turn), np.zeros(3))
                views.append((_sensor_id(camera_ids[camera_id, k]), turn * pose))
    if not views:
        return None
    (reference, moved), *others = views
    new = pycolmap.Rig(rig_id=rig.rig_id)
    new.add_ref_sensor(reference)
    for sensor, pose in others:
        new.add_sensor(sensor, pose * moved.inverse())
    made.add_rig(new)
    return moved


def _share_points(
    model: pycolmap.Reconstruction, by_id: Mapping[int, Flat]
) -> tuple[Points, dict[tuple[int, int], FloatArray]]:
    """Return the points, and the keypoints (k, 2) of the pictures that images become, by image and pinhole.

    The points' images are the rows of these.
    """
    arrays, _ = arrays_of(model)
    images = images_of(arrays)
    points, pixels = points_of(arrays, images), points2d_of(arrays, images)
    image_of, place_of = np.full(len(points.images), -1), np.full(len(points.images), -1)
    keypoints: dict[tuple[int, int], FloatArray] = {}
    for row, own in enumerate(points.rows_of_images(images.num_images)):
        flat = by_id.get(int(images.ids[row]))
        if flat is None:
            continue
        rays = rays_of(images.lenses[images.lens_of[row]], np.asarray(pixels(row))[points.keypoints[own]])
        for k, pinhole in enumerate(flat.pinholes):
            xy = pinhole.project(rays)
            seen = np.isfinite(xy[:, 0]) & (place_of[own] < 0)
            image_of[own[seen]], place_of[own[seen]] = len(keypoints), np.arange(seen.sum())
            keypoints[flat.image.image_id, k] = xy[seen]
    shared = replace(points, images=image_of, keypoints=place_of)
    return shared.taken(shared.paired(place_of >= 0)), keypoints
