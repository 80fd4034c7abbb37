"""Models without a database: what their own tracks say of rotations and lenses, and what they leave open."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.reasons import Grade, Kind
from sfm_shapefit.judgement.wrong_lenses import is_like_others
from sfm_shapefit.synthetic.layouts import looking_along
from tests.pipeline.test_evidence import with_own_lenses
from tests.scenes import RING

_WIDTH, _HEIGHT = 960, 720


def model_of(turns, centers, points, focal_px, k1=0.0, seed=0, noise_px=0.4):
    """Return a model of pinhole cameras at true poses; its noisy pixels are those of a lens with some k1."""
    rng, model = np.random.default_rng(seed), pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", focal_px, _WIDTH, _HEIGHT)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for k, (turn, center) in enumerate(zip(turns, centers, strict=True)):
        seen = (points - center) @ turn.T
        plane = seen[:, :2] / seen[:, 2:]
        pixels = focal_px * plane * (1.0 + k1 * np.sum(plane**2, axis=1))[:, None] + [_WIDTH / 2, _HEIGHT / 2]
        pixels += noise_px * rng.standard_normal(pixels.shape)
        inside = ((pixels > 0.0) & (pixels < [_WIDTH, _HEIGHT])).all(axis=1)
        rows = np.flatnonzero((seen[:, 2] > 0.2) & inside & (rng.random(len(points)) < 0.7))
        for keypoint, point in enumerate(rows.tolist()):
            tracks[point].add_element(k + 1, keypoint)
        image = pycolmap.Image(name=f"{k:03d}.jpg", camera_id=1, image_id=k + 1, keypoints=pixels[rows])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.from_matrix(turn).as_quat()), -turn @ center)
        model.add_image_with_trivial_frame(image, pose)
    for xyz, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(xyz, track, np.zeros(3, dtype=np.uint8))
    return model


def yawing_drone(seed, k1=0.01):
    """Return a model of a room: the camera yaws by 120 degrees on the spot, flies 1.5 m and yaws on."""
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-1.0, 1.0, (900, 3)) * [5.0, 1.5, 5.0]
    side = rng.integers(0, 2, 900) * 2
    walls[np.arange(900), side] = 5.0 * np.sign(walls[np.arange(900), side])
    yaw = np.radians(np.concatenate([np.linspace(0, 120, 12), np.full(6, 120.0), np.linspace(120, 240, 12)]))
    along = np.concatenate([np.zeros(12), np.linspace(0.2, 1.5, 6), np.full(12, 1.6)])
    centers = np.column_stack([along, np.zeros(30), 0.4 * along]) + 0.02 * rng.standard_normal((30, 3))
    turns = Rotation.from_euler("y", -yaw[:, None]).as_matrix()
    return model_of(turns, centers, walls, 900.0, k1, seed)


def slalom(stretch, seed):
    """Return a straight drive with slaloms whose focal length and depths are `stretch` times too long."""
    rng = np.random.default_rng(seed)
    steps = np.arange(16.0)
    centers = np.column_stack([np.sin(steps), 0.5 * np.cos(0.7 * steps), 0.5 * steps])
    points = np.column_stack([rng.uniform(-6.0, 6.0, (400, 2)), rng.uniform(6.0, 40.0, 400)])
    long = np.array([1.0, 1.0, stretch])
    return centers, model_of(
        np.tile(np.eye(3), (16, 1, 1)), long * centers, long * points, 700.0 * stretch, seed=seed
    )


def orbit(seed):
    """Return rotations, centers, and points of twelve cameras around an object."""
    angles = 2.0 * np.pi * np.arange(12) / 12
    centers = np.column_stack([6.0 * np.cos(angles), 6.0 * np.sin(angles), 1.0 + 0.3 * np.sin(3.0 * angles)])
    return looking_along(-centers), centers, drawn(seed, [2.0, 2.0, 2.0], 300)


def drawn(seed, sizes, count):
    """Return points (count, 3) in a box from -sizes to sizes."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)) * sizes


def turned(model, image_id, angle_deg):
    """Turn one image of a model about its center."""
    frame = model.image(image_id).frame
    pose = frame.rig_from_world
    turn = pycolmap.Rotation3d(np.radians(angle_deg) * np.array([0.6, 0.8, 0.0]))
    frame.rig_from_world = pycolmap.Rigid3d(turn * pose.rotation, turn * pose.translation)
    return model


def short_rig(seed, baseline):
    """Return a model of a hall: a rig of two lenses back to back, `baseline` apart, at twelve places."""
    turns, centers, _ = orbit(seed)
    points = drawn(seed, [20.0, 20.0, 5.0], 1500)
    points = points[np.abs(points[:, :2]).max(axis=1) > 12.0]
    back = np.diag([-1.0, 1.0, -1.0])
    both = np.concatenate([turns, back @ turns])
    offset = baseline * turns[:, 2]
    made = model_of(both, np.concatenate([centers, centers - offset]), points, 500.0, seed=seed)
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    for k in (1, 2):
        camera = pycolmap.Camera(made.camera(1).todict())
        camera.camera_id = k
        model.add_camera(camera)
    rig.add_ref_sensor(model.camera(1).sensor_id)
    mount = pycolmap.Rigid3d(pycolmap.Rotation3d(back), np.array([0.0, 0.0, -baseline]))
    rig.add_sensor(model.camera(2).sensor_id, mount)
    model.add_rig(rig)
    for k in range(1, 13):
        frame = pycolmap.Frame(frame_id=k, rig_id=1, rig_from_world=made.image(k).cam_from_world())
        images = []
        for side, own in enumerate((made.image(k), made.image(k + 12))):
            keypoints = np.array([point.xy for point in own.points2D])
            image = pycolmap.Image(
                name=own.name, camera_id=1 + side, image_id=own.image_id, keypoints=keypoints
            )
            image.frame_id = k
            images.append(image)
        for image in images:
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
    for point in made.points3D.values():
        model.add_point3D(point.xyz, point.track, point.color)
    return model


def test_a_rig_too_short_to_tell_the_scale_leaves_no_shape_open():
    """Pixels tell the scale to half of it here; it is no part of the shape, which noise hardly bends."""
    model = short_rig(0, 0.005)
    found, checked = sfm_shapefit.locate(model), sfm_shapefit.check(model)
    assert checked.verdict.grade is found.verdict.grade is Grade.GOOD
    assert checked.facts.evidence.shape.largest < 0.001


@pytest.mark.parametrize("seed", range(2))
def test_a_rotation_off_by_a_little_is_mended_where_halves_hardly_move_the_cameras(seed):
    """1.3 pixels of one camera: what the halves say is believed, though pixels gain little by it."""
    found = sfm_shapefit.locate(turned(model_of(*orbit(seed), 900.0, seed=seed), 6, 0.08))
    # Noise of 200 points turns it by some .003 degrees; their depths, which noise moves too, by more.
    assert found.turned_deg[5] == pytest.approx(0.08, abs=0.02)
    assert np.nanmax(np.delete(found.turned_deg, 5)) < 0.002  # nearly held


@pytest.mark.parametrize("seed", range(2))
def test_rotations_stay_where_a_camera_yaws_on_the_spot(seed):
    """The distortion that the model lacks turns whole groups of freed frames, and their fit hardly gains."""
    model = yawing_drone(seed)
    found = sfm_shapefit.locate(model)
    assert found.kept.all()
    assert np.nanmax(found.turned_deg) == 0.0
    # Twice what is seen of noise and distortion on both seeds; freed, cameras move by 10 % and more.
    assert sfm_shapefit.evaluate(found.reconstruction, model).position.max < 0.03
    assert sfm_shapefit.check(model).verdict.grade is found.verdict.grade


@pytest.mark.parametrize("angle_deg", [5.0, 20.0])
def test_a_rotation_that_is_wrong_is_found_where_a_camera_yaws(angle_deg):
    model = turned(yawing_drone(0), 15, angle_deg)
    found = sfm_shapefit.locate(model)
    name = model.image(15).name
    (k,) = [k for k, own in enumerate(found.images.names) if own == name]
    is_mended = abs(found.turned_deg[k] - angle_deg) < 0.5
    assert is_mended or name in found.verdict.cameras
    assert np.nanmax(np.delete(found.turned_deg, k)) < 0.5


@pytest.mark.parametrize("stretch", [1.0, 2.0])
def test_a_shape_that_its_points_leave_open_is_not_good_and_its_error_bars_say_how_far(stretch):
    """Straight ahead, a focal length twice too long is a scene twice as deep: no pixel sees it."""
    truth, model = slalom(stretch, 0)
    found, checked = sfm_shapefit.locate(model), sfm_shapefit.check(model)
    for verdict in (found.verdict, checked.verdict):
        assert verdict.grade is Grade.LOOK
        assert Kind.UNCERTAIN in {finding.kind for finding in verdict.findings}
    similarity = fit_similarity(found.placed.centers, truth)
    errors = similarity.apply(found.placed.centers) - truth
    sigmas = similarity.scale * np.array([row.sigma for row in found.cameras])
    rms = np.sqrt(np.mean((errors / sigmas) ** 2))
    assert 0.5 < rms < 2.0 if stretch == 2.0 else rms < 2.0


def test_what_the_user_says_is_known_is_not_left_open():
    found = sfm_shapefit.locate(slalom(1.0, 0)[1], rotations="held", intrinsics="held")
    assert found.verdict.grade is Grade.GOOD
    assert found.evidence.shape is None


def test_a_focal_length_beyond_those_of_like_lenses_is_not_believed():
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    images = read_model(with_own_lenses(model, {image.name: 1.0 for image in model.images.values()})).images
    own = images.lenses[0].focal_px
    for factor, sigma, believed in ((1.02, 0.0, True), (0.9, 0.001, False), (0.9, 0.03, True)):
        assert is_like_others(images, 0, factor * own, sigma) is believed
    assert is_like_others(read_model(model).images, 0, 2.0 * own, 0.0)  # one lens has no like ones
