"""Models with known rotations: what is read of a COLMAP reconstruction, and the rays of its pixels.

COLMAP's convention is x_cam = R x_world + t with center C = -R^T t. Only R and the intrinsics are
trusted: the centers of the input are carried along for comparison and never place a camera.

Poses live in frames (`rig_from_world`); for a model of an older COLMAP, pycolmap makes one frame per
image. In a rig of several sensors cam_from_world = sensor_from_rig * rig_from_world, so that a camera stands
at C = C_frame + R_frame^T o, with the metric offset o = -R_s^T t_s of its sensor; the frames are the
unknowns.

Source of the conventions: https://colmap.github.io/format.html and `colmap/scene/reconstruction.h`.
"""

from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, IntArray, UInt64Array, frozen
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.files.colmap.check import UNIT_QUATERNION_TOLERANCE, check_model_files, model_suffix
from sfm_shapefit.files.colmap.images import images_of, put_images
from sfm_shapefit.files.colmap.other_programs import intrinsics_of, make_camera
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.posed_model import PosedModelFile

PYCOLMAP_ERRORS = (ValueError, IndexError, KeyError, RuntimeError, MemoryError)
"""What pycolmap raises on bad data."""

_ONE_TO_ONE = ("SIMPLE_PINHOLE", "PINHOLE")
# By how much a pixel may miss itself over its ray and back; solving for the ray leaves 1e-8.
_ROUND_TRIP_PX = 0.01
# Sums of squares of larger coordinates overflow; these count as not finite.
_LARGEST_COORDINATE = 1e100
_POINT3D_ID = attrgetter("point3D_id")
# For this camera, pixel coordinates and normalized coordinates are the same numbers.
_IDENTITY_CAMERA = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[1.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedModel:
    """The posed images of a COLMAP model, in the order of their names. Arrays are read-only.

    The answer's sums depend on the order of images, so it is that of the user's names, not of ids.
    """

    reconstruction: pycolmap.Reconstruction
    """The input; nobody modifies it."""
    images: Images
    """The same n images as arrays, in the same order."""
    image_ids: IntArray
    """(n,) ids of the images that have a pose."""
    names: tuple[str, ...]
    """The names of those images, all different."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3) the input's camera centers; they never place a camera, and may all be 0."""
    focal_lengths_px: FloatArray
    """(n,) mean focal length; for a camera without one (equirectangular) its pixels per radian."""
    frame_ids: IntArray
    """(n,) id of the frame of each image."""
    frame_offsets: FloatArray
    """(n, 3) C - C_frame in world axes and the unit of the rigs, exactly 0 for a rig's reference sensor."""

    @property
    def groups(self) -> RigidGroups:
        """The frames as rigid groups of images."""
        _, labels = np.unique(self.frame_ids, return_inverse=True)
        return RigidGroups(group_of=labels.ravel(), offsets=self.frame_offsets)

    @property
    def has_rigs(self) -> bool:
        """Whether any frame has several posed images."""
        return len(np.unique(self.frame_ids)) < self.num_images

    @property
    def num_images(self) -> int:
        """Number of posed images, n."""
        return len(self.image_ids)

    def camera(self, index: int) -> pycolmap.Camera:
        """Return the camera of an image by its index."""
        return self.reconstruction.camera(self.reconstruction.image(int(self.image_ids[index])).camera_id)

    def world_rays(self, image: int, xy: FloatArray) -> FloatArray:
        """Return the unit rays R^T f(xy) of pixels in world axes.

        Args:
            image: its index.
            xy: (k, 2) pixels in COLMAP's convention: the center of the first pixel is (0.5, 0.5).

        Returns:
            (k, 3) unit vectors; rows of NaN for pixels that the camera model maps to no ray.
        """
        rays = camera_rays(self.camera(image), np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2))
        return normalized(rays @ self.rotations[image])

    def image_sizes(self) -> FloatArray:
        """Return width and height of each image in pixels, (n, 2)."""
        cameras = map(self.camera, range(self.num_images))
        return np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64)


def sensors_of(reconstruction: pycolmap.Reconstruction) -> dict[int, pycolmap.Rigid3d]:
    """Return the poses of all sensors in their rigs but the references, by the ids of their cameras."""
    rigs = reconstruction.rigs.values()
    return {
        sensor.id: pose for rig in rigs for sensor, pose in rig.non_ref_sensors.items() if pose is not None
    }


def posed_cameras(model: PosedModel) -> PosedModelFile:
    """Return what rays in world axes need as plain values for other processes: no points, no centers."""
    cameras = [model.camera(index) for index in range(model.num_images)]
    different, index_of = np.unique([camera.camera_id for camera in cameras], return_inverse=True)
    return PosedModelFile(
        cameras=tuple(intrinsics_of(model.reconstruction.camera(i)) for i in different.tolist()),
        names=model.names,
        camera_of=index_of.astype(np.int64),
        rotations=np.array(model.rotations),
        centers=np.zeros((model.num_images, 3)),
    )


def from_posed_cameras(scene: PosedModelFile) -> PosedModel:
    """Return a model of these images: the same rotations to the bit, no poses in frames, no points."""
    reconstruction = pycolmap.Reconstruction()
    cameras = [make_camera(camera, k) for k, camera in enumerate(scene.cameras, start=1)]
    for camera in cameras:
        reconstruction.add_camera_with_trivial_rig(camera)
    camera_of_image = [cameras[k] for k in scene.camera_of.tolist()]
    image_ids = np.arange(1, len(scene.names) + 1)
    for image_id, name, camera in zip(image_ids.tolist(), scene.names, camera_of_image, strict=True):
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=image_id)
        reconstruction.add_image_with_trivial_frame(image)
    return PosedModel(
        reconstruction=reconstruction,
        images=images_of(reconstruction),
        image_ids=image_ids,
        names=scene.names,
        rotations=scene.rotations,
        centers=scene.centers,
        focal_lengths_px=_focal_lengths_px("the model", camera_of_image),
        frame_ids=image_ids,
        frame_offsets=np.zeros_like(scene.centers),
    )


def read_model(source: Path | str | pycolmap.Reconstruction) -> PosedModel:
    """Read a model folder, or take a reconstruction in memory, and refuse what cannot be used.

    Args:
        source: a folder with cameras, images and points3D (.bin preferred over .txt) and, from COLMAP
            3.12 on, rigs and frames; or a reconstruction, which is not modified.

    Raises:
        InputError: if files are missing, truncated or not finite (see `check_model_files`), if pycolmap
            refuses them, if the pose of a sensor in its rig is not known, or if fewer than two images have a
            pose.
    """
    is_checked = False
    if isinstance(source, pycolmap.Reconstruction):
        label, reconstruction = "the reconstruction", source
    else:
        label, reconstruction = str(Path(source)), _load(Path(source))
        is_checked = model_suffix(Path(source)) == ".bin"
    try:
        with quiet_log():
            _refuse_inconsistent(label, reconstruction, is_checked=is_checked)
            return _posed_model(label, reconstruction)
    except PYCOLMAP_ERRORS as error:
        raise InputError(f"{label} is not a sound COLMAP model: {_first_line(error)}") from error


def turned_model(model: PosedModel, turned: Images) -> PosedModel:
    """Return the model with the frames' rotations, the sensors and the lenses of images; no input changes.

    Args:
        model: the posed images.
        turned: some of them. Frames turn about their own centers; what is the same keeps its bits.
    """
    own, copy = model.images.frames, pycolmap.Reconstruction(model.reconstruction)
    rows = np.searchsorted(own.ids, turned.frames.ids)
    put_images(copy, turned.posed(turned.frames.rotations, own.centers[rows]))
    return read_model(copy)


def camera_rays(camera: pycolmap.Camera, xy: FloatArray) -> FloatArray:
    """Return the unit rays (k, 3) of pixels (k, 2) in camera axes; NaN for those that are no image of a ray.

    pycolmap folds rays of a fisheye beyond 90 degrees back: 58 degrees where 90.3 is right. Such a ray has
    its image elsewhere, by which it is told.
    """
    rays = np.asarray(camera.cam_ray_from_img(xy), dtype=np.float64).reshape(-1, 3)
    if len(rays) == 0 or camera.model_name in _ONE_TO_ONE:
        return rays
    with np.errstate(invalid="ignore"):
        ahead = rays[:, 2] > 0.0
        back = np.asarray(camera.img_from_cam(rays), dtype=np.float64).reshape(-1, 2)
        false = ahead & ~(np.abs(back - xy).max(axis=1) <= _ROUND_TRIP_PX)
    rays[false] = np.nan
    return rays


# --- reading ---------------------------------------------------------------------------------------


def _load(folder: Path) -> pycolmap.Reconstruction:
    """Check the files of a model and only then let pycolmap read them."""
    check_model_files(folder)
    try:
        with quiet_log():
            return pycolmap.Reconstruction(folder)
    except PYCOLMAP_ERRORS as error:
        raise InputError(
            f"{folder} cannot be read as a COLMAP model ({_first_line(error)}); write it again with COLMAP"
        ) from error


def _first_line(error: BaseException) -> str:
    """Return the first line of an exception's text, or its type if it has none."""
    text = str(error).strip()
    return text.splitlines()[0].strip() if text else type(error).__name__


def _refuse_inconsistent(label: str, reconstruction: pycolmap.Reconstruction, *, is_checked: bool) -> None:
    """Refuse dangling references, and what is not finite unless the files were checked for that."""
    if not reconstruction.is_valid():
        raise InputError(
            f"{label} refers to an image, a frame or a 3D point that it does not have; "
            "write it again with COLMAP or pycolmap"
        )
    if is_checked:
        return
    points = reconstruction.points3D
    _refuse_not_finite(label, "3D point", list(points), [point.xyz for point in points.values()])
    cameras = reconstruction.cameras
    params = [float(np.sum(camera.params)) for camera in cameras.values()]  # NaN or infinite if one is
    _refuse_not_finite(label, "camera", list(cameras), params)
    for image_id in sorted(reconstruction.images):
        if not np.isfinite(points2d_xy(reconstruction.image(image_id))).all():
            raise InputError(f"{label}: image {image_id} has a point whose coordinates are not finite")


def _refuse_not_finite(label: str, kind: str, ids: list[int], values: npt.ArrayLike) -> None:
    """Raise InputError for the first of `ids` whose row of `values` is not finite."""
    array = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if not finite.all():
        raise InputError(f"{label}: {kind} {ids[int(np.argmin(finite))]} is not finite")


def _posed_model(label: str, reconstruction: pycolmap.Reconstruction) -> PosedModel:
    """Collect the posed images of a reconstruction."""
    posed = {i: image.name for i, image in reconstruction.images.items() if image.has_pose}
    image_ids = sorted(posed, key=lambda i: (posed[i], i))
    if len(image_ids) < 2:
        few = "only one image" if image_ids else "no image"
        raise InputError(f"{label} has {few} with a pose, but two or more are needed; register more")
    images = [reconstruction.image(i) for i in image_ids]
    frame_offsets = [_frame_offset(label, image, reconstruction) for image in images]
    names = tuple(image.name for image in images)
    if len(set(names)) < len(names):
        repeated = next(name for k, name in enumerate(names) if name in names[:k])
        raise InputError(f"{label} has two images of the name {repeated}; rename one")

    cameras = [reconstruction.camera(image.camera_id) for image in images]
    poses = [image.cam_from_world() for image in images]
    quaternions_xyzw = np.array([pose.rotation.quat for pose in poses], dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        # Quaternions are unit up to rounding in a file.
        sound = np.abs(np.linalg.norm(quaternions_xyzw, axis=1) - 1.0) <= UNIT_QUATERNION_TOLERANCE
    if not sound.all():
        raise InputError(f"{label}: image {image_ids[int(np.argmin(sound))]} has no valid rotation")
    rotations = rotation_matrices(quaternions_xyzw[:, [3, 0, 1, 2]])
    translations = np.array([pose.translation for pose in poses], dtype=np.float64)
    absurd = np.abs(translations) > _LARGEST_COORDINATE
    _refuse_not_finite(label, "the position of image", image_ids, np.where(absurd, np.inf, translations))
    images_as_arrays = images_of(reconstruction)
    return PosedModel(
        reconstruction=reconstruction,
        images=images_as_arrays.part(np.flatnonzero(np.isin(images_as_arrays.ids, image_ids))),
        image_ids=frozen(np.array(image_ids, dtype=np.int64)),
        names=names,
        rotations=frozen(rotations),
        centers=frozen(-np.einsum("nji,nj->ni", rotations, translations)),
        focal_lengths_px=frozen(_focal_lengths_px(label, cameras)),
        frame_ids=frozen(np.array([image.frame_id for image in images], dtype=np.int64)),
        frame_offsets=frozen(np.array(frame_offsets)),
    )


def _frame_offset(label: str, image: pycolmap.Image, reconstruction: pycolmap.Reconstruction) -> FloatArray:
    """Return C - C_frame of a posed image in world axes, exactly 0 for the reference sensor.

    Nothing says where a sensor without a pose in its rig stands: its image is refused.
    """
    frame = reconstruction.frame(image.frame_id)
    sensor, rig = reconstruction.camera(image.camera_id).sensor_id, reconstruction.rig(frame.rig_id)
    if rig.is_ref_sensor(sensor):
        return np.zeros(3)
    if not rig.has_sensor_from_rig(sensor):
        raise InputError(
            f"{label}: camera {image.camera_id} has no pose in rig {rig.rig_id} (sensor_from_rig), so that "
            f"image {image.name} has none; calibrate the rig, or give a trivial rig to each camera"
        )
    sensor_from_rig, rig_from_world = rig.sensor_from_rig(sensor), frame.rig_from_world
    assert sensor_from_rig is not None
    assert rig_from_world is not None
    in_rig = -sensor_from_rig.rotation.matrix().T @ sensor_from_rig.translation
    return np.asarray(rig_from_world.rotation.matrix().T @ in_rig)


def rotation_matrices(quaternions_wxyz: FloatArray) -> FloatArray:
    """Return the (n, 3, 3) rotations of quaternions (n, 4) in the order w, x, y, z; none may be zero."""
    w, x, y, z = normalized(quaternions_wxyz).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def _focal_lengths_px(label: str, cameras: list[pycolmap.Camera]) -> FloatArray:
    """Return the focal length of each camera, or refuse one that is not positive."""
    focals = [
        camera.params[0] / (2.0 * np.pi)  # its width covers a full turn
        if camera.model == pycolmap.CameraModelId.EQUIRECTANGULAR
        else camera.mean_focal_length()
        for camera in cameras
    ]
    for camera, focal in zip(cameras, focals, strict=True):
        if not (np.isfinite(focal) and focal > 0.0):
            raise InputError(
                f"{label}: camera {camera.camera_id} has focal length {focal:g} px; it must be > 0"
            )
    return np.array(focals, dtype=np.float64)


# --- points ----------------------------------------------------------------------------------------


def points2d_xy(image: pycolmap.Image) -> FloatArray:
    """Return the pixels of all points of an image, (k, 2), without a Python loop over them."""
    if not len(image.points2D):
        return np.zeros((0, 2))
    return np.asarray(_IDENTITY_CAMERA.cam_from_img(image.points2D), dtype=np.float64).reshape(-1, 2)


def observed_points(image: pycolmap.Image) -> tuple[IntArray, UInt64Array]:
    """Return the indices, ascending, of the points2D that observe a 3D point, and the ids of those points.

    pycolmap has no array of the ids. Only the observed points become Python objects, one attribute each;
    most points of an image usually observe nothing.
    """
    keypoints = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
    points = image.get_observation_points2D()
    return keypoints, np.fromiter(map(_POINT3D_ID, points), dtype=np.uint64, count=len(keypoints))
