"""The door to our own bundle adjustment: a reconstruction as an `AdjustmentProblem`, and back into a new one.

Frames of the reconstruction are frames of the problem. An image whose camera is a case of OPENCV is one
camera of the problem. An image through any other lens becomes several ideal cameras of one center: its rays
are undistorted once and shared out to 14 views, the faces and corners of a cube round the camera, of which
those that see something take part. No ray is more than 28 degrees off the axis of its view, so that an error
is at most 1.3 times that of the image, even for rays at right angles to the camera or behind it.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from sfm_shapefit.adjustment import AdjustmentProblem, Lens, Rig
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.files.colmap.lenses import lens_of
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.tracks.links import CameraPoses, ObservedTracks
from sfm_shapefit.tracks.triangulation import TriangulatedPoints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedFrames:
    """The posed frames of a reconstruction and the cameras in them, as arrays; points apart."""

    frame_ids: tuple[int, ...]
    """Of the n frames, ascending."""
    rotations: FloatArray
    """(n, 3, 3) rig_from_world."""
    centers: FloatArray
    """(n, 3)"""
    fixed: BoolArray
    """(n,) frames that stay."""
    image_ids: tuple[int, ...]
    """Of the images, ascending; all of them are posed."""
    images: IntArray
    """(c,) the place in `image_ids` of the image that each camera is a view of, ascending."""
    frame_of_camera: IntArray
    """(c,)"""
    sensor_rotations: FloatArray
    """(c, 3, 3) camera_from_rig."""
    sensor_translations: FloatArray
    """(c, 3)"""
    sensor_of_camera: IntArray
    """(c,) place in `free_sensors` of the sensor that a camera is, or is a view of; -1 if that stays."""
    view_rotations: FloatArray
    """(c, 3, 3) view_from_camera: the identity where a camera is the whole image."""
    free_sensors: tuple[int, ...]
    """The ids of the cameras that may move in their rigs, ascending."""
    lenses: tuple[Lens, ...]
    lens_of_camera: IntArray
    """(c,)"""
    colmap_camera_of_lens: tuple[int, ...]
    """The id of the camera in the reconstruction."""
    center_prior: KnownPositions | None = None
    """Of the frames."""

    def poses(self) -> CameraPoses:
        """Return where the cameras stand."""
        turned = self.sensor_rotations @ self.rotations[self.frame_of_camera]
        shifts = np.einsum("cba,cb->ca", turned, self.sensor_translations)
        focals = np.array([np.mean(lens.values()[:2]) for lens in self.lenses])
        return CameraPoses(
            rotations=np.ascontiguousarray(turned),
            centers=self.centers[self.frame_of_camera] - shifts,
            focal_lengths_px=focals[self.lens_of_camera],
            images=self.images,
        )

    def problem(self, tracks: ObservedTracks, found: TriangulatedPoints) -> AdjustmentProblem:
        """Return the problem of points that were triangulated from tracks, at the frames' own poses."""
        used = np.flatnonzero(found.points_seen >= 0)
        return self.problem_of(
            found.points, tracks.cameras[used], found.points_seen[used], tracks.pixels[used]
        )

    def problem_of(
        self, points: FloatArray, cameras_seeing: IntArray, points_seen: IntArray, pixels: FloatArray
    ) -> AdjustmentProblem:
        """Return the problem of points and their observations, at the frames' own poses."""
        is_plain = len(self.images) == len(self.frame_ids) and not self.sensor_translations.any()
        is_plain = is_plain and bool((self.sensor_rotations == np.eye(3)).all())
        is_plain = is_plain and bool((self.frame_of_camera == np.arange(len(self.images))).all())
        return AdjustmentProblem(
            rotations=self.rotations,
            centers=self.centers,
            points=points,
            cameras_seeing=cameras_seeing,
            points_seen=points_seen,
            pixels=pixels,
            lenses=self.lenses,
            lens_of_camera=self.lens_of_camera,
            rig=None
            if is_plain
            else Rig(
                frame_of_camera=self.frame_of_camera,
                rotations=self.sensor_rotations,
                translations=self.sensor_translations,
                free_sensor_of_camera=self.sensor_of_camera,
            ),
            fixed=self.fixed,
            center_prior=self.center_prior,
        )


def read_frames(
    reconstruction: pycolmap.Reconstruction,
    fixed_frames: Collection[int] = (),
    known: KnownPositions | None = None,
    *,
    free_rigs: bool = False,
) -> PosedFrames:
    """Return the posed frames of a reconstruction as arrays.

    Args:
        reconstruction: whose frames with a pose are read.
        fixed_frames: ids of those that stay; others are ignored.
        known: centers measured otherwise, by the ids of frames; of other frames they are ignored.
        free_rigs: whether sensors may move in their rigs, all but the references.
    """
    image_ids = sorted(reconstruction.reg_image_ids())
    images = [reconstruction.image(i) for i in image_ids]
    frame_ids = sorted({image.frame_id for image in images})
    place = {frame: k for k, frame in enumerate(frame_ids)}
    rotations = rotations_of_frames(reconstruction, frame_ids)
    translations = np.array([_pose(reconstruction.frame(i)).translation for i in frame_ids]).reshape(-1, 3)
    camera_ids = sorted({image.camera_id for image in images})
    views = {i: _views(reconstruction.camera(i)) for i in camera_ids}
    lenses = tuple(_lens(reconstruction.camera(i)) for i in camera_ids)
    sensors = [_sensor_from_rig(reconstruction, image) for image in images]
    counts = np.array([len(views[image.camera_id]) for image in images], dtype=np.int64)
    of_image = np.repeat(np.arange(len(images)), counts)
    turns = np.concatenate([views[image.camera_id] for image in images])
    sensor_rotations = np.array([rotation for rotation, _ in sensors])[of_image]
    sensor_translations = np.array([translation for _, translation in sensors])[of_image]
    moving = [free_rigs and not _is_reference(reconstruction, image) for image in images]
    free_sensors = sorted({image.camera_id for image, moves in zip(images, moving, strict=True) if moves})
    place_of_sensor = {camera_id: k for k, camera_id in enumerate(free_sensors)}
    is_turned = (counts > 1)[of_image]
    sensor_rotations[is_turned] = turns[is_turned] @ sensor_rotations[is_turned]
    sensor_translations[is_turned] = np.einsum("cab,cb->ca", turns[is_turned], sensor_translations[is_turned])
    return PosedFrames(
        frame_ids=tuple(frame_ids),
        rotations=rotations,
        centers=-np.einsum("nba,nb->na", rotations, translations),
        fixed=np.isin(frame_ids, sorted(fixed_frames)),
        image_ids=tuple(image_ids),
        images=of_image,
        frame_of_camera=np.array([place[image.frame_id] for image in images])[of_image],
        sensor_rotations=sensor_rotations,
        sensor_translations=sensor_translations,
        sensor_of_camera=np.array([place_of_sensor.get(image.camera_id, -1) for image in images])[of_image],
        view_rotations=turns,
        free_sensors=tuple(free_sensors),
        lenses=lenses,
        lens_of_camera=np.array([camera_ids.index(image.camera_id) for image in images])[of_image],
        colmap_camera_of_lens=tuple(camera_ids),
        center_prior=None if known is None else known.among(np.array(frame_ids)),
    )


def with_points(
    reconstruction: pycolmap.Reconstruction, point_ids: IntArray, points: FloatArray
) -> pycolmap.Reconstruction:
    """Return a copy with points moved, and all errors of points updated.

    Args:
        reconstruction: not changed.
        point_ids: (k,) of some of its points.
        points: (k, 3) where they go.
    """
    copy = pycolmap.Reconstruction(reconstruction)
    for point_id, xyz in zip(point_ids.tolist(), points, strict=True):
        copy.point3D(point_id).xyz = xyz
    copy.update_point_3d_errors()
    return copy


def with_poses(
    reconstruction: pycolmap.Reconstruction, old: PosedFrames, new: PosedFrames
) -> pycolmap.Reconstruction:
    """Return a copy with other poses, see `set_poses`."""
    copy = pycolmap.Reconstruction(reconstruction)
    set_poses(copy, old, new)
    return copy


def set_poses(reconstruction: pycolmap.Reconstruction, old: PosedFrames, new: PosedFrames) -> None:
    """Let frames and free sensors of our own `reconstruction` stand, and lenses be, as in `new`; points stay.

    Args:
        reconstruction: whose frames `old` were read from; changed in place.
        old: before; what is the same in `new` to the last bit keeps its bits.
        new: after.
    """
    for k, frame_id in enumerate(new.frame_ids):
        rotation, center = new.rotations[k], new.centers[k]
        turns = bool((rotation != old.rotations[k]).any())
        if not turns and (center == old.centers[k]).all():
            continue
        frame = reconstruction.frame(frame_id)
        turn = pycolmap.Rotation3d(rotation) if turns else _pose(frame).rotation
        frame.rig_from_world = pycolmap.Rigid3d(turn, -(rotation @ center))
    for camera_id, pose in sensors_from_rigs(new).items():
        sensor = reconstruction.camera(camera_id).sensor_id
        rigs = reconstruction.rigs.values()
        next(rig for rig in rigs if rig.has_sensor(sensor)).set_sensor_from_rig(sensor, pose)
    for before, after, camera_id in zip(old.lenses, new.lenses, new.colmap_camera_of_lens, strict=True):
        if after.parameters != before.parameters:
            reconstruction.camera(camera_id).params = list(after.parameters)


def sensors_from_rigs(frames: PosedFrames) -> dict[int, pycolmap.Rigid3d]:
    """Return the poses of the free sensors in their rigs, by the ids of their cameras."""
    found = {}
    for k, camera_id in enumerate(frames.free_sensors):
        camera = int(np.argmax(frames.sensor_of_camera == k))
        rotation, translation = frames.sensor_rotations[camera], frames.sensor_translations[camera]
        view = frames.view_rotations[camera]
        found[camera_id] = pycolmap.Rigid3d(pycolmap.Rotation3d(view.T @ rotation), view.T @ translation)
    return found


def add_points(
    reconstruction: pycolmap.Reconstruction,
    frames: PosedFrames,
    tracks: ObservedTracks,
    found: TriangulatedPoints,
    colors: "pycolmap.Reconstruction | None" = None,
) -> None:
    """Add points and their tracks to our own `reconstruction`.

    Args:
        reconstruction: changed in place.
        frames: of it.
        tracks: whose observations they are.
        found: the points. Those of a model's own tracks get their ids; others are numbered on from those that
            are there, the first one from 1.
        colors: the model whose points give theirs, by the same ids.
    """
    used = np.flatnonzero(found.points_seen >= 0)
    used = used[np.argsort(found.points_seen[used], kind="stable")]
    ends = np.cumsum(np.bincount(found.points_seen[used], minlength=len(found.points))).tolist()
    image_ids = np.array(frames.image_ids)[frames.images[tracks.cameras[used]]].tolist()
    keypoints = tracks.keypoints[used].tolist()
    first = 1 + reconstruction.num_points3D()
    ids = range(first, first + len(ends)) if tracks.may_split else tracks.ids[found.tracks].tolist()
    begin = 0
    for point_id, end, xyz in zip(ids, ends, found.points, strict=True):
        track = pycolmap.Track()
        for image_id, keypoint in zip(image_ids[begin:end], keypoints[begin:end], strict=True):
            track.add_element(image_id, keypoint)  # a TrackElement for each takes four times as long
        point = pycolmap.Point3D(xyz=xyz, track=track)
        if colors is not None:
            point.color = colors.point3D(point_id).color
        reconstruction.add_point3D_with_id(point_id, point)
        begin = end


def rotations_of_frames(reconstruction: pycolmap.Reconstruction, frame_ids: Sequence[int]) -> FloatArray:
    """Return rig_from_world (n, 3, 3) of posed frames by their ids."""
    found = [_matrix(_pose(reconstruction.frame(i)).rotation) for i in frame_ids]
    return np.array(found).reshape(-1, 3, 3)


def _matrix(rotation: pycolmap.Rotation3d) -> FloatArray:
    """Return the matrix of a rotation; the quaternion of a model in text need not be of length 1."""
    return np.asarray(pycolmap.Rotation3d(normalized(rotation.quat)).matrix())


def _pose(frame: pycolmap.Frame) -> pycolmap.Rigid3d:
    """Return rig_from_world of a frame of a posed image."""
    pose = frame.rig_from_world
    assert pose is not None
    return pose


def _views(camera: pycolmap.Camera) -> FloatArray:
    """Return the views of a camera, (v, 3, 3) view_from_camera: itself if it is adjusted as it is."""
    return np.eye(3)[None] if lens_of(camera).is_adjustable else CUBE


def _lens(camera: pycolmap.Camera) -> Lens:
    """Return the lens of a camera, or that of its views."""
    lens = lens_of(camera)
    return lens if lens.is_adjustable else Lens("SIMPLE_PINHOLE", (lens.focal_px, 0.0, 0.0), fixed=True)


def _is_reference(reconstruction: pycolmap.Reconstruction, image: pycolmap.Image) -> bool:
    """Return whether an image is of the reference sensor of its rig."""
    rig = reconstruction.rig(reconstruction.frame(image.frame_id).rig_id)
    return bool(rig.is_ref_sensor(reconstruction.camera(image.camera_id).sensor_id))


def _sensor_from_rig(
    reconstruction: pycolmap.Reconstruction, image: pycolmap.Image
) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation of the sensor of an image, exactly the identity for a reference."""
    sensor = reconstruction.camera(image.camera_id).sensor_id
    rig = reconstruction.rig(reconstruction.frame(image.frame_id).rig_id)
    if _is_reference(reconstruction, image):
        return np.eye(3), np.zeros(3)
    pose = rig.sensor_from_rig(sensor)
    assert pose is not None  # `read_model` refuses others
    return _matrix(pose.rotation), pose.translation


def _cube() -> FloatArray:
    """Return rotations (14, 3, 3) whose last rows are the faces and corners of a cube, +z first."""
    axes = np.concatenate([np.eye(3)[::-1], -np.eye(3), np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0])
    z = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.cross(z, np.where(np.abs(z[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    y = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=1)


CUBE = _cube()
