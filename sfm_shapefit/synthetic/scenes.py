"""Photographed scenes whose truth is known.

A scene is made in the order in which a real one comes about:

    surfaces and cameras (`SceneOptions.shape`)
      -> keypoints:  x = K R (X - C) for the points in front of the camera, in view and facing it, plus noise
      -> pairs:      the images that share most points, with their shared points as matches
      -> corruption: whole pairs that show a false baseline, and random matches inside every list

A corrupted pair is wrong the way a repeated facade makes it wrong: its list satisfies the epipolar
constraint of the true relative rotation and of a baseline that does not exist, so nothing inside the pair
gives it away. Its second image gets keypoints of its own for that, which belong to no point.

Conventions are COLMAP's: x_cam = R x_world + t with t = -R C; pixels count from the image's top left corner.
World axes: z is up; one unit is a meter. OpenCV is imported when a scene is projected and not before.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.synthetic.layouts import (
    FARTHEST_M,
    ByteArray,
    SceneCameras,
    SceneLayout,
    lay_out_scene,
    state_rotations,
    turn_at_random,
)
from sfm_shapefit.synthetic.mounts import Rigs
from sfm_shapefit.synthetic.scene_options import SceneOptions

_NEAREST_DEPTH_M = 0.3  # meters; nothing is photographed closer
_LARGEST_VIEW_ANGLE_DEG = 80.0  # degrees from a normal to the line of sight; also the occlusion rule
_SMALLEST_FALSE_ANGLE_DEG = 10.0  # degrees; a corrupted pair's direction is off by at least this
_MOST_FALSE_MATCHES = 200  # matches of a corrupted pair; keeps the number of extra keypoints low
_RELATIVE_POSE_DIRECTION_FACTOR = 3.0  # direction error per rotation error; about that of a two-view estimate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene(SceneCameras):
    """A photographed scene: n images, p points, m pairs, M matches, and what is false among them."""

    points: FloatArray
    """(p, 3) surface points."""
    colors: ByteArray
    """(p, 3) red, green, blue of each point."""
    keypoints: tuple[FloatArray, ...]
    """Per image (k, 2): x, y in pixels. Keypoints of no point come last."""
    keypoint_points: tuple[IntArray, ...]
    """Per image (k,): the point of each keypoint, or -1 for the keypoints of corrupted pairs."""
    pairs: IntArray
    """(m, 2) image indices (i, j), i < j, in lexicographic order."""
    match_offsets: IntArray
    """(m + 1,) the matches of pair e are the rows match_offsets[e]:match_offsets[e + 1]."""
    matches: IntArray
    """(M, 2) keypoint index in image i and in image j."""
    match_is_wrong: BoolArray
    """(M,) True where random keypoints of the list were joined."""
    pair_is_corrupted: BoolArray
    """(m,) True where the whole list agrees on a false baseline."""
    relative_rotations: FloatArray
    """(m, 3, 3) rotation of cam_j_from_cam_i as two-view geometry would estimate it."""
    relative_translations: FloatArray
    """(m, 3) unit translation of cam_j_from_cam_i, of the false baseline where the pair is corrupted."""

    @property
    def num_pairs(self) -> int:
        """Number of pairs, m."""
        return len(self.pairs)

    def matches_of(self, pair: int) -> IntArray:
        """Return the (k, 2) matches of one pair."""
        return self.matches[self.match_offsets[pair] : self.match_offsets[pair + 1]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _FalseList:
    """The matches of a corrupted pair: one image really shows the points, the other never did."""

    displaced: int
    """0 or 1: which image of the pair was displaced."""
    keypoints: IntArray
    """(k,) keypoints of the other image."""
    xy: FloatArray
    """(k, 2) the new keypoints of the displaced image."""
    center: FloatArray
    """(3,) where the displaced image would have to be."""


def make_scene(options: SceneOptions) -> Scene:
    """Lay out, photograph, pair and corrupt a scene; InputError if too few points are shared for that."""
    rngs = np.random.default_rng(options.seed).spawn(6)  # one stream for each kind of draw
    return build_scene(*lay_out_scene(options, rngs[0]), options, rngs[1:])


def build_scene(
    layout: SceneLayout, rigs: Rigs, options: SceneOptions, rngs: list[np.random.Generator]
) -> Scene:
    """Photograph, pair and corrupt a layout with five streams of draws; raises what `make_scene` does."""
    pixel_rng, corruption_rng, match_rng, pose_rng, rotation_rng = rngs
    thinning_rng = match_rng.spawn(1)[0]  # which leaves the stream itself as it is
    candidates = _candidates(layout, options)
    images = [_photograph(layout, image, ids, options, pixel_rng) for image, ids in enumerate(candidates)]
    keypoint_points = [ids for ids, _ in images]
    keypoints = [xy for _, xy in images]
    pairs = _pairs(keypoint_points, options)

    false_lists = _false_lists(layout, keypoint_points, pairs, options, corruption_rng)
    lists = _match_lists(keypoints, keypoint_points, pairs, false_lists)
    most = options.max_matches_per_pair
    for k, rows in enumerate(lists):
        if most is not None and len(rows) > most:
            lists[k] = rows[np.sort(thinning_rng.choice(len(rows), most, replace=False))]
    scrambled = [_scramble(rows, options.wrong_match_fraction, match_rng) for rows in lists]
    ray_noise_rad = options.pixel_noise_px / options.focal_length_px
    relative = _relative_poses(layout, pairs, false_lists, ray_noise_rad, pose_rng)
    return Scene(
        options=options,
        rotations=layout.rotations,
        centers=layout.centers,
        stated_rotations=state_rotations(layout.rotations, rigs, options, rotation_rng),
        rigs=rigs,
        points=layout.points,
        colors=layout.colors,
        keypoints=tuple(keypoints),
        keypoint_points=tuple(keypoint_points),
        pairs=pairs,
        match_offsets=offsets_of([len(rows) for rows in lists]),
        matches=np.concatenate([rows for rows, _ in scrambled]),
        match_is_wrong=np.concatenate([wrong for _, wrong in scrambled]),
        pair_is_corrupted=np.isin(np.arange(len(pairs)), list(false_lists)),
        relative_rotations=relative[0],
        relative_translations=relative[1],
    )


def project_points(
    points: FloatArray, cam_from_world: FloatArray, center: FloatArray, calibration: FloatArray
) -> FloatArray:
    """Return the (k, 2) pixels of (k, 3) points in world axes in a camera without distortion, by OpenCV.

    The camera has the rotation cam_from_world, its center in world axes, and the (3, 3) calibration K.
    ValueError if a point is not in front of it; OpenCV would project it without a word.
    """
    import cv2

    offsets = points - center
    behind = ~(offsets @ cam_from_world[2] > 0.0)
    if behind.any():
        raise ValueError(f"point {int(np.argmax(behind))} is not in front of the camera; remove it first")
    if len(points) == 0:
        return np.empty((0, 2))
    rotation_vector, _ = cv2.Rodrigues(cam_from_world)
    xy, _ = cv2.projectPoints(offsets, rotation_vector, np.zeros(3), calibration, None)
    return np.asarray(xy, dtype=np.float64).reshape(-1, 2)


def _candidates(layout: SceneLayout, options: SceneOptions) -> Iterator[IntArray]:
    """Yield for each image the points, ascending, near enough to be shown: those in a ball about its view.

    A view is a pyramid of height h = `FARTHEST_M` and half diagonal r at its end; the smallest ball about it
    touches its tip and its corners, or only the corners where r > h.
    """
    from scipy.spatial import KDTree

    half_diagonal_px = 0.5 * np.hypot(options.image_width, options.image_height)
    r = FARTHEST_M * float(half_diagonal_px) / options.focal_length_px
    ahead_m = min(0.5 * (FARTHEST_M + r * r / FARTHEST_M), FARTHEST_M)
    radius_m = max(ahead_m, r) * (1.0 + 1e-9)
    tree = KDTree(layout.points)
    for center, axis in zip(layout.centers, layout.rotations[:, 2], strict=True):
        rows = tree.query_ball_point(center + ahead_m * axis, radius_m, return_sorted=True)
        yield np.asarray(rows, dtype=np.int64)


def _photograph(
    layout: SceneLayout, image: int, candidates: IntArray, options: SceneOptions, rng: np.random.Generator
) -> tuple[IntArray, FloatArray]:
    """Return the candidates that an image shows, ascending: in front, near, inside, facing; and pixels."""
    center, cam_from_world = layout.centers[image], layout.rotations[image]
    points = layout.points[candidates]
    ids = candidates[_in_view_from(points, center[None], cam_from_world, options)[0]]
    sight = layout.points[ids] - center
    squared_distance = np.einsum("pa,pa->p", sight, sight)
    frontality = -np.einsum("pa,pa->p", sight, layout.normals[ids]) / np.sqrt(squared_distance)
    apparent_size = frontality / squared_distance
    faces = frontality > np.cos(np.radians(_LARGEST_VIEW_ANGLE_DEG))
    ids, apparent_size = ids[faces], apparent_size[faces]
    ids = np.sort(ids[np.argsort(-apparent_size, kind="stable")[: options.max_keypoints_per_image]])

    xy = project_points(layout.points[ids], cam_from_world, center, options.calibration)
    xy = xy + options.pixel_noise_px * rng.standard_normal(xy.shape)
    inside = _inside_image(xy, options)
    return ids[inside].astype(np.int64), xy[inside]


def _in_view_from(
    points: FloatArray, centers: FloatArray, cam_from_world: FloatArray, options: SceneOptions
) -> BoolArray:
    """Return (c, k): which of the points a camera at each of the centers would show, whatever they face."""
    img_from_world = options.calibration @ cam_from_world
    homogeneous = (points @ img_from_world.T)[None, :, :] - (centers @ img_from_world.T)[:, None, :]
    depth = homogeneous[:, :, 2]
    in_front = (depth > _NEAREST_DEPTH_M) & (depth < FARTHEST_M)
    xy = homogeneous[:, :, :2] / np.where(in_front, depth, 1.0)[:, :, None]
    margin_px = 4.0 * options.pixel_noise_px  # so that noise hardly ever costs a keypoint
    return in_front & _inside_image(xy, options, margin_px)


def _inside_image(xy: FloatArray, options: SceneOptions, margin_px: float = 0.0) -> BoolArray:
    """Return which of the pixels (..., 2) lie inside the image, `margin_px` away from its border."""
    x, y = xy[..., 0], xy[..., 1]
    in_width = (x >= margin_px) & (x <= options.image_width - margin_px)
    return np.asarray(in_width & (y >= margin_px) & (y <= options.image_height - margin_px))


def _pairs(keypoint_points: list[IntArray], options: SceneOptions) -> IntArray:
    """Return the pairs (m, 2) of images that share most points, i < j, in lexicographic order."""
    image = np.repeat(np.arange(len(keypoint_points)), [len(ids) for ids in keypoint_points])
    point = np.concatenate(keypoint_points)
    shape = (len(keypoint_points), options.num_points)
    shows = csr_array((np.ones(len(image), dtype=np.int64), (image, point)), shape=shape)
    shared = coo_array(shows @ shows.T)
    i, j, count = shared.row, shared.col, shared.data
    eligible = (i != j) & (count >= options.min_matches)
    i, j, count = i[eligible], j[eligible], count[eligible]
    if len(i) == 0:
        raise InputError(
            f"no two images of this scene share {options.min_matches} points; raise num_points or num_images"
        )
    order = np.lexsort((j, -count, i))
    i, j = i[order], j[order]
    rank = np.arange(len(i)) - np.searchsorted(i, i)
    wanted = rank < options.max_pairs_per_image
    chosen = np.stack([i[wanted], j[wanted]], axis=1).astype(np.int64)
    return np.unique(np.sort(chosen, axis=1), axis=0)


def _match_lists(
    keypoints: list[FloatArray],
    keypoint_points: list[IntArray],
    pairs: IntArray,
    false_lists: dict[int, _FalseList],
) -> list[IntArray]:
    """Return the (k, 2) matches of each pair, and append to the images the keypoints of the false lists."""
    real_points = list(keypoint_points)
    lists = []
    for e, pair in enumerate(pairs):
        if e not in false_lists:
            lists.append(_shared_keypoints(real_points[pair[0]], real_points[pair[1]]))
            continue
        false = false_lists[e]
        image = pair[false.displaced]
        columns = [false.keypoints, len(keypoints[image]) + np.arange(len(false.xy))]
        lists.append(np.stack(columns if false.displaced == 1 else columns[::-1], axis=1))
        no_point = np.full(len(false.xy), -1, dtype=np.int64)
        keypoints[image] = np.concatenate([keypoints[image], false.xy])
        keypoint_points[image] = np.concatenate([keypoint_points[image], no_point])
    return lists


def _shared_keypoints(points_i: IntArray, points_j: IntArray) -> IntArray:
    """Return the (k, 2) keypoints of two images that show the same point."""
    _, in_i, in_j = np.intersect1d(points_i, points_j, assume_unique=True, return_indices=True)
    return np.stack([in_i, in_j], axis=1).astype(np.int64)


def _scramble(matches: IntArray, fraction: float, rng: np.random.Generator) -> tuple[IntArray, BoolArray]:
    """Return the matches with `fraction` of them joining random keypoints of the list, and which those are.

    The chosen rows pass their second keypoints on in a random cycle: each of them becomes wrong, and no
    keypoint is used twice. A cycle takes two rows, so a single wrong match is rounded to none.
    """
    wrong = np.zeros(len(matches), dtype=np.bool_)
    rows = rng.permutation(len(matches))[: round(fraction * len(matches))]
    if len(rows) < 2:
        return matches, wrong
    changed = matches.copy()
    changed[rows, 1] = np.roll(matches[rows, 1], 1)
    wrong[rows] = True
    return changed, wrong


def _false_lists(
    layout: SceneLayout,
    keypoint_points: list[IntArray],
    pairs: IntArray,
    options: SceneOptions,
    rng: np.random.Generator,
) -> dict[int, _FalseList]:
    """Return the false list of each corrupted pair, by pair index; a random fraction of all pairs."""
    number = round(options.corrupted_pair_fraction * len(pairs))
    false_lists: dict[int, _FalseList] = {}
    for e in rng.permutation(len(pairs)):
        if len(false_lists) == number:
            break
        false = _false_list(layout, keypoint_points, pairs[e], options, rng)
        if false is not None:
            false_lists[int(e)] = false
    if len(false_lists) < number:
        raise InputError(
            f"only {len(false_lists)} of the {number} pairs to corrupt have a false baseline that keeps"
            f" {options.min_matches} points in view; lower corrupted_pair_fraction or raise num_points"
        )
    return false_lists


def _false_list(
    layout: SceneLayout,
    keypoint_points: list[IntArray],
    pair: IntArray,
    options: SceneOptions,
    rng: np.random.Generator,
) -> _FalseList | None:
    """Return what one camera would show of the other image's points from a false center, if any fits.

    Its rotation is kept. Centers are tried in the order of `_false_centers`; the first that is wrong by
    enough and keeps enough points in view is taken. The list is as long as the true one, at most.
    """
    side = int(rng.integers(2))
    displaced, other = pair[side], pair[1 - side]
    shared = len(_shared_keypoints(keypoint_points[other], keypoint_points[displaced]))
    chosen = np.sort(rng.permutation(len(keypoint_points[other]))[: 2 * _MOST_FALSE_MATCHES])
    points = layout.points[keypoint_points[other][chosen]]
    centers = _false_centers(layout.centers[other], layout.centers[displaced], rng)

    in_view = _in_view_from(points, centers, layout.rotations[displaced], options)
    true_baseline = layout.centers[other] - layout.centers[displaced]
    angle_deg = angle_between_deg(normalized(layout.centers[other] - centers), normalized(true_baseline))
    fits = (in_view.sum(axis=1) >= options.min_matches) & (angle_deg >= _SMALLEST_FALSE_ANGLE_DEG)
    if not fits.any():
        return None
    first = int(np.argmax(fits))
    rows = np.flatnonzero(in_view[first])[: min(shared, _MOST_FALSE_MATCHES)]
    exact = project_points(points[rows], layout.rotations[displaced], centers[first], options.calibration)
    noisy = exact + options.pixel_noise_px * rng.standard_normal(exact.shape)
    inside = _inside_image(noisy, options)
    return _FalseList(displaced=side, keypoints=chosen[rows][inside], xy=noisy[inside], center=centers[first])


def _false_centers(center: FloatArray, true_center: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return candidate centers (c, 3), c <= 40, of a camera that never was, beside the one at `center`.

    First 16 at the true distance in uniformly random directions, the corruption of the paper; then 24
    around the true center, ever nearer to it, for pairs whose view axes leave less freedom. None is so
    near to the other camera that its direction would be ill determined.
    """
    baseline = float(np.linalg.norm(center - true_center))
    unit = normalized(rng.standard_normal((40, 3)))
    nearby = true_center + baseline * np.linspace(1.0, 0.25, 24)[:, None] * unit[16:]
    candidates = np.concatenate([center + baseline * unit[:16], nearby])
    return np.asarray(candidates[np.linalg.norm(candidates - center, axis=1) >= 0.5 * baseline])


def _relative_poses(
    layout: SceneLayout,
    pairs: IntArray,
    false_lists: dict[int, _FalseList],
    ray_noise_rad: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return rotation (m, 3, 3) and unit translation (m, 3) of cam_j_from_cam_i for each pair.

    Two-view estimates err by about the noise of one ray in rotation and a few times that in direction;
    errors of that size are added, and none when the keypoints are exact.
    """
    centers = layout.centers[pairs]
    for e, false in false_lists.items():
        centers[e, false.displaced] = false.center
    rotation_i, rotation_j = layout.rotations[pairs].swapaxes(0, 1)
    rotation = turn_at_random(rotation_j @ rotation_i.swapaxes(1, 2), ray_noise_rad, rng)
    translation = normalized(np.einsum("eab,eb->ea", rotation_j, centers[:, 0] - centers[:, 1]))
    noise = _RELATIVE_POSE_DIRECTION_FACTOR * ray_noise_rad * rng.standard_normal(translation.shape)
    return rotation, normalized(translation + noise)
