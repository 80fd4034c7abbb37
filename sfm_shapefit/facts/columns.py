"""The rows of a result as columns, which pandas takes: `pandas.DataFrame(found.table("cameras"))`."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from sfm_shapefit.facts.tables import CameraRow, PairRow, columns_of_field

TableName = Literal["cameras", "pairs"]
Column = npt.NDArray[Any]


class HasRows(Protocol):
    """A result with a row per camera and a row per pair."""

    @property
    def cameras(self) -> list[CameraRow]:
        """One row per camera."""

    @property
    def pairs(self) -> list[PairRow]:
        """One row per pair."""


def table_of(found: HasRows, name: TableName, dimension: int) -> dict[str, Column]:
    """Return the cameras or the pairs of a result as columns.

    Raises:
        ValueError: if there is no table of this name.
    """
    if name == "cameras":
        return columns_of(found.cameras, CameraRow, dimension)
    if name == "pairs":
        return columns_of(found.pairs, PairRow, dimension)
    raise ValueError(f"there is no table {name!r}; there are 'cameras' and 'pairs'")


def columns_of(
    rows: Sequence[CameraRow] | Sequence[PairRow], row_type: type[CameraRow] | type[PairRow], dimension: int
) -> dict[str, Column]:
    """Return an array for each column of cameras.csv or pairs.csv, by its name there.

    Args:
        rows: n rows of one type.
        row_type: their type, also if there are none.
        dimension: of the locations; a vector has so many columns, correlations one per two axes.

    Returns:
        n values each: numbers are float64, or int64 and bool where none can be missing, NaN where there is
        none; texts are objects.
    """
    found: dict[str, Column] = {}
    for item in fields(row_type):
        values = [getattr(row, item.name) for row in rows]
        names = columns_of_field(item.name, dimension)
        if names != [item.name]:
            nothing = (math.nan,) * len(names)
            whole = np.array([value or nothing for value in values], dtype=np.float64)
            whole = whole.reshape(-1, len(names))
            found |= {name: whole[:, k] for k, name in enumerate(names)}
        else:
            found[item.name] = _column(values, item.type)
    return found


def _column(values: list[Any], kind: Any) -> Column:
    """Return values of a field's type as an array."""
    if kind is str:
        return np.array(values, dtype=object)
    if kind in (bool, int):
        return np.array(values, dtype=np.bool_ if kind is bool else np.int64)
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)
