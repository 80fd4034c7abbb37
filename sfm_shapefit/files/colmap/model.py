"""Models with known rotations: what is read of a COLMAP reconstruction.

COLMAP's convention is x_cam = R x_world + t with center C = -R^T t. Only R and the intrinsics are
trusted: the centers of the input are carried along for comparison and never place a camera.

Poses live in frames (`rig_from_world`); for a model of an older COLMAP, pycolmap makes one frame per
image. In a rig of several sensors cam_from_world = sensor_from_rig * rig_from_world, so that a camera stands
at C = C_frame + R_frame^T o, with the metric offset o = -R_s^T t_s of its sensor; the frames are the
unknowns.

Source of the conventions: https://colmap.github.io/format.html and `colmap/scene/reconstruction.h`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted, counted_are, first_of
from sfm_shapefit.files.colmap.check import (
    ContradictionError,
    binary_files,
    name_contradiction,
    walk_files,
)
from sfm_shapefit.files.colmap.images import bytes_of_name, images_of, name_of
from sfm_shapefit.files.colmap.lenses import focal_lengths
from sfm_shapefit.files.colmap.model_copies import with_own_cameras, without_points
from sfm_shapefit.files.colmap.points import Observed, points2d_xy
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.files.lines import UNIT_TOLERANCE
from sfm_shapefit.files.norms import are_off, say_normalized
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import names_among

PYCOLMAP_ERRORS = (ValueError, IndexError, KeyError, RuntimeError, MemoryError)
"""What pycolmap raises on bad data."""

# Sums of squares of larger coordinates overflow; these count as not finite.
_LARGEST_COORDINATE = 1e100


class HoldsModel(Protocol):
    """A result that has a model."""

    @property
    def reconstruction(self) -> pycolmap.Reconstruction:
        """The model."""


ModelSource = pycolmap.Reconstruction | HoldsModel | Path | str
"""A reconstruction, a result that has one, or a model folder."""


def model_of(source: ModelSource) -> pycolmap.Reconstruction | Path | str:
    """Return the reconstruction of a result; anything else as it is."""
    return source.reconstruction if hasattr(source, "reconstruction") else source


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColmapModel:
    """A COLMAP model: its posed images as arrays, and the rest, into which `files` alone looks."""

    reconstruction: pycolmap.Reconstruction
    """The input; nobody modifies it."""
    images: Images
    """Its posed images, in the order of their names.

    The answer's sums depend on the order of images, so it is that of the user's names, not of ids.
    """

    observed: Observed
    """What images observe, as far as the files told it already."""
    notes: tuple[str, ...] = ()
    """What is read otherwise than it stands in the input, a sentence each."""

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of all images, posed or not."""
        return tuple(name_of(image) for image in self.reconstruction.images.values())


def renamed_as(model: ColmapModel, names: Sequence[str]) -> ColmapModel:
    """Return a model whose images have the names that the same images have among others."""
    called, _ = names_among(model.image_names, names)
    changed = {old: new for old, new in called.items() if new != old}
    if not changed:
        return model
    copy = pycolmap.Reconstruction(model.reconstruction)
    for image in copy.images.values():
        image.name = bytes_of_name(changed.get(name_of(image), name_of(image)))
    old, new = next(iter(changed.items()))
    note = f"{counted_are(len(changed), 'image')} called otherwise in an earlier model, such as {old} {new}"
    return replace(read_model(copy), notes=(*model.notes, note))


def read_model(source: ModelSource, *, rotations_suffice: bool = False) -> ColmapModel:
    """Read a model folder, or take a reconstruction in memory, and refuse what cannot be used.

    Args:
        source: a folder with cameras, images and points3D (.bin preferred over .txt) and, from COLMAP
            3.12 on, rigs and frames; or a reconstruction, or a result that has one, which is not modified.
        rotations_suffice: whether images whose position is NaN have a pose; their centers are NaN then.

    Raises:
        InputError: if files are missing, truncated or not finite (see `check_model_files`), if pycolmap
            refuses them, if the pose of a sensor in its rig is not known, or if fewer than two images have a
            pose.
    """
    source = model_of(source)
    observed: Observed = {}
    notes: tuple[str, ...] = ()
    if not isinstance(source, pycolmap.Reconstruction | Path | str):
        raise InputError(
            f"a {type(source).__name__} is no model; give a folder, a reconstruction or a result"
        )
    if isinstance(source, pycolmap.Reconstruction):
        label, reconstruction = "the reconstruction", source
    else:
        label, (reconstruction, observed, notes) = str(Path(source)), _load(Path(source))
    try:
        with quiet_log():
            _refuse_inconsistent(label, reconstruction, is_checked=reconstruction is not source)
            reconstruction, note = _with_unit_quaternions(reconstruction, source)
            model = _posed_model(label, reconstruction, observed)
            model = replace(model, notes=(*notes, *filter(None, [note])))
            return model if rotations_suffice else _with_positions(label, model)
    except PYCOLMAP_ERRORS as error:
        raise InputError(f"{label} is not a sound COLMAP model: {_first_line(error)}") from error


def _load(folder: Path) -> tuple[pycolmap.Reconstruction, Observed, tuple[str, ...]]:
    """Check the files of a model and only then let pycolmap read them; with it come `ColmapModel.notes`."""
    try:
        with quiet_log(), binary_files(folder) as files, with_own_cameras(files) as own:
            try:
                observed, model = walk_files(own), pycolmap.Reconstruction(own.folder)
                # pycolmap lets a keypoint of no point observe the one whose track has it.
                same = {i: s for i, s in observed.items() if len(s[0]) == model.image(i).num_points3D}
                return model, same, own.notes
            except ContradictionError as error:
                reason = str(error)
            except PYCOLMAP_ERRORS:
                reason = name_contradiction(own)
                if not reason:
                    raise
            with without_points(own, reason) as bare:
                return pycolmap.Reconstruction(bare.folder), walk_files(bare), bare.notes
    except PYCOLMAP_ERRORS as error:
        raise InputError(
            f"{folder} cannot be read as a COLMAP model ({_first_line(error)}); write it again with COLMAP"
        ) from error


def _first_line(error: BaseException) -> str:
    """Return the first line of an exception's text, or its type if it has none."""
    text = str(error).strip().partition("\n")[0]
    if "Check failed" in text:  # its own assertions, which say nothing to users
        return "its parts contradict one another"
    return text or type(error).__name__


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


def _with_unit_quaternions(
    reconstruction: pycolmap.Reconstruction, source: ModelSource
) -> tuple[pycolmap.Reconstruction, str]:
    """Return a reconstruction whose quaternions are of norm 1, and a sentence if some were not.

    That of the user is not modified. A quaternion that is no rotation stays, to be refused.
    """
    norms = np.array([np.linalg.norm(pose.rotation.quat) for pose, _ in _poses_in(reconstruction)])
    off = are_off(norms)
    if not off.any():
        return reconstruction, ""
    own = pycolmap.Reconstruction(reconstruction) if reconstruction is source else reconstruction
    for (pose, put), norm, is_off in zip(_poses_in(own), norms.tolist(), off.tolist(), strict=True):
        if is_off:
            put(pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation.quat / norm), pose.translation))
    return own, say_normalized(norms)


def _poses_in(
    model: pycolmap.Reconstruction,
) -> Iterator[tuple[pycolmap.Rigid3d, Callable[[pycolmap.Rigid3d], None]]]:
    """Yield the poses of frames and of sensors in rigs, and what puts another in place of each."""
    for frame in model.frames.values():
        if frame.has_pose():
            yield frame.rig_from_world, partial(setattr, frame, "rig_from_world")
    for rig in model.rigs.values():
        for sensor, pose in rig.non_ref_sensors.items():
            if pose is not None:
                yield pose, partial(rig.set_sensor_from_rig, sensor)


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
    copy = pycolmap.Reconstruction(model.reconstruction)
    for frame_id in images.frames.ids[~images.frames.is_posed].tolist():
        copy.deregister_frame(frame_id)
    images = images.part(np.flatnonzero(known))
    return replace(model, reconstruction=copy, images=images, observed={}, notes=(*model.notes, note))


def _posed_model(label: str, reconstruction: pycolmap.Reconstruction, observed: Observed) -> ColmapModel:
    """Collect the posed images of a reconstruction."""
    every = images_of(reconstruction)
    has_pose = [reconstruction.image(image_id).has_pose for image_id in every.ids.tolist()]
    images = every.part(np.flatnonzero(has_pose))
    if images.num_images < 2:
        few = "only one image" if images.num_images else "no image"
        raise InputError(f"{label} has {few} with a pose, but two or more are needed; register more")
    _refuse_unplaced_sensors(label, reconstruction, images)
    names = images.names
    if len(set(names)) < len(names):
        repeated = next(name for k, name in enumerate(names) if name in names[:k])
        raise InputError(f"{label} has two images of the name {repeated}; rename one")
    ids = images.ids.tolist()
    poses = [reconstruction.image(image_id).cam_from_world() for image_id in ids]
    quaternions = np.array([pose.rotation.quat for pose in poses], dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        # Quaternions are unit up to rounding in a file.
        sound = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) <= UNIT_TOLERANCE
    if not sound.all():
        raise InputError(f"{label}: image {ids[int(np.argmin(sound))]} has no valid rotation")
    translations = np.array([pose.translation for pose in poses], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        absurd = np.abs(translations) > _LARGEST_COORDINATE
    _refuse_not_finite(label, "the position of image", ids, np.where(absurd, np.inf, 0.0))
    for lens in images.lenses:
        for focal in focal_lengths(lens):
            if not (np.isfinite(focal) and focal > 0.0):
                raise InputError(f"{label}: camera {lens.id} has focal length {focal:g} px; it must be > 0")
    return ColmapModel(reconstruction=reconstruction, images=images, observed=observed)


def _refuse_unplaced_sensors(label: str, reconstruction: pycolmap.Reconstruction, images: Images) -> None:
    """Refuse images through a lens of which nothing says where in its rig it stands."""
    is_open = np.isnan(images.sensors.translations[images.lens_of]).any(axis=1)
    if is_open.any():
        k = int(np.argmax(is_open))
        rig_id = reconstruction.frame(int(images.frames.ids[images.frame_of[k]])).rig_id
        raise InputError(
            f"{label}: camera {images.lenses[images.lens_of[k]].id} has no pose in rig {rig_id} "
            f"(sensor_from_rig), so that image {images.names[k]} has none; calibrate the rig, or give a "
            "trivial rig to each camera"
        )
