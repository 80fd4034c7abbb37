"""pycolmap's reconstructions: taken from users as arrays, and made of arrays where a user asks for one.

Both go through COLMAP's own binary files, in a private folder: pycolmap has no arrays of points and tracks,
and objects of them one by one take ten times as long. What the files do not have is copied one by one: frames
and images without a pose, and whether a focal length is a prior.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.atomic_folder import private_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.binary_records import NO_POINT, POINT2D
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model_arrays import FrameRecords, ImageRecords, ModelArrays
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.files.colmap.read_binary import ModelFiles, read_files
from sfm_shapefit.files.colmap.write_binary import write_binary
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

PYCOLMAP_ERRORS = (ValueError, IndexError, KeyError, RuntimeError, MemoryError)
"""What pycolmap raises on bad data."""

# For this camera, pixel coordinates and normalized coordinates are the same numbers.
_IDENTITY_CAMERA = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[1.0, 1.0, 0.0, 0.0])


def name_of(image: pycolmap.Image) -> str:
    """Return the name of an image; its bytes that are no UTF-8 become lone surrogates, as Python's own do."""
    try:
        return str(image.name)
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "surrogateescape")


def bytes_of_name(name: str) -> bytes:
    """Return the name that a new image of pycolmap is to have."""
    return name.encode("utf-8", "surrogateescape")


def points2d_xy(image: pycolmap.Image) -> FloatArray:
    """Return the pixels of all points of an image, (k, 2), without a Python loop over them."""
    if not len(image.points2D):
        return np.zeros((0, 2))
    return np.asarray(_IDENTITY_CAMERA.cam_from_img(image.points2D), dtype=np.float64).reshape(-1, 2)


def arrays_of(reconstruction: pycolmap.Reconstruction) -> tuple[ModelArrays, tuple[str, ...]]:
    """Return a reconstruction, which is not modified, as arrays; returns and raises as `read_folder`."""
    called = "the reconstruction"
    try:
        if not reconstruction.is_valid():
            raise InputError(
                f"{called} refers to an image, a frame or a 3D point that it does not have; "
                "write it again with COLMAP or pycolmap"
            )
        _refuse_unplaced_sensors(reconstruction)  # which pycolmap cannot write
        with private_folder() as own, quiet_log():
            reconstruction.write_binary(own)
            model, notes = read_files(ModelFiles(own, called, ""))
    except PYCOLMAP_ERRORS as error:
        raise InputError(f"{called} is not a sound COLMAP model: {first_line(error)}") from error
    priors = {i for i, camera in reconstruction.cameras.items() if camera.has_prior_focal_length}
    return _with_unposed(replace(model, prior_focals=frozenset(priors)), reconstruction), notes


def _refuse_unplaced_sensors(reconstruction: pycolmap.Reconstruction) -> None:
    sensors = ((rig, one) for rig in reconstruction.rigs.values() for one in rig.non_ref_sensors.items())
    unplaced = {(rig.rig_id, sensor.id) for rig, (sensor, pose) in sensors if pose is None}
    for image in reconstruction.images.values() if unplaced else ():
        rig_id = reconstruction.frame(image.frame_id).rig_id
        if image.has_pose and (rig_id, image.camera_id) in unplaced:
            raise unplaced_error("the reconstruction", image.camera_id, rig_id, name_of(image))


def unplaced_error(called: str, camera_id: int, rig_id: int, name: str) -> InputError:
    """Return the error that nothing says where the camera of an image stands in its rig."""
    return InputError(
        f"{called}: camera {camera_id} has no pose in rig {rig_id} (sensor_from_rig), so that image {name} "
        "has none; calibrate the rig, or give a trivial rig to each camera"
    )


def _with_unposed(model: ModelArrays, reconstruction: pycolmap.Reconstruction) -> ModelArrays:
    """Return a model with the frames and images that a reconstruction has without a pose."""
    frames = [frame for frame in reconstruction.frames.values() if not frame.has_pose()]
    images = [image for image in reconstruction.images.values() if not image.has_pose]
    if not frames:
        return model
    both = FrameRecords(
        np.append(model.frames.ids, [frame.frame_id for frame in frames]),
        np.append(model.frames.rig_ids, [frame.rig_id for frame in frames]),
        np.concatenate([model.frames.poses, np.full((len(frames), 7), np.nan)]),
        (*model.frames.data, *(tuple(_data_of(frame)) for frame in frames)),
    )
    order = np.argsort(both.ids)
    ids = both.ids[order]
    frame_ids = np.append(model.frames.ids[model.images.frame_of], [image.frame_id for image in images])
    every = ImageRecords(
        np.append(model.images.ids, [image.image_id for image in images]).astype(np.int64),
        np.append(model.images.camera_ids, [image.camera_id for image in images]).astype(np.int64),
        np.searchsorted(ids, frame_ids),
        (*model.images.names, *map(name_of, images)),
    )
    known = len(model.images.ids)
    keypoints = [model.keypoints(row) for row in range(known)] + [
        bare_keypoints(points2d_xy(one)) for one in images
    ]
    rows = np.argsort(every.ids).tolist()
    return replace(
        model,
        frames=FrameRecords(ids, both.rig_ids[order], both.poses[order], tuple(both.data[k] for k in order)),
        images=ImageRecords(
            every.ids[rows], every.camera_ids[rows], every.frame_of[rows], tuple(every.names[k] for k in rows)
        ),
        starts=np.append(0, np.cumsum([len(keypoints[k]) for k in rows])),
        points2d=np.concatenate([np.zeros(0, POINT2D), *(keypoints[k] for k in rows)]),
    )


def _data_of(frame: pycolmap.Frame) -> Iterator[tuple[int, int, int]]:
    """Yield what `FrameRecords.data` says of a frame."""
    for data_id in frame.data_ids:
        yield int(data_id.sensor_id.type), int(data_id.sensor_id.id), int(data_id.id)


def bare_keypoints(xy: FloatArray) -> np.ndarray:
    """Return keypoints at pixels (k, 2) that observe no point."""
    records = np.empty(len(xy), POINT2D)
    records["xy"], records["point3d_id"] = xy, NO_POINT
    return records


def reconstruction_of(model: ModelArrays) -> pycolmap.Reconstruction:
    """Return a new reconstruction of a model, with its images that have no pose.

    Raises:
        InputError: if there is no room for its files.
    """
    with private_folder() as own, quiet_log():
        write_binary(model, own)
        built = pycolmap.Reconstruction(own)
    for camera_id in model.prior_focals & {lens.id for lens in model.lenses}:
        built.camera(camera_id).has_prior_focal_length = True
    for k in np.flatnonzero(~model.frames.is_posed).tolist():
        frame = pycolmap.Frame(frame_id=int(model.frames.ids[k]), rig_id=int(model.frames.rig_ids[k]))
        for kind, sensor_id, data_id in model.frames.data[k]:
            sensor = pycolmap.sensor_t(type=pycolmap.SensorType(kind), id=sensor_id)
            frame.add_data_id(pycolmap.data_t(sensor, data_id))
        built.add_frame(frame)
    for row in np.flatnonzero(~model.frames.is_posed[model.images.frame_of]).tolist():
        image = pycolmap.Image(
            name=bytes_of_name(model.images.names[row]),
            camera_id=int(model.images.camera_ids[row]),
            image_id=int(model.images.ids[row]),
            keypoints=model.keypoints(row)["xy"].astype(np.float64),
        )
        image.frame_id = int(model.frames.ids[model.images.frame_of[row]])
        built.add_image(image)
    return built


def moved_reconstruction(model: ModelArrays, images: Images, points: Points) -> pycolmap.Reconstruction:
    """Return a model with some images and points elsewhere, see `put_images`; all errors are updated."""
    places = model.points.copy()
    places["xyz"][np.searchsorted(places["id"], points.ids.astype(np.uint64))] = points.xyz
    moved = reconstruction_of(replace(put_images(model, images), points=places))
    moved.update_point_3d_errors()
    return moved


def transform_model(
    reconstruction: pycolmap.Reconstruction, similarity: Similarity
) -> pycolmap.Reconstruction:
    """Return the model under a similarity: cameras and points, and sensors in rigs if it scales."""
    copy = pycolmap.Reconstruction(reconstruction)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    copy.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return copy


def first_line(error: BaseException) -> str:
    """Return the first line of an exception's text, or its type if it has none."""
    text = str(error).strip().partition("\n")[0]
    if "Check failed" in text:  # its own assertions, which say nothing to users
        return "its parts contradict one another"
    return text or type(error).__name__
