"""A placement with the evidence for it: what is judged once, when cameras stand where they are to stay."""

from dataclasses import dataclass, fields, replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, hand_back_memory
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.geometry import extent_of
from sfm_shapefit.judgement.few_ties import held_by_chance
from sfm_shapefit.judgement.limits import KNOWN_DEG
from sfm_shapefit.judgement.verdicts import Assessment, assess
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.second_configuration import (
    SecondConfiguration,
    find_fold,
    find_rival,
    find_second_configuration,
)
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.scene.lens import LensErrors
from sfm_shapefit.solver.splitting.linear import Resources


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Judged(Placement):
    """A placement, and the evidence for its pairs and cameras."""

    assessment: Assessment
    """Evidence for the nodes and edges of the placement, in the solver's units."""
    second_configuration: SecondConfiguration | None
    """Another placement that many pairs agree on; its cameras are nodes of the graph."""
    adjusted_covariances: FloatArray | None = None
    """(k, 3, 3) covariances of adjusted centers, squared solver's units; NaN where unknown, None without an
    adjustment."""
    lens_errors: LensErrors | None = None
    """What these covariances take errors of the lenses for."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale, where an adjustment knows it, or pairs hardly do."""
    open_covariances: FloatArray | float = 0.0
    """(k, 3, 3) what the shape leaves open of the centers beside, squared solver's units; 0 if not asked."""

    def loosened(self, loose: BoolArray) -> "Judged":
        """Return the same where nothing says how some of the cameras (k,) stand to the rest."""
        own, adjusted = self.assessment.covariances.copy(), self.adjusted_covariances
        own[: len(loose)][loose] = np.diag(np.full(own.shape[1], np.inf))
        if adjusted is not None:
            adjusted = np.where(loose[:, None, None], np.nan, adjusted)
        return replace(
            self, assessment=replace(self.assessment, covariances=own), adjusted_covariances=adjusted
        )

    @property
    def num_contradicting(self) -> int:
        """Number of rejected pairs that are off by a degree or more; others are off by little, if surely."""
        rejected = self.pairs[~self.agreement.agrees[self.pairs]]
        return int(np.sum(~(self.assessment.residuals_deg[rejected] < KNOWN_DEG)))

    @property
    def covariances(self) -> FloatArray:
        """Covariances (k, d, d) of `locations`: of an adjustment, else from the noise of directions only.

        What an open shape adds is in them.

        They are infinite where a standard deviation is larger than the scene: nothing holds such a camera.
        """
        found = self.assessment.covariances[: len(self.cameras)]
        if self.adjusted_covariances is not None:
            known = np.isfinite(self.adjusted_covariances).all(axis=(1, 2), keepdims=True)
            found = np.where(known, self.adjusted_covariances, found)
        found, extent = found + self.open_covariances, extent_of(self.locations)
        lost = np.einsum("kaa->ka", found).max(axis=1) > extent**2
        return np.where(lost[:, None, None], np.inf, found)


@one_blas_thread()  # as `place`: bits must depend neither on the machine nor on what runs beside
def judge(placement: Placement, options: PlacementOptions) -> Judged:
    """Return a placement with what its directions say of its pairs and cameras.

    UnsolvableError if the factor for standard deviations would take more memory than allowed.
    """
    hand_back_memory()  # what the solve took, before the samples are propagated
    part, agreement, undetermined = (
        placement.measured_part(),
        placement.agreement,
        placement.refined.reset_nodes,
    )
    if placement.refined.variances is not None:
        by_chance = held_by_chance(part.graph, agreement.agrees, agreement.level_rad)
        undetermined = np.union1d(undetermined, by_chance)
    assessment = assess(
        part,
        placement.refined.locations,
        undetermined_nodes=undetermined,
        resources=Resources.of(options.solver),
        agreement=agreement,
    )
    is_bare = part.evidence is None  # what matches say of a model says more of folds
    second = (
        (find_rival(placement.refined) if is_bare else None)
        or find_second_configuration(part.graph, part.pairs, agreement.agrees, assessment.level_deg)
        or (find_fold(part.graph, agreement.agrees, placement.refined.triangles) if is_bare else None)
    )
    if second is not None:
        second = replace(second, cameras=placement.nodes[second.cameras])
    as_placed = {item.name: getattr(placement, item.name) for item in fields(Placement)}
    return Judged(
        **as_placed, assessment=assessment, second_configuration=second, scale_sigma=assessment.scale_sigma
    )
