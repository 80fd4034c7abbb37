"""The cameras of an adjustment: images as they are, or views of images through other lenses.

An image whose lens is a case of OPENCV is one camera. An image through any other lens becomes several cameras
of one center: its rays are shared out to 14 views, the faces and corners of a cube round the camera, of which
those that see something take part. Points are triangulated from these, as no ray is more than 28 degrees off
the axis of its view, even at right angles to the camera or behind it.

The adjustment itself takes the pixels of the image, in all views alike, where it knows the projection of the
lens. A lens that it does not know is ideal in its views: rays are undistorted once, and an error is at most
1.3 times that of the image.
"""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.adjustment.freedom import GivenPoses
from sfm_shapefit.adjustment.problem import AdjustmentProblem, Rig
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import CameraPoses, SeenTracks
from sfm_shapefit.tracks.triangulation import TriangulatedPoints

_AT_ONCE = 1_000_000  # observations whose pixels are looked up together; they take 24 MB


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """The cameras of images, all of which are posed, in the order of the images."""

    images: IntArray
    """(c,) the image that each is a view of, ascending."""
    rotations: FloatArray
    """(c, 3, 3) camera_from_image: exactly the identity where a camera is the whole image."""

    def poses(self, images: Images) -> CameraPoses:
        """Return where the cameras stand."""
        in_rigs, translations = self._sensors(images)
        frames = images.frame_of[self.images]
        turned = in_rigs @ images.frames.rotations[frames]
        return CameraPoses(
            rotations=np.ascontiguousarray(turned),
            centers=images.frames.centers[frames] - np.einsum("cba,cb->ca", turned, translations),
            focal_lengths_px=images.focal_lengths_px[self.images],
            images=self.images,
        )

    def problem(
        self,
        images: Images,
        sensors: BoolArray,
        given: GivenPoses,
        tracks: SeenTracks,
        found: TriangulatedPoints,
    ) -> AdjustmentProblem:
        """Return the problem of points found of tracks, at the poses of the images of the views.

        Lenses among `sensors` (l,) move in their rigs. Rotations that were given have no part yet.
        """
        used = np.flatnonzero(found.points_seen >= 0).astype(np.int32)
        pixels = np.empty((len(used), 2))
        for first in range(0, len(used), _AT_ONCE):
            pixels[first : first + _AT_ONCE] = tracks.pixels[used[first : first + _AT_ONCE]]
        rotations, translations = self._as_adjusted(images)._sensors(images)
        frames, lenses = images.frame_of[self.images], images.lens_of[self.images]
        rig = Rig(
            frame_of_camera=frames,
            rotations=rotations,
            translations=translations,
            free_sensor_of_camera=np.where(sensors, np.cumsum(sensors) - 1, -1)[lenses],
        )
        return AdjustmentProblem(
            rotations=images.frames.rotations,
            centers=images.frames.centers,
            points=found.points,
            cameras_seeing=tracks.cameras[used],
            points_seen=found.points_seen[used],
            pixels=pixels,
            lenses=tuple(map(_lens_of_views, images.lenses)),
            lens_of_camera=lenses,
            rig=rig,
            fixed=np.zeros(0, np.bool_) if given.fixed is None else given.fixed,
            center_prior=given.centers,
        )

    def images_of(self, images: Images, solved: AdjustmentProblem) -> Images:
        """Return the images where a problem of theirs has frames and free sensors, with its lenses."""
        lenses = [
            replace(lens, parameters=found.parameters) if lens.is_adjustable else lens
            for lens, found in zip(images.lenses, solved.lenses, strict=True)
        ]
        moved = images.posed(solved.rotations, solved.centers).with_lenses(lenses)
        cameras = np.flatnonzero(solved.rig.free_sensor_of_camera >= 0)
        if not len(cameras):
            return moved
        views = self._as_adjusted(images)
        own, back = solved.lens_of_camera[cameras], views.rotations[cameras].transpose(0, 2, 1)
        rotations, translations = images.sensors.rotations.copy(), images.sensors.translations.copy()
        rotations[own] = back @ solved.rig.rotations[cameras]
        translations[own] = np.einsum("cab,cb->ca", back, solved.rig.translations[cameras])
        return moved.with_sensors(rotations, translations)

    def seen_points(self, tracks: SeenTracks, found: TriangulatedPoints) -> Points:
        """Return triangulated points and their observations; own tracks keep their ids."""
        used = np.flatnonzero(found.points_seen >= 0)
        used = used[np.argsort(found.points_seen[used], kind="stable")]
        lengths = np.bincount(found.points_seen[used], minlength=len(found.points))
        return Points(
            xyz=found.points,
            offsets=offsets_of(lengths),
            images=self.images[tracks.cameras[used]],
            keypoints=tracks.keypoints[used].astype(np.int32, copy=False),
            ids=1 + np.arange(len(lengths)) if tracks.may_split else tracks.ids[found.tracks],
        )

    def _as_adjusted(self, images: Images) -> "Views":
        """Return the views as the problem has them: those of a lens that it knows are all the whole image."""
        known = np.array([lens.is_adjustable for lens in images.lenses], dtype=np.bool_)
        is_whole = known[images.lens_of][self.images]
        return replace(self, rotations=np.where(is_whole[:, None, None], np.eye(3), self.rotations))

    def _sensors(self, images: Images) -> tuple[FloatArray, FloatArray]:
        """Return rotations (c, 3, 3) and translations (c, 3) of camera_from_rig."""
        lenses = images.lens_of[self.images]
        rotations, translations = images.sensors.rotations[lenses], images.sensors.translations[lenses]
        turned = np.flatnonzero((self.rotations != np.eye(3)).any(axis=(1, 2)))
        rotations[turned] = self.rotations[turned] @ rotations[turned]
        translations[turned] = np.einsum("cab,cb->ca", self.rotations[turned], translations[turned])
        return rotations, translations


def views_of(images: Images) -> Views:
    """Return the cameras of posed images."""
    whole = np.array([lens.is_plane for lens in images.lenses], dtype=np.bool_)[images.lens_of]
    parts = [np.eye(3)[None] if is_whole else CUBE for is_whole in whole.tolist()]
    return Views(
        images=np.repeat(np.arange(images.num_images), [len(part) for part in parts]),
        rotations=np.concatenate(parts),
    )


def _lens_of_views(lens: Lens) -> Lens:
    """Return the lens of the views of an image, as the problem has them."""
    if lens.is_adjustable:
        return lens
    return Lens("SIMPLE_PINHOLE", (lens.focal_px, 0.0, 0.0), fixed=True, id=lens.id)


def _cube() -> FloatArray:
    """Return rotations (14, 3, 3) whose last rows are the faces and corners of a cube, +z first."""
    axes = np.concatenate([np.eye(3)[::-1], -np.eye(3), np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0])
    z = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.cross(z, np.where(np.abs(z[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    y = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=1)


CUBE = _cube()
