"""Results of `locate` and `place`: the answer with the evidence for it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.display import Telling, Written, report_in_notebook
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.base.wording import counted, reasons_by_place
from sfm_shapefit.facts.command_options import PlacingOptions
from sfm_shapefit.facts.control_points import ControlPoint
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.joins import JoinFacts
from sfm_shapefit.facts.lengths import LengthFacts
from sfm_shapefit.facts.model import (
    GroupFacts,
    ModelFacts,
    ModelInputs,
    PlacementAdjustment,
    RotationRefinement,
)
from sfm_shapefit.facts.placed import (
    IN_MEMORY,
    SOLVER_UNITS,
    Delivered,
    GraphFacts,
    GraphInputs,
    facts_of_placement,
    sigma_of,
    unit_of,
)
from sfm_shapefit.facts.placed_graph import PlacedGraph
from sfm_shapefit.facts.rigs import RefinedSensor
from sfm_shapefit.facts.rows import camera_rows, own_camera_rows, pair_rows, without_direction
from sfm_shapefit.facts.scale_bars import ScaleBar
from sfm_shapefit.facts.scene import told_distances
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, Tabled
from sfm_shapefit.facts.warnings import match_warnings
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import Shares, judge_model, too_few_to_judge, weigh_evidence
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.limits import LOCAL_SHARE
from sfm_shapefit.judgement.reasons import Kind, ModelVerdict, Reason, of_each, of_model
from sfm_shapefit.judgement.straight import find_line, sigma_along
from sfm_shapefit.judgement.support import Support
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.missing_matches import doubtful_pairs, score_pairs
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.gauge_options import KnownDistance
from sfm_shapefit.placement.prior_fit import PriorFit
from sfm_shapefit.placement.prior_refinement import PULLED
from sfm_shapefit.placement.right_pairs import TakenForRight, examine_right_pairs
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.sequences import Loop
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import PairNames
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.solver.solver_options import SolverResult

if TYPE_CHECKING:
    import pycolmap

NO_POINTS = "no 3D point could be triangulated"
NO_SUPPORT = "hardly any of its matches makes a point with a third image: its pose is wrong"
_SOLVER_SCALE = "solver: the weighted mean length along the directions is 1, the centroid 0"
CARRIED_FIXED = "fixed; no pair of it takes part"
CARRIED_BY_FRAME = "placed with its frame; no pair of its own takes part"


class ModelInArrays(Protocol):
    """A model that writes itself, and becomes a reconstruction once somebody asks for that."""

    @property
    def reconstruction(self) -> "pycolmap.Reconstruction":
        """The reconstruction, made once."""

    @property
    def as_it_is(self) -> Any:
        """The reconstruction, which may have been changed, if it is made; else the model itself."""

    @property
    def structure(self) -> Structure:
        """The points, and what they are seen with."""

    def colored(self, pictures: Any) -> tuple["ModelInArrays", tuple[str, ...]]:
        """Return the model with colors of pictures, and the names of those that cannot be read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What `locate` worked from."""

    folder: Path | None
    """The model folder; None for a reconstruction in memory."""
    database: Path | None
    """The database whose matches were used, if any."""
    statement: str
    """Where the directions came from, and how that choice was made, for the user."""
    left_out: PairNames = frozenset()
    """Pairs that are taken for unmatched."""
    is_found: bool = False
    """Whether the database was found beside the model, and nobody asked for it."""
    images: Path | None = None
    """Folder of the pictures that the database was made of, for this run alone; None for any other."""
    far: PairNames = frozenset()
    """Pairs of these that are not nearest in pose; sides that are alike contradict a sound model by them."""

    @property
    def is_made(self) -> bool:
        """Whether the database was made of the model's pictures."""
        return self.images is not None

    @property
    def facts(self) -> ModelInputs:
        """What is told of them."""
        return ModelInputs(
            model=IN_MEMORY if self.folder is None else str(self.folder.absolute()),
            database=None if self.database is None or self.is_made else str(self.database.absolute()),
            directions=self.statement,
        )


class _Placed(Written, Tabled):
    placement: Judged

    @property
    def told(self: Any) -> Telling:
        left_out = reasons_by_place(self.not_placed, self.cameras.columns["name"].tolist())
        told: Telling = self.facts.told(left_out, self.placement.refined.finish.statement())
        return told

    @property
    def not_placed(self: Any) -> dict[str, str]:
        """Name and reason of each camera that is placed neither here nor in another model of `map`."""
        elsewhere = getattr(self, "elsewhere", None)
        others = set() if elsewhere is None else {*np.array(self.images.names)[elsewhere].tolist()}
        names, placed, reasons = (self.cameras.columns[name] for name in ("name", "placed", "reason"))
        left_out = zip(names[~placed], reasons[~placed], strict=True)
        return {name: reason for name, reason in left_out if name not in others}

    def _repr_html_(self) -> str:
        """Return verdict, figures and warnings, and the report with its scene."""
        return report_in_notebook(self)

    @property
    def certified(self) -> SolverResult:
        """The solve of the largest rigid piece, with its certificate, before any refinement."""
        return self.placement.certified

    @property
    def dimension(self) -> int:
        """Number of coordinates of a location."""
        return self.placement.graph.dimension


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LocateResult(_Placed):
    """The placed model and the evidence for it: that of piece 0, the largest, and `further` ones."""

    _PUBLIC = (
        *("reconstruction", "cameras", "pairs", "table", "warnings", "database", "options", "timings_s"),
        *("gauge", "intrinsics", "rigs", "control_points", "scale_bars", "certified"),
    )
    seed: ModelInArrays
    """The output, as `reconstruction` and `write` have it."""
    inputs: Inputs
    options: PlacingOptions
    images: Images
    """The posed images of the input, with refined rotations if those were asked for; camera k below is image
    k of them."""
    placed: Images
    """The same images in the output; NaN where they are not in it."""
    image_names: tuple[str, ...]
    """Names of all images of the input, posed or not."""
    directions: PairDirections
    """All pairs that were looked at, with their support."""
    placement: Judged
    """The view graph of all cameras and usable directions (edge e is row `directions.usable()[e]`), its
    largest rigid piece solved, and the evidence for it, in the solver's units."""
    kept: BoolArray
    """Which of the placement's cameras are in the output; the others are not trusted enough, or see too few
    points."""
    gauge: Gauge
    """From the solver's units to the output's."""
    adjusted: Estimate | None
    """How bundle adjustment went, if it was asked for; its model is `reconstruction`, uncolored."""
    adjustment: Estimate | None
    """What became of the placement and of the given rotations, before any bundle adjustment; None if the
    placement stayed as it was found."""
    timings_s: dict[str, float]
    warnings: tuple[str, ...]
    turned_deg: FloatArray | None = None
    """(n,) by how much each rotation of the input was turned by the adjustment of the placement, exactly 0
    where it was kept; None if there was none."""
    moved: FloatArray | None = None
    """(n,) by how much each center of the input was moved, see `CameraRow`; None but for rough rotations."""
    further: "tuple[LocateResult, ...]" = ()
    """The further rigid pieces of three cameras or more, each with a scale of its own."""
    fixed: BoolArray | None = None
    """(n,) images that stay exactly where the input has them; None if that was not asked for."""
    distances: tuple[KnownDistance, ...] = ()
    """Distances that the user gave between its images."""
    scores: FloatArray | None = None
    """(m, 2) scores of the `directions` by their triangles, and matched shares, see `pairs.missing_matches`;
    NaN where a pair has none, shares of all where pairs are too many; None where `map` did not average."""
    loops: tuple[Loop, ...] = ()
    """Loops of the videos among the images, where `map` looked for some."""
    prior_fit: PriorFit | None = None
    """How well position priors fit the images and the `directions`; None where there are too few or none."""
    support: Support
    """Images (n,) left out for their points, and which observations agree with the cameras."""
    evidence: ModelEvidence = field(default_factory=ModelEvidence)
    """What speaks against it although it fits."""

    intrinsics: RefinedIntrinsics
    """What became of the lenses that were in doubt."""
    rigs: tuple[RefinedSensor, ...] = ()
    """The sensors that were refined in their rigs."""
    control_points: tuple[ControlPoint, ...] = ()
    """Ground control points with their residuals, where some are given."""
    scale_bars: tuple[ScaleBar, ...] = ()
    """Scale bars as they are in the model, where some are given."""
    lengths: LengthFacts | None = None
    """How well a length between its points is known; None where that is not known."""
    suspicions: tuple[Reason, ...] = ()
    """What else speaks against the model: steps that failed, rotations that were far off, and what the
    averaging of rotations saw."""
    recognized: Reason | None = None
    """What the input seems to be instead of what it was read as; None if it is not."""
    join: JoinFacts | None = None
    """What came of joining it to a larger model of `map`."""
    averaging: AveragedRotations | None = None
    """The rotations that `map` started from, of the images `averaged_names`; None of `locate`."""
    averaged_names: tuple[str, ...] = ()
    elsewhere: BoolArray | None = None
    """(n,) images that only another model of `map` has; they are not missing here. None without others."""

    @property
    def reconstruction(self) -> "pycolmap.Reconstruction":
        """A new reconstruction: placed cameras and triangulated points; other images are unregistered."""
        return self.seed.reconstruction

    @property
    def model(self) -> Any:
        """What tells how many images and points there are, and is written."""
        return self.seed.as_it_is

    @cached_property
    def facts(self) -> ModelFacts:
        """What is told of the model: each figure of locate.json, terminal and report."""
        placement, model, gauge = self.placement, self.model, self.gauge
        solved = [(p.placement.piece, p.gauge.statement, int(np.sum(p.kept))) for p in (self, *self.further)]
        measures = (float(np.median(self.images.focal_lengths_px)), unit_of(gauge))
        facts = facts_of_placement(placement, self.cameras, solved, measures) | {
            "num_images": len(self.image_names),
            "num_placed": model.num_reg_images(),
            "num_pairs": len(self.directions.pairs),
            "sigma_of": sigma_of(placement, by_priors=PULLED in gauge.statement),
        }
        facts["num_pairs_rejected"] += len(self.directions.pairs) - placement.num_pairs
        return ModelFacts.taken_from(
            self,
            **facts,
            options=flat_values(self.options),
            inputs=self.inputs.facts,
            not_trusted=self._not_trusted(),
            few_points={self.images.names[camera]: count for camera, count in self.few_points.items()},
            pairs={status.name.lower(): count for status, count in self.directions.counts().items()}
            | {"outlier": len(placement.rejected_pairs)},
            num_contradicting=placement.num_contradicting,
            agreement=replace(self.support.observations, pairs=self.agreeing_pairs),
            num_points=model.num_points3D(),
            mean_reprojection_error_px=model.compute_mean_reprojection_error(),
            num_points_as_nodes=int(np.sum(placement.nodes >= placement.num_cameras)),
            scale=gauge.statement,
            scale_sigma=gauge.scale_sigma,
            known_distances=told_distances(self.distances, self.placed),
            wrong_priors=self._wrong_priors(),
            datum=gauge.datum,
            rigid_groups=GroupFacts.of_placement(placement, self.kept, self.fixed),
            intrinsics=tuple(self.intrinsics.rows(self.placed)),
            refined_rigs=self.rigs,
            num_doubtful_pairs=len(self.doubtful_pairs),
            adjustment=PlacementAdjustment.of_estimate(self.adjustment),
            lens_errors=placement.lens_errors,
            rotation_refinement=RotationRefinement.of_turns(self.turned_deg),
            bundle_adjustment=self.adjusted and self.adjusted.solves,
        )

    def _headline(self) -> str:
        images = f"{self.model.num_reg_images()} of {len(self.image_names)} images placed"
        return f"{self.verdict.grade.value}: {images}, {counted(self.model.num_points3D(), 'point')}"

    @property
    def delivered(self) -> Delivered:
        """The certified and the delivered solution, and how far apart they are."""
        return Delivered.compare(self.placement, self._centers, adjusted=self.adjusted is not None)

    @cached_property
    def verdict(self) -> ModelVerdict:
        """Whether the model can be used, and why."""
        is_posed, elsewhere = self.placed.is_posed, self.elsewhere
        shares = Shares(
            self.support.observations.contradicting or 0.0,
            placed=float(np.mean(is_posed if elsewhere is None else is_posed[~elsewhere])),
            placed_here=float(np.mean(is_posed)),
        )
        left_out, lone = (
            [self.images.names[camera] for camera in cameras]
            for cameras in (self.placement.cameras[~self.kept].tolist(), self.cameras_without_support)
        )
        before = (
            *too_few_to_judge(int(is_posed.sum())),
            *of_each(Kind.LEFT_OUT, left_out, "it is left out: not trusted, or it sees too few points"),
            *of_each(Kind.POINTS, lone, NO_SUPPORT),
            *weigh_evidence(self.evidence, self.placed),
        )
        repeats = tuple(match_warnings(self.directions, may_repeat=self.database is not None))[:1]
        repeated = (of_model(Kind.REPEATED, sentence) for sentence in repeats)
        lacks = () if self.model.num_points3D() else (of_model(Kind.POINTS, NO_POINTS),)
        after = (*repeated, *self._off_priors(), *lacks, *self.suspicions)
        return judge_model(self.placement, shares, before, after).led_by(self.recognized)

    def _off_priors(self) -> Iterator[Reason]:
        """Yield that many position priors contradict the cameras: a few are wrong, many may be right."""
        if self.prior_fit is not None:
            wrong, count = len(self.prior_fit.wrong), int(np.isfinite(self.prior_fit.off).sum())
            if wrong > max(1, LOCAL_SHARE * count):
                clause = f"{wrong} of {counted(count, 'position prior')} contradict where cameras stand"
                yield of_model(Kind.INPUT, clause)

    @property
    def database(self) -> Path | None:
        """The database whose matches were used, if any."""
        return self.inputs.database

    @cached_property
    def _centers(self) -> FloatArray:
        """Centers (k, 3) of the placement's cameras in the output, NaN for those that are not in it."""
        centers = self.placed.centers[self.placement.cameras]
        centers[~self.kept] = np.nan
        return centers

    @cached_property
    def cameras(self) -> Table[CameraRow]:
        """One row per image of the input: the posed ones by id, then those without a rotation."""
        pieces, cameras = [piece.placement for piece in self.further], self.placement.graph
        rows = camera_rows(
            self.placement, self._centers, self.gauge.similarity.scale, pieces, self.gauge.axes
        )
        reasons = rows.columns["reason"]
        for camera, reason in without_direction(self.directions, cameras).items():
            reasons[camera] = reason
        carried = self._carried()
        rows.columns["placed"][carried], rows.columns["piece"][carried] = True, 0
        rows.columns["center"][carried] = self.placed.centers[carried]
        fixed = np.zeros(len(rows), dtype=np.bool_) if self.fixed is None else self.fixed
        reasons[carried] = np.where(fixed[carried], CARRIED_FIXED, CARRIED_BY_FRAME)
        for camera, count in self.few_points.items():
            least = self.options.structure.min_points_per_image
            reasons[camera] = f"it sees {counted(count, 'point')}, fewer than {least}"
        reasons[self.cameras_without_support] = NO_SUPPORT
        off = self.prior_fit and self.prior_fit.off
        told = {"turned_deg": self.turned_deg, "moved": self.moved, "prior_off": off}
        rows = rows.changed({name: values for name, values in told.items() if values is not None})
        unposed = sorted(set(self.image_names) - set(self.images.names))
        why = ["the input has no rotation for it"] * len(unposed)
        return rows.followed_by(Table(CameraRow, rows.dimension, {"name": unposed, "reason": why}))

    @cached_property
    def own_cameras(self) -> Table[CameraRow]:
        """One row per camera of the piece that is placed."""
        return own_camera_rows(self.placement, self._centers, self.gauge.similarity.scale)

    @property
    def agreeing_pairs(self) -> float:
        """Share that agrees, of the pairs of cameras in the output whose matches say anything of a direction.

        Pairs whose matches contradict the rotations count as disagreeing; NaN where there are none.
        """
        placement = self.placement
        is_in = np.zeros(placement.num_cameras, dtype=np.bool_)
        is_in[placement.cameras[self.kept]] = True
        judged = is_in[placement.graph.edges[placement.edges[placement.pairs]]].all(axis=1)
        against = self.directions.pairs[self.directions.contradicting()]
        num_against = int(np.sum(is_in[against].all(axis=1)))
        agreeing = int(np.sum(placement.assessment.inliers[placement.pairs] & judged))
        total = int(np.sum(judged)) + num_against
        return agreeing / total if total else math.nan

    @property
    def few_points(self) -> dict[int, int]:
        """Number of points that an image sees, by each image that was left out because of it."""
        seen = self.support.num_seen
        return {camera: int(seen[camera]) for camera in np.flatnonzero(seen >= 0).tolist()}

    @property
    def cameras_without_support(self) -> list[int]:
        """The images hardly any of whose matches makes a point with a third image, in the output or not."""
        return np.flatnonzero(self.support.unsupported).tolist()

    def _not_trusted(self) -> dict[str, str]:
        """Return the images that are left out because they are not trusted, and why."""
        placement, few = self.placement, self.few_points
        left_out = {int(placement.cameras[k]): k for k in np.flatnonzero(~self.kept).tolist()}
        return {
            placement.graph.name_of(camera): placement.assessment.reasons[k]
            for camera, k in left_out.items()
            if camera not in few
        }

    def _wrong_priors(self) -> dict[str, float]:
        fit = self.prior_fit
        return {} if fit is None else {self.images.names[k]: float(fit.off[k]) for k in fit.wrong.tolist()}

    def _carried(self) -> IntArray:
        """Return the images in the output that no pair placed: fixed ones, and rest of a frame, rows (k,)."""
        carried = self.placed.is_posed
        carried[self.placement.cameras[self.kept]] = False
        return np.flatnonzero(carried)

    @cached_property
    def pairs(self) -> Table[PairRow]:
        """One row per pair that was looked at, usable or not, in the order of pairs."""
        more: dict[str, FloatArray] = {}
        if self.scores is not None:
            more |= {"triplet_score": self.scores[:, 0], "matched_share": self.scores[:, 1]}
            more["pair_score"] = score_pairs(*self.scores.T)
        if self.prior_fit is not None:
            more["prior_angle_deg"] = self.prior_fit.angles_deg
        usable, names, axes = self.directions.usable(), self.images.names, self.gauge.axes
        ends, support = self.directions.pairs, self.directions.num_inliers
        columns = {
            "name1": [names[i] for i in ends[:, 0].tolist()],
            "name2": [names[j] for j in ends[:, 1].tolist()],
            "support": support,
            "reason": [status.value for status in self.directions.status],
        }
        rows = Table(PairRow, self.dimension, columns | more)
        judged = pair_rows(self.placement, support[usable], [piece.placement for piece in self.further])
        for name in judged.columns.keys() - more.keys() - {"name1", "name2", "support"}:
            rows.columns[name][usable] = judged.columns[name]
        if axes is not None:
            turned = [axes @ direction for direction in judged.columns["direction"]]
            rows.columns["direction"][usable] = np.reshape(turned, (-1, self.dimension))
        return rows

    @cached_property
    def line_sigma(self) -> float | None:
        """Median standard deviation along the line on which all cameras stand, as a share of its length.

        None where they do not stand on one, or where it is not known.
        """
        placement = self.placement
        line = find_line(placement.graph.directions[placement.edges[placement.pairs]])
        if line is None:
            return None
        sigma = sigma_along(line, placement.locations, placement.covariances)
        return sigma if math.isfinite(sigma) else None

    @cached_property
    def doubtful_pairs(self) -> Table[PairRow]:
        """The pairs that agree with the model and look like repeated structure all the same, worst first."""
        columns = self.pairs.columns
        used = columns["verdict"] == Verdict.INLIER.value
        rows = np.flatnonzero(doubtful_pairs(columns["pair_score"]) & used).tolist()
        order = [columns[name] for name in ("pair_score", "name1", "name2")]
        return self.pairs.taken(sorted(rows, key=lambda row: tuple(column[row] for column in order)))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class GraphResult(_Placed):
    """A bare view graph, placed. Locations are in the solver's units, centroid 0."""

    _PUBLIC = (
        *("cameras", "pairs", "table", "warnings", "options", "timings_s"),
        *("placement", "further", "certified"),
    )
    path: Path
    """The graph's file or folder."""
    statement: str
    """What it is, and where rotations came from, for the user."""
    options: PlacementOptions
    placement: PlacedGraph
    further: tuple[Judged, ...]
    """The further rigid pieces of three nodes or more, each with a scale of its own."""
    timings_s: dict[str, float]

    @cached_property
    def facts(self) -> GraphFacts:
        """What is told of the graph: each figure of locate.json, terminal and report."""
        placement = self.placement
        solved = [(p.piece, _SOLVER_SCALE, len(p.cameras)) for p in (placement, *self.further)]
        return GraphFacts.taken_from(
            self,
            **facts_of_placement(placement, self.cameras, solved, (math.nan, SOLVER_UNITS)),
            options=flat_values(self.options),
            delivered=Delivered.compare(placement, placement.locations, adjusted=False),
            warnings=list(self.warnings),
            inputs=GraphInputs(graph=str(self.path.absolute()), directions=self.statement),
            dimension=placement.graph.dimension,
        )

    @cached_property
    def right_pairs(self) -> TakenForRight:
        """The pairs of the largest piece that are taken for right, and the program restricted to them."""
        return examine_right_pairs(self.placement, self.options.solver)

    def _headline(self) -> str:
        placed, total = len(self.placement.cameras), self.placement.graph.num_nodes
        return f"{placed} of {total} nodes placed, {self.placement.num_pairs} pairs"

    @property
    def image_names(self) -> tuple[str, ...]:
        """None: nodes have no images."""
        return ()

    @property
    def verdict(self) -> ModelVerdict:
        """Whether the model can be used, and why."""
        return self.placement.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know and to do, a sentence each."""
        return self.placement.warnings

    @cached_property
    def cameras(self) -> Table[CameraRow]:
        """One row per node."""
        return camera_rows(self.placement, self.placement.locations, 1.0, self.further)

    @cached_property
    def pairs(self) -> Table[PairRow]:
        """One row per edge."""
        support = np.zeros(self.placement.num_pairs, dtype=np.int64)
        return pair_rows(self.placement, support, self.further)
