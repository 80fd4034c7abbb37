"""Models of pycolmap for tests: where their images stand, and copies that have them elsewhere."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.files.colmap.model_arrays import ModelArrays
from sfm_shapefit.files.colmap.reconstructions import arrays_of
from sfm_shapefit.scene.images import Images

Floats = npt.NDArray[np.float64]
Change = Callable[[str, Floats, Floats], tuple[Floats, Floats]]


def arrays(model: pycolmap.Reconstruction) -> ModelArrays:
    """Return a model as arrays."""
    return arrays_of(model)[0]


def centers_of(model: pycolmap.Reconstruction) -> Floats:
    """Return the centers (k, 3) of the posed images, by ascending id."""
    return np.array([model.image(i).projection_center() for i in sorted(model.reg_image_ids())])


def poses_of(model: pycolmap.Reconstruction) -> dict[str, Floats]:
    """Return cam_from_world (3, 4) of the posed images, by name."""
    images = (model.image(i) for i in sorted(model.reg_image_ids()))
    return {image.name: image.cam_from_world().matrix() for image in images}


def posed(model: pycolmap.Reconstruction | Path, change: Change) -> pycolmap.Reconstruction:
    """Return a copy of a model without rigs whose images stand elsewhere.

    `change` takes the name, the rotation cam_from_world and the center of an image, by ascending id, and
    returns the new rotation and center.
    """
    copy = pycolmap.Reconstruction(model)
    for image_id in sorted(copy.reg_image_ids()):
        image = copy.image(image_id)
        given = image.cam_from_world().rotation.matrix(), image.projection_center()
        rotation, center = change(image.name, *given)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -(rotation @ center))
        copy.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    return copy


def turned(
    model: pycolmap.Reconstruction | Path, names: Iterable[str], turn: Floats
) -> pycolmap.Reconstruction:
    """Return a copy some of whose cameras are turned, each about its own center: R becomes `turn` R."""
    chosen = set(names)
    return posed(
        model, lambda name, rotation, center: (turn @ rotation if name in chosen else rotation, center)
    )


def only(model: pycolmap.Reconstruction, image_ids: Iterable[int]) -> pycolmap.Reconstruction:
    """Return the model of some of the images of one without rigs, with the points that two of them see."""
    part, chosen = pycolmap.Reconstruction(), sorted(image_ids)
    for camera_id in sorted({model.image(i).camera_id for i in chosen}):
        part.add_camera_with_trivial_rig(model.camera(camera_id))
    for image_id in chosen:
        image = model.image(image_id)
        own = {"name": image.name, "camera_id": image.camera_id, "image_id": image_id}
        xy = np.array([point.xy for point in image.points2D])
        part.add_image_with_trivial_frame(pycolmap.Image(keypoints=xy, **own), image.cam_from_world())
    for point in model.points3D.values():
        seen = [element for element in point.track.elements if element.image_id in chosen]
        if len(seen) > 1:
            part.add_point3D(point.xyz, pycolmap.Track(seen), point.color)
    return part


def write_priors(path: Path, positions: Mapping[str, npt.ArrayLike], *further: float) -> Path:
    """Write a table of position priors, by the names of images; the same further columns follow each."""
    rows = ((name, *np.asarray(xyz).tolist(), *further) for name, xyz in positions.items())
    path.write_text("\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    return path


def by_name(images: Images, positions: npt.ArrayLike) -> dict[str, Floats]:
    """Return positions (n, 3) of images by their names."""
    return dict(zip(images.names, np.asarray(positions), strict=True))
