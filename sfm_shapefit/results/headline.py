"""The figures that matter of a placed model, and what to do next.

placed              25 of 25 images
typical pair error  0.008 deg (0.2 px)
typical deviation   0.0009 of the input's units, 0.006% of the cameras' extent (standard deviation)
"""

import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.placement.place import Placement
from sfm_shapefit.results.model_verdict import Grade
from sfm_shapefit.results.summary import sigma_of
from sfm_shapefit.results.warnings import extent_of
from sfm_shapefit.wording import counted, rounded

if TYPE_CHECKING:
    from sfm_shapefit.results.result import GraphResult, LocateResult

_UNITS = {
    "input": "of the input's units",
    "unit": "units",
    "rig": "of the rigs' units",
    "distance": "of the known distance's units",
    "prior": "of the priors' units",
    "fixed": "of the fixed cameras' units",
}
"""What a standard deviation is given in, by the choice of the scale."""
_SOLVER_UNITS = "of the solver's units"
_NOISE_ONLY = "matching noise only"


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """The three figures that matter; a number is NaN where it is not known."""

    num_placed: int
    num_images: int
    noun: str
    """What is placed: images or nodes."""
    pair_error_deg: float
    """Median angle between the direction of a pair that agrees and the baseline of its cameras."""
    pair_error_px: float
    """The same at the median focal length; NaN for a bare graph."""
    sigma: float
    """Median over the placed cameras of the norm of the three standard deviations."""
    sigma_of_extent: float
    """The same as a share of the cameras' extent."""
    unit: str
    """What `sigma` is given in, to follow the number."""
    knows_only_noise: bool
    """Whether `sigma` leaves out what errors of rotations and calibration do."""

    def rows(self) -> list[tuple[str, str]]:
        """Return a label and a text for each figure."""
        in_pixels = f" ({self.pair_error_px:.2g} px)" if math.isfinite(self.pair_error_px) else ""
        sigma = "not known; see warnings, or --verbose"
        if math.isfinite(self.sigma):
            sigma = f"{self.sigma:.2g} {self.unit}, {self.sigma_of_extent:.2g}% of the cameras' extent"
            sigma += f" (standard deviation{f', {_NOISE_ONLY}' if self.knows_only_noise else ''})"
        return [
            ("placed", f"{self.num_placed:,} of {counted(self.num_images, self.noun)}"),
            ("typical pair error", f"{rounded(self.pair_error_deg, digits=2)} deg{in_pixels}"),
            ("typical deviation", sigma),
        ]


def headline_of_model(found: "LocateResult") -> Headline:
    """Return the figures of a placed model."""
    cameras = found.model.reconstruction.cameras.values()
    focal_px = float(np.median([camera.mean_focal_length() for camera in cameras]))
    rows = [row for row in found.cameras if row.placed]
    centers = np.array([row.center for row in rows if row.center]).reshape(-1, 3)
    return _headline(
        found.placement,
        (found.reconstruction.num_reg_images(), len(found.image_names), "image"),
        [math.hypot(*row.sigma) for row in rows if row.sigma],
        extent_of(centers) if len(centers) else math.nan,
        (focal_px, _UNITS[found.gauge.scale]),
    )


def headline_of_graph(found: "GraphResult") -> Headline:
    """Return the figures of a placed graph."""
    placement = found.placement
    return _headline(
        placement,
        (len(placement.cameras), placement.graph.num_nodes, "node"),
        [math.hypot(*row.sigma) for row in found.cameras if row.sigma],
        extent_of(placement.locations),
        (math.nan, _SOLVER_UNITS),
    )


def _headline(
    placement: Placement,
    placed: tuple[int, int, str],
    sigmas: list[float],
    extent: float,
    scale: tuple[float, str],
) -> Headline:
    """Put the figures together: numbers placed and in all, and their noun; the focal length and the unit."""
    agreeing = placement.pairs[placement.assessment.inliers[placement.pairs]]
    errors_deg = placement.assessment.residuals_deg[agreeing]
    error_deg = float(np.median(errors_deg)) if len(errors_deg) else math.nan
    known = [sigma for sigma in sigmas if math.isfinite(sigma)]
    sigma = float(np.median(known)) if known else math.nan
    focal_px, unit = scale
    return Headline(
        num_placed=placed[0],
        num_images=placed[1],
        noun=placed[2],
        pair_error_deg=error_deg,
        pair_error_px=math.radians(error_deg) * focal_px,
        sigma=sigma,
        sigma_of_extent=100.0 * sigma / extent if extent > 0.0 else math.nan,
        unit=unit,
        knows_only_noise=sigma_of(placement).startswith(_NOISE_ONLY),
    )


def next_steps(found: "LocateResult", out: Path, *, report: bool) -> Iterator[str]:
    """Yield what a user does next with a model that was written to OUT, a line each; commands to copy.

    Args:
        found: the model.
        out: its folder.
        report: whether its report was written.
    """
    folder, verdict = shlex.quote(str(out)), found.verdict
    if report:
        yield f"open {shlex.quote(str(out / 'report.html'))}"
    if verdict.grade is Grade.DO_NOT_USE:
        model = found.inputs.folder
        yield f"sfm-shapefit inspect {shlex.quote(str(model))}" if model else "sfm-shapefit inspect MODEL"
    elif found.adjusted is None:
        yield f"colmap bundle_adjuster --input_path {folder} --output_path ADJUSTED"
    else:
        yield f"colmap image_undistorter --image_path IMAGES --input_path {folder} --output_path DENSE"
