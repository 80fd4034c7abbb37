"""Models with known rotations: what is read of a COLMAP reconstruction.

COLMAP's convention is x_cam = R x_world + t with center C = -R^T t. Only R and the intrinsics are
trusted: the centers of the input are carried along for comparison and never place a camera.

Poses live in frames (`rig_from_world`); for a model of an older COLMAP, pycolmap makes one frame per
image. In a rig of several sensors cam_from_world = sensor_from_rig * rig_from_world, so that a camera stands
at C = C_frame + R_frame^T o, with the metric offset o = -R_s^T t_s of its sensor; the frames are the
unknowns.

Source of the conventions: https://colmap.github.io/format.html and `colmap/scene/reconstruction.h`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted, counted_are, first_of
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.lenses import focal_lengths
from sfm_shapefit.files.colmap.model_arrays import LARGEST_COORDINATE, ModelArrays, RigRecord
from sfm_shapefit.files.colmap.read_binary import read_folder
from sfm_shapefit.files.colmap.reconstructions import arrays_of, reconstruction_of
from sfm_shapefit.files.norms import are_off, say_normalized
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import names_among


class HoldsModel(Protocol):
    """A result that has a model."""

    @property
    def reconstruction(self) -> pycolmap.Reconstruction:
        """The model."""


ModelSource = pycolmap.Reconstruction | HoldsModel | ModelArrays | Path | str
"""A reconstruction, a result that has one, a model folder, or what was read of one."""


def model_of(source: ModelSource) -> pycolmap.Reconstruction | ModelArrays | Path | str:
    """Return the reconstruction of a result; anything else as it is."""
    return source.reconstruction if hasattr(source, "reconstruction") else source


@dataclass(frozen=True, kw_only=True, eq=False)
class ColmapModel:
    """A COLMAP model: its posed images, and all that it has, into which `files` alone looks."""

    arrays: ModelArrays
    """The input."""
    images: Images
    """Its posed images, in the order of their names.

    The answer's sums depend on the order of images, so it is that of the user's names, not of ids.
    """

    notes: tuple[str, ...] = ()
    """What is read otherwise than it stands in the input, a sentence each."""
    given: pycolmap.Reconstruction | None = None
    """The reconstruction that was handed in, which nobody modifies, if it is this very model."""

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of all images, posed or not."""
        return self.arrays.images.names

    @property
    def num_points(self) -> int:
        """Number of 3D points."""
        return len(self.arrays.points)

    @cached_property
    def reconstruction(self) -> pycolmap.Reconstruction:
        """The model as pycolmap has it."""
        return self.given or reconstruction_of(self.arrays)


def renamed_as(model: ColmapModel, names: Sequence[str]) -> ColmapModel:
    """Return a model whose images have the names that the same images have among others."""
    called, _ = names_among(model.image_names, names)
    changed = {old: new for old, new in called.items() if new != old}
    if not changed:
        return model
    old, new = next(iter(changed.items()))
    note = f"{counted_are(len(changed), 'image')} called otherwise in an earlier model, such as {old} {new}"
    return replace(read_model(model.arrays.renamed(changed)), notes=(*model.notes, note))


def read_model(source: ModelSource, *, rotations_suffice: bool = False) -> ColmapModel:
    """Read a model folder, or take a reconstruction in memory, and refuse what cannot be used.

    Args:
        source: a folder with cameras, images and points3D (.bin preferred over .txt) and, from COLMAP
            3.12 on, rigs and frames; or a reconstruction, or a result that has one, which is not modified.
        rotations_suffice: whether images whose position is NaN have a pose; their centers are NaN then.

    Raises:
        InputError: if files are missing, truncated or not finite (see `read_folder`), if the pose of a sensor
            in its rig is not known, or if fewer than two images have a pose.
    """
    source = model_of(source)
    label, notes, given = "the reconstruction", tuple[str, ...](), None
    if isinstance(source, ModelArrays):
        arrays = source
    elif isinstance(source, pycolmap.Reconstruction):
        given, (arrays, notes) = source, arrays_of(source)
    elif isinstance(source, Path | str):
        label, (arrays, notes) = str(Path(source)), read_folder(Path(source))
    else:
        raise InputError(f"a model is a folder, a reconstruction or a result; got {type(source).__name__}")
    arrays, note = _with_unit_quaternions(arrays)
    notes = (*notes, *filter(None, [note]))
    images, given = images_of(arrays), None if notes else given
    model = _posed_model(label, ColmapModel(arrays=arrays, images=images, notes=notes, given=given))
    return model if rotations_suffice else _with_positions(label, model)


def _with_unit_quaternions(model: ModelArrays) -> tuple[ModelArrays, str]:
    """Return a model whose quaternions are of norm 1, and a sentence if some were not."""
    poses = [
        *model.frames.poses[model.frames.is_posed],
        *(p for rig in model.rigs for p in rig.poses.values()),
    ]
    norms = np.array([_norm_of(pose) for pose in poses])
    if not are_off(norms).any():
        return model, ""
    frames = model.frames._replace(poses=np.array([_of_unit_norm(pose) for pose in model.frames.poses]))
    rigs = tuple(
        RigRecord(
            rig.id, {**rig.sensors, **{sensor: _of_unit_norm(pose) for sensor, pose in rig.poses.items()}}
        )
        for rig in model.rigs
    )
    return replace(model, frames=frames, rigs=rigs), say_normalized(norms)


def _of_unit_norm(pose: FloatArray) -> FloatArray:
    """Return a pose (7,) whose quaternion is of norm 1; a norm that is 1 up to rounding stays."""
    norm = _norm_of(pose)
    return np.append(pose[:4] / norm, pose[4:]) if are_off(np.array([norm])).all() else pose


def _norm_of(pose: FloatArray) -> float:
    """Return the norm of the quaternion of a pose (7,)."""
    return float(np.linalg.norm(pose[[1, 2, 3, 0]]))


def _with_positions(label: str, model: ColmapModel) -> ColmapModel:
    """Return a model without the images whose position is not known, and say how many these are."""
    images = model.images
    known = images.is_posed
    if known.all():
        return model
    unknown = [images.names[k] for k in np.flatnonzero(~known).tolist()]
    said = f"of {len(unknown)} of {counted(len(known), 'image')} the position is not known (NaN)"
    remedy = "`sfm-shapefit locate` finds positions from rotations and matches"
    if np.sum(known) < 2:
        raise InputError(f"{label}: {said}; {remedy}")
    note = f"{said}, so that these have no pose here: {first_of(unknown)}; {remedy}"
    rows = np.flatnonzero(np.isin(model.arrays.frames.ids, images.frames.ids[~images.frames.is_posed]))
    arrays, images = model.arrays.without_poses(rows), images.part(np.flatnonzero(known))
    return replace(model, arrays=arrays, images=images, notes=(*model.notes, note), given=None)


def _posed_model(label: str, model: ColmapModel) -> ColmapModel:
    every, arrays = model.images, model.arrays
    has_pose = arrays.frames.is_posed[arrays.images.frame_of[arrays.images.rows(every.ids)]]
    images = every.part(np.flatnonzero(has_pose))
    if images.num_images < 2:
        few = "only one image" if images.num_images else "no image"
        raise InputError(f"{label} has {few} with a pose, but two or more are needed; register more")
    _refuse_unplaced_sensors(label, arrays, images)
    names = images.names
    if len(set(names)) < len(names):
        repeated = next(name for k, name in enumerate(names) if name in names[:k])
        raise InputError(f"{label} has two images of the name {repeated}; rename one")
    translations = arrays.camera_poses()[arrays.images.rows(images.ids), 4:]
    with np.errstate(invalid="ignore"):
        absurd = (np.abs(translations) > LARGEST_COORDINATE).any(axis=1)
    if absurd.any():
        raise InputError(f"{label}: the position of image {images.ids[np.argmax(absurd)]} is not finite")
    for lens in images.lenses:
        for focal in focal_lengths(lens):
            if not (np.isfinite(focal) and focal > 0.0):
                raise InputError(f"{label}: camera {lens.id} has focal length {focal:g} px; it must be > 0")
    return replace(model, images=images)


def _refuse_unplaced_sensors(label: str, model: ModelArrays, images: Images) -> None:
    """Refuse images through a lens of which nothing says where in its rig it stands."""
    is_open = np.isnan(images.sensors.translations[images.lens_of]).any(axis=1)
    if is_open.any():
        k = int(np.argmax(is_open))
        frame = model.images.frame_of[model.images.rows(images.ids[k : k + 1])[0]]
        camera_id, rig_id = images.lenses[images.lens_of[k]].id, int(model.frames.rig_ids[frame])
        raise InputError(
            f"{label}: camera {camera_id} has no pose in rig {rig_id} (sensor_from_rig), so that image "
            f"{images.names[k]} has none; calibrate the rig, or give a trivial rig to each camera"
        )
