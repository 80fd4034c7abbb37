"""Inlier matches and relative poses of a COLMAP database, read by sqlite3 without touching the file.

How the file is opened stands in `sqlite_file`, which pairs it has in `database_pairs`.
"""

import copy
import itertools
import os
import sqlite3
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.files.colmap.database_pairs import (
    PairRows,
    check_schema,
    indices_of_names,
    match_names,
    read_pairs,
)
from sfm_shapefit.files.colmap.model import (
    PosedModel,
    batch_ranges,
    rotation_matrices,
    same_intrinsics,
    world_rays,
)
from sfm_shapefit.files.colmap.sorted_matches import (
    MOST_BESIDE_TRACKS,
    MOST_MATCHES,
    SortedMatches,
    UInt32Array,
)
from sfm_shapefit.files.colmap.sqlite_file import (
    columns_of,
    is_blob,
    readonly_connection,
    readonly_rows,
    sqlite_errors,
)
from sfm_shapefit.files.pair_list import PairNames
from sfm_shapefit.scene.matches import KeypointMatches, MatchBatch, RelativePoses

KEPT_MATCHES = 1_000_000
"""So many are kept with their rays, in 80 MB."""

BATCH = 250_000
"""Matches that are put together at a time, in 60 MB. The arrays of larger batches come from the system and go
back to it each time, and its zeros cost as much as what is written over them."""

_KEYPOINT_BITS = np.uint64(32)
_KEYPOINT_MASK = np.uint64(2**32 - 1)

# Of COLMAP's configurations these are not verified (0, 1, 7), a pure rotation (5), or several motions (8).
_CONFIGS_WITHOUT_POSE = (0, 1, 5, 7, 8)

# Limit of the memory for rays of keypoints that may be needed again, unless another is set.
_CACHE_BYTES = 1_000_000_000
# Stored translations are 1, or of the scene's size; shorter ones mean "none".
_MIN_TRANSLATION = 1e-12


def find_database(model_folder: Path) -> Path | None:
    """Return database.db in the model's folder, its parent or its grandparent, whichever comes first."""
    folder = Path(os.path.abspath(model_folder))
    for candidate in (folder, *folder.parents[:2]):
        path = candidate / "database.db"
        if os.path.isfile(path):  # False, not an error, where the folder may not be read
            return path
    return None


def images_with_keypoints(path: Path) -> set[str]:
    """Return the names of the images of a database that have keypoints.

    Raises:
        InputError: if it is no COLMAP database, or cannot be read.
    """
    query = "SELECT name FROM images JOIN keypoints USING (image_id) WHERE rows > 0"
    return {name for (name,) in readonly_rows(path, "keypoints", {("image_id", "rows"): query})}


@contextmanager
def open_database(
    path: Path | str,
    model: PosedModel,
    left_out: PairNames = frozenset(),
    rows: "PairRows | None" = None,
) -> Iterator["MatchDatabase"]:
    """Open a COLMAP database, for the matches of a model's images; neither it nor its folder is changed.

    Pairs `left_out` are taken for unmatched. With `rows`, as `MatchDatabase.rows` gave them for a model of
    the same images, it has these pairs only, and the table of all pairs is not read again.

    Raises:
        InputError: if the file is missing, is no COLMAP database, is locked or damaged, or has fewer
            than two images of the model; later reads raise it for damaged rows, naming image or pair.
    """
    file = Path(path)
    with ExitStack() as stack:
        with sqlite_errors(file):
            connection = stack.enter_context(readonly_connection(file))
            check_schema(file, connection)
            database = MatchDatabase(file, connection, model, left_out, rows)
        yield database


class MatchDatabase:
    """The matches of a database between the images of a model; made by `open_database`."""

    def __init__(
        self,
        path: Path,
        connection: sqlite3.Connection,
        model: PosedModel,
        left_out: PairNames = frozenset(),
        rows: "PairRows | None" = None,
    ) -> None:
        self.path = path
        self._connection = connection
        self._model = model
        self._cache_bytes = _CACHE_BYTES
        self._rays: OrderedDict[int, FloatArray] = OrderedDict()
        self._cached_bytes = 0
        self._kept: dict[tuple[int, int], list[MatchBatch]] = {}
        index_of_id = match_names(path, connection, model)
        self._id_of_index = {index: i for i, index in index_of_id.items() if index >= 0}
        pairs = read_pairs(path, connection, index_of_id) if rows is None else rows
        self._pairs = pairs.without(indices_of_names(model, left_out))
        self._looked_at: dict[int, _Keypoints] = {}
        self._sorted: SortedMatches | None = None
        if float(self._pairs.num_inliers.sum(dtype=np.float64)) <= MOST_MATCHES:
            _, rowids, swapped, _, counts = self._pairs
            self._share(SortedMatches(rowids, swapped, counts))

    @property
    def unmatched_names(self) -> tuple[str, ...]:
        """Names of the model's images that the database does not have, in model order."""
        return tuple(name for k, name in enumerate(self._model.names) if k not in self._id_of_index)

    @property
    def num_pairs(self) -> int:
        """Number of pairs of posed images with verified inlier matches."""
        return int(self._pairs.has_matches.sum())

    def limit_rays(self, num_bytes: int) -> None:
        """Keep no more bytes than these of the rays of keypoints that may be needed again."""
        self._cache_bytes = num_bytes

    def forget_rays(self) -> None:
        """Give back the memory of the rays that are kept; they are computed again where they are needed."""
        self._rays.clear()
        self._cached_bytes = 0

    def among(self, model: PosedModel, left_out: PairNames = frozenset()) -> "MatchDatabase":
        """Return the matches between the images of another model, those that were read already included.

        Raises:
            InputError: as `open_database`.
        """
        with sqlite_errors(self.path):
            other = MatchDatabase(self.path, self._connection, model, left_out)
        if self._sorted is not None:
            other._share(self._sorted)
        return other

    def _share(self, matches: SortedMatches) -> None:
        """Look matches up among, and add them to, those that were read already."""
        self._sorted, self._places = matches, matches.places(self._pairs.rowids, self._pairs.swapped)

    def forget_matches(self) -> None:
        """Give back the memory of all matches; from now on they are read each time they are needed."""
        self._sorted, self._kept = None, {}

    def clear_matches(self) -> None:
        """Give back the memory of the matches, if they are many, until they are needed again."""
        if self._sorted is not None and self.num_matches > MOST_BESIDE_TRACKS:
            self._sorted.clear()

    def turned(self, model: PosedModel) -> "MatchDatabase":
        """Return the same matches for a model of the same images, in the same order, with other rotations.

        Its intrinsics may be others too.
        """
        other = copy.copy(self)
        other._model, other._rays, other._cached_bytes, other._kept = model, OrderedDict(), 0, {}
        if not same_intrinsics(model, self._model):
            other._looked_at = {}
            return other
        other._kept = {kind: [other._with_rays(batch) for batch in kept] for kind, kept in self._kept.items()}
        return other

    @property
    def num_matches(self) -> int:
        """Number of these pairs' inlier matches."""
        return int(self._pairs.num_inliers[self._pairs.has_matches].sum())

    def num_keypoints(self) -> int:
        """Return the number of keypoints of all images, posed or not; damaged rows do not count."""
        counts = self._query(
            "SELECT rows FROM keypoints WHERE typeof(rows) = 'integer' AND rows BETWEEN 0 AND 2147483647"
        )
        return sum(count for (count,) in counts)

    def _query(self, query: str, *values: int) -> list[tuple[Any, ...]]:
        """Return the rows of a query."""
        with sqlite_errors(self.path):
            return self._connection.execute(query, values).fetchall()

    def keypoints(self, image: int) -> FloatArray:
        """Return the pixels (k, 2) of the keypoints of an image by its index; k = 0 if there are none.

        Raises:
            InputError: if the row is damaged or a coordinate is not finite.
        """
        found, name = [], self._model.names[image]
        if image in self._id_of_index:
            query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
            found = self._query(query, self._id_of_index[image])
        if not found or not found[0][0]:
            return np.zeros((0, 2))
        rows, cols, data = found[0]
        if cols not in (2, 4, 6) or not is_blob(data, rows, cols, itemsize=4):
            raise InputError(f"{self.path}: the keypoints of image {name} are damaged; extract them again")
        with np.errstate(invalid="ignore"):  # a signaling NaN
            xy = np.frombuffer(data, dtype="<f4").reshape(rows, cols)[:, :2].astype(np.float64)
        if np.isfinite(xy).all():
            return xy
        raise InputError(f"{self.path}: image {name} has a keypoint that is not finite; extract them again")

    def count_keypoints(self, image: int) -> int:
        """Return the number of keypoints of an image by its index; errors as of `keypoints`."""
        return self._look_at(image).number

    def parts(self, max_matches: int) -> list[tuple[int, int]]:
        """Return the ranges (first, stop) of pairs, in their order, of about so many matches each."""
        totals = np.append(0, np.cumsum(self._pairs.num_inliers[self._pairs.has_matches]))
        count = max(-(-int(totals[-1]) // max(max_matches, 1)), 1)
        bounds = np.unique(np.searchsorted(totals, np.linspace(0, totals[-1], count + 1)))
        bounds[-1] = len(totals) - 1
        return list(itertools.pairwise(bounds.tolist()))

    def rows(self, part: tuple[int, int]) -> "PairRows":
        """Return where the matches of a range of pairs, one of `parts`, are, for another process."""
        return self._pairs.subset(np.flatnonzero(self._pairs.has_matches)[slice(*part)])

    def iter_matches(
        self,
        min_matches: int,
        max_matches_per_batch: int = BATCH,
        among: IntArray | None = None,
        part: tuple[int, int] | None = None,
    ) -> Iterator[MatchBatch]:
        """Yield the verified inlier matches of all pairs, in the order of pairs (i, j), in batches.

        Repeated matches of a pair count once, and matches whose pixel has no ray are left out.

        Args:
            min_matches: pairs with fewer matches are left out; at least 1.
            max_matches_per_batch: only a single pair may exceed it.
            among: only pairs of these images, by their index.
            part: only this range of the pairs, one of `parts`.

        Raises:
            InputError: naming the pair whose matches are damaged or refer to keypoints that do not exist.
        """
        if among is None and part is None and self._keeps_rays(max_matches_per_batch):
            kind = min_matches, max_matches_per_batch
            if kind not in self._kept:
                self._kept[kind] = list(self._batches(*kind))
            yield from self._kept[kind]
        else:
            yield from self._batches(min_matches, max_matches_per_batch, among, part)

    def _keeps_rays(self, max_matches_per_batch: int) -> bool:
        """Return whether all matches are kept with their rays; who wants small batches wants no memory."""
        return self.num_matches <= KEPT_MATCHES and max_matches_per_batch >= min(BATCH, self.num_matches)

    def iter_keypoints(
        self, min_matches: int, among: IntArray | None = None, without: IntArray | None = None
    ) -> Iterator[KeypointMatches]:
        """Yield the same matches without their rays, which takes a fraction of the time.

        Args:
            min_matches: as in `iter_matches`.
            among: only pairs of these images, by their index.
            without: (k, 2) pairs that are left out.

        Raises:
            InputError: as `iter_matches`.
        """
        chosen = self._choose(min_matches, among)
        if without is not None and len(without):
            first, second = np.sort(without, axis=1).T
            codes = self._pairs.pairs[chosen] @ [self._model.num_images, 1]
            chosen = chosen[~np.isin(codes, first * self._model.num_images + second)]
        for first, last in batch_ranges(self._pairs.num_inliers[chosen], BATCH):
            batch = self._keypoint_batch(chosen[first:last], max(min_matches, 1))
            if len(batch.pairs):
                yield batch

    def _choose(
        self, min_matches: int, among: IntArray | None = None, part: tuple[int, int] | None = None
    ) -> IntArray:
        """Return the pairs that `iter_matches` is asked for, by their position."""
        enough = self._pairs.has_matches & (self._pairs.num_inliers >= min_matches)
        if part is not None:
            rank = np.cumsum(self._pairs.has_matches) - 1
            enough &= (rank >= part[0]) & (rank < part[1])
        if among is not None:
            enough &= np.isin(self._pairs.pairs, among).all(axis=1)
        return np.flatnonzero(enough)

    def _batches(
        self,
        min_matches: int,
        max_matches_per_batch: int,
        among: IntArray | None = None,
        part: tuple[int, int] | None = None,
    ) -> Iterator[MatchBatch]:
        """Read what `iter_matches` yields."""
        yield from self._batches_of(
            self._choose(min_matches, among, part), min_matches, max_matches_per_batch
        )

    def iter_matches_between(
        self, groups: IntArray, max_matches_per_batch: int = BATCH
    ) -> Iterator[MatchBatch]:
        """Yield the matches of all pairs whose images are in different groups (n,), as `iter_matches` does.

        Images of a negative group are in none.
        """
        ends = groups[self._pairs.pairs]
        chosen = self._pairs.has_matches & (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
        yield from self._batches_of(np.flatnonzero(chosen), 1, max_matches_per_batch)

    def _batches_of(
        self, chosen: IntArray, min_matches: int, max_matches_per_batch: int
    ) -> Iterator[MatchBatch]:
        """Read the matches of chosen pairs."""
        for first, last in batch_ranges(self._pairs.num_inliers[chosen], max_matches_per_batch):
            batch = self._match_batch(chosen[first:last], max(min_matches, 1))
            if len(batch.pairs):
                yield batch

    def relative_poses(self) -> RelativePoses:
        """Return the relative poses that the database stores, most often none.

        Left out are pairs whose configuration has no pose with a direction, and poses that are NULL, not
        finite, of zero quaternion, or of zero translation (older COLMAP wrote the identity for "none").
        Pairs are oriented i < j in the model's order: the pose is inverted when the database's ids
        are in the other order. Translations are scaled to length 1.

        Raises:
            InputError: naming the pair whose pose is damaged.
        """
        keep = np.flatnonzero(~np.isin(self._pairs.configs, _CONFIGS_WITHOUT_POSE))
        poses = np.full((len(keep), 7), np.nan)
        if {"qvec", "tvec"} <= columns_of(self._connection, "two_view_geometries"):
            for k, pair in enumerate(keep.tolist()):
                poses[k] = self._stored_pose(pair)
        with np.errstate(over="ignore", invalid="ignore"):  # neither NaN nor infinity passes
            lengths = np.stack([np.linalg.norm(part, axis=1) for part in (poses[:, :4], poses[:, 4:])])
            sound = ((lengths > [[0.0], [_MIN_TRANSLATION]]) & (lengths < np.inf)).all(axis=0)
        keep, poses = keep[sound], poses[sound]

        rotations, translations = rotation_matrices(poses[:, :4]), normalized(poses[:, 4:])
        swapped = self._pairs.swapped[keep]
        inverted = -np.einsum("nji,nj->ni", rotations, translations)
        return RelativePoses(
            pairs=self._pairs.pairs[keep],
            rotations=np.where(swapped[:, None, None], rotations.transpose(0, 2, 1), rotations),
            translations=np.where(swapped[:, None], inverted, translations),
            configs=self._pairs.configs[keep],
            num_inliers=self._pairs.num_inliers[keep],
        )

    def _stored(self, pair: int, columns: str) -> tuple[Any, ...]:
        """Return columns of a pair's two-view geometry."""
        query = f"SELECT {columns} FROM two_view_geometries WHERE rowid = ?"
        return self._query(query, int(self._pairs.rowids[pair]))[0]

    def _stored_pose(self, pair: int) -> FloatArray:
        """Return (qw, qx, qy, qz, tx, ty, tz) of a pair as stored, NaN if it has none."""
        qvec, tvec = self._stored(pair, "qvec, tvec")
        if qvec is None or tvec is None:
            return np.full(7, np.nan)
        if not (is_blob(qvec, 4, 1, itemsize=8) and is_blob(tvec, 3, 1, itemsize=8)):
            raise self._damaged_pair(pair, "a relative pose of wrong length")
        return np.frombuffer(qvec + tvec, dtype="<f8")

    def _match_batch(self, chosen: IntArray, min_matches: int) -> MatchBatch:
        """Return the matches of the chosen pairs, sorted, without repetitions and those without ray."""
        return self._with_rays(self._keypoint_batch(chosen, min_matches))

    def _with_rays(self, found: KeypointMatches | MatchBatch) -> MatchBatch:
        """Return the same matches with the rays of their keypoints."""
        rays = np.empty((2, len(found.keypoints), 3))
        bounds = found.offsets.tolist()
        for pair, (first, last) in zip(found.pairs.tolist(), itertools.pairwise(bounds), strict=True):
            for side, image in enumerate(pair):
                own = found.keypoints[first:last, side]
                self.world_rays(image).take(own, axis=0, out=rays[side, first:last])
        return MatchBatch(
            pairs=found.pairs,
            offsets=found.offsets,
            keypoints=found.keypoints,
            rays_i=rays[0],
            rays_j=rays[1],
            pixel_angles=1.0 / self._model.focal_lengths_px[found.pairs].min(axis=1),
        )

    def _keypoint_batch(self, chosen: IntArray, min_matches: int) -> KeypointMatches:
        """Return the matches of the chosen pairs, sorted, without repetitions and those without ray."""
        pairs = self._pairs.pairs[chosen]
        counts, keypoints = self._matches_of(chosen)
        images = np.unique(pairs).tolist()
        if any(self._look_at(image).blind is not None for image in images):
            has_ray = np.ones(len(keypoints), dtype=np.bool_)
            ends = itertools.pairwise(np.append(0, np.cumsum(counts)).tolist())
            for images_of_pair, (first, last) in zip(pairs.tolist(), ends, strict=True):
                for side, image in enumerate(images_of_pair):
                    blind = self._look_at(image).blind
                    if blind is not None:
                        has_ray[first:last] &= ~blind[keypoints[first:last, side]]
            keypoints = keypoints[has_ray]
            counts = np.bincount(np.repeat(np.arange(len(pairs)), counts)[has_ray], minlength=len(pairs))
        kept = counts >= min_matches
        if not kept.all():
            keypoints = keypoints[np.repeat(kept, counts)]
        return KeypointMatches(
            pairs=pairs[kept],
            offsets=np.append(0, np.cumsum(counts[kept])),
            keypoints=keypoints.astype(np.int64),
        )

    def _matches_of(self, chosen: IntArray) -> tuple[IntArray, UInt32Array]:
        """Return the sorted matches of the chosen pairs, of each how many and then all of them.

        They are read from the file only if they were not before, or there is no room to keep them.
        """
        if self._sorted is not None and (self._places[chosen] >= 0).all():
            return self._sorted.read(self._places[chosen], lambda new: self._read_matches(chosen[new]))
        return self._read_matches(chosen)

    def _read_matches(self, chosen: IntArray) -> tuple[IntArray, UInt32Array]:
        """Return the matches of pairs from the file, image i first, of each pair ascending and each once.

        Sums over matches then do not depend on the order in which the database lists them. Many pairs are
        read together, since a pair has few matches, and a call of numpy takes as long as a hundred of them.
        """
        counts = self._pairs.num_inliers[chosen]
        stored = np.frombuffer(self._stored_matches(chosen), dtype="<u4").reshape(-1, 2).astype(np.uint64)
        swapped = np.repeat(self._pairs.swapped[chosen], counts)
        first, second = np.where(swapped, stored.T[::-1], stored.T)
        # Of two keypoints one number is made, for numbers are sorted several times faster than rows.
        both = first << _KEYPOINT_BITS | second
        ends = np.cumsum(counts)
        for begin, end in zip((ends - counts).tolist(), ends.tolist(), strict=True):
            both[begin:end].sort()
        new = np.append(True, both[1:] != both[:-1])[: len(both)]
        new[(ends - counts)[counts > 0]] = True
        of_pair = np.repeat(np.arange(len(chosen)), counts)[new]
        both = both[new]
        matches = np.stack([both >> _KEYPOINT_BITS, both & _KEYPOINT_MASK], axis=1).astype(np.uint32)
        ends_of = self._pairs.pairs[chosen]
        numbers = {image: self._look_at(image).number for image in np.unique(ends_of).tolist()}
        limits = np.array([[numbers[i], numbers[j]] for i, j in ends_of.tolist()]).reshape(-1, 2)
        missing = np.flatnonzero((matches >= limits[of_pair]).any(axis=1))
        if len(missing):
            pair = int(chosen[of_pair[missing[0]]])
            raise self._damaged_pair(pair, "matches of keypoints that do not exist")
        return np.bincount(of_pair, minlength=len(chosen)), matches

    def _stored_matches(self, chosen: IntArray) -> bytes:
        """Return the matches of pairs as the file lists them, one pair after the other."""
        query, parts = "SELECT cols, data FROM two_view_geometries WHERE rowid = ?", []
        rowids, counts = self._pairs.rowids[chosen].tolist(), self._pairs.num_inliers[chosen].tolist()
        with sqlite_errors(self.path):
            for pair, rowid, count in zip(chosen.tolist(), rowids, counts, strict=True):
                cols, data = self._connection.execute(query, (rowid,)).fetchone()
                if cols != 2 or not is_blob(data, count, 2, itemsize=4):
                    raise self._damaged_pair(pair, "matches of wrong length")
                parts.append(data)
        return b"".join(parts)

    def world_rays(self, image: int) -> FloatArray:
        """Return the rays (k, 3) of all keypoints of an image in world axes, from memory if there lately.

        NaN where a pixel has none.

        Raises:
            InputError: as `keypoints`.
        """
        if image in self._rays:
            self._rays.move_to_end(image)
            return self._rays[image]
        rays = world_rays(self._model, image, self.keypoints(image))
        self._rays[image] = rays
        self._cached_bytes += rays.nbytes
        while self._cached_bytes > self._cache_bytes:
            self._cached_bytes -= self._rays.popitem(last=False)[1].nbytes
        return rays

    def _look_at(self, image: int) -> "_Keypoints":
        """Return how many keypoints an image has, and which of them have no ray."""
        if image not in self._looked_at:
            blind = np.isnan(self.world_rays(image)[:, 0])
            self._looked_at[image] = _Keypoints(len(blind), blind if blind.any() else None)
        return self._looked_at[image]

    def _damaged_pair(self, pair: int, what: str) -> InputError:
        """Return the error that names a pair of images."""
        i, j = self._pairs.pairs[pair]
        names = f"{self._model.names[i]} and {self._model.names[j]}"
        return InputError(f"{self.path}: the pair {names} has {what}; match the images again")


class _Keypoints(NamedTuple):
    """Those of an image."""

    number: int
    blind: BoolArray | None
    """(number,) which have no ray; None if all have one."""
