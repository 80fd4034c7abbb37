"""What is told of scale bars: a row for each, warnings, and one sentence on all."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.place_errors import Distances, ScaleErrors, draws_at, errors_of_points
from sfm_shapefit.adjustment.scale_bars import MOST_SIGMAS, BarFit, pooled_noise
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, rounded
from sfm_shapefit.facts.control_points import said_use
from sfm_shapefit.files.colmap.marks import look_at_marks
from sfm_shapefit.placement.control_points import TriangulatedMarks, triangulate_marks
from sfm_shapefit.scene.given import ScaleBars
from sfm_shapefit.scene.images import Images
from sfm_shapefit.tracks.structure_options import StructureOptions


class ScaleBar(Record):
    """A known length between two points."""

    name: Annotated[str, "Name in the file."]
    use: Annotated[
        Literal["control", "check", "unused"],
        "Whether it sets the scale, only checks the model, or contradicts the others or has no place.",
    ]
    known: Annotated[float, "Its length, in the output's units."]
    known_sigma: Annotated[float, "Standard deviation of that."]
    found: Annotated[float | None, "Length in the model; null if it has none."]
    found_sigma: Annotated[
        float | None, "Standard deviation of that, errors of the scale included as far as they are known."
    ]
    error: Annotated[float | None, "Length in the model minus the known one."]
    error_sigmas: Annotated[
        float | None,
        "The error in standard deviations of the difference; of a bar that sets the scale, from what the "
        "other bars make it; null where there is nothing to compare with.",
    ]
    error_px: Annotated[float | None, "Mean distance of its marks from the ends in the model, in pixels."]
    num_marks: Annotated[int, "Marks in images of the model."]
    num_agreeing_marks: Annotated[int, "Those in placed images that agree."]

    @property
    def cells(self) -> list[str]:
        """Name, use, known and found length, error, the same in sigmas, pixels and marks, as in a table."""
        found = "" if self.found is None else rounded(self.found, digits=6)
        return [
            self.name,
            said_use(self.use, found=self.found is not None),
            f"{rounded(self.known, digits=6)} ± {self.known_sigma:.2g}",
            f"{found} ± {self.found_sigma:.2g}" if self.found_sigma is not None else found,
            "" if self.error is None else f"{self.error:+.3g}",
            "" if self.error_sigmas is None else f"{self.error_sigmas:+.1f}",
            "" if self.error_px is None else f"{self.error_px:.2g}",
            f"{self.num_agreeing_marks} of {self.num_marks}",
        ]

    @property
    def line(self) -> str:
        """The same in words."""
        name, use, known, found, error, sigmas, _, marks = self.cells
        if not found:
            return f"{name}: known {known}, not found; {marks} marks agree"
        off = f"{error} ({sigmas} sigmas)" if sigmas else error
        return f"{name}: known {known}, found {found}, off by {off}; {use}{' bar' * (self.use == 'check')}"


class MeasuredBars(NamedTuple):
    """Scale bars as a model has them."""

    known: ScaleBars
    marks: TriangulatedMarks
    found: Distances
    """In the output's units, with the errors of its scale."""
    fit: BarFit | None = None
    """What set the scale; None if it is not theirs."""

    def in_scale_of(self, fit: BarFit) -> "MeasuredBars":
        """Return the bars of a model that was brought to the scale that they give it."""
        return self._replace(found=self.found.in_scale(fit.errors, fit.scale), fit=fit)

    def rows(self) -> tuple[ScaleBar, ...]:
        """Return the row of each bar that has a mark in the model."""
        sigmas = np.hypot(self.found.sigmas, self.known.sigmas)
        scores = (self.found.lengths - self.known.lengths) / sigmas
        return tuple(self._row(k, float(scores[k])) for k in np.flatnonzero(self.known.are_seen).tolist())

    def _row(self, k: int, score: float) -> ScaleBar:
        known, marks = self.known, self.marks
        own = known.points // 2 == k
        sets = self.fit is not None and bool(self.fit.used[k])
        compared = self.fit is not None and not known.is_check[k]
        found, errors = float(self.found.lengths[k]) or np.nan, marks.errors_px[own & marks.agreeing]
        unused = not np.isfinite(found) or (compared and not sets)
        return ScaleBar(
            name=known.bars[k],
            use="unused" if unused else "control" if sets else "check",
            known=float(known.lengths[k]),
            known_sigma=float(known.sigmas[k]),
            found=found,
            found_sigma=float(self.found.sigmas[k]),
            error=found - float(known.lengths[k]),
            error_sigmas=float(self.fit.scores[k]) if self.fit is not None and compared else score,
            error_px=float(np.mean(errors)) if len(errors) else None,
            num_marks=int(own.sum()),
            num_agreeing_marks=int(np.sum(own & marks.agreeing)),
        )

    def warnings(self) -> Iterator[str]:
        """Yield what is wrong with bars or their marks, a sentence each."""
        place_of = dict(zip(self.known.bars, self.known.places, strict=True))
        rows = self.rows()
        lost = [row for row in rows if row.found is None]
        if lost:
            first = lost[0].name
            yield (
                f"{place_of[first]}: {first}{_more(lost)} of no use: an end lacks agreeing marks in two "
                "placed images that see it from far enough apart, or both are one point; mark it in others"
            )
        off = [row for row in rows if row.found is not None and abs(row.error_sigmas or 0.0) > MOST_SIGMAS]
        off = [row for row in off if self.fit is None or row.use != "control" or self.fit.contradict]
        if off:
            worst = max(off, key=lambda row: abs(row.error_sigmas or 0.0))
            error, sigmas = worst.error or 0.0, abs(worst.error_sigmas or 0.0)
            whom = {"control": "one another", "unused": "the others", "check": "the model"}[worst.use]
            who = f"{counted(len(off), 'scale bar')} contradict{'s' * (len(off) == 1)} {whom}"
            by = f"{abs(error):.3g} {'longer' if error > 0.0 else 'shorter'}"
            yield (
                f"{place_of[worst.name]}: {who}: the model makes {worst.name} {by} than it is told to be, "
                f"{sigmas:.0f} standard deviations; check its length and its marks"
            )


def _more(rows: Sequence[ScaleBar]) -> str:
    return " is" if len(rows) == 1 else f" and {counted(len(rows) - 1, 'other scale bar')} are"


def describe_scale_bars(rows: Sequence[ScaleBar]) -> str:
    """Say how far control bars and check bars are off; empty where there are none."""
    parts = []
    for use, noun in (("control", "control bar"), ("check", "check bar")):
        own = [row for row in rows if row.use == use and row.error is not None]
        if own:
            worst = max(own, key=lambda row: abs(row.error or 0.0))
            typical = float(np.sqrt(np.mean([(row.error or 0.0) ** 2 for row in own])))
            most = f", {worst.name} most, by {worst.error:.3g}" if len(own) > 1 else f" ({worst.name})"
            parts.append(f"{counted(len(own), noun)} off by {typical:.3g} (root mean square){most}")
    unused = sum(row.use == "unused" for row in rows)
    return "; ".join(parts + [f"{unused} not used"] * (unused > 0))


def measure_bars(
    images: Images, known: ScaleBars, estimate: Estimate | None, options: StructureOptions
) -> MeasuredBars:
    """Return scale bars as images have them where they stand, by what is known of the errors of these."""
    marks = triangulate_marks(known, look_at_marks(images, known), options)
    rows = np.flatnonzero(images.is_posed)
    posed, used = images.part(rows), marks.agreeing
    seen = known.points[used], np.searchsorted(rows, known.images[used])
    noise_px = np.nan if estimate is None else estimate.noise_px
    noise_px = pooled_noise(marks.errors_px[used], seen[0], noise_px)
    ends = errors_of_points(posed, draws_at(estimate, posed), marks.positions, seen, noise_px)
    return MeasuredBars(known, marks, ends.apart(known.ends))


def compare_bars(
    images: Images, known: ScaleBars, estimate: Estimate | None, scale_sigma: float | None
) -> MeasuredBars:
    """Return scale bars that only check a model, whose scale has an error, as far as that is known."""
    found = measure_bars(images, known, estimate, StructureOptions())
    count = found.found.draws.shape[2]
    return found._replace(found=found.found.in_scale(ScaleErrors(np.zeros(count), scale_sigma or 0.0)))
