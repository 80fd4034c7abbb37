"""Intrinsics that were in doubt: which and why, how they changed, and how sure that is."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, quantile
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import first_of, label_lens
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import ADJUSTED_ELSEWHERE, Lens, Origin

_NAMED = 3  # cameras; more in doubt are told together, as a list of them is not read
_LOOSE = 0.01  # relative sigma of a focal length; more of its distance is more than most cameras are off
_UNCHANGED = 1e-12  # relative change of a parameter; less is rounding

_FOUND = ("adjusted", "view graph")

How = Literal["adjusted", "view graph", "undetermined", "held"]


class CameraIntrinsics(Record):
    """A camera whose intrinsics were in doubt, and what became of them."""

    camera: Annotated[int, "Its id in the model."]
    image: Annotated[str, "The first of the placed images that it took."]
    num_images: Annotated[int, "Placed images that it took."]
    model: Annotated[str, "COLMAP's name of its model."]
    origin: Annotated[str, "Origin of the given parameters: a guess, EXIF data, or a calibration."]
    decided_by: Annotated[
        How,
        "What decided about its focal length: the adjustments; pairs of images alone; nothing, as "
        "the matches leave it undetermined, so that it stays as given and only the distortion may change; "
        "or the options, which hold it, or its model, whose intrinsics are not adjusted here.",
    ]
    given_focal_px: Annotated[float, "Mean focal length as given."]
    focal_px: Annotated[float, "Mean focal length of the output."]
    focal_sigma_px: Annotated[float | None, "Its standard deviation by the noise alone; null if not known."]
    given_parameters: Annotated[list[float], "All parameters as given, in COLMAP's order."]
    parameters: Annotated[list[float], "All parameters of the output."]

    @property
    def statement(self) -> str:
        """What the camera was given, what it has, and why."""
        head = f"{self.label}: focal length {self.given_focal_px:,.1f} px ({self.origin})"
        if self.decided_by == "undetermined":
            return f"{head} kept, as the matches do not determine it{self._distortion()}"
        if self.decided_by == "held":
            return f"{head} kept"
        by = "by the view graph" if self.decided_by == "view graph" else "by adjustment"
        doubt = "" if self.focal_sigma_px is None else f" ± {self.focal_sigma_px:,.1f}"
        return f"{head} became {self.focal_px:,.1f}{doubt} px ({self.change:+.1%}) {by}{self._distortion()}"

    @property
    def label(self) -> str:
        """Its id, and the images by which a user knows it."""
        return label_lens(self.camera, self.image, self.num_images)

    @property
    def cells(self) -> list[str]:
        """The same as the report has it in a row; lengths in pixels."""
        doubt = "" if self.focal_sigma_px is None else f" ± {self.focal_sigma_px:,.1f}"
        found, change = f"{self.focal_px:,.1f}{doubt}", f"{self.change:+.1%}"
        if self.decided_by == "held" or self.change == 0.0:
            found, change = "kept", ""
        distortion = self._distortion().removeprefix(", distortion ")
        given = f"{self.given_focal_px:,.1f} ({self.origin})"
        return [str(self.camera), self.model, str(self.num_images), given, found, change, distortion]

    @property
    def change(self) -> float:
        """Growth of the focal length as a share of the given one."""
        return self.focal_px / self.given_focal_px - 1.0

    def _distortion(self) -> str:
        before, after = np.array(self.given_parameters), np.array(self.parameters)
        is_distortion = np.abs(after) < 10.0  # lengths in pixels are larger
        changed = is_distortion & (np.abs(after - before) > _UNCHANGED)
        if not changed.any():
            return ""
        return ", distortion " + ", ".join(f"{value:.4f}" for value in after[is_distortion])


@dataclass(frozen=True, slots=True, eq=False)
class RefinedIntrinsics:
    """What may still change of lenses in doubt, and what became of them so far; arrays over lenses."""

    parts: BoolArray
    """(l, p) which `PARTS` of each lens adjustments may change."""
    by_view_graph: BoolArray
    """(l,) lenses whose focal length the view graph has changed before anything was adjusted."""
    focal_sigmas: FloatArray
    """(l,) standard deviations of adjusted focal lengths, as shares of them; NaN if none was adjusted."""
    undetermined: BoolArray
    """(l,) lenses whose focal length an adjustment has left open."""

    def part(self, lenses: IntArray) -> "RefinedIntrinsics":
        """Return those of some lenses."""
        return RefinedIntrinsics(*(getattr(self, one.name)[lenses] for one in fields(self)))

    def after(self, estimate: Estimate, lenses: IntArray) -> "RefinedIntrinsics":
        """Return the same after an adjustment of some lenses, by their rows; what it left open is held."""
        parts, sigmas, undetermined = self.parts.copy(), self.focal_sigmas.copy(), self.undetermined.copy()
        parts[lenses] = estimate.freedom.parts
        undetermined[lenses] |= estimate.undetermined
        sigmas[lenses] = np.where(estimate.is_tried, estimate.focal_sigmas, sigmas[lenses])
        return RefinedIntrinsics(parts, self.by_view_graph, sigmas, undetermined)

    def how(self, lens: int) -> How:
        """Return what decided about the focal length of a lens at last."""
        if self.undetermined[lens]:
            return "undetermined"
        if not np.isnan(self.focal_sigmas[lens]):
            return "adjusted"
        return "view graph" if self.by_view_graph[lens] else "held"

    def rows(self, images: Images) -> list[CameraIntrinsics]:
        """Return a row for each lens that took placed images and was in doubt."""
        posed = np.flatnonzero(images.is_posed)
        counts = np.bincount(images.lens_of[posed], minlength=len(images.lenses)).tolist()
        rows = []
        for k, lens in enumerate(images.lenses):
            if lens.origin is None or not counts[k]:
                continue
            how, given = self.how(k), lens.as_given()
            sigma_px = float(self.focal_sigmas[k]) * lens.focal_px
            rows.append(
                CameraIntrinsics(
                    camera=lens.id,
                    image=images.names[int(posed[np.argmax(images.lens_of[posed] == k)])],
                    num_images=counts[k],
                    model=lens.model,
                    origin=lens.origin.value,
                    decided_by=how,
                    given_focal_px=given.focal_px,
                    focal_px=lens.focal_px,
                    focal_sigma_px=sigma_px if how == "adjusted" and np.isfinite(sigma_px) else None,
                    given_parameters=list(given.parameters),
                    parameters=list(lens.parameters),
                )
            )
        return rows


def intrinsics_in_doubt(parts: BoolArray, by_view_graph: BoolArray) -> RefinedIntrinsics:
    """Return what adjustments may change of lenses, their `PARTS` (l, p), before any of them."""
    unknown, nothing = np.full(len(parts), np.nan), np.zeros(len(parts), dtype=np.bool_)
    return RefinedIntrinsics(parts, by_view_graph, unknown, nothing)


def describe_intrinsics(rows: Sequence[CameraIntrinsics]) -> list[str]:
    """Return a sentence for each camera in doubt, most images first; of many, one for all."""
    if len(rows) <= _NAMED:
        return [row.statement for row in sorted(rows, key=lambda row: (-row.num_images, row.camera))]
    found = [row for row in rows if row.decided_by in _FOUND]
    changes = [row.change for row in found]
    unknown = sum(row.decided_by == "undetermined" for row in rows)
    held = len(rows) - len(changes) - unknown
    parts = [f"the focal lengths of {len(changes)} of {len(rows)} cameras in doubt changed"]
    if changes:
        low, middle, high = (quantile(np.array(changes), share) for share in (0.0, 0.5, 1.0))
        parts = [
            f"{parts[0]} by {low:+.1%} to {high:+.1%} (median {middle:+.1%}), "
            f"most that of {max(found, key=lambda row: abs(row.change)).label}"
        ]
    parts += [f"{unknown} kept the given one, as the matches do not determine it"] if unknown else []
    parts += [f"{held} were not to be changed"] if held else []
    return ["; ".join(parts) + "; locate.json has each"]


def _why(row: CameraIntrinsics) -> str:
    """Return what decided about a camera, told apart where it is held because of its model."""
    is_other = row.decided_by == "held" and not Lens(row.model, ()).is_adjustable
    return "other model" if is_other else row.decided_by


def intrinsics_warnings(rows: Sequence[CameraIntrinsics]) -> Iterator[str]:
    """Yield which cameras keep a focal length that was never measured, or have one that is hardly known."""
    guessed = [row for row in rows if row.origin != Origin.CALIBRATION.value]
    for how, what in (
        (
            "undetermined",
            "which the matches do not determine: the scene is flat, or the camera hardly turns and shifts",
        ),
        ("held", "as intrinsics=held or adjust=none says, or as cameras are too many to be adjusted"),
        ("other model", f"as {ADJUSTED_ELSEWHERE}"),
    ):
        cameras = [row.label for row in guessed if _why(row) == how]
        if cameras:
            yield (
                f"{first_of(cameras)} kept a focal length that was never measured, "
                f"{what}; calibrate if the result is poor"
            )
    adjusted = (row for row in guessed if row.decided_by == "adjusted")
    loose = [row.label for row in adjusted if not (row.focal_sigma_px or np.inf) <= _LOOSE * row.focal_px]
    if loose:
        yield (
            f"the matches hardly determine the focal length of {first_of(loose)} (± {_LOOSE:.0%} or more), "
            "so cameras may be too near to what they see, or too far from it; calibrate if that matters"
        )
