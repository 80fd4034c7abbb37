"""Standard deviations where lenses were guessed: free ones add their noise, open ones their own doubt."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.adjustment.lens_doubts import covariances_of_open_lenses
from sfm_shapefit.base.geometry import fit_similarity
from tests.judgement.test_left_out import Scene
from tests.pipeline.test_evidence import with_own_lenses
from tests.scenes import COURTYARD


class Seen:
    """The points of a scene and the observations of them."""

    def __init__(self, scene):
        self.points, self.points_seen = scene.points.xyz, scene.points.points_seen()


def test_a_lens_that_was_left_open_widens_its_camera_along_its_view():
    scene = Scene()
    lenses = [replace(lens, sigmas=(0.1, 0.1)) for lens in scene.images.lenses]
    images, is_open = scene.images.with_lenses(lenses), np.arange(len(lenses)) == 4
    found = covariances_of_open_lenses(images, Seen(scene), scene.points.images, is_open)
    assert np.flatnonzero(found.any(axis=(1, 2))).tolist() == [4]
    view = images.rotations[4, 2]
    assert np.sqrt(view @ found[4] @ view) == pytest.approx(
        0.1 * 10.0, rel=0.05
    )  # 10 from the points' middle
    assert np.linalg.matrix_rank(found[4]) == 1


def test_errors_of_cameras_through_lenses_that_were_free_are_as_large_as_is_said():
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    rng = np.random.default_rng(3)
    factors = {image.name: float(np.exp(0.05 * rng.standard_normal())) for image in truth.images.values()}
    model = with_own_lenses(truth, factors)
    found = sfm_shapefit.locate(model, COURTYARD / "database.db", intrinsics="focal")
    rows = [row for row in found.cameras if row.placed]
    centers = np.array([row.center for row in rows])
    right = np.array([truth.find_image_with_name(row.name).projection_center() for row in rows])
    motion = fit_similarity(centers, right)
    errors = np.linalg.norm(motion.apply(centers) - right, axis=1)
    sigmas = motion.scale * np.linalg.norm([row.sigma for row in rows], axis=1)
    assert 0.5 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.7  # 2.4 with lenses held


def test_what_standard_deviations_take_errors_of_lenses_for_is_told():
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    bent = pycolmap.Reconstruction(truth)
    for camera in bent.cameras.values():
        camera.params = camera.params * np.where(np.arange(len(camera.params)) < 2, 1.02, 1.0)
    for model, is_wrong in ((truth, False), (bent, True)):
        found = sfm_shapefit.locate(model, COURTYARD / "database.db", intrinsics="held")
        told = found.summary()["lens_errors"]
        assert (told["score"] > 3.0) == (told["own_px"] > 0.0)
        assert (told["own_px"] > 0.1) == is_wrong
        assert (told["shared_px"] > 0.0) == is_wrong
