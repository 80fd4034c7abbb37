"""Inlier matches of a COLMAP database, read by sqlite3 without touching the file.

How the file is opened stands in `sqlite_file`, which pairs it has in `database_pairs`.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray, UInt32Array, UInt64Array, distinct, rows_taken
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.damage import Damage
from sfm_shapefit.files.colmap.database_pairs import (
    PairRows,
    check_schema,
    match_names,
    pair_table,
    read_pairs,
    refuse_no_features,
)
from sfm_shapefit.files.colmap.lenses import rays_of
from sfm_shapefit.files.colmap.sorted_matches import (
    MATCH_BYTES,
    MOST_MATCHES,
    SortedMatches,
    keypoints_of,
)
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, database_beside, is_blob
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.matches import Matches, Reading, View, batch_ranges

PIXEL_BYTES, MOST_KEYPOINTS = 8, 10_000_000
"""Bytes of a keypoint that is kept, and keypoints of a database up to which they are: a run looks at each a
dozen times."""

_HALF = np.uint64(32)  # bits of a keypoint; the number of a match holds two, see `sorted_matches`
_SURVEYED = 250_000  # matches that are looked at together; as many as are read together later


def find_database(model_folder: Path) -> Path | None:
    """Return the database in the model's folder, its parent or its grandparent, whichever comes first."""
    folder = Path(os.path.abspath(model_folder))
    return next(filter(None, map(database_beside, (folder, *folder.parents[:2]))), None)


def open_database(path: Path | str, names: Sequence[str], sound: "Sound | None" = None) -> "DatabaseMatches":
    """Open a COLMAP database for the matches between images of some names; see `DatabaseMatches`."""
    file = DatabaseFile(path)
    try:
        return DatabaseMatches(file, names, sound)
    except BaseException:
        file.close()
        raise


class Sound(NamedTuple):
    """What of a database can be used."""

    rows: PairRows
    broken: Mapping[str, IntArray]
    """Keypoints that are not finite, of the images that have some."""


class DatabaseMatches(Matches):
    """The matches of an open database.

    What was read is kept for all views, unless it is very much: the pixels of keypoints, and matches as their
    numbers.
    """

    def __init__(self, file: DatabaseFile, names: Sequence[str], sound: Sound | None = None) -> None:
        """Read which pairs the database has, and look at all that is to be read of it.

        Args:
            file: the database, which is closed with these; what is left aside as damaged is noted there.
            names: of the images, ascending.
            sound: what of it can be used, where that is known; then nothing is looked at.

        Raises:
            InputError: if it is no COLMAP database, has fewer than two of the images, or is too damaged; the
                first row that is damaged is named.
        """
        super().__init__()
        self.file, self.names, self.notes = file, tuple(names), file.notes
        check_schema(file)
        self._table = pair_table(file)
        index_of_id = match_names(file, names)
        self._ids = {self.names[index]: i for i, index in index_of_id.items() if index >= 0}
        self.missing_names = tuple(name for name in names if name not in self._ids)
        is_sound = "typeof(rows) = 'integer' AND rows BETWEEN 0 AND 2147483647"
        counts = dict(file.query(f"SELECT image_id, rows FROM keypoints WHERE {is_sound}"))
        self.num_keypoints = np.array([counts.get(self._ids.get(name), 0) for name in names], dtype=np.int64)
        self.total_keypoints = sum(counts.values())
        self._pixels: dict[str, npt.NDArray[np.float32]] = {}
        self._broken = {} if sound is None else {**sound.broken}
        self._num_wrong, self._first_wrong = 0, -1
        damage = Damage(file)
        rows = self._readable_pairs(index_of_id, damage) if sound is None else sound.rows
        self.rows, self.pairs, self.num_matches = rows, rows.pairs, rows.num_inliers
        is_kept = float(self.num_matches.sum(dtype=np.float64)) <= MOST_MATCHES
        self._sorted = SortedMatches(self.num_matches) if is_kept else None
        if sound is None:
            self._survey(damage)
            damage.tell()

    def _readable_pairs(self, index_of_id: dict[int, int], damage: Damage) -> PairRows:
        """Return the pairs of images whose keypoints can be read; others have none from now on."""
        rows = read_pairs(self.file, index_of_id, damage)
        if len(rows.pairs):
            refuse_no_features(self.file)
        query = (
            "SELECT image_id FROM keypoints WHERE typeof(rows) != 'integer' OR rows != 0 AND "
            "(rows < 0 OR cols NOT IN (2, 4, 6) OR typeof(data) != 'blob' OR length(data) != 4 * rows * cols)"
        )
        unreadable = {row[0] for row in self.file.query(query)}
        is_lost = np.array([self._ids.get(name, -1) in unreadable for name in self.names], dtype=np.bool_)
        self.num_keypoints[is_lost] = 0
        is_empty = self.num_keypoints == 0
        lost = np.flatnonzero(is_lost | (is_empty & np.isin(np.arange(len(self.names)), rows.pairs)))
        first = f"the keypoints of image {self.names[lost[0]]} are damaged" if len(lost) else ""
        damage.leave_aside(len(lost), len(self.names), "images", first)
        return rows_taken(rows, ~is_empty[rows.pairs].any(axis=1))

    def _survey(self, damage: Damage) -> None:
        """Look for keypoints that are not finite, and matches of those that do not exist; all is kept."""
        for image in np.flatnonzero(self.num_keypoints).tolist():
            self._stored_pixels(self.names[image])
        broken, first = sum(map(len, self._broken.values())), ""
        if broken:
            first = f"image {next(iter(self._broken))} has a keypoint that is not finite"
        damage.leave_aside(broken, int(self.num_keypoints.sum()), "keypoints", first)
        for begin, end in batch_ranges(self.num_matches, _SURVEYED):
            self.read(np.arange(begin, end), keep=True)
        if self._num_wrong:
            names = " and ".join(self.names[image] for image in self.pairs[self._first_wrong])
            first = f"the pair {names} has matches of keypoints that do not exist"
        damage.leave_aside(self._num_wrong, int(self.num_matches.sum()), "matches", first)

    def close(self) -> None:
        """Close the database."""
        self.file.close()

    def forget(self) -> None:
        """Give back the memory of the keypoints and matches that are kept."""
        self._pixels.clear()
        if self._sorted is not None:
            self._sorted.clear()

    def sizes_px(self) -> FloatArray:
        """Return the widths and heights (n, 2) in pixels of the images' cameras here; NaN if not known."""
        cameras = (
            "SELECT image_id, width, height FROM images JOIN cameras USING (camera_id) "
            "WHERE typeof(width) = 'integer' AND width > 0 AND typeof(height) = 'integer' AND height > 0"
        )
        sizes = {image_id: size for image_id, *size in self.file.query(cameras)}
        nothing = [np.nan, np.nan]
        return np.array(
            [sizes.get(self._ids.get(name, -1), nothing) for name in self.names], dtype=np.float64
        )

    def keypoints(self, name: str) -> FloatArray:
        """Return the pixels (k, 2) of the keypoints of an image; zeros for one that is not finite."""
        return self._stored_pixels(name).astype(np.float64)

    def _stored_pixels(self, name: str) -> npt.NDArray[np.float32]:
        """Return the same in the precision of the file; what is read is kept, unless it is very much."""
        if name in self._pixels:
            return self._pixels[name]
        pixels = self._read_keypoints(name)
        if self.total_keypoints <= MOST_KEYPOINTS:
            self._pixels[name] = pixels
        return pixels

    def _read_keypoints(self, name: str) -> npt.NDArray[np.float32]:
        query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
        found = self.file.query(query, self._ids[name]) if name in self._ids else []
        rows, cols, data = found[0] if found else (0, 0, b"")
        if cols not in (2, 4, 6) or not is_blob(data, rows, cols, itemsize=4):
            return np.zeros((0, 2), dtype=np.float32)  # what is damaged was told when the file was opened
        xy = np.frombuffer(data, dtype="<f4").reshape(rows, cols)[:, :2].astype(np.float32)
        if not np.isfinite(xy).all():  # which takes a tenth of the time of a look at each keypoint
            is_finite = np.isfinite(xy).all(axis=1)
            self._broken[name] = np.flatnonzero(~is_finite)
            xy[~is_finite] = 0.0
        return xy

    def rays(self, lens: Lens, pixels: FloatArray) -> FloatArray:
        """Return the unit rays (k, 3) of pixels (k, 2) in camera axes; NaN for those without."""
        return rays_of(lens, pixels)

    def read(self, pairs: IntArray, *, keep: bool) -> tuple[IntArray, UInt32Array]:
        """Return the matches of pairs, from the file only if they were not read, or not to be kept."""
        if keep and self._sorted is not None:
            counts, numbers = self._sorted.read(pairs, self._numbers)
        else:
            counts, numbers = self._numbers(pairs)
        return counts, keypoints_of(numbers)

    def _numbers(self, chosen: IntArray) -> tuple[IntArray, UInt64Array]:
        """Return the matches of pairs (k,) from the file as numbers, of each pair ascending and each once.

        Sums over matches then do not depend on the order in which the database lists them. Many pairs are
        read together, since a pair has few matches, and a call of numpy takes as long as a hundred of them.
        """
        counts, swapped = self.num_matches[chosen], self.rows.swapped[chosen]
        stored = np.frombuffer(self._stored_matches(chosen), dtype="<u8")
        numbers = stored << _HALF
        numbers |= stored >> _HALF
        if swapped.any():
            numbers = np.where(np.repeat(swapped, counts), stored, numbers)
        begins = np.cumsum(counts) - counts
        ascends = numbers[1:] > numbers[:-1]
        ascends[begins[1:] - 1] = True
        if not ascends.all():
            counts, numbers = _ascending(numbers, counts, 1 + np.flatnonzero(~ascends))
            begins = np.cumsum(counts) - counts
        firsts, seconds = numbers[begins + counts - 1] >> _HALF, keypoints_of(numbers)[:, 1]
        last = np.stack([firsts, np.maximum.reduceat(seconds, begins)], axis=1)
        if self._broken or (last >= self.num_keypoints[self.pairs[chosen]]).any():
            return self._without_lost(chosen, counts, numbers)
        return counts, numbers

    def _without_lost(
        self, chosen: IntArray, counts: IntArray, numbers: UInt64Array
    ) -> tuple[IntArray, UInt64Array]:
        """Return matches of pairs without those of keypoints that do not exist or are not finite."""
        of_pair, matches = np.repeat(np.arange(len(chosen)), counts), keypoints_of(numbers)
        ends = self.pairs[chosen][of_pair]
        is_lost = (matches >= self.num_keypoints[ends]).any(axis=1)
        if is_lost.any():
            self._num_wrong += int(is_lost.sum())
            self._first_wrong = (
                int(chosen[of_pair[is_lost][0]]) if self._first_wrong < 0 else self._first_wrong
            )
        for image in map(self.names.index, self._broken):
            is_lost |= ((ends == image) & np.isin(matches, self._broken[self.names[image]])).any(axis=1)
        return np.bincount(of_pair[~is_lost], minlength=len(chosen)), numbers[~is_lost]

    def _stored_matches(self, chosen: IntArray) -> bytes:
        """Return the matches of pairs as the file lists them, one pair after the other."""
        blobs = self.file.look_up(self._table, "data", self.rows.rowids[chosen].tolist())
        sizes = [len(data) if isinstance(data, bytes) else -1 for data in blobs]
        wrong = np.flatnonzero(sizes != MATCH_BYTES * self.num_matches[chosen])
        if len(wrong):
            names = " and ".join(self.names[image] for image in self.pairs[chosen[wrong[0]]])
            what = "has matches of wrong length; match the images again"
            raise InputError(f"{self.file.path}: the pair {names} {what}")
        return b"".join(blobs)

    def parts(self, view: View, ranges: Sequence[slice]) -> "list[DatabasePart]":
        """Return ranges of a view's pairs for other processes."""
        path = Path(os.path.abspath(self.file.path))
        return [
            DatabasePart(
                path=path,
                sound=Sound(
                    rows_taken(self.rows, view.rows[part])._replace(pairs=view.pairs[part]), self._broken
                ),
            )
            for part in ranges
        ]


def _ascending(numbers: UInt64Array, counts: IntArray, steps: IntArray) -> tuple[IntArray, UInt64Array]:
    """Return how many matches of each pair (k,) are left, and these, ascending and each once.

    Args:
        numbers: (M,) of all pairs, which are sorted in place.
        counts: (k,) how many each pair has.
        steps: numbers that are not larger than the one before, which is of the same pair.
    """
    of_pair, ends = np.repeat(np.arange(len(counts)), counts), np.cumsum(counts)
    for pair in distinct(of_pair[steps]).tolist():
        numbers[ends[pair] - counts[pair] : ends[pair]].sort()
    is_new = np.ones(len(numbers), dtype=np.bool_)
    is_new[1:] = (numbers[1:] != numbers[:-1]) | (of_pair[1:] != of_pair[:-1])
    return np.bincount(of_pair[is_new], minlength=len(counts)), numbers[is_new]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DatabasePart:
    """Some pairs of a view, and where they are to be read elsewhere: see `MatchPart`."""

    path: Path
    """Absolute path of the database; it must be the same for all workers."""
    sound: Sound
    """Where in it the pairs are: to find that out anew takes longer, the more pairs the database has."""

    @property
    def num_pairs(self) -> int:
        """Number of pairs."""
        return len(self.sound.rows.pairs)

    @contextmanager
    def open(self, images: Images) -> Iterator[View]:
        """Open the database again, for the images of the view and these pairs, nothing of which is kept."""
        with closing(open_database(self.path, images.names, self.sound)) as matches:
            yield matches.at(images, reading=Reading(keeps=False))
