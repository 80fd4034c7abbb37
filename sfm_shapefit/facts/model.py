"""What is told of models: placed by `locate` or `map`, joined by `map`, or looked at as they stand.

A new figure is a field here, with its sentence, and the line that computes it in `LocateResult.facts`;
what people are to see of it is one more line in `scene_rows` (terminal, report and notebooks) or of `told`.
"""

import math
import shlex
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np

from sfm_shapefit.adjustment.estimate import BundleAdjustment, Estimate
from sfm_shapefit.base.arrays import BoolArray, FloatArray, distinct
from sfm_shapefit.base.display import NextStep, Row, Telling, row
from sfm_shapefit.base.paths import from_here
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, first_of, in_pixels, rounded
from sfm_shapefit.facts.control_points import ControlPoint, describe_control_points
from sfm_shapefit.facts.intrinsics import CameraIntrinsics, describe_intrinsics
from sfm_shapefit.facts.joins import JoinFacts
from sfm_shapefit.facts.lengths import LengthFacts
from sfm_shapefit.facts.placed import (
    IN_MEMORY,
    SCHEMA_VERSION,
    Facts,
    InputFacts,
    Options,
    PlacedFacts,
    Timings,
    Version,
    Warnings,
)
from sfm_shapefit.facts.rigs import RefinedSensor, describe_rigs
from sfm_shapefit.facts.scale_bars import ScaleBar, describe_scale_bars
from sfm_shapefit.facts.scene import DistanceFacts, describe_line, describe_loops
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, contradicting
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.reasons import Grade, Kind
from sfm_shapefit.judgement.second_opinion import SecondOpinion
from sfm_shapefit.judgement.support import EvidenceShares
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.rotations.averaged import Averaging
from sfm_shapefit.rotations.sequences import Loop
from sfm_shapefit.scene.given import EarthDatum
from sfm_shapefit.scene.lens import LensErrors


class ModelInputs(InputFacts):
    """What a model was made of."""

    model: Annotated[str, "The model's folder or file, from the root on."]
    database: Annotated[str | None, "The database whose matches were used, if any, from the root on."]
    directions: Annotated[str, "Where the directions came from."]

    @property
    def path(self) -> str:
        """Path of the model as it is typed here; one in memory, as of `map`, is named by its database."""
        return from_here((self.model == IN_MEMORY and self.database) or self.model)

    @property
    def typed_database(self) -> str:
        """The database as it is typed in a command here; empty without one."""
        return shlex.quote(from_here(self.database)) if self.database else ""

    @property
    def database_flag(self) -> str:
        """How a command is given the database, after a space; empty without one."""
        return f" --database {self.typed_database}" if self.database else ""


class PlacementAdjustment(Record):
    """How placed cameras were adjusted to the pixels, and their given rotations treated."""

    statement: Annotated[str, "What was chosen and why, in words."]
    rotations: Annotated[Literal["held", "weighted", "free"], "How the given rotations were treated."]
    rotation_sigma_deg: Annotated[
        float | None, "Standard deviation per axis by which they were weighted; null if they were not."
    ]
    chance_deg: Annotated[
        float | None, "Turn per axis that chance explains; null if the matches were not asked."
    ]

    @classmethod
    def of_estimate(cls, estimate: Estimate | None) -> Self | None:
        """Return how a placement was adjusted; None if it was not."""
        if estimate is None:
            return None
        errors, sigma_rad = estimate.errors, estimate.freedom.least_pull_rad
        held, free = estimate.freedom.holds_rotations, math.isinf(sigma_rad)
        return cls(
            statement=estimate.statement,
            rotations="held" if held else "free" if free else "weighted",
            rotation_sigma_deg=None if held or free else math.degrees(sigma_rad),
            chance_deg=None if errors is None else math.degrees(errors.chance_rad),
        )


class RotationRefinement(Record):
    """What the adjustment of the placement changed of the given rotations."""

    num_updated: Annotated[int, "Cameras that turned."]
    num_kept: Annotated[int, "Cameras that keep the rotation of the input."]
    median_change_deg: Annotated[float, "Median angle by which those turned."]
    max_change_deg: Annotated[float, "Largest angle by which a camera turned."]

    @property
    def statement(self) -> str:
        """The same in words."""
        if not self.num_updated:
            return "rotations kept"
        usual, most = (rounded(deg, digits=2) for deg in (self.median_change_deg, self.max_change_deg))
        return f"rotations refined by {usual} deg (at most {most})"

    @classmethod
    def of_turns(cls, turned_deg: FloatArray | None) -> Self | None:
        """Return what is told of turns (n,), 0 where a rotation is kept, NaN where unknown; None of None."""
        if turned_deg is None:
            return None
        changed = turned_deg[turned_deg > 0.0]
        return cls(
            num_updated=len(changed),
            num_kept=int(np.sum(turned_deg == 0.0)),
            median_change_deg=float(np.median(changed)) if len(changed) else 0.0,
            max_change_deg=float(changed.max(initial=0.0)),
        )


class GroupFacts(Record):
    """Cameras that move together: frames of rigs, and fixed cameras."""

    num_groups: Annotated[int, "Groups of the input."]
    num_placed: Annotated[int, "Groups with a camera in the output."]
    num_fixed: Annotated[int, "Cameras that stay where the input has them."]
    num_inner_pairs: Annotated[
        int, "Pairs inside one frame, which say nothing; those of fixed cameras are not measured."
    ]

    @classmethod
    def of_placement(cls, placement: Placement, kept: BoolArray, fixed: BoolArray | None) -> Self | None:
        """Return what moved together, by which images (n,) are `fixed`; None where each moves by itself."""
        if placement.groups is None:
            return None
        cameras = placement.groups.group_of[: placement.num_cameras]
        pairs = placement.graph.edges[: placement.num_pairs]
        return cls(
            num_groups=len(distinct(cameras)),
            num_placed=len(distinct(cameras[placement.cameras[kept]])),
            num_fixed=0 if fixed is None else int(np.sum(fixed)),
            num_inner_pairs=int(np.sum(~placement.groups.joins(pairs))),
        )

    @property
    def statement(self) -> str:
        """The same in words."""
        fixed = f", {counted(self.num_fixed, 'camera')} fixed" if self.num_fixed else ""
        count = self.num_inner_pairs
        inner = f"; {count} pairs inside them give no constraint" if count else ""
        return f"{self.num_placed} of {self.num_groups} placed{fixed}{inner}"


class FactsOfModel(Facts):
    """What is told of any COLMAP model, placed or only looked at."""

    inputs: Annotated[ModelInputs, "What was read."]
    num_points: Annotated[int, "3D points."]
    mean_reprojection_error_px: Annotated[
        float | None, "Mean reprojection error of these points; null if there are none."
    ]
    scale: Annotated[str, "Scale, origin and axes of the output, in words."]
    evidence: Annotated[ModelEvidence, "What speaks against the model although it fits."] = ModelEvidence()

    def told_lines(self, against: tuple[int, int], more: str = "", num_rejected: int = 0) -> list[str]:
        """Return the answer in lines: how many pairs are `against` it, of how many, and `more` of matches.

        Further pairs are rejected, as their matches contradict the rotations.
        """
        error_px = self.mean_reprojection_error_px
        points = f", mean reprojection error {in_pixels(error_px, 2)}" if error_px is not None else ""
        source = from_here(self.inputs.database) if self.inputs.database else self.inputs.directions
        contradict = (
            f"{against[0]:,} of {counted(against[1], 'pair')} contradict{'s' * (against[1] == 1)} the result"
        )
        contradict = contradict if against[1] else "no pair determines where cameras are"
        silent = self.num_pairs - against[1] - num_rejected
        if self.num_pairs - against[1] > against[1] > 0:
            if num_rejected:
                contradict += (
                    f", and {num_rejected:,} more contradict{'s' * (num_rejected == 1)} its rotations"
                )
            if silent:
                contradict += f", and {silent:,} of {self.num_pairs:,} pairs say nothing of it"
        return [
            f"{self.num_placed:,} of {counted(self.num_images, 'image')} placed, "
            f"{counted(self.num_points, 'point')}{points}",
            "; ".join(part for part in (f"matches: {source}", contradict, more) if part),
            self.figures.uncertainty(self.sigma_of),
        ]


class ModelFacts(FactsOfModel, PlacedFacts):
    """locate.json, and what `sfm-shapefit locate --json` prints."""

    not_trusted: Annotated[dict[str, str], "Images that are left out because they are not trusted, and why."]
    few_points: Annotated[
        dict[str, int],
        "Images that are left out because they see too few points, or hardly any of those that their matches "
        "could make, and how many they see.",
    ]
    pairs: Annotated[
        dict[str, int],
        "Pairs by what became of them: usable, outlier, too_few_matches, few_inliers, no_parallax ...",
    ]
    num_contradicting: Annotated[int, "Usable pairs that are set aside, and off by a degree or more."]
    agreement: Annotated[EvidenceShares, "What share of the evidence agrees."]
    num_points_as_nodes: Annotated[int, "Tracks that joined the view graph."]
    scale_sigma: Annotated[
        float | None,
        "Relative standard deviation of a scale that comes from rigs, priors, known distances, scale bars or "
        "control points; else null.",
    ]
    known_distances: Annotated[
        tuple[DistanceFacts, ...], "Distances that the user gave, and those in the model."
    ]
    wrong_priors: Annotated[
        dict[str, float], "Images whose position priors are wrong, most likely, and how far these are off."
    ]
    control_points: Annotated[tuple[ControlPoint, ...], "Ground control points, with their residuals."]
    scale_bars: Annotated[tuple[ScaleBar, ...], "Known lengths between points, and those in the model."]
    datum: Annotated[EarthDatum | None, "Where the output's origin is on Earth; null if that is not known."]
    rigid_groups: Annotated[GroupFacts | None, "Null where every camera moves by itself."]
    intrinsics: Annotated[
        tuple[CameraIntrinsics, ...], "Cameras that were never calibrated, or were asked to be refined."
    ]
    refined_rigs: Annotated[tuple[RefinedSensor, ...], "Sensors whose poses in their rigs were refined."]
    lengths: Annotated[
        LengthFacts | None, "How well a length between its points is known; null where that is not known."
    ]
    line_sigma: Annotated[
        float | None,
        "Median standard deviation of a position along the line on which all cameras stand, as a share of "
        "its length; null where they stand on none, or where it is not known.",
    ]
    num_doubtful_pairs: Annotated[
        int, "Pairs of doubtful_pairs.csv: used, but with far smaller scores than others."
    ]
    loops: Annotated[tuple[Loop, ...], "Loops of the videos among the images of `map`."]
    adjustment: Annotated[PlacementAdjustment | None, "Null if the placement stayed as it was found."]
    lens_errors: Annotated[
        LensErrors | None, "Null where the standard deviations know of matching noise only."
    ]
    rotation_refinement: Annotated[RotationRefinement | None, "Null if nothing was adjusted."]
    bundle_adjustment: Annotated[BundleAdjustment | None, "Null if it was not asked for."]
    join: Annotated[JoinFacts | None, "Join of a model of `map` beside the largest; else null."]

    @property
    def next_step(self) -> NextStep:
        """What to do next."""
        if self.verdict.doubts_database:
            text = "Next: place it by the database that it was made from."
            model, sigma_deg = shlex.quote(self.inputs.path), self.options["rotations"]
            by = f"--database ITS_DATABASE --rotations {sigma_deg:g}"
            return NextStep(text, f"sfm-shapefit locate {model} {{out}} --overwrite {by}")
        return next_of_model(self.verdict.grade, self)

    def scene_rows(self) -> list[Row]:
        """Return what is told of lenses, rigs, control points and the scene, where there is something."""
        return [
            Row("intrinsics", describe_intrinsics(self.intrinsics)),
            Row("rigs", describe_rigs(self.refined_rigs)),
            row("control points", describe_control_points(self.control_points, "m" if self.datum else "")),
            row("scale bars", describe_scale_bars(self.scale_bars)),
            row("lengths", self.lengths.statement if self.lengths and self.lengths.has_scale else ""),
            row("straight", describe_line(self.line_sigma)),
            row("numbered images", describe_loops(self.loops)),
        ]

    def expert_sentences(self) -> list[str]:
        """Return what only those who know the method ask for."""
        said = self.adjustment.statement if self.adjustment else ""
        return super().expert_sentences() + ([f"{said[:1].upper()}{said[1:]}."] if said else [])

    def told(self, left_out: Sequence[str], centers: str) -> Telling:
        """Return what the terminal says; `left_out` has images and why, `centers` where centers come from."""
        rows = [
            Row("not placed", left_out),
            row("not trusted", _how_to_keep(len(self.not_trusted))),
            *self.piece_rows(),
            *self.scene_rows(),
            Row("warning", self.warnings),
        ]
        nodes = f"{counted(self.num_points_as_nodes, 'track')} helped to place cameras"
        details = [
            row("directions", self.inputs.directions),
            row("typical error of a pair", self.figures.pair_error),
            row("rigid groups", self.rigid_groups.statement if self.rigid_groups else ""),
            Row("pairs", self._pair_lines()),
            row("points as nodes", nodes),
            row("centers", centers),
            row("adjustment", self.adjustment.statement if self.adjustment else ""),
            row("scale", self.scale),
            row("bundle adjustment", self.bundle_adjustment.statement if self.bundle_adjustment else ""),
            row("certificate", self.delivered.statement),
        ]
        turned = self.rotation_refinement
        is_given = turned is not None and self.inputs.model != IN_MEMORY
        rotations = turned.statement if turned and is_given else ""
        lines = self.told_lines((self.num_contradicting, self.pairs["usable"]), rotations)
        return Telling(lines, rows, details, step=self.next_step)

    def _pair_lines(self) -> list[str]:
        """Say what became of the pairs, in the words of `inspect`."""
        counts = dict(self.pairs)
        contradicting, usable = counts.pop("outlier"), counts.pop("usable")
        others = [f"{count}: {DirectionStatus[status.upper()].value}" for status, count in counts.items()]
        return [f"{usable}: usable ({contradicting} contradict the solution)", *others]


def _how_to_keep(num_not_trusted: int) -> str:
    """Say how to keep images that are left out; empty if there are none."""
    count = counted(num_not_trusted, "image")
    return (
        f"{count} of those above; min_trust=0 keeps {'them' if num_not_trusted > 1 else 'it'}"
        if num_not_trusted
        else ""
    )


def next_of_model(grade: Grade, facts: FactsOfModel) -> NextStep:
    """Return what to do with a model of ours, by what it was made of."""
    inputs = facts.inputs
    if grade is Grade.DO_NOT_USE and inputs.model == IN_MEMORY:  # as `map` has it
        step = f"sfm-shapefit inspect {{out}}{inputs.database_flag}"
        return NextStep("Next: find out what is wrong with the input.", step)
    if grade is Grade.DO_NOT_USE:
        matches = inputs.typed_database or "{images}"
        text = "Next: make a model from the matches alone, without the poses of the input."
        return NextStep(text, f"sfm-shapefit map {matches} mapped")
    looked = "once you have looked" if grade is Grade.LOOK else ""
    text = f"Next: undistort the images for splatting or dense reconstruction{looked and f', {looked}'}."
    return NextStep(text, "sfm-shapefit workspace {out} {images} {out_dense}", looked)


def _next_in(folder: str, grade: Grade, facts: FactsOfModel) -> NextStep:
    """Return what to do with a model that was only looked at, in its folder."""
    return next_of_model(grade, facts).at(out=folder, out_dense="dense")


class CheckedFacts(FactsOfModel):
    """What `sfm-shapefit check --json` prints: a model that was judged as it stands, not placed."""

    examined: Annotated[Literal[True], "Its positions were looked at as they stand."] = True
    options: Annotated[dict[str, Any], "Options of `locate` or `map` that made it; none of another model."]
    median_track_length: Annotated[
        float | None, "Median number of images that see a 3D point; null if there are none."
    ]
    num_lenses: Annotated[int, "Cameras in COLMAP's sense: lenses of the images with a pose."]
    scale_bars: Annotated[tuple[ScaleBar, ...], "Known lengths between points, and those in the model."] = ()
    second_opinion: Annotated[str | None, "Folder that has the models of the second opinion, if any."] = None
    images: Annotated[str | None, "Folder of the pictures that were matched for this, if any."] = None

    @property
    def has_matches(self) -> bool:
        """Whether it was compared with matches of a database or of its pictures, and not its tracks alone."""
        return bool(self.inputs.database or self.images)

    @property
    def told_verdict(self) -> str:
        """The verdict in words; a good one names what its evidence cannot show."""
        is_alone = self.verdict.grade is Grade.GOOD and not self.has_matches
        return self.verdict.statement + ", by its own tracks alone, which cannot show a fold" * is_alone

    @property
    def next_step(self) -> NextStep:
        """What to do next, with the folder of the pictures where it is known."""
        return self._next().at(images=from_here(self.images) if self.images else "IMAGES")

    def _next(self) -> NextStep:
        """Return what to do next, by the verdict and by what was asked."""
        path, second, verdict = shlex.quote(self.inputs.path), self.evidence.second, self.verdict
        is_alike = second is not None and second.is_alike
        is_equal = second is not None and second.grade is verdict.grade and not verdict.doubts_database
        is_sound = verdict.grade is Grade.GOOD or (verdict.grade is Grade.LOOK and is_alike)
        if is_sound and self.num_points:  # poses alone, as of a list, are to be placed with points
            return _next_in(self.inputs.path, verdict.grade, self)
        if (
            second is not None
            and not is_alike
            and self.inputs.database
            and (second.wrong or second.grade.is_better_than(verdict.grade) or is_equal)
        ):
            return self._next_of_map(second)
        if any(one.kind is Kind.LENS for one in verdict.findings) and not self.evidence.lenses:
            return self._next_of_lenses(path)
        if verdict.grade is Grade.CANNOT_BE_JUDGED or not (self.inputs.database and self.num_pairs):
            return self._next_of_evidence(path)
        if verdict.doubts_database:
            text = "Next: check it against the database that it was made from."
            return NextStep(text, f"sfm-shapefit check {path} --database ITS_DATABASE")
        text = "Next: place the cameras anew from their rotations and matches, and compare."
        step = f"locate {path} located"
        if self.options:  # `locate` and `map` would make the same again
            text, step = "Next: see which of its pairs contradict one another.", f"inspect {path}"
        return NextStep(text, f"sfm-shapefit {step}{self.inputs.database_flag}")

    def _next_of_evidence(self, path: str) -> NextStep:
        """Return how to get more evidence: from photographs, or from all pairs of them if asked."""
        if self.inputs.database:
            text = "Next: make a model of all images of the database."
            return NextStep(text, f"sfm-shapefit map {self.inputs.typed_database} mapped")
        if self.images:
            text = "Next: match all its photographs, and place them anew."
            return NextStep(text, "sfm-shapefit map {images} mapped")
        text = "Next: check it against its photographs, or the database that it was made from (--database)."
        return NextStep(text, f"sfm-shapefit check {path} --images {{images}}")

    def _next_of_map(self, second: SecondOpinion) -> NextStep:
        """Return how to take the model that `map` makes of the database: the one that was kept, or anew."""
        why = "; pairs support it" if second.wrong else ""
        if self.second_opinion:
            step = _next_in(f"{self.second_opinion}/{second.folder}", second.grade, self)
            return step._replace(text=f"Next: take the model that map made of the database{why}.")
        command = f"sfm-shapefit map {self.inputs.typed_database} mapped"
        return NextStep(f"Next: take the model that map makes of the database{why}.", command)

    def _next_of_lenses(self, path: str) -> NextStep:
        """Return what to do about lenses that cannot be: one per device is known better."""
        if self.num_lenses == 1 and self.options.get("intrinsics") != "all":
            text = "Next: calibrate the lens, or let it change where the cameras are placed anew."
            command = f"sfm-shapefit locate {path} located --intrinsics all{self.inputs.database_flag}"
            return NextStep(text, command)
        text = "Next: give all images of a device one lens of few parameters, and reconstruct them again."
        return NextStep(text, "sfm-shapefit map {images} mapped")

    def told(self, cameras: Table[CameraRow], pairs: Table[PairRow]) -> Telling:
        """Return what the terminal says, of cameras what is weak about them."""
        # One that the second opinion confirms is not told, whatever its weakness.
        doubted = (row for row in cameras if row.placed and row.name in self.verdict.cameras)
        weak = [f"{row.name}: {row.reason}" for row in doubted if row.reason]
        absent = first_of([row.name for row in cameras if not row.placed])
        judged = np.isfinite(pairs.columns["direction"]).all(axis=1)  # the others say nothing of positions
        against, num_rejected = contradicting(pairs), int(np.sum(contradicting(pairs) & ~judged))
        counts = int(np.sum(against & judged)), int(judged.sum())
        lines = self.told_lines(counts, num_rejected=num_rejected)[:2]
        second = row("second opinion", self.evidence.second.statement if self.evidence.second else "")
        notes = Row("warning", [one for one in self.warnings if one not in self.evidence.statements])
        bars = row("scale bars", describe_scale_bars(self.scale_bars))
        rows = [Row("weak", weak), row("without a pose", absent), second, bars, notes]
        return Telling(lines, rows, elsewhere="see the report", step=self.next_step)


class JoinedFacts(CheckedFacts):
    """locate.json of joined models, those of `map` in joined_0: looked at, not placed anew."""

    options: Options
    models: Annotated[list[str], "The models in it, as they were given."]
    joins: Annotated[list[JoinFacts], "How they were joined."]
    scale_sigma: Annotated[float | None, "Relative standard deviation of the scale; null if not known."]
    known_distances: Annotated[
        tuple[DistanceFacts, ...], "Distances that the user gave, and those in the model."
    ]
    datum: Annotated[EarthDatum | None, "Where the origin is on Earth; null if that is not known."]

    def scene_rows(self) -> list[Row]:
        """Return what came of joining the models."""
        return [Row("join", [one.statement for one in self.joins])]

    @property
    def next_step(self) -> NextStep:
        """What to do next."""
        return next_of_model(self.verdict.grade, self)


class DatabaseInputs(Record):
    """What `map` worked from."""

    database: Annotated[str, "The database's path, from the root on."]


class Component(Record):
    """One connected component of the images."""

    folder: Annotated[str, "Where it stands in OUT."]
    num_images: Annotated[int, "Images that have an averaged rotation."]
    num_placed: Annotated[int, "Cameras in the output."]
    averaging: Annotated[Averaging, "Where its rotations come from."]
    located: Annotated[ModelFacts, "What stands in the model's own locate.json."]


class MapFacts(Record):
    """map.json, and what `sfm-shapefit map --json` prints."""

    schema_version: Version = SCHEMA_VERSION
    inputs: Annotated[DatabaseInputs, "What was read."]
    options: Options
    num_images: Annotated[int, "Images of the database."]
    num_placed: Annotated[int, "Cameras in all models."]
    num_video_frames: Annotated[int, "Images that are frames of a video."]
    num_pairs: Annotated[int, "Pairs with a relative rotation."]
    models: Annotated[list[Component], "One per connected component, most cameras first."]
    joins: Annotated[list[JoinFacts], "What came of joining the models; one for each but the largest."]
    left_out: Annotated[dict[str, str], "Images in no model, and why."]
    timings_s: Timings
    warnings: Warnings
