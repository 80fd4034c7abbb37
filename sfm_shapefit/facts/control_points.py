"""What is told of ground control points: a row for each, warnings, and one sentence on all."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.geometry import Alignment
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, in_unit
from sfm_shapefit.placement.control_points import ControlFit, TriangulatedMarks
from sfm_shapefit.scene.given import ControlPoints


class ControlPoint(Record):
    """A ground control point, and where the model has it."""

    name: Annotated[str, "Name in the file, or else its coordinates."]
    use: Annotated[
        Literal["control", "check", "unused"],
        "Whether it sets scale and axes, only checks the model, or contradicts the others or has no place.",
    ]
    known: Annotated[list[float], "Where it is, in the output's axes."]
    residual: Annotated[list[float] | None, "The model's position minus the known one; null if it has none."]
    error: Annotated[float | None, "Length of the residual."]
    error_px: Annotated[float | None, "Mean distance of its marks from the point in the model, in pixels."]
    num_marks: Annotated[int, "Images of the model in which it is marked."]
    num_agreeing_marks: Annotated[int, "Placed images among these whose marks agree."]

    @property
    def cells(self) -> list[str]:
        """Name, use, error and its axes, pixels and marks, as the report has them in a row."""
        return [
            self.name,
            said_use(self.use, found=self.error is not None),
            "" if self.error is None else f"{self.error:.3g}",
            ", ".join(f"{value:.3g}" for value in self.residual or ()),
            "" if self.error_px is None else f"{self.error_px:.2g}",
            f"{self.num_agreeing_marks} of {self.num_marks}",
        ]


class ControlComparison(Record):
    """How a finished model compares with control points and check points."""

    statement: Annotated[str, "What was compared, and after which alignment."]
    points_from_model: Annotated[Alignment | None, "Null if the model is compared as it stands."]
    control_rms: Annotated[float | None, "Root mean square of the errors of control points; null if none."]
    check_rms: Annotated[float | None, "The same of check points."]
    points: Annotated[tuple[ControlPoint, ...], "All points with a mark in the model."]


def said_use(use: str, *, found: bool) -> str:
    """Say what a known point or length is used for, and why it is not, given whether the model has it."""
    return use if use != "unused" else "not used: contradicts the others" if found else "not used: no place"


def control_columns(points: Sequence[ControlPoint]) -> dict[str, npt.NDArray[Any]]:
    """Return the points as columns by the names of locate.json, a column per axis; NaN where unknown."""
    nowhere = [np.nan] * 3
    known = np.array([point.known for point in points], np.float64).reshape(-1, 3).T
    residual = np.array([point.residual or nowhere for point in points], np.float64).reshape(-1, 3).T
    return {
        "name": np.array([point.name for point in points], object),
        "use": np.array([point.use for point in points], object),
        **dict(zip(("known_x", "known_y", "known_z"), known, strict=True)),
        **dict(zip(("residual_x", "residual_y", "residual_z"), residual, strict=True)),
        "error": np.array([point.error for point in points], np.float64),
        "error_px": np.array([point.error_px for point in points], np.float64),
        "num_marks": np.array([point.num_marks for point in points], np.int64),
        "num_agreeing_marks": np.array([point.num_agreeing_marks for point in points], np.int64),
    }


def control_rows(known: ControlPoints, found: TriangulatedMarks, fit: ControlFit | str) -> list[ControlPoint]:
    """Return the row of each point in locate.json."""
    fitted = fit if isinstance(fit, ControlFit) else None
    rows = []
    for k, name in enumerate(known.names):
        own = known.points == k
        residual = np.full(3, np.nan) if fitted is None else fitted.residuals[k]
        there = bool(np.isfinite(residual).all())
        errors = found.errors_px[own & found.agreeing]
        sets = fitted is not None and bool(fitted.fitting[k])
        rows.append(
            ControlPoint(
                name=name,
                use="check" if known.is_check[k] else "control" if sets else "unused",
                known=known.positions[k].tolist(),
                residual=residual.tolist() if there else None,
                error=float(np.linalg.norm(residual)) if there else None,
                error_px=float(np.mean(errors)) if len(errors) else None,
                num_marks=int(own.sum()),
                num_agreeing_marks=int(np.sum(own & found.agreeing)),
            )
        )
    return rows


def control_warnings(
    known: ControlPoints, found: TriangulatedMarks, fit: ControlFit | str, names: Sequence[str]
) -> Iterator[str]:
    """Yield what is wrong with the points or their marks, a sentence each; `names` are of the images."""
    if isinstance(fit, str):
        yield f"{fit}: the model is not in the axes of the control points"
    else:
        there = np.isfinite(fit.residuals[:, 0])
        errors = np.where(there & ~known.is_check & ~fit.fitting, np.linalg.norm(fit.residuals, axis=1), 0.0)
        if errors.any():
            worst, count = int(np.argmax(errors)), int(np.sum(errors > 0.0))
            off = in_unit(float(errors[worst]), "m" if known.datum else "")
            say, are, most = ("contradicts", "is", "") if count == 1 else ("contradict", "are", " most")
            yield (
                f"{counted(count, 'control point')} {say} the others and {are} not used: "
                f"{known.names[worst]}{most}, off by {off}; check coordinates and marks"
            )
        lost = np.flatnonzero(~there)
        if len(lost):
            yield (
                f"{len(lost)} of the control points cannot be triangulated, {known.names[lost[0]]} for one: "
                "they need agreeing marks in two placed images"
            )
    missing = np.where(found.agreeing | np.isnan(found.errors_px), 0.0, found.errors_px)
    if missing.any():
        worst = int(np.argmax(missing))
        yield (
            f"{counted(int(np.sum(missing > 0.0)), 'mark')} of control points miss where the others put the "
            f"point, that of {known.names[known.points[worst]]} in {names[known.images[worst]]} most, by "
            f"{missing[worst]:.0f} px"
        )


def describe_control_points(rows: Sequence[ControlPoint], unit: str) -> str:
    """Say how far the model is off control points and check points; empty where there are none.

    The unit is "m", or empty where it is not known.
    """
    parts = []
    for use, noun in (("control", "control point"), ("check", "check point")):
        own = [row for row in rows if row.use == use and row.error is not None]
        if own:
            worst = max(own, key=lambda row: row.error or 0.0)
            typical, most = (in_unit(error or 0.0, unit) for error in (rms_of(rows, use), worst.error))
            off = f"off by {typical} in space (root mean square), {worst.name} most, by {most}"
            parts.append(f"{counted(len(own), noun)} {off}")
    unused = sum(row.use == "unused" for row in rows)
    if unused:
        parts.append(f"{unused} not used")
    return "; ".join(parts)


def rms_of(rows: Sequence[ControlPoint], use: str) -> float | None:
    """Return the root mean square of the errors of the points of one use; None if there are none."""
    errors = [row.error for row in rows if row.use == use and row.error is not None]
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None
