"""The three figures that matter of a placed model, for the terminal and for notebooks.

    placed                   25 of 25 images
    typical error of a pair  0.04 deg (0.5 px)
    typical uncertainty      0.0002 of the input's units, 0.006% of the scene (standard deviation)

The tiles of the report say the same.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.results.summary import sigma_of
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
# Of an angle that is seen in pixels.
_MOST_DEG = 89.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """The three figures that matter; a number is NaN where it is not known."""

    num_placed: int
    num_images: int
    noun: str
    """What is placed: images or nodes."""
    pair_error_deg: float
    """Median angle between the direction of a pair and the line between its cameras."""
    pair_error_px: float
    """The same at the median focal length; NaN for a bare graph."""
    sigma: float
    """Median over the placed cameras of the largest of the standard deviations along the axes."""
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
            share = f"{self.sigma_of_extent:.2g}% of the scene"
            sigma = f"{self.sigma:.2g} {self.unit}, {share}"
            sigma += f" (standard deviation{f', {_NOISE_ONLY}' if self.knows_only_noise else ''})"
        return [
            ("placed", f"{self.num_placed:,} of {counted(self.num_images, self.noun)}"),
            ("typical error of a pair", f"{rounded(self.pair_error_deg, digits=2)} deg{in_pixels}"),
            ("typical uncertainty", sigma),
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
        [max(row.sigma) for row in rows if row.sigma],
        centers,
        (focal_px, _UNITS[found.gauge.scale]),
    )


def headline_of_graph(found: "GraphResult") -> Headline:
    """Return the figures of a placed graph."""
    placement = found.placement
    return _headline(
        placement,
        (len(placement.cameras), placement.graph.num_nodes, "node"),
        [max(row.sigma) for row in found.cameras if row.sigma],
        placement.locations,
        (math.nan, _SOLVER_UNITS),
    )


def _headline(
    placement: Placement,
    placed: tuple[int, int, str],
    sigmas: list[float],
    centers: FloatArray,
    scale: tuple[float, str],
) -> Headline:
    """Put the figures together: numbers placed and in all, and their noun; the focal length and the unit."""
    errors_deg = placement.assessment.residuals_deg[placement.pairs]
    error_deg = float(np.median(errors_deg)) if len(errors_deg) else math.nan
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) else 0.0
    known = [sigma for sigma in sigmas if math.isfinite(sigma)]
    sigma = float(np.median(known)) if known else math.nan
    focal_px, unit = scale
    return Headline(
        num_placed=placed[0],
        num_images=placed[1],
        noun=placed[2],
        pair_error_deg=error_deg,
        pair_error_px=math.tan(math.radians(min(error_deg, _MOST_DEG))) * focal_px,
        sigma=sigma,
        sigma_of_extent=100.0 * sigma / extent if extent > 0.0 else math.nan,
        unit=unit,
        knows_only_noise=sigma_of(placement).startswith(_NOISE_ONLY),
    )
