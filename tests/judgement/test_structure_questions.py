"""Questions that are asked of the observations of all images together: by columns, and by several threads."""

from contextlib import suppress
from threading import Barrier, BrokenBarrierError

import numpy as np
import pytest

from sfm_shapefit.judgement.lenses import find_odd_lenses
from sfm_shapefit.judgement.resolutions import find_outside
from sfm_shapefit.scene.images import Frames, Images, Sensors
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import keypoint_errors_px

NUM_IMAGES, NUM_POINTS, FOCAL_PX = 6, 12_000, 500.0  # more observations than are projected together


class Pictures:
    """Keypoints beside where pinholes see points, by a distance that each image has for itself."""

    def __init__(self, images, points, off_px):
        in_camera = np.einsum("iab,ixb->ixa", images.rotations, points.xyz - images.centers[:, None])
        self.projected = FOCAL_PX * in_camera[..., :2] / in_camera[..., 2:] + 500.0
        self.places, self.reads = self.projected + np.array(off_px)[:, None, None] * [0.6, 0.8], []
        self.meeting = Barrier(1)

    def pixels(self, image, keypoints):
        self.reads.append(image)
        return self.places[image][keypoints]

    def project(self, _image, positions, **_ahead):
        with suppress(BrokenBarrierError):
            self.meeting.wait(1.0)  # until what others give is there, too
        return FOCAL_PX * positions[:, :2] / positions[:, 2:] + 500.0


def structure(off_px, lens_of=(0, 0, 0, 1, 1, 0)):
    rng, ids = np.random.default_rng(0), np.arange(NUM_IMAGES)
    centers = np.column_stack([0.1 * ids, np.zeros(NUM_IMAGES), np.zeros(NUM_IMAGES)])
    lens = Lens("PINHOLE", (FOCAL_PX, FOCAL_PX, 500.0, 500.0), id=0, width=1000, height=1000)
    images = Images(
        names=tuple(f"{k}.jpg" for k in ids),
        ids=ids,
        frame_of=ids,
        lens_of=np.array(lens_of),
        frames=Frames(ids=ids, rotations=np.tile(np.eye(3), (NUM_IMAGES, 1, 1)), centers=centers),
        lenses=(lens, Lens(lens.model, lens.parameters, id=1, width=1000, height=1000)),
        sensors=Sensors.references(2),
    )
    points = Points(
        xyz=rng.uniform([-3.0, -3.0, 4.0], [3.0, 3.0, 6.0], (NUM_POINTS, 3)),
        offsets=NUM_IMAGES * np.arange(NUM_POINTS + 1),
        images=np.tile(ids, NUM_POINTS),
        keypoints=np.repeat(np.arange(NUM_POINTS), NUM_IMAGES),
        ids=np.arange(NUM_POINTS),
    )
    return Structure(points, images, Pictures(images, points, off_px))


@pytest.mark.parametrize("threads", [1, 3])
def test_errors_are_those_of_each_image_whoever_shares_them(threads):
    off_px = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    seen = structure(off_px)
    seen.pictures.meeting = Barrier(threads)
    errors_px = keypoint_errors_px(seen, threads=threads)
    np.testing.assert_allclose(errors_px, np.array(off_px)[seen.points.images], atol=1e-9)
    assert np.array_equal(errors_px, keypoint_errors_px(structure(off_px)))


def test_the_pixels_of_an_image_are_read_once_for_all_questions():
    seen = structure([0.0] * NUM_IMAGES)
    assert [*find_odd_lenses(seen, np.zeros(2, dtype=bool)), *find_outside(seen)] == []
    keypoint_errors_px(seen)
    assert sorted(seen.pictures.reads) == list(range(NUM_IMAGES))


def test_lenses_whose_observations_are_outside_are_told_with_their_share():
    seen = structure([0.0, 0.0, 0.0, 300.0, -300.0, 0.0])
    (told,) = find_outside(seen)
    places = seen.pictures.places[3:5]
    share = 100.0 * np.mean(((places < -4.0) | (places > 1004.0)).any(axis=2))
    assert told.images == ("3.jpg", "4.jpg")
    assert f"{share:.2f} %" in told.what
