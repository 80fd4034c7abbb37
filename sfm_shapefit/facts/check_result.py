"""The verdict on a model as it stands, with its tables of cameras and pairs."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.display import Reported
from sfm_shapefit.facts.map_result import MapResult
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.facts.scale_bars import MeasuredBars
from sfm_shapefit.facts.tables import CameraRow, PairRow, Stated, Table
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.judgement.image_quality import ImageQuality
from sfm_shapefit.judgement.pair_fits import PairFits
from sfm_shapefit.judgement.reasons import Reason
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.scene.images import Images

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckResult(Reported, Stated):
    """The verdict on a model, with the evidence for it."""

    model: ColmapModel
    cameras: Table[CameraRow]
    """One row per image, those with a pose first; the reason says what is weak about a camera."""
    pairs: Table[PairRow]
    """One row per pair that was looked at."""
    quality: ImageQuality
    facts: CheckedFacts
    """The figures, as `check --json` prints them."""
    second_opinion: MapResult | None = None
    """What `map_database` made of the same matches, to compare with."""

    @property
    def reconstruction(self) -> "pycolmap.Reconstruction":
        """The model as read, so that the result serves as a model."""
        return self.model.reconstruction

    def with_bars(self, bars: MeasuredBars | None) -> "CheckResult":
        """Return the same with scale bars that were compared with the model."""
        if bars is None:
            return self
        warnings = [*self.facts.warnings, *bars.warnings()]
        return replace(self, facts=replace(self.facts, scale_bars=bars.rows(), warnings=warnings))

    def _headline(self) -> str:
        return f"{self.facts.num_placed} of {self.facts.num_images} images, {self.facts.told_verdict}"


def checked_pair_rows(images: Images, fits: PairFits | None) -> Table[PairRow]:
    """Return a row per pair that was looked at; none where no pair has a match."""
    if fits is None:
        return Table(PairRow, 3, {"name1": []})
    directions, is_judged = fits.directions, np.isfinite(fits.residuals_deg)
    columns = {
        "name1": images.names_of(directions.pairs[:, 0]),
        "name2": images.names_of(directions.pairs[:, 1]),
        "direction": np.where(is_judged[:, None], directions.directions, np.nan),
        "support": directions.num_inliers,
        "residual_deg": fits.residuals_deg,
        "verdict": np.where(fits.contradicts, Verdict.OUTLIER.value, Verdict.INLIER.value),
        "reason": np.where(is_judged, "", [status.value for status in directions.status]),
    }
    return Table(PairRow, 3, columns)


def checked_camera_rows(model: ColmapModel, fits: PairFits | None, weak: list[Reason]) -> Table[CameraRow]:
    """Return a row per image, those with a pose first."""
    names, others = model.images.names, sorted(set(model.image_names) - set(model.images.names))
    judged = np.zeros((0, 2), dtype=np.int64)
    if fits is not None:
        judged = fits.directions.pairs[np.isfinite(fits.residuals_deg)]
    clauses: dict[str, list[str]] = {name: [] for name in names}
    for one in weak:
        for name in one.images:
            clauses.setdefault(name, []).append(one.sentence)
    columns = {
        "name": names,
        "placed": [True] * len(names),
        "reason": ["; ".join(clauses[name]) for name in names],
        "piece": [0] * len(names),
        "center": model.images.centers,
        "degree": np.bincount(judged.ravel(), minlength=len(names)),
    }
    reasons = ["it has no pose in the model"] * len(others)
    unposed = Table(CameraRow, 3, {"name": others, "reason": reasons})
    return Table(CameraRow, 3, columns).followed_by(unposed)


class OtherModel(NamedTuple):
    """Another model of the same matches, to compare with."""

    images: Images
    """Where it has the images."""
    fits: PairFits
    """How pairs fit it."""
    doubted: BoolArray
    """(n,) images that may stand elsewhere by their own matches."""
    source: MapResult
    """What it is one of."""
    number: int
    """Which of these it is."""
