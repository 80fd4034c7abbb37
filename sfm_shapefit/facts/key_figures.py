"""The three figures that matter of a placed model: `figures` in locate.json.

    placed                   25 of 25 images
    typical error of a pair  0.04 deg (0.5 px)
    typical uncertainty      0.0002 of the input's units, 0.006% of the scene (standard deviation)

They are computed here only; the terminal and notebooks show them as above, the report as tiles.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sfm_shapefit.base.wording import counted, rounded
from sfm_shapefit.facts.json_types import KeyFigures
from sfm_shapefit.facts.tables import CameraRow

UNITS = {
    "input": "of the input's units",
    "unit": "units",
    "rig": "of the rigs' units",
    "distance": "of the known distance's units",
    "prior": "of the priors' units",
    "fixed": "of the fixed cameras' units",
    "control points": "of the control points' units",
}
"""What a standard deviation is given in, by the choice of the scale."""
SOLVER_UNITS = "of the solver's units"
NOISE_ONLY = "matching noise only"
"""How a statement begins that standard deviations leave out errors of rotations and calibration."""
# Of an angle that is seen in pixels.
_MOST_DEG = 89.0


def key_figures(
    cameras: Sequence[CameraRow], pair_error_deg: float, focal_length_px: float, unit: str
) -> KeyFigures:
    """Return the figures of placed cameras; None where one is not known.

    Args:
        cameras: their rows; those that are not placed do not count.
        pair_error_deg: median angle between the direction of a pair and the line between its cameras.
        focal_length_px: median over the images, as pairs are of images, and one camera may take most of
            them; NaN for a bare graph.
        unit: what positions are given in, one of `UNITS` or `SOLVER_UNITS`.
    """
    placed = [row for row in cameras if row.placed]
    centers = np.array([row.center for row in placed if row.center])
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) else 0.0
    largest = [max(row.sigma) for row in placed if row.sigma]
    known = [sigma for sigma in largest if math.isfinite(sigma)]
    sigma = float(np.median(known)) if known else math.nan
    return {
        "pair_error_deg": _or_none(pair_error_deg),
        "pair_error_px": _or_none(math.tan(math.radians(min(pair_error_deg, _MOST_DEG))) * focal_length_px),
        "sigma": _or_none(sigma),
        "sigma_of_extent": _or_none(sigma / extent if extent > 0.0 else math.nan),
        "sigma_unit": unit,
    }


def figure_rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return a label and a text for each figure; the facts are those of locate.json."""
    noun = "node" if "graph" in facts["inputs"] else "image"
    return [
        ("placed", f"{facts['num_placed']:,} of {counted(facts['num_images'], noun)}"),
        ("typical error of a pair", _pair_error(facts["figures"])),
        ("typical uncertainty", _uncertainty(facts["figures"], facts["sigma_of"])),
    ]


def _pair_error(figures: KeyFigures) -> str:
    if figures["pair_error_deg"] is None:
        return "not known"
    pixels = figures["pair_error_px"]
    in_pixels = "" if pixels is None else f" ({pixels:.2g} px)"
    return f"{rounded(figures['pair_error_deg'], digits=2)} deg{in_pixels}"


def _uncertainty(figures: KeyFigures, sigma_of: str) -> str:
    if figures["sigma"] is None:
        return "not known; see warnings, or --verbose"
    share = figures["sigma_of_extent"]
    of_scene = "" if share is None else f", {100.0 * share:.2g}% of the scene"
    scope = f", {NOISE_ONLY}" if sigma_of.startswith(NOISE_ONLY) else ""
    return f"{figures['sigma']:.2g} {figures['sigma_unit']}{of_scene} (standard deviation{scope})"


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
