"""Models as `Images` and `Points`, and what changed put back: nothing else changes a bit."""

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.files.colmap.images import images_of, put_images
from sfm_shapefit.files.colmap.lenses import lens_of
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.files.colmap.reconstructions import moved_reconstruction, reconstruction_of
from tests.adjustment.test_views import DISTORTIONS, scene
from tests.files.test_colmap_writing import dump
from tests.models import arrays
from tests.structures import colored, pictures_of, put_points


def with_rigs():
    """A model of two rigs, one frame of which has no pose, with sensors' bits in what `dump` shows."""
    model = scene("OPENCV_FISHEYE", rigs=True)
    model.deregister_frame(sorted(model.reg_frame_ids())[1])
    return model


def dump_all(model):
    sensors = [
        (rig_id, sensor.id, bytes(np.array(pose.params)))
        for rig_id, rig in sorted(model.rigs.items())
        for sensor, pose in rig.non_ref_sensors.items()
    ]
    return dump(model), sorted(sensors)


def test_images_stand_and_look_as_pycolmap_says():
    model = with_rigs()
    images = images_of(arrays(model))
    assert list(images.names) == sorted(image.name for image in model.images.values())
    own = images.part(np.flatnonzero(images.is_posed))
    theirs = [model.image(i) for i in own.ids.tolist()]
    assert own.num_images == sum(image.has_pose for image in model.images.values())
    poses, centers = (
        [image.cam_from_world() for image in theirs],
        [image.projection_center() for image in theirs],
    )
    np.testing.assert_allclose(own.rotations, [pose.rotation.matrix() for pose in poses], atol=1e-14)
    np.testing.assert_allclose(own.centers, centers, atol=1e-12)
    origins = [image.frame.rig_from_world.inverse().translation for image in theirs]
    np.testing.assert_allclose(own.offsets, np.subtract(centers, origins), atol=1e-12)
    np.testing.assert_allclose(own.focal_lengths_px, [i.camera.mean_focal_length() for i in theirs])
    assert own.frames.ids[own.frame_of].tolist() == [image.frame_id for image in theirs]
    for k, image_id in enumerate(images.ids.tolist()):
        camera = model.image(image_id).camera
        assert images.lenses[images.lens_of[k]] == lens_of(camera)
        is_reference = images.sensors.is_reference[images.lens_of[k]]
        assert is_reference == model.image(image_id).is_ref_in_frame()


@pytest.mark.parametrize("name", [n for n in pycolmap.CameraModelId.__members__ if n != "INVALID"])
def test_the_mean_focal_length_of_every_lens_is_known(name):
    camera = pycolmap.Camera.create_from_model_id(7, getattr(pycolmap.CameraModelId, name), 400.0, 640, 480)
    places = camera.focal_length_idxs()
    if places:
        camera.params = [410.0 + k if k in places else p for k, p in enumerate(camera.params)]
    lens = lens_of(camera)
    expected = camera.mean_focal_length() if places else 640.0 / (2.0 * np.pi)
    assert lens.focal_px == pytest.approx(expected, rel=1e-15)
    assert (lens.id, lens.width, lens.height) == (7, 640, 480)


def test_images_put_back_as_they_are_change_no_bit():
    model = with_rigs()
    before = dump_all(model)
    read = arrays(model)
    assert dump_all(reconstruction_of(put_images(read, images_of(read)))) == before


def test_only_what_changed_is_put_back():
    model = with_rigs()
    before, read = pycolmap.Reconstruction(model), arrays(model)
    images = images_of(read)
    rotations, centers = images.frames.rotations.copy(), images.frames.centers.copy()
    moved, turned, gone = np.flatnonzero(images.frames.is_posed)[:3]
    centers[moved] += 1.0
    rotations[turned] = rotations[turned][[1, 2, 0]]
    centers[gone] = np.nan
    sensor = int(np.argmin(images.sensors.is_reference))
    shifts = images.sensors.translations.copy()
    shifts[sensor] += 0.1
    there = images.posed(rotations, centers).with_sensors(images.sensors.rotations, shifts)
    changed = put_images(read, there)
    model = reconstruction_of(changed)
    ids = images.frames.ids.tolist()
    assert model.frame(ids[gone]).rig_from_world is None
    poses = {i: (before.frame(i).rig_from_world, model.frame(i).rig_from_world) for i in ids}
    for k, frame_id in enumerate(ids):
        old, new = poses[frame_id]
        if k not in (moved, turned, gone):
            assert old is new is None or bytes(np.array(old.params)) == bytes(np.array(new.params))
    old, new = poses[ids[moved]]
    assert bytes(old.rotation.quat) == bytes(new.rotation.quat)
    again = images_of(changed)
    np.testing.assert_allclose(again.frames.rotations[turned], rotations[turned], atol=1e-15)
    np.testing.assert_allclose(again.frames.centers[moved], centers[moved], atol=1e-12)
    np.testing.assert_array_equal(again.sensors.translations, shifts)
    same = np.arange(len(shifts)) != sensor
    np.testing.assert_array_equal(again.sensors.rotations[same], images.sensors.rotations[same])


def test_lenses_are_put_back():
    model = arrays(scene("RADIAL"))
    (lens,) = images_of(model).lenses
    values = lens.values() * 1.01
    model = put_images(model, images_of(model).with_lenses([lens.with_values(values)]))
    np.testing.assert_array_equal(images_of(model).lenses[0].values(), values)


def test_points_read_and_added_again_are_the_same():
    model = scene(rigs=True)
    read = arrays(model)
    images = images_of(read)
    points = points_of(read, images)
    assert points.lengths().tolist() == [model.point3D(i).track.length() for i in points.ids.tolist()]
    bare = colored(moved_reconstruction(arrays(put_points(model, images, points)), images, points), model)
    errors = [[p.error for _, p in sorted(one.points3D.items())] for one in (bare, model)]
    np.testing.assert_allclose(*errors, rtol=1e-12)  # sums in the order of tracks
    for one in (bare, model):
        for point in one.points3D.values():
            point.error = 0.0
    assert dump(bare) == dump(model)
    twice = points_of(arrays(bare), images.part(np.arange(3)))
    assert twice.offsets[-1] == np.sum(points.images < 3)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_rays_of_pictures_lead_back_to_their_pixels(name):
    model = scene(name)
    images = images_of(arrays(model))
    pictures, camera = pictures_of(model, images), model.camera(1)
    chosen = np.arange(0, pictures.count(2), 3)
    pixels = pictures.pixels(2, chosen)
    rays = pictures.rays(2, pixels)
    known = [model.image(int(images.ids[2])).point2D(k).xy for k in chosen.tolist()]
    np.testing.assert_array_equal(pixels, known)
    np.testing.assert_allclose(camera.img_from_cam(rays), pixels, atol=1e-6)
    np.testing.assert_allclose(pictures.project(2, 3.0 * rays), pixels, atol=1e-6)
    assert (rays[:, 2] == 1.0).all() == images.lenses[0].is_plane
