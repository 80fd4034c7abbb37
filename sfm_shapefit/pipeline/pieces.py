"""Models as pieces: their cameras, and what ties those of two: matches of a database, and images of both."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import METRIC_SIGMA, normalized
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import ColmapModel, read_model, renamed_as
from sfm_shapefit.files.colmap.points import ModelKeypoints, points2d_of
from sfm_shapefit.placement.piece_ties import PieceCameras, PieceTies
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import Matches, PairNames, RayMatches

if TYPE_CHECKING:
    import pycolmap

_LEAST_MATCHES = 10  # matches of a pair; fewer tell no direction, and would be taken for one by chance
_SAME_PIXEL = 0.5  # pixels; keypoints of a model and of a database that are no farther apart are one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelPiece:
    """A model with a world of its own."""

    label: str
    model: ColmapModel
    scale_sigma: float | None = None
    """Relative standard deviation of its scale, where its rigs tell one; None where it is arbitrary."""

    @property
    def is_metric(self) -> bool:
        """Whether its scale must stay."""
        return self.scale_sigma is not None and self.scale_sigma <= METRIC_SIGMA


class TiedPieces(NamedTuple):
    """Pieces and their ties, with what the arrays refer to."""

    cameras: PieceCameras
    ties: PieceTies
    names: tuple[str, ...]
    """Image of each camera, (v,)."""
    keypoints: IntArray
    """(M, 2) points of the two pieces that the keypoints of a match observe, by their ids; -1 for none, and
    less for a camera of the piece, `_camera_id`."""


class _Tie(NamedTuple):
    cameras: tuple[int, ...]
    rays: tuple[FloatArray, ...]
    """Two (m, 3), in axes of the cameras."""
    ids: IntArray
    """(m, 2)"""
    pixel_angle: float
    is_shared: bool


def read_pieces(
    models: "Sequence[pycolmap.Reconstruction | Path | str]", database: Path | None
) -> list[ModelPiece]:
    """Read the models, and refuse those that have nothing to join."""
    pieces: list[ModelPiece] = []
    read_models = [*map(read_model, models)]
    every = {name for model in read_models for name in model.images.names}
    # A database that has all of them, each under its own name, says that they are different images.
    are_different = False
    with suppress(InputError):  # what is wrong with a database is said where it is opened for its matches
        are_different = database is not None and not missing_images(database, every)
    for number, (source, model) in enumerate(zip(models, read_models, strict=True)):
        label = str(source) if isinstance(source, Path | str) else f"model {number}"
        names = dict.fromkeys(name for piece in pieces for name in piece.model.images.names)
        piece = ModelPiece(label=label, model=model if are_different else renamed_as(model, list(names)))
        for earlier in pieces:
            if {*piece.model.images.names} <= {*earlier.model.images.names}:
                raise InputError(
                    f"every image of {label} is in {earlier.label} too, so that there is nothing to join; "
                    "leave out one of them"
                )
        pieces.append(piece)
    rigs = [piece.model.images.has_rigs for piece in pieces]
    if any(rigs) and not all(rigs):
        raise InputError(
            f"{pieces[rigs.index(True)].label} has rigs of several cameras, and a scale by that, but "
            f"{pieces[rigs.index(False)].label} has none; give both the same rigs"
        )
    return [replace(piece, scale_sigma=0.0) for piece in pieces] if any(rigs) else pieces


def missing_images(database: Path, names: Collection[str]) -> tuple[str, ...]:
    """Return the names of images that a database lacks."""
    with closing(open_database(database, sorted(names))) as matches:
        return matches.missing_names


def tie_pieces(pieces: Sequence[ModelPiece], matches: Matches | None, left_out: PairNames) -> TiedPieces:
    """Return what ties pieces to one another: matches of their images, but for pairs that are left out.

    Without matches, images that they share tie them.
    """
    seen = _Seen(pieces)
    links = list(seen.shared())
    if matches is not None:
        links += seen.matched(matches, left_out)
    first = [one.cameras for one in links]
    counts = [len(one.ids) for one in links]
    ids = np.concatenate([np.zeros((0, 2), dtype=np.int64), *(one.ids for one in links)])
    ends = np.repeat(np.reshape(np.array(first, dtype=np.int64), (-1, 2)), counts, axis=0)
    ties = PieceTies(
        matches=RayMatches(
            pairs=np.reshape(np.array(first, dtype=np.int64), (-1, 2)),
            offsets=offsets_of(counts),
            rays_i=np.concatenate([np.zeros((0, 3)), *(one.rays[0] for one in links)]),
            rays_j=np.concatenate([np.zeros((0, 3)), *(one.rays[1] for one in links)]),
            pixel_angles=np.array([one.pixel_angle for one in links]),
        ),
        points=np.stack([seen.points(ends[:, k], ids[:, k]) for k in range(2)], axis=1),
        is_shared=np.array([one.is_shared for one in links], dtype=np.bool_),
    )
    return TiedPieces(seen.cameras, ties, seen.names, ids)


def _camera_id(cameras: IntArray) -> IntArray:
    """Return the ids of cameras where ids of points are expected, or the cameras with such ids."""
    return -2 - cameras


class _Seen:
    """The cameras of all pieces, by piece and then by name, and what their keypoints observe."""

    def __init__(self, pieces: Sequence[ModelPiece]) -> None:
        self.pieces = pieces
        every = [piece.model.images for piece in pieces]
        self.names = tuple(name for images in every for name in images.names)
        self.row = np.concatenate([np.arange(images.num_images) for images in every])
        self.focal = np.concatenate([images.focal_lengths_px for images in every])
        self.cameras = PieceCameras(
            piece_of=np.repeat(np.arange(len(every)), [images.num_images for images in every]),
            rotations=np.concatenate([images.rotations for images in every]),
            centers=np.concatenate([images.centers for images in every]),
            is_metric=np.array([piece.is_metric for piece in pieces], dtype=np.bool_),
            points=tuple(piece.model.arrays.points["xyz"].copy() for piece in pieces),
        )
        self.of_name: dict[str, list[int]] = {}
        for v, name in enumerate(self.names):
            self.of_name.setdefault(name, []).append(v)
        self.pictures = [
            ModelKeypoints(i, points2d_of(p.model.arrays, i)) for p, i in zip(pieces, every, strict=True)
        ]
        self.observed = [self._observed(v) for v in range(len(self.names))]

    def _observed(self, v: int) -> tuple[IntArray, IntArray]:
        """Return which keypoints of a camera's image observe a point, and the ids of these."""
        model = self.pieces[self.cameras.piece_of[v]].model
        row = int(model.arrays.images.rows(model.images.ids[self.row[v : v + 1]])[0])
        keypoints, points = model.arrays.observed(row)
        return keypoints, points.astype(np.int64)

    def points(self, cameras: IntArray, ids: IntArray) -> FloatArray:
        """Return the points (m, 3) of cameras' pieces by their ids; NaN for none."""
        xyz = np.full((len(ids), 3), np.nan)
        is_camera = ids < -1
        xyz[is_camera] = self.cameras.centers[_camera_id(ids[is_camera])]
        numbers = self.cameras.piece_of[cameras]
        for number in distinct(numbers[ids >= 0]).tolist():
            rows, points = (
                np.flatnonzero((ids >= 0) & (numbers == number)),
                self.pieces[number].model.arrays.points,
            )
            xyz[rows] = points["xyz"][np.searchsorted(points["id"], ids[rows].astype(np.uint64))]
        return xyz

    def shared(self) -> Iterator[_Tie]:
        """Yield a tie for each two cameras that are one image, with what each of them sees of its piece."""
        for cameras in self.of_name.values():
            for second in range(1, len(cameras)):
                for first in range(second):
                    yield self._shared(cameras[first], cameras[second])

    def _shared(self, first: int, second: int) -> _Tie:
        rays, ids = [], []
        for place, v in enumerate((first, second)):
            seen, points = self._sees(v)
            rays.append(normalized(seen))
            column = np.full((len(points), 2), -1)
            column[:, place] = points
            ids.append(column)
        both, known = np.concatenate(rays), np.concatenate(ids)
        finite = np.isfinite(both).all(axis=1)
        angle = 1.0 / float(min(self.focal[first], self.focal[second]))
        return _Tie((first, second), (both[finite], both[finite]), known[finite], angle, True)

    def _sees(self, v: int) -> tuple[FloatArray, IntArray]:
        """Return what a camera sees, in its axes, and ids: points or, with few, the other cameras.

        Models without points have poses all the same, and one image is one camera in both.
        """
        keypoints, points = self.observed[v]
        if len(keypoints) < _LEAST_MATCHES:
            others = np.flatnonzero(self.cameras.piece_of == self.cameras.piece_of[v])
            others = others[others != v]
            away = self.cameras.centers[others] - self.cameras.centers[v]
            return away @ self.cameras.rotations[v].T, _camera_id(others)
        pictures, row = self.pictures[self.cameras.piece_of[v]], int(self.row[v])
        return pictures.rays(row, pictures.pixels(row, keypoints)), points

    def matched(self, matches: Matches, left_out: PairNames) -> Iterator[_Tie]:
        """Yield the pairs of a database whose images no piece has both of."""
        images, labels = self._union()
        view = matches.at(images, left_out)
        ids = {}
        for batch in view.between(labels):
            for k, ((i, j), rows) in enumerate(zip(batch.pairs.tolist(), batch.slices(), strict=True)):
                if rows.stop - rows.start < _LEAST_MATCHES:
                    continue
                ends = [self.of_name[images.names[end]] for end in (i, j)]
                piece_of = self.cameras.piece_of
                if {*piece_of[ends[0]].tolist()} & {*piece_of[ends[1]].tolist()}:
                    continue
                for v in ends[0]:
                    for w in ends[1]:
                        for one in (v, w):
                            if one not in ids:
                                ids[one] = self._by_keypoint(one, view.keypoints(i if one == v else j))
                        seen = batch.keypoints[rows].T
                        seen_ids, angle = np.stack([ids[v][seen[0]], ids[w][seen[1]]]), batch.pixel_angles[k]
                        rays = batch.rays_i[rows], batch.rays_j[rows]
                        way = -1 if piece_of[v] > piece_of[w] else 1
                        yield _Tie((v, w)[::way], rays[::way], seen_ids[::way].T, float(angle), False)

    def _union(self) -> tuple[Images, IntArray]:
        """Return every image once, apart from all others, and labels that differ unless one piece has both.

        An image of several pieces looks through the lens of the first.
        """
        names = sorted(self.of_name)
        first = [self.of_name[name][0] for name in names]
        every = [piece.model.images for piece in self.pieces]
        begins = offsets_of([len(images.lenses) for images in every])
        lenses = [lens for images in every for lens in images.lenses]
        lens_of = np.concatenate([n + images.lens_of for n, images in zip(begins, every, strict=False)])
        used, lens_of_image = np.unique(lens_of[first], return_inverse=True)
        images = replace(
            every[0],
            names=tuple(names),
            ids=np.arange(len(names)),
            frame_of=np.arange(len(names)),
            lens_of=lens_of_image,
            lenses=tuple(replace(lenses[k], id=number) for number, k in enumerate(used.tolist())),
        ).apart()
        is_shared = [len(self.of_name[name]) > 1 for name in names]
        labels = np.where(is_shared, len(self.pieces) + np.arange(len(names)), self.cameras.piece_of[first])
        return images, labels

    def _by_keypoint(self, v: int, pixels: FloatArray) -> IntArray:
        """Return the id of the point that each keypoint (k, 2) of a database observes; -1 for none."""
        point_ids = np.full(len(pixels), -1)
        keypoints, points = self.observed[v]
        if not len(keypoints) or not len(pixels):
            return point_ids
        observed = self.pictures[self.cameras.piece_of[v]].pixels(int(self.row[v]), keypoints)
        places = np.minimum(keypoints, len(pixels) - 1)
        if not np.abs(observed - pixels[places]).max() <= _SAME_PIXEL:
            from scipy.spatial import KDTree  # here, since it takes long to import

            apart, nearest = KDTree(pixels).query(observed)
            places = np.asarray(nearest)
            points = np.where(apart <= _SAME_PIXEL, points, -1)
        point_ids[places] = points
        return point_ids
