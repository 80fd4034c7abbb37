"""Leave one out: an image against the points as the others make them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.judgement.left_out import LeftOut, leave_one_out
from sfm_shapefit.judgement.wrong_lenses import ContradictedLens, question_lenses, wrong_lenses
from sfm_shapefit.scene.images import Frames, Images, Sensors
from sfm_shapefit.scene.lens import ADJUSTED_ELSEWHERE, Lens, Origin
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from tests.adjustment.made import look_at

NUM_IMAGES, FOCAL_PX = 12, 1000.0


class Scene:
    """Images on an arc that see all points, each through a lens of its own unless told otherwise.

    `factors` are the true focal lengths over the given ones; image `turned` was taken at another rotation.
    """

    def __init__(self, *, noise_px=0.5, factors=(), flat=False, shared=False, fisheye=False, turned=None):
        num_points = 200
        rng, n = np.random.default_rng(7), NUM_IMAGES
        angles = np.linspace(-0.7, 0.7, n)
        centers = 10.0 * np.stack([np.sin(angles), np.zeros(n), -np.cos(angles)], axis=1)
        if flat:  # all look along the normal of the wall
            centers = np.stack(
                [np.linspace(-3.0, 3.0, n), rng.normal(0.0, 0.5, n), np.full(n, -10.0)], axis=1
            )
        rotations = np.tile(np.eye(3), (n, 1, 1)) if flat else look_at(centers, np.zeros((n, 3)))
        xyz = rng.uniform(-2.5, 2.5, (num_points, 3))
        xyz[:, 2] *= not flat
        ids = np.arange(n)
        lens = "OPENCV_FISHEYE" if fisheye else "SIMPLE_PINHOLE"
        count = 1 if shared else n
        self.images = Images(
            names=tuple(f"{k:02d}.jpg" for k in range(n)),
            ids=ids,
            frame_of=ids,
            lens_of=np.zeros(n, dtype=int) if shared else ids,
            frames=Frames(ids=ids, rotations=rotations, centers=centers),
            lenses=tuple(
                Lens(lens, (FOCAL_PX, FOCAL_PX, 0.0, 0.0), id=k, width=1, height=1) for k in range(count)
            ),
            sensors=Sensors(
                rotations=np.tile(np.eye(3), (count, 1, 1)),
                translations=np.zeros((count, 3)),
                rig_of=np.arange(count),
                is_reference=np.ones(count, dtype=bool),
            ),
        )
        images = np.tile(ids, num_points)
        self.points = Points(
            xyz=xyz,
            offsets=n * np.arange(num_points + 1),
            images=images,
            keypoints=np.repeat(np.arange(num_points), n),
            ids=np.arange(num_points),
        )
        true = rotations.copy()
        if turned is not None:
            true[turned] = Rotation.from_rotvec([0.1, -0.05, 0.02]).as_matrix() @ true[turned]
        x, y, z = np.einsum("iab,ixb->aix", true, xyz - centers[:, None])
        across = np.hypot(x, y)
        stretch = np.arctan2(across, z) / across if fisheye else 1.0 / z
        focal = np.ones(n)
        focal[: len(factors)] = factors
        self.plane = (focal[:, None] * stretch)[..., None] * np.stack([x, y], axis=2)
        self.plane += rng.normal(0.0, noise_px / FOCAL_PX, self.plane.shape)
        self.fisheye = fisheye

    def pixels(self, image, keypoints):
        return FOCAL_PX * self.plane[image, keypoints]

    def rays(self, _image, pixels):
        plane = pixels / FOCAL_PX
        if not self.fisheye:
            return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        angle = np.linalg.norm(plane, axis=1, keepdims=True)
        return np.concatenate([np.sin(angle) * plane / angle, np.cos(angle)], axis=1)

    def left_out(self, threads=1):
        return leave_one_out(self.structure(), threads)

    def structure(self, points=None, among=None):
        return Structure(points or self.points, self.images, self, among)


def test_right_lenses_change_by_as_much_as_the_noise_says():
    scene = Scene()
    found = scene.left_out()
    assert (found.num_observations == 200).all()
    assert 0.5 < np.std(found.log_factors / found.sigmas) < 1.6
    assert found.noise_px == pytest.approx(np.full(NUM_IMAGES, 0.5), rel=0.25)
    assert found.observable.all()
    assert wrong_lenses(found, scene.images) == ()


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_wrong_lens_is_named_with_what_is_right(fisheye):
    scene = Scene(factors=[1.0, 1.0, 1.0, 1.2], fisheye=fisheye)
    found = scene.left_out()
    (wrong,) = wrong_lenses(found, scene.images)
    assert (wrong.camera, wrong.num_images) == (3, 1)
    assert wrong.factor == pytest.approx(1.2, abs=0.015)
    assert abs(np.log(wrong.factor / 1.2)) < 4.0 * wrong.sigma
    assert wrong.sigma < 0.01


def test_the_rays_of_a_wrong_lens_make_no_right_one_look_wrong():
    scene = Scene(noise_px=0.1, factors=[1.3, 1.0, 0.8])
    once = wrong_lenses(scene.left_out(), scene.images)
    assert {0, 2} <= {wrong.camera for wrong in once}
    left_out, wrong = question_lenses(scene.structure())
    assert {item.camera: round(item.factor, 2) for item in wrong} == {0: 1.3, 2: 0.8}
    right = np.setdiff1d(np.arange(NUM_IMAGES), [0, 2])
    assert np.abs(left_out.log_factors[right]).max() < 0.003


@pytest.mark.parametrize("noisy", [False, True])
def test_an_image_that_makes_no_points_is_asked_if_its_pixels_fit(noisy):
    scene = Scene(factors=[1.0, 1.0, 1.0, 1.2])
    if noisy:
        scene.plane[3] += np.random.default_rng(1).normal(0.0, 8.0 / FOCAL_PX, scene.plane[3].shape)
    points, among = scene.points, np.arange(NUM_IMAGES) != 3
    alone = points.taken(among[points.images])
    keypoints = np.full(NUM_IMAGES, points.num_points)
    links = KeypointMatches(
        pairs=np.array([[3, 5]]),
        offsets=np.array([0, points.num_points]),
        keypoints=np.tile(np.arange(points.num_points)[:, None], 2),
    )
    seen = alone.seen_by(~among, keypoints, [links])
    assert seen.count_seen(NUM_IMAGES).tolist() == [points.num_points] * NUM_IMAGES
    assert (seen.keypoints == seen.points_seen()).all()  # each image numbers them as they are
    _, wrong = question_lenses(scene.structure(seen, among))
    assert [item.camera for item in wrong] == ([] if noisy else [3])
    assert noisy or wrong[0].factor == pytest.approx(1.2, abs=0.015)


def test_own_rays_have_no_part_in_the_points_of_an_image():
    scene = Scene(noise_px=0.0, turned=5)
    found = scene.left_out()
    assert found.log_factors[5] == pytest.approx(0.0, abs=1e-6)
    assert found.noise_px[5] <= 0.01  # the least that is assumed
    assert found.noise_px[4] > 0.1  # which sees points that the turned image has a part in


def test_an_image_before_a_flat_wall_says_nothing_of_its_lens():
    scene = Scene(flat=True)
    found = scene.left_out()
    assert np.nanmax(np.abs(found.log_factors)) > 0.5
    assert not found.observable.any()
    assert wrong_lenses(found, scene.images) == ()


def test_what_a_pose_can_make_up_for_or_noise_hides_is_not_observable():
    figures = np.array([[0.1, 0.005, 1e-3], [0.1, 0.005, 1e-6], [0.1, 0.05, 1e-3], [np.nan] * 3]).T
    left_out = LeftOut(np.full(4, 100), *figures, np.ones(4))
    assert left_out.observable.tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("others", "num_others", "is_named"), [(2.4, 11, True), (2.6, 11, False), (0.1, 2, False)]
)
def test_five_deviations_do_where_no_other_image_is_near_them(others, num_others, is_named):
    changes, sigmas, free = np.full((3, NUM_IMAGES), [[0.005 * others], [0.005], [1e-3]])
    changes[0], sigmas[0], free[0] = 0.2, 0.04, 1e-6  # a camera that stands nearer hides nearly all
    free[1 + num_others :] = 1e-6
    left_out = LeftOut(np.full(NUM_IMAGES, 100), changes, sigmas, free, np.ones(NUM_IMAGES))
    alike = Scene().images
    unlike = alike.with_lenses([replace(alike.lenses[0], width=2), *alike.lenses[1:]])
    assert [one.camera for one in wrong_lenses(left_out, unlike)] == [0] * is_named
    assert wrong_lenses(left_out, alike) == ()  # the others, of the same size, have no such focal length


def test_a_lens_of_all_images_is_wrong_if_they_ask_for_unlike_ones():
    right = Scene(shared=True)
    assert wrong_lenses(right.left_out(), right.images) == ()
    unlike = Scene(shared=True, factors=np.tile([0.95, 1.05], NUM_IMAGES // 2))
    _, (wrong,) = question_lenses(unlike.structure())
    assert (wrong.camera, wrong.num_images) == (0, NUM_IMAGES)
    assert wrong.factor == pytest.approx(1.0, abs=0.02)
    assert 0.02 < wrong.sigma < 0.1


def test_few_observations_say_nothing_and_nor_do_points_that_nobody_else_holds():
    scene = Scene()
    few = scene.points.taken((scene.points.images != 2) | (scene.points.points_seen() < 14))
    found = leave_one_out(scene.structure(few))
    assert found.num_observations[2] == 14
    assert np.isnan(found.log_factors).tolist() == [k == 2 for k in range(NUM_IMAGES)]
    pairs = scene.points.taken(scene.points.images < 2)
    assert (leave_one_out(scene.structure(pairs)).num_observations == 0).all()


def test_neither_threads_nor_which_others_are_asked_change_a_bit():
    scene = Scene(factors=[0.8, 1.1])
    once, twice = scene.left_out(1), scene.left_out(5)
    asked = np.arange(scene.images.num_images) == 1
    alone = leave_one_out(scene.structure(), asked=asked)
    for name in ("num_observations", "log_factors", "sigmas", "free_shares", "noise_px"):
        assert getattr(once, name).tobytes() == getattr(twice, name).tobytes()
        assert getattr(alone, name)[asked].tobytes() == getattr(once, name)[asked].tobytes()
    assert alone.num_observations[~asked].sum() == 0


@pytest.mark.parametrize(
    ("lens", "remedy"),
    [
        ({}, "intrinsics=focal lets it change"),
        ({"origin": Origin.GUESS, "given": (FOCAL_PX, 0.0, 0.0)}, "intrinsics=focal lets it change"),
        ({"origin": Origin.GUESS, "given": (900.0, 0.0, 0.0)}, "it was adjusted already"),
        ({"model": "SIMPLE_MODEL_OF_LATER"}, ADJUSTED_ELSEWHERE),
    ],
)
def test_the_remedy_for_a_wrong_lens_depends_on_what_may_still_change(lens, remedy):
    own = Lens(**({"model": "SIMPLE_PINHOLE", "parameters": (FOCAL_PX, 0.0, 0.0), "id": 7} | lens))
    wrong = ContradictedLens.of_lens(own, "a.jpg", (1.2, 0.01), 1, 20.0)
    assert wrong.remedy.startswith(remedy)
    assert wrong.remedy.endswith("calibrate that camera")
    assert (wrong.asked_focal_px, wrong.asked_sigma_px) == pytest.approx((1.2 * FOCAL_PX, 12.0))
    assert "its image asks for 1,200 \u00b1 12 px, not 1,000 px" in wrong.statement
