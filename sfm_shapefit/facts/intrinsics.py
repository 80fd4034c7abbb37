"""What became of intrinsics that were in doubt: which, why, how they changed, and how sure that is."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from sfm_shapefit.adjustment.estimate import UNREFINED, RefinedLenses
from sfm_shapefit.adjustment.free_lenses import ALL_HELD, FreeLenses
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.facts.json_types import CameraIntrinsics
from sfm_shapefit.files.colmap.intrinsics import Origin

if TYPE_CHECKING:
    import pycolmap

_NAMED = 3
_UNCHANGED = 1e-12

_FOUND = ("adjusted", "view graph")

How = Literal["adjusted", "view graph", "undetermined", "held"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Intrinsics:
    """Cameras whose intrinsics are in doubt, and what became of them; by COLMAP's ids of cameras."""

    given: "Mapping[int, pycolmap.Camera]" = field(default_factory=dict)
    """As they were given."""
    origins: Mapping[int, Origin] = field(default_factory=dict)
    """Where those come from."""
    free: FreeLenses = ALL_HELD
    """What adjustments may still change."""
    view_graph: Mapping[int, float] = field(default_factory=dict)
    """By which factor the view graph made focal lengths larger, before anything was adjusted."""
    refined: RefinedLenses = UNREFINED
    """What the adjustments made of them."""

    def after(self, refined: RefinedLenses) -> "Intrinsics":
        """Return the same after one more adjustment; what it left open is held from then on."""
        undetermined = tuple(dict.fromkeys((*self.refined.undetermined, *refined.undetermined)))
        together = RefinedLenses({**self.refined.sigmas, **refined.sigmas}, undetermined, refined.free)
        return replace(self, refined=together, free=refined.free)

    def how(self, camera: int) -> How:
        """Return what decided about the focal length of a camera at last."""
        if camera in self.refined.undetermined:
            return "undetermined"
        if camera in self.refined.sigmas:
            return "adjusted"
        return "view graph" if camera in self.view_graph else "held"

    def rows(self, model: "pycolmap.Reconstruction") -> list[CameraIntrinsics]:
        """Return a row for each camera that took placed images of a model and was in doubt."""
        images = [model.image(i) for i in model.reg_image_ids()]
        counts = {i: sum(image.camera_id == i for image in images) for i in sorted(self.origins)}
        return [self._row(camera, model.camera(camera), count) for camera, count in counts.items() if count]

    def _row(self, camera: int, found: "pycolmap.Camera", num_images: int) -> CameraIntrinsics:
        given, sigma = self.given[camera], self.refined.sigmas.get(camera, np.nan)
        known = self.how(camera) == "adjusted" and np.isfinite(sigma)
        return {
            "camera": camera,
            "num_images": num_images,
            "model": found.model_name,
            "origin": self.origins[camera].value,
            "decided_by": self.how(camera),
            "given_focal_px": _focal_px(given),
            "focal_px": _focal_px(found),
            "focal_sigma_px": float(sigma) * _focal_px(found) if known else None,
            "given_parameters": given.params.tolist(),
            "parameters": found.params.tolist(),
        }


NO_DOUBTS = Intrinsics()
"""Every camera is calibrated, or taken as it is."""


def _focal_px(camera: "pycolmap.Camera") -> float:
    indices = camera.focal_length_idxs()
    return float(np.mean(camera.params[indices])) if len(indices) else float(camera.params[0])


def describe_intrinsics(rows: list[CameraIntrinsics]) -> list[str]:
    """Return a sentence for each camera in doubt, most images first; of many, one for all."""
    if len(rows) > _NAMED:
        return [_describe_together(rows)]
    return [_describe(row) for row in sorted(rows, key=lambda row: (-row["num_images"], row["camera"]))]


def _describe_together(rows: list[CameraIntrinsics]) -> str:
    """Say what became of many cameras."""
    changes = [row["focal_px"] / row["given_focal_px"] - 1.0 for row in rows if row["decided_by"] in _FOUND]
    unknown = sum(row["decided_by"] == "undetermined" for row in rows)
    held = len(rows) - len(changes) - unknown
    parts = [f"{len(changes)} of {len(rows)} cameras in doubt have another focal length now"]
    if changes:
        low, middle, high = np.quantile(changes, [0.0, 0.5, 1.0])
        parts = [f"{parts[0]}, by {low:+.1%} to {high:+.1%} (median {middle:+.1%})"]
    parts += [f"{unknown} kept what was given, as the matches do not tell it"] if unknown else []
    parts += [f"{held} were not to be changed"] if held else []
    return "; ".join(parts) + "; each stands in locate.json"


def _describe(row: CameraIntrinsics) -> str:
    """Say what a camera was given, what it has, and why."""
    given, found = row["given_focal_px"], row["focal_px"]
    head = f"camera {row['camera']}: focal length {given:,.1f} px ({row['origin']})"
    if row["decided_by"] == "undetermined":
        return f"{head} kept, the matches do not tell it{_describe_distortion(row)}"
    if row["decided_by"] == "held":
        return f"{head} kept"
    by = "by the view graph" if row["decided_by"] == "view graph" else "by adjustment"
    sigma = row["focal_sigma_px"]
    doubt = "" if sigma is None else f" +- {sigma:,.1f}"
    return (
        f"{head} became {found:,.1f}{doubt} px ({found / given - 1.0:+.1%}) {by}{_describe_distortion(row)}"
    )


def _describe_distortion(row: CameraIntrinsics) -> str:
    """Say how the distortion changed, if it did."""
    before, after = (np.array(row[key]) for key in ("given_parameters", "parameters"))
    is_distortion = np.abs(after) < 10.0  # lengths in pixels are larger
    changed = is_distortion & (np.abs(after - before) > _UNCHANGED)
    if not changed.any():
        return ""
    return ", distortion " + ", ".join(f"{value:.4f}" for value in after[is_distortion])


def intrinsics_warnings(intrinsics: Intrinsics, rows: list[CameraIntrinsics]) -> Iterator[str]:
    """Yield which cameras keep a focal length that was never measured."""
    guessed = [row for row in rows if intrinsics.origins[row["camera"]] is not Origin.CALIBRATION]
    for how, what in (
        (
            "undetermined",
            "which the matches do not tell: the scene is flat, or the camera hardly turns and shifts",
        ),
        ("held", "which stays as it is: --intrinsics auto, and an adjustment, would refine it"),
    ):
        cameras = [str(row["camera"]) for row in guessed if row["decided_by"] == how]
        if cameras:
            noun = "cameras" if len(cameras) > 1 else "camera"
            yield (
                f"{noun} {first_of(cameras)} kept a focal length that was never measured, "
                f"{what}; calibrate if the result is poor"
            )
