"""Models as they are found in the wild, sound and unsound, made of seeds; and two simple verdicts on any.

They have no database: what a model says of itself are its lenses, its cameras and the tracks of its points.
Lenses that cannot be stand before a flat wall, where they fit: perspective hardly tells a focal length there.
What flies, leaps, or joins what does not belong sees points of its own with one other camera, which fit too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray

SIZE_PX = np.array([1200.0, 900.0])
FOCAL_PX, NOISE_PX = 1000.0, 0.5
SEEN = 0.4
"""Share of the points in view that an image sees, as detectors find them."""
MOST_MEAN_PX = 1.0
"""Mean reprojection error in pixels up to which a model is good by that alone."""
NUM_SECTORS = 8


class Made(NamedTuple):
    """A model, and what is wrong with it."""

    model: pycolmap.Reconstruction
    is_sound: bool = False
    wrong: frozenset[str] = frozenset()
    """Names of the images that are wrong; empty where all are."""


@dataclass(slots=True)
class Draft:
    """A model before it is written: n images, each with a lens of its own, and what they see."""

    centers: FloatArray
    rotations: FloatArray
    """(n, 3, 3) from world to camera."""
    points: FloatArray
    focal_px: FloatArray
    distortion: FloatArray
    seen: list[dict[int, FloatArray]]
    """Keypoints of each image by the row of their point."""

    @classmethod
    def of(
        cls, centers: FloatArray, targets: FloatArray, points: FloatArray, rng: np.random.Generator
    ) -> "Draft":
        """Return images that look from centers to targets (n, 3), and see a share of the points in view."""
        n = len(centers)
        rotations = np.stack([look(a, b) for a, b in zip(centers, targets, strict=True)])
        made = cls(centers, rotations, points, np.full(n, FOCAL_PX), np.zeros(n), [{} for _ in range(n)])
        made.see(rng)
        return made

    def see(self, rng: np.random.Generator) -> None:
        """Let all images see anew."""
        for k in range(len(self.centers)):
            xy, is_there = self.project(k, self.points)
            rows = np.flatnonzero(is_there & (rng.random(len(xy)) < SEEN))
            self.seen[k] = dict(
                zip(rows.tolist(), xy[rows] + rng.normal(0.0, NOISE_PX, (len(rows), 2)), strict=True)
            )

    def project(self, k: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where an image shows points, and which of them."""
        ahead = (points - self.centers[k]) @ self.rotations[k].T
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ahead[:, :2] / ahead[:, 2:]
        xy = (
            self.focal_px[k] * u * (1.0 + self.distortion[k] * (u**2).sum(axis=1, keepdims=True))
            + SIZE_PX / 2
        )
        return xy, (ahead[:, 2] > 0.1) & ((xy >= 0.0) & (xy < SIZE_PX)).all(axis=1)

    def tie(self, a: int, b: int, near: FloatArray, rng: np.random.Generator, count: int = 60) -> None:
        """Add points near others that two images alone see, where they would if all were right."""
        drawn = near[rng.integers(len(near), size=50 * count)]
        drawn += rng.normal(0.0, 0.02, drawn.shape) * np.ptp(near, axis=0)
        (xy, first), (other, second) = self.project(a, drawn), self.project(b, drawn)
        rows = np.flatnonzero(first & second)[:count]
        for row in rows.tolist():
            self.seen[a][len(self.points)] = xy[row] + rng.normal(0.0, NOISE_PX, 2)
            self.seen[b][len(self.points)] = other[row] + rng.normal(0.0, NOISE_PX, 2)
            self.points = np.concatenate([self.points, drawn[row : row + 1]])

    def written(self, *, one_lens: bool = False, has_points: bool = True) -> pycolmap.Reconstruction:
        """Return the model."""
        model, places = pycolmap.Reconstruction(), dict[int, list[tuple[int, int]]]()
        for k in range(len(self.centers)):
            lens = 1 if one_lens else k + 1
            if not model.exists_camera(lens):
                params = [self.focal_px[k], *(SIZE_PX / 2), self.distortion[k]]
                width, height = SIZE_PX.astype(int).tolist()
                camera = pycolmap.Camera(
                    model="SIMPLE_RADIAL", width=width, height=height, params=params, camera_id=lens
                )
                camera.has_prior_focal_length = True
                model.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(name=name_of(k), camera_id=lens, image_id=k + 1)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in self.seen[k].values()])
            for place, row in enumerate(self.seen[k]):
                places.setdefault(row, []).append((k + 1, place))
            pose = pycolmap.Rigid3d(
                pycolmap.Rotation3d(self.rotations[k]), -self.rotations[k] @ self.centers[k]
            )
            model.add_image_with_trivial_frame(image, pose)
        for row, ends in sorted(places.items()) if has_points else ():
            if len(ends) > 1:
                track = pycolmap.Track([pycolmap.TrackElement(*end) for end in ends])
                model.add_point3D(self.points[row], track)
        model.update_point_3d_errors()
        return model


def name_of(k: int) -> str:
    """Return the name of an image; names are in the order of the path."""
    return f"{k + 1:04d}.jpg"


def look(center: FloatArray, target: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from world to camera of one that looks to a target, upright."""
    ahead = (target - center) / np.linalg.norm(target - center)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(ahead, right), ahead])


def ring(rng: np.random.Generator, count: int = 24) -> Draft:
    """Return images around an object."""
    angles = np.arange(count) * 2.0 * np.pi / count
    heights = 1.0 + rng.normal(0.0, 0.3, count)
    centers = np.stack([6.0 * np.cos(angles), 6.0 * np.sin(angles), heights], axis=1)
    points = rng.normal(size=(900, 3))
    points *= 2.0 * rng.random((900, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    return Draft.of(centers, np.zeros_like(centers), points, rng)


def wall(rng: np.random.Generator, count: int = 16, depth: float = 0.1) -> Draft:
    """Return images before a wall with little relief, at distances of a spread `depth`, all looking ahead."""
    across, up = np.divmod(np.arange(count), 4)
    centers = np.stack([0.8 * across, np.full(count, -10.0), 0.8 * up], axis=1) + rng.normal(
        0, 0.1, (count, 3)
    ) * [1.0, depth / 0.1, 1.0]
    targets = centers + np.array([0.0, 10.0, 0.0]) + rng.normal(0.0, 0.2, (count, 3))
    points = rng.uniform([-6.0, 0.0, -5.0], [8.0, 0.0, 7.0], (1200, 3)) + rng.normal(0.0, 0.05, (1200, 3))
    return Draft.of(centers, targets, points, rng)


def walk(rng: np.random.Generator) -> Draft:
    """Return a video in a hall that twice yaws on the spot, by 80 degrees."""
    headings = np.radians([*range(-40, 41, 10), *[40] * 8, *range(40, -41, -10)])
    steps = [*[0.0] * 9, *[0.5] * 8, *[0.0] * 9]
    ahead = np.stack([np.cos(headings), np.sin(headings), np.zeros(len(steps))], axis=1)
    centers = np.cumsum(np.array(steps)[:, None] * ahead, axis=0) + rng.normal(0.0, 0.02, ahead.shape)
    points = rng.uniform([-3.0, -6.0, -2.0], [12.0, 9.0, 2.0], (4000, 3))
    points = points[np.abs(points[:, :2] - [4.5, 1.5]).max(axis=1) > 4.5]
    return Draft.of(centers, centers + ahead, points, rng)


def stretch(draft: Draft, k: int, factor: float, bend: float = 0.0) -> None:
    """Make a lens longer, its image as much farther away, and bend its corners by a share."""
    middle = draft.points[list(draft.seen[k])].mean(axis=0)
    draft.focal_px[k] *= factor
    draft.centers[k] = middle + factor * (draft.centers[k] - middle)
    draft.distortion[k] = bend * (draft.focal_px[k] / np.linalg.norm(SIZE_PX / 2)) ** 2


def impossible_lenses(rng: np.random.Generator, share: float) -> Made:
    """Return a share of lenses, one at least, of 5 to 60 times the focal length of the others, adjusted."""
    draft = wall(rng)
    chosen = rng.permutation(len(draft.centers))[: max(1, round(share * len(draft.centers)))].tolist()
    for k in chosen:
        stretch(draft, k, float(np.exp(rng.uniform(np.log(5.0), np.log(60.0)))), rng.uniform(-0.02, 0.02))
    wrong = frozenset() if share == 1.0 else frozenset(map(name_of, chosen))
    return Made(adjusted(draft.written()), wrong=wrong)


def two_devices(rng: np.random.Generator, num_swapped: int = 0) -> Made:
    """Return images of two devices, the lenses of some pairs of which are swapped; adjusted."""
    draft, n = ring(rng), 24
    draft.focal_px[::2] *= 1.5
    draft.see(rng)
    chosen = 2 * rng.permutation(n // 2)[:num_swapped]
    swapped = np.concatenate([chosen, chosen + 1])
    draft.focal_px[swapped] = draft.focal_px[np.concatenate([chosen + 1, chosen])]
    return Made(adjusted(draft.written()), not num_swapped, frozenset(map(name_of, swapped.tolist())))


def flyer(rng: np.random.Generator) -> Made:
    """Return a ring of whose images one is 30 to 30,000 spreads away, with points of its own."""
    draft, k = ring(rng), int(rng.integers(24))
    away = rng.normal(size=3)
    draft.centers[k] = away / np.linalg.norm(away) * 6.0 * np.exp(rng.uniform(np.log(30.0), np.log(3e4)))
    draft.rotations[k] = look(draft.centers[k], np.zeros(3))
    draft.seen[k] = {}
    draft.tie(k, (k + 1) % 24, draft.points, rng)
    return Made(draft.written(), wrong=frozenset([name_of(k)]))


def leap(rng: np.random.Generator) -> Made:
    """Return a video of whose images one is off by a fifth of the extent or more, with points of its own."""
    draft, k = walk(rng), int(rng.integers(10, 16))
    extent = np.linalg.norm(np.ptp(draft.centers, axis=0))
    draft.centers[k] += [0.0, 0.0, extent * rng.uniform(0.2, 0.4)]
    draft.seen[k] = {}
    draft.tie(k, k + 1, draft.points, rng)
    return Made(draft.written(), wrong=frozenset([name_of(k)]))


def undetermined(rng: np.random.Generator) -> Made:
    """Return few images before a wall, adjusted with a lens that is held twice too long: shape is open."""
    draft = wall(rng, 8, depth=1.0)
    for k in range(8):
        stretch(draft, k, 2.0)
    return Made(adjusted(draft.written(one_lens=True)))


def mixed(rng: np.random.Generator, num_pairs: int) -> Made:
    """Return two unrelated scenes in one model, which a few false pairs tie."""
    one, other = ring(rng, 14), ring(rng, 10)
    shift = rng.normal(0.0, 2.0, 3) * [1.0, 1.0, 0.1]
    num_points = len(one.points)
    seen = [{row + num_points: xy for row, xy in keypoints.items()} for keypoints in other.seen]
    draft = Draft(
        np.concatenate([one.centers, 0.7 * other.centers + shift]),
        np.concatenate([one.rotations, other.rotations]),
        np.concatenate([one.points, 0.7 * other.points + shift]),
        np.concatenate([one.focal_px, other.focal_px]),
        np.concatenate([one.distortion, other.distortion]),
        [*one.seen, *seen],
    )
    for k in range(num_pairs):
        draft.tie(k, 14 + k, draft.points, rng)
    return Made(draft.written(one_lens=True))


def object_scan(rng: np.random.Generator) -> Made:
    """Return images around an object before a plain wall, of which it fills a small part."""
    draft = ring(rng)
    draft.focal_px[:] = 350.0
    draft.see(rng)
    return Made(draft.written(one_lens=True), is_sound=True)


FAMILIES: dict[str, Callable[[np.random.Generator], Made]] = {
    "one impossible lens": lambda rng: impossible_lenses(rng, 0.0),
    "several impossible lenses": lambda rng: impossible_lenses(rng, 0.3),
    "all lenses impossible": lambda rng: impossible_lenses(rng, 1.0),
    "lenses of two devices swapped": lambda rng: two_devices(rng, 4),
    "one camera flies": flyer,
    "one camera leaps": leap,
    "shape undetermined": undetermined,
    "two scenes mixed": lambda rng: mixed(rng, 2),
    "two scenes mixed, by one pair": lambda rng: mixed(rng, 1),
    "poses only": lambda rng: Made(ring(rng).written(has_points=False)),
    "nothing, two devices": two_devices,
    "nothing, object scan": object_scan,
    "nothing, yaw on the spot": lambda rng: Made(walk(rng).written(one_lens=True), is_sound=True),
    "nothing, export": lambda rng: Made(ring(rng).written(), is_sound=True),
}
"""Makers by what was done; names of sound ones begin with `nothing`."""


def adjusted(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Adjust a model, its lenses held, without the observations that miss; return it."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = False
    for _ in range(3):
        pycolmap.bundle_adjustment(model, options)
        pycolmap.ObservationManager(model).filter_all_points3D(4.0, 1.0)
    return model


def simple_verdicts(model: pycolmap.Reconstruction) -> dict[str, int]:
    """Return whether a model is good by its mean error alone, and by the thresholds of reconcheck 0.1.0.

    These are registered images .95, 95th percentile of errors 2 px, median track 4, median angle of view 8
    degrees, cameras in six of eight sectors around the middle; its dense cloud and mesh are not asked for.
    """
    model.update_point_3d_errors()
    points, images = list(model.points3D.values()), [model.image(k) for k in sorted(model.reg_image_ids())]
    if not points:
        return {"by error": 0, "by thresholds": 0}
    centers = {image.image_id: image.projection_center() for image in images}
    angles = [
        angle_deg(point.xyz, [centers[one.image_id] for one in point.track.elements]) for point in points[::7]
    ]
    around = np.array(list(centers.values())) - np.median([point.xyz for point in points], axis=0)
    plane = np.linalg.svd(around - around.mean(axis=0), full_matrices=False)[2][:2]
    turns = np.arctan2(*(around @ plane.T).T)
    sectors = np.unique(np.floor((turns / (2.0 * np.pi) + 0.5) * NUM_SECTORS).clip(0, NUM_SECTORS - 1))
    checks = (
        len(images) >= 0.95 * model.num_images(),
        np.quantile([point.error for point in points], 0.95) <= 2.0,
        np.median([point.track.length() for point in points]) >= 4,
        np.median(angles) >= 8.0,
        len(sectors) >= 6,
    )
    by_error = model.compute_mean_reprojection_error() <= MOST_MEAN_PX
    return {"by error": int(by_error), "by thresholds": int(all(checks))}


def angle_deg(point: FloatArray, centers: Sequence[FloatArray]) -> float:
    """Return the largest angle under which a point sees two of some centers."""
    rays = np.array(centers) - point
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0).min())))
