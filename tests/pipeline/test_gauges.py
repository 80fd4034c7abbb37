"""Scale, origin and axes are those that are stated, with bundle adjustment as without it."""

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.geometry import mean_rotation_l1
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.placement.gauge import input_gauge, prior_gauge
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_rig_drive
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.scenes import RING

EXACT = 1e-9
ADJUSTED = [{}, {"adjust": "full"}]
NAMES = ["as placed", "adjusted"]


@pytest.fixture(params=ADJUSTED, ids=NAMES)
def adjusted(request):
    return request.param


@pytest.fixture(scope="module")
def ring():
    """The ring with centers that are disturbed by a tenth of its radius, in another unit."""
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    rng = np.random.default_rng(0)
    for frame_id in sorted(model.reg_frame_ids()):
        pose = model.frame(frame_id).rig_from_world
        center = pose.rotation.matrix().T @ -pose.translation
        moved = 3.0 * (center + 0.1 * rng.standard_normal(3)) + [5.0, 6.0, 7.0]
        rotation = pose.rotation
        model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ moved))
    return model


def located(model, **options):
    """Locate the ring, and return what was found with centers and rotations of the output."""
    found = sfm_shapefit.locate(model, RING / "database.db", **options)
    assert (found.adjusted is not None) == ("adjust" in options)
    return found, *poses_of(found.reconstruction, found.images)


def poses_of(reconstruction, images):
    images = [reconstruction.image(i) for i in images.ids.tolist()]
    centers = np.array([image.projection_center() for image in images])
    return centers, np.array([image.cam_from_world().rotation.matrix() for image in images])


def assert_in_the_axes_of(images, rotations):
    turn = mean_rotation_l1(images.rotations.transpose(0, 2, 1) @ rotations)
    np.testing.assert_allclose(turn, np.eye(3), atol=EXACT)


def assert_says_where(found, centers):
    """The table of cameras has the centers of the model, and the gauge maps the placement near them."""
    np.testing.assert_allclose([row.center for row in found.cameras], centers, atol=1e-12 * np.ptp(centers))
    near = found.gauge.apply(found.placement.locations)
    assert np.abs(near - centers).max() < 0.01 * np.ptp(centers)


def test_the_input_sets_scale_origin_and_axes(ring, adjusted):
    found, centers, rotations = located(ring, **adjusted)
    assert found.gauge.scale == "input"
    again = input_gauge(centers, found.images.centers).similarity
    assert again.scale == pytest.approx(1.0, abs=EXACT)
    np.testing.assert_allclose(again.translation, 0.0, atol=EXACT * np.ptp(centers))
    assert_in_the_axes_of(found.images, rotations)
    assert_says_where(found, centers)


def test_the_unit_is_the_median_distance_from_the_centroid(ring, adjusted):
    found, centers, rotations = located(ring, scale="unit", **adjusted)
    np.testing.assert_allclose(centers.mean(axis=0), 0.0, atol=EXACT)
    assert np.median(np.linalg.norm(centers, axis=1)) == pytest.approx(1.0, abs=EXACT)
    assert_in_the_axes_of(found.images, rotations)
    assert_says_where(found, centers)


def test_a_known_distance_is_true(ring, adjusted):
    names = read_model(ring).images.names
    found, centers, rotations = located(ring, known_distance=(names[1], names[4], 10.0), **adjusted)
    assert np.linalg.norm(centers[1] - centers[4]) == pytest.approx(10.0, abs=10.0 * EXACT)
    np.testing.assert_allclose(centers.mean(axis=0), 0.0, atol=10.0 * EXACT)
    assert_in_the_axes_of(found.images, rotations)
    assert_says_where(found, centers)


@pytest.mark.parametrize("pulled", [False, True])
def test_priors_fit_best_as_they_are(ring, adjusted, tmp_path, pulled):
    model = read_model(RING / "sparse" / "0")
    turn = pycolmap.Rotation3d(np.array([0.3, -0.2, 0.1])).matrix()
    noise = 0.01 * np.random.default_rng(1).standard_normal(model.images.centers.shape)
    positions = 2.0 * (model.images.centers + noise) @ turn.T + [100.0, 200.0, 300.0]
    rows = [
        f"{name} {x!r} {y!r} {z!r}{' 0.02' * pulled}"
        for name, (x, y, z) in zip(model.images.names, positions.tolist(), strict=True)
    ]
    (tmp_path / "priors.txt").write_text("\n".join(rows))
    found, centers, rotations = located(ring, priors=tmp_path / "priors.txt", **adjusted)
    assert found.gauge.scale == "prior"
    assert ("the priors moved cameras by" in found.gauge.statement) == pulled
    if pulled:
        # What is pulled fits better than any similarity of what was placed.
        assert np.median(np.linalg.norm(centers - positions, axis=1)) < 1.538 * 0.02
        return
    information = np.full((len(positions), 3, 3), np.nan)
    known = KnownPositions(np.arange(len(positions)), positions, information)
    priors = PositionPriors(known=known, statement="")
    again = prior_gauge(centers, priors)
    # Weights by the level of the residuals are no fixed point after twenty rounds.
    assert again.similarity.scale == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(again.axes, np.eye(3), atol=1e-4)
    np.testing.assert_allclose(again.similarity.translation, 0.0, atol=0.1)
    np.testing.assert_allclose(found.gauge.axes, turn, atol=0.02)
    assert_in_the_axes_of(found.images, rotations @ found.gauge.axes)
    assert_says_where(found, centers)


@pytest.mark.parametrize("count", [1, 5])
def test_fixed_cameras_stay_to_the_bit(ring, adjusted, tmp_path, count):
    model = read_model(ring)
    given = model.reconstruction
    if count > 1:  # their shape must be right, or the others cannot join them
        given = pycolmap.Reconstruction(RING / "sparse" / "0")
        model = read_model(given)
    (tmp_path / "names.txt").write_text("\n".join(model.images.names[:count]))
    options = {"fix": str(tmp_path / "names.txt"), **({"scale": "unit"} if count == 1 else {})}
    found, centers, _ = located(given, **options, **adjusted)
    for image_id in model.images.ids[:count].tolist():
        ours, theirs = (m.image(image_id).cam_from_world().matrix() for m in (found.reconstruction, given))
        np.testing.assert_array_equal(ours, theirs)
    if count == 1:
        from_centroid = np.linalg.norm(centers - centers.mean(axis=0), axis=1)
        assert np.median(from_centroid) == pytest.approx(1.0, abs=EXACT)


def test_rigs_set_the_scale_and_the_input_the_origin(adjusted, tmp_path):
    drive = make_rig_drive(SceneOptions(num_images=36, num_points=600, max_pairs_per_image=12, seed=4))
    write_workspace(drive, tmp_path / "drive", WorkspaceOptions())
    options = {"points": "never", **adjusted}
    found = sfm_shapefit.locate(tmp_path / "drive" / "sparse" / "0", **options)
    assert found.gauge.scale == "rig"
    centers, rotations = poses_of(found.reconstruction, found.images)
    for rig_id, rig in pycolmap.Reconstruction(tmp_path / "drive" / "sparse" / "0").rigs.items():
        for sensor, pose in rig.non_ref_sensors.items():
            ours = found.reconstruction.rig(rig_id).sensor_from_rig(sensor)
            np.testing.assert_allclose(ours.matrix(), pose.matrix(), atol=1e-12)
    np.testing.assert_allclose(np.median(found.images.centers - centers, axis=0), 0.0, atol=EXACT)
    assert_in_the_axes_of(found.images, rotations)
    assert np.ptp(centers) == pytest.approx(np.ptp(drive.centers), rel=2e-3)
