"""Damaged rows of a database: a few are left aside, which is told; with more the database is refused."""

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile

_MOST = 0.01  # share of the rows of a kind that may be damaged; a file with more is wrong elsewhere too


class Damage:
    """What of a database is left aside as damaged."""

    def __init__(self, file: DatabaseFile) -> None:
        self._file, self._left = file, list[str]()

    def leave_aside(self, count: int, total: int, what: str, first: str) -> None:
        """Leave aside `count` of `total` things, called `what`; `first` names one and says what is wrong.

        Raises:
            InputError: if more than one in a hundred is damaged, and more than one.
        """
        if count > max(1.0, _MOST * total):
            raise InputError(
                f"{self._file.path}: {first}; {count} of {total} {what} ({count / total:.0%}) are damaged, "
                "which is too much to leave aside; extract features and match again"
            )
        if count:
            self._left.append(f"{count} of {total} {what} ({first})")

    def tell(self) -> None:
        """Add the sentence that says what was left aside to the notes of the file, once."""
        sentence = f"{self._file.path} is damaged; left aside: {'; '.join(self._left)}"
        if self._left and sentence not in self._file.notes:
            self._file.notes.append(sentence)
