"""Databases of what belongs to no one model: whatever is made of them, none that is false is called good."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit import check, locate, map_database
from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.synthetic import SceneOptions, make_scene

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


def scenes(*shapes, num_images=6):
    """Return keypoints of images, and matches of pairs, of scenes that have nothing in common."""
    keypoints, matches = [], {}
    for k, shape in enumerate(shapes):
        scene = make_scene(SceneOptions(shape=shape, num_images=num_images, num_points=400, seed=k))
        first = len(keypoints)
        keypoints += [xy.copy() for xy in scene.keypoints]
        for e, (i, j) in enumerate(scene.pairs.tolist()):
            matches[first + i, first + j] = scene.matches_of(e)
    return keypoints, matches


def called_good(path, is_false=bool):
    """Return who calls a false model of `map` good; no model at all is as well."""
    try:
        found = map_database(path)
    except ShapeFitError:
        return []
    told = []
    for model in found.models:
        reconstruction = model.reconstruction
        if not is_false([int(reconstruction.image(k).name[:2]) for k in reconstruction.reg_image_ids()]):
            continue
        told.append(("map", model.verdict))
        told.append(("check", check(reconstruction, path, second_opinion=found).verdict))
        told.append(("locate", locate(reconstruction, path).verdict))
    return [who for who, verdict in told if verdict.grade is Grade.GOOD]


@pytest.mark.parametrize("num_across", [1, 2])
def test_two_scenes_that_false_pairs_join_make_no_good_model(tmp_path, num_across):
    rng, (keypoints, matches) = np.random.default_rng(0), scenes("ring", "facade")
    for k in range(num_across):
        join_falsely(keypoints, matches, (k, 6 + k), rng)
    write(tmp_path / "database.db", keypoints, matches)
    assert not called_good(tmp_path / "database.db", lambda rows: min(rows) < 6 <= max(rows))


def test_a_camera_that_a_single_pair_holds_is_to_be_looked_at_and_no_more(tmp_path):
    keypoints, matches = scenes("facade")
    once = {pair: own for pair, own in matches.items() if 5 not in pair or pair == (4, 5)}
    for name, pairs in (("all.db", matches), ("once.db", once)):
        write(tmp_path / name, keypoints, pairs)
    model = map_database(tmp_path / "all.db").models[0].reconstruction
    assert check(model, tmp_path / "all.db", second_opinion=False).verdict.grade is Grade.GOOD
    thin = check(model, tmp_path / "once.db", second_opinion=False)
    assert thin.verdict.grade in (Grade.GOOD, Grade.LOOK)  # points of three images may check it
    for point in [k for k, one in model.points3D.items() if has_image(model, one, "05.jpg")]:
        model.delete_point3D(point)
    thin = check(model, tmp_path / "once.db", second_opinion=False)
    assert thin.verdict.grade is Grade.LOOK
    assert "05.jpg" in thin.verdict.cameras
    assert any("nothing checks where 1 camera (05.jpg) is" in told for told in thin.facts.warnings)


def has_image(model, point, name):
    return any(model.image(one.image_id).name == name for one in point.track.elements)


def test_near_duplicates_that_stand_apart_are_named_and_a_camera_that_stands_still_is_sound(tmp_path):
    rng, (keypoints, matches) = np.random.default_rng(0), scenes("facade")
    keypoints.append(keypoints[5] + 0.5 * rng.standard_normal(keypoints[5].shape))
    matches |= {(i, 6): own for (i, j), own in matches.items() if j == 5}
    matches[5, 6] = np.tile(np.arange(len(keypoints[5]))[:, None], (1, 2))
    write(tmp_path / "database.db", keypoints, matches)
    model = map_database(tmp_path / "database.db").models[0].reconstruction
    still = check(model, tmp_path / "database.db", second_opinion=False)
    assert not still.facts.evidence.odd
    (moved,) = (image for image in model.images.values() if image.name == "06.jpg")
    away = np.array([2.0 * np.ptp([image.projection_center() for image in model.images.values()]), 0.0, 0.0])
    pose = moved.frame.rig_from_world
    moved.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + away)
    found = check(model, tmp_path / "database.db", second_opinion=False)
    assert found.verdict.grade is not Grade.GOOD
    (odd,) = (one for one in found.facts.evidence.odd if "near duplicate" in one.what)
    assert odd.images == ("05.jpg", "06.jpg")


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
