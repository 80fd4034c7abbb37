"""What became of intrinsics that were in doubt: which, why, how they changed, and how sure that is."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np

from sfm_shapefit.adjustment.estimate import UNREFINED, RefinedLenses
from sfm_shapefit.adjustment.free_lenses import ALL_HELD, FreeLenses
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.files.colmap.intrinsics import Origin
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens

_NAMED = 3
_UNCHANGED = 1e-12

_FOUND = ("adjusted", "view graph")

How = Literal["adjusted", "view graph", "undetermined", "held"]


class CameraIntrinsics(Record):
    """A camera whose intrinsics were in doubt, and what became of them."""

    camera: Annotated[int, "Its id in the model."]
    num_images: Annotated[int, "Placed images that it took."]
    model: Annotated[str, "COLMAP's name of its model."]
    origin: Annotated[str, "Where what was given comes from: a guess, EXIF data, or given."]
    decided_by: Annotated[
        How,
        "What decided about its focal length: the adjustments; the fundamental matrices alone; the matches "
        "do not tell it, so that it stays as given, and only the distortion may change; it was not to be "
        "changed.",
    ]
    given_focal_px: Annotated[float, "Mean focal length as given."]
    focal_px: Annotated[float, "Mean focal length of the output."]
    focal_sigma_px: Annotated[float | None, "Its standard deviation by the noise alone; null if not known."]
    given_parameters: Annotated[list[float], "All parameters as given, in COLMAP's order."]
    parameters: Annotated[list[float], "All parameters of the output."]

    @property
    def statement(self) -> str:
        """What the camera was given, what it has, and why."""
        head = f"camera {self.camera}: focal length {self.given_focal_px:,.1f} px ({self.origin})"
        if self.decided_by == "undetermined":
            return f"{head} kept, the matches do not tell it{self._distortion()}"
        if self.decided_by == "held":
            return f"{head} kept"
        by = "by the view graph" if self.decided_by == "view graph" else "by adjustment"
        doubt = "" if self.focal_sigma_px is None else f" +- {self.focal_sigma_px:,.1f}"
        return f"{head} became {self.focal_px:,.1f}{doubt} px ({self.change:+.1%}) {by}{self._distortion()}"

    @property
    def change(self) -> float:
        """By which share the focal length became larger."""
        return self.focal_px / self.given_focal_px - 1.0

    def _distortion(self) -> str:
        """Say how the distortion changed, if it did."""
        before, after = np.array(self.given_parameters), np.array(self.parameters)
        is_distortion = np.abs(after) < 10.0  # lengths in pixels are larger
        changed = is_distortion & (np.abs(after - before) > _UNCHANGED)
        if not changed.any():
            return ""
        return ", distortion " + ", ".join(f"{value:.4f}" for value in after[is_distortion])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DoubtedIntrinsics:
    """Cameras whose intrinsics are in doubt, and what became of them; by COLMAP's ids of cameras."""

    given: Mapping[int, Lens] = field(default_factory=dict)
    """As they were given."""
    origins: Mapping[int, Origin] = field(default_factory=dict)
    """Where those come from."""
    free: FreeLenses = ALL_HELD
    """What adjustments may still change."""
    view_graph: Mapping[int, float] = field(default_factory=dict)
    """By which factor the view graph made focal lengths larger, before anything was adjusted."""
    refined: RefinedLenses = UNREFINED
    """What the adjustments made of them."""

    def after(self, refined: RefinedLenses, free: FreeLenses) -> "DoubtedIntrinsics":
        """Return the same after one more adjustment; what it left open is held from then on."""
        undetermined = tuple(dict.fromkeys((*self.refined.undetermined, *refined.undetermined)))
        together = RefinedLenses({**self.refined.sigmas, **refined.sigmas}, undetermined)
        return replace(self, refined=together, free=free)

    def how(self, camera: int) -> How:
        """Return what decided about the focal length of a camera at last."""
        if camera in self.refined.undetermined:
            return "undetermined"
        if camera in self.refined.sigmas:
            return "adjusted"
        return "view graph" if camera in self.view_graph else "held"

    def rows(self, images: Images) -> list[CameraIntrinsics]:
        """Return a row for each camera that took placed images and was in doubt."""
        counts = np.bincount(images.lens_of[images.is_posed], minlength=len(images.lenses)).tolist()
        taken = zip(images.lenses, counts, strict=True)
        return [self._row(lens.id, lens, count) for lens, count in taken if count and lens.id in self.origins]

    def _row(self, camera: int, found: Lens, num_images: int) -> CameraIntrinsics:
        given, sigma = self.given[camera], self.refined.sigmas.get(camera, np.nan)
        known = self.how(camera) == "adjusted" and np.isfinite(sigma)
        return CameraIntrinsics(
            camera=camera,
            num_images=num_images,
            model=found.model,
            origin=self.origins[camera].value,
            decided_by=self.how(camera),
            given_focal_px=given.focal_px,
            focal_px=found.focal_px,
            focal_sigma_px=float(sigma) * found.focal_px if known else None,
            given_parameters=list(given.parameters),
            parameters=list(found.parameters),
        )


NO_DOUBTS = DoubtedIntrinsics()
"""Every camera is calibrated, or taken as it is."""


def describe_intrinsics(rows: Sequence[CameraIntrinsics]) -> list[str]:
    """Return a sentence for each camera in doubt, most images first; of many, one for all."""
    if len(rows) <= _NAMED:
        return [row.statement for row in sorted(rows, key=lambda row: (-row.num_images, row.camera))]
    changes = [row.change for row in rows if row.decided_by in _FOUND]
    unknown = sum(row.decided_by == "undetermined" for row in rows)
    held = len(rows) - len(changes) - unknown
    parts = [f"{len(changes)} of {len(rows)} cameras in doubt have another focal length now"]
    if changes:
        low, middle, high = np.quantile(changes, [0.0, 0.5, 1.0])
        parts = [f"{parts[0]}, by {low:+.1%} to {high:+.1%} (median {middle:+.1%})"]
    parts += [f"{unknown} kept what was given, as the matches do not tell it"] if unknown else []
    parts += [f"{held} were not to be changed"] if held else []
    return ["; ".join(parts) + "; each stands in locate.json"]


def intrinsics_warnings(intrinsics: DoubtedIntrinsics, rows: Sequence[CameraIntrinsics]) -> Iterator[str]:
    """Yield which cameras keep a focal length that was never measured."""
    guessed = [row for row in rows if intrinsics.origins[row.camera] is not Origin.CALIBRATION]
    for how, what in (
        (
            "undetermined",
            "which the matches do not tell: the scene is flat, or the camera hardly turns and shifts",
        ),
        ("held", "which stays as it is: --intrinsics auto, and an adjustment, would refine it"),
    ):
        cameras = [str(row.camera) for row in guessed if row.decided_by == how]
        if cameras:
            noun = "cameras" if len(cameras) > 1 else "camera"
            yield (
                f"{noun} {first_of(cameras)} kept a focal length that was never measured, "
                f"{what}; calibrate if the result is poor"
            )
