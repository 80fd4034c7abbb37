"""Rows that would take the most memory: in a temporary file, in fewer bits, or looked up and not copied."""

import tempfile
import threading
import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import AnyArray
from sfm_shapefit.base.errors import InputError


class RowFile:
    """Rows (m, ...) of one type of number that are written in their order, read by slices, and written over.

    The file goes with the object.
    """

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        """Begin without a row; `shape` is that of an array with room for all, as of `numpy.empty`."""
        self.dtype, self._shape, self._length = np.dtype(dtype), shape[1:], 0
        try:
            self._file = tempfile.TemporaryFile(buffering=0, prefix="shapefit-")  # noqa: SIM115  closed below
        except OSError as error:
            raise InputError(f"no folder for temporary files can be written ({error}); set TMPDIR") from error
        self._one_at_a_time = threading.Lock()  # who seeks and who reads
        weakref.finalize(self, self._file.close)
        self._row_bytes = self.dtype.itemsize * int(np.prod(self._shape))

    def __len__(self) -> int:
        """Return the number of rows that were written."""
        return self._length

    def __getitem__(self, rows: slice) -> npt.NDArray[Any]:
        """Return the rows of a slice of step 1."""
        first, end, _ = rows.indices(self._length)
        found = np.empty((max(end - first, 0), *self._shape), self.dtype)
        room = found.data.cast("B") if len(found) else memoryview(b"")
        with self._one_at_a_time:
            self._file.seek(first * self._row_bytes)
            while len(room):  # a system call may read less, and write less
                room = room[self._file.readinto(room) :]
        return found

    def __setitem__(self, rows: slice, values: AnyArray) -> None:
        """Write rows from the beginning of a slice on, which has as many.

        Raises:
            InputError: if the folder of temporary files is full.
        """
        try:
            left = np.ascontiguousarray(values, dtype=self.dtype).tobytes()
            with self._one_at_a_time:
                self._file.seek(rows.start * self._row_bytes)
                while left:
                    left = left[self._file.write(left) :]
                self._length = max(self._length, rows.start + len(values))
        except OSError as error:
            raise InputError(
                f"{tempfile.gettempdir()} has no room for {self._row_bytes * rows.stop / 1e6:.0f} MB of "
                f"matches ({error.strerror}); set TMPDIR to a folder that has"
            ) from error


AnyRows = npt.NDArray[Any] | RowFile
"""Rows that slices of step 1 read and write."""


def make_room(shape: tuple[int, ...], dtype: npt.DTypeLike, *, in_file: bool) -> AnyRows:
    """Return room for rows, in a file or in memory, which is taken as they are written."""
    return RowFile(shape, dtype) if in_file else np.empty(shape, dtype)


class Widened:
    """Numbers of 32 bits, or of 64 already, which have 64 where they are looked at."""

    __slots__ = ("_stored",)

    def __init__(self, stored: npt.NDArray[np.floating[Any]]) -> None:
        """Take an array of them."""
        self._stored = stored

    def __getitem__(self, chosen: Any) -> npt.NDArray[np.float64]:
        """Return what a slice, a mask or numbers choose."""
        return np.asarray(self._stored[chosen], dtype=np.float64)


class Gathered:
    """Rows of an array, as if they were one array; they are copied where they are looked at."""

    __slots__ = ("_rows", "_source")

    def __init__(self, source: npt.NDArray[Any], rows: npt.NDArray[np.integer[Any]]) -> None:
        """Take an array and the rows (m,) of it."""
        self._source, self._rows = source, rows

    def __len__(self) -> int:
        """Return m."""
        return len(self._rows)

    def __getitem__(self, chosen: Any) -> Any:
        """Return those of the m rows that a number, a slice, a mask or numbers choose."""
        return self._source[self._rows[chosen]]
