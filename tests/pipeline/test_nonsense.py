"""Databases of what belongs to no one model: whatever is made of them, none that is false is called good."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit import check, locate, map_database
from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.judgement.reasons import Grade

SIZE_PX, FOCAL_PX = np.array([1200.0, 900.0]), 1000.0


def write(path, keypoints, matches):
    """Write a database of keypoints (k, 2) of each image and matches of pairs, verified as COLMAP does it."""
    width, height = SIZE_PX.astype(int).tolist()
    params = [FOCAL_PX, width / 2, height / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params, camera_id=1)
    camera.has_prior_focal_length = True
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        for k, xy in enumerate(keypoints):
            database.write_image(
                pycolmap.Image(name=f"{k:02d}.jpg", camera_id=1, image_id=k + 1), use_image_id=True
            )
            database.write_keypoints(k + 1, xy.astype(np.float32))
        for (i, j), rows in matches.items():
            ends = camera, keypoints[i], camera, keypoints[j]
            geometry = pycolmap.estimate_two_view_geometry(*ends, rows.astype(np.uint32), options)
            database.write_matches(i + 1, j + 1, rows.astype(np.uint32))
            if len(geometry.inlier_matches) >= options.min_num_inliers:
                database.write_two_view_geometry(i + 1, j + 1, geometry)


def seen_elsewhere(xy, rng):
    """Return keypoints (k, 2) as another camera, drawn at random, sees them at random depths."""
    rays = np.column_stack([(xy - SIZE_PX / 2) / FOCAL_PX, np.ones(len(xy))])
    shift = rng.standard_normal(3)
    turn = Rotation.from_rotvec(0.2 * rng.standard_normal(3))
    points = turn.apply(rays * rng.uniform(4.0, 12.0, (len(xy), 1))) + shift / np.linalg.norm(shift)
    return FOCAL_PX * points[:, :2] / points[:, 2:] + SIZE_PX / 2 + 0.5 * rng.standard_normal(xy.shape)


def join_falsely(keypoints, matches, pair, rng, count=60):
    """Add matches of a pair that agree on a pose that is no one's."""
    i, j = pair
    own, begin = rng.permutation(len(keypoints[i]))[:count], len(keypoints[j])
    keypoints[j] = np.concatenate([keypoints[j], seen_elsewhere(keypoints[i][own], rng)])
    matches[pair] = np.column_stack([own, begin + np.arange(count)])


def called_good(path):
    """Return who calls a model of `map` good; no model at all is as well."""
    try:
        found = map_database(path)
    except ShapeFitError:
        return []
    told = []
    for model in found.models:
        reconstruction = model.located.reconstruction
        told.append(("map", model.located.verdict))
        told.append(("check", check(reconstruction, path, second_opinion=found).verdict))
        told.append(("locate", locate(reconstruction, path).verdict))
    return [who for who, verdict in told if verdict.grade is Grade.GOOD]


def test_one_picture_many_times_is_no_good_model(tmp_path):
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, SIZE_PX, (300, 2))
    same = np.tile(np.arange(300)[:, None], (1, 2))
    keypoints = [xy + 0.3 * rng.standard_normal(xy.shape) for _ in range(4)]
    write(tmp_path / "database.db", keypoints, dict.fromkeys(combinations(range(4), 2), same))
    assert not called_good(tmp_path / "database.db")


@pytest.mark.parametrize(("share", "count"), [(0.3, 60), (0.7, 20)])
def test_noise_is_no_good_model(tmp_path, share, count):
    rng = np.random.default_rng(16)
    keypoints, matches = [rng.uniform(0.0, SIZE_PX, (300, 2)) for _ in range(12)], {}
    for pair in combinations(range(12), 2):
        if rng.random() < share:
            join_falsely(keypoints, matches, pair, rng, count)
    write(tmp_path / "database.db", keypoints, matches)
    assert not called_good(tmp_path / "database.db")
