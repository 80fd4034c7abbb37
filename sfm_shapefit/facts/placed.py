"""What is told of any placement: records with their sentences, each with what computes and what says it.

Terminal and notebooks begin with three lines, whose figures the report has as tiles:

    25 of 25 images placed, 1,364 points, mean reprojection error 0.56 px
    matches: courtyard/database.db; 44 of 176 pairs contradict the result
    positions known to ± 0.0092 % of the scene
"""

import math
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from typing import Annotated, Any, Literal, Self

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.base.arrays import FloatArray, quantile
from sfm_shapefit.base.display import NextStep, Row, Telling, row
from sfm_shapefit.base.geometry import extent_of, fit_similarity_l1, median_spread
from sfm_shapefit.base.paths import from_here
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, in_unit, rounded
from sfm_shapefit.facts.tables import CameraRow, Table
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.reasons import ModelVerdict
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.place import Placement, count_large
from sfm_shapefit.placement.right_pairs import TakenForRight
from sfm_shapefit.refinement.starts import Finish
from sfm_shapefit.solver.solver_options import Solve, Status

UNITS = {
    "input": "in the input's units",
    "unit": "units",
    "rig": "in the rigs' units",
    "distance": "in the known distance's units",
    "prior": "in the priors' units",
    "fixed": "in the fixed cameras' units",
    "control points": "in the control points' units",
    "scale bars": "in the scale bars' units",
}
"""Unit of a standard deviation, by the choice of the scale."""
METERS = "m"
"""Unit of positions whose origin on Earth is known."""
SOLVER_UNITS = "in the solver's units"
NOISE_ONLY = "matching noise only"
"""Beginning of a statement that standard deviations leave out errors of rotations and calibration."""
BY_PRIORS = "the position priors"
"""End of a statement that standard deviations include errors of scale and origin."""
IN_MEMORY = "in memory"
"""Stand-in for the path of a model without one, in locate.json."""
SCHEMA_VERSION: Literal[1] = 1  # number in each JSON output; within it keys are added, never renamed

_MOST_DEG = 89.0  # degrees, largest angle given in pixels; its tangent is finite
_CAP_OF_SIZE = 0.5  # share of the spread of all; a camera farther off has no say in a fitted similarity
_SAME = 1e-9  # share of the spread; positions that are closer differ by rounding only
_OTHERS = {True: ", and no other is as good", False: ", but others may be as good", None: ""}
_QUANTILES = (25, 50, 75, 90)  # percent of the pairs; their residuals stand in locate.json
_ANGLES_DEG = (1, 2, 5, 10, 30, 90)  # degrees; the share of pairs beyond each stands in locate.json
_NOT_SOLVED = "free: its directions determine no placement"

Options = Annotated[dict[str, Any], "The settings of the run, a key per option of the command."]
Timings = Annotated[dict[str, float], "Wall-clock seconds per stage."]
Versions = Annotated[dict[str, str], "Versions of the packages that the answer depends on."]
Warnings = Annotated[list[str], "What the user should know, a sentence each."]
Version = Annotated[Literal[1], "Keys are added, never renamed, within a version."]


class KeyFigures(Record):
    """The figures that terminal and report begin with, beside the number of placed cameras."""

    pair_error_deg: Annotated[
        float | None,
        "Median angle between the direction of a pair that agrees and the line between its cameras.",
    ]
    pair_error_px: Annotated[
        float | None, "The same in pixels, at the images' median focal length; null for a bare graph."
    ]
    sigma: Annotated[
        float | None,
        "Median over the placed cameras of the largest standard deviation along the axes; null if not known.",
    ]
    sigma_of_extent: Annotated[float | None, "The same as a share of the extent of the placed cameras."]
    sigma_unit: Annotated[str, "Unit of sigma, to follow the number."]

    @classmethod
    def of_cameras(
        cls, cameras: Table[CameraRow], pair_error_deg: float | None, focal_length_px: float, unit: str
    ) -> Self:
        """Return the figures of placed cameras.

        Args:
            cameras: their rows; those that are not placed do not count.
            pair_error_deg: median angle between the direction of a pair and the line between its cameras.
            focal_length_px: median over the images, as pairs are of images, and one camera may take most of
                them; NaN for a bare graph.
            unit: what positions are given in, see `unit_of`, or `SOLVER_UNITS`.
        """
        placed, centers, sigmas = (cameras.columns[name] for name in ("placed", "center", "sigma"))
        centers = centers[placed & np.isfinite(centers).all(axis=1)]
        extent = extent_of(centers) if len(centers) else 0.0
        known = sigmas[placed].max(axis=1)
        sigma = float(np.median(known[known > 0.0])) if (known > 0.0).any() else math.nan
        sigma = sigma if math.isfinite(sigma) else math.nan
        error_deg = math.nan if pair_error_deg is None else pair_error_deg
        return cls(
            pair_error_deg=error_deg,
            pair_error_px=math.tan(math.radians(min(error_deg, _MOST_DEG))) * focal_length_px,
            sigma=sigma,
            sigma_of_extent=sigma / extent if extent > 0.0 else math.nan,
            sigma_unit=unit,
        )

    @property
    def pair_error(self) -> str:
        """The error of a pair in words."""
        if self.pair_error_deg is None:
            return "not known"
        in_pixels = "" if self.pair_error_px is None else f" ({self.pair_error_px:.2g} px)"
        return f"{rounded(self.pair_error_deg, digits=2)} deg{in_pixels}"

    @property
    def unit(self) -> str:
        """Unit of positions where that is known, else "units"."""
        return METERS if self.sigma_unit == METERS else "units"

    @property
    def has_scale(self) -> bool:
        """Whether something known set the scale of positions."""
        return self.sigma_unit not in (UNITS["input"], UNITS["unit"], SOLVER_UNITS)

    def uncertainty(self, sigma_of: str) -> str:
        """Say how uncertain a position is; `sigma_of` as of `Facts`."""
        share = self.sigma_of_extent
        if self.sigma is None or share is None or share > 1.0:
            return "the uncertainty of positions is not known"
        sigma = in_unit(self.sigma, self.sigma_unit, digits=2)
        measured = f" ({sigma}, {relation_of(sigma_of)})" if self.has_scale else ""
        return f"positions known to ± {100.0 * share:.2g} % of the scene{measured}{scope_of(sigma_of)}"


def unit_of(gauge: Gauge) -> str:
    """Return what positions in a gauge are given in, to follow a number."""
    return METERS if gauge.datum else UNITS[gauge.scale]


def relation_of(sigma_of: str) -> str:
    """Say what standard deviations are relative to, in few words."""
    if sigma_of.endswith(BY_PRIORS):
        return f"relative to {BY_PRIORS}"
    return f"relative to {'the fixed cameras' if 'fixed cameras' in sigma_of else 'one another'}"


def scope_of(sigma_of: str) -> str:
    """Say after a comma that standard deviations know of noise only, if so."""
    return f", {NOISE_ONLY}" if sigma_of.startswith(NOISE_ONLY) else ""


class LooseGroup(Record):
    """Cameras that are rigid by the graph but loose by the geometry."""

    cameras: Annotated[list[str], "The group's images."]
    cause: Annotated[str, "Why it hangs loose."]


class Piece(Record):
    """A parallel-rigid piece of three cameras or more."""

    num_cameras: Annotated[int, "Cameras of it, placed or not."]
    scale: Annotated[str, "Its gauge, in words, or why it has none."]
    hinges: Annotated[list[str], "Cameras that it shares with other pieces."]
    folder: Annotated[str, 'Where it stands in OUT, "." for the largest; empty if it was not solved.']
    num_placed: Annotated[int, "Cameras of it that are in the output; the others are not trusted."]

    @property
    def statement(self) -> str:
        """Where it stands, in words."""
        hinged = f", hinged at {', '.join(self.hinges)}" if self.hinges else ""
        cameras = f"{self.num_placed} of {counted(self.num_cameras, 'camera')}"
        return f"{self.folder}: {cameras}{hinged}, with a scale of its own"


def folder_of(piece: int) -> str:
    """Return where a piece stands in the output."""
    return f"pieces/{piece}" if piece else "."


def pieces_of(placement: Placement, solved: Iterable[tuple[int, str, int]]) -> list[Piece]:
    """Return the parallel-rigid pieces of three cameras or more, and the largest.

    Pieces that are `solved` have a number, a scale and a number of placed cameras.
    """
    facts = {number: (scale, num_placed) for number, scale, num_placed in solved}
    n, graph = placement.num_cameras, placement.graph
    rows = []
    for k, piece in enumerate(placement.pieces[: max(count_large(placement.pieces, placement.measured), 1)]):
        scale, num_placed = facts.get(k, (_NOT_SOLVED, 0))
        rows.append(
            Piece(
                num_cameras=int(np.sum(piece.nodes < n)),
                scale=scale,
                hinges=[graph.name_of(hinge) for hinge in piece.hinges[piece.hinges < n].tolist()],
                folder=folder_of(k) if k in facts else "",
                num_placed=num_placed,
            )
        )
    return rows


class Delivered(Record):
    """What is certified, and how far the cameras that are delivered stand from it.

    The certificate proves the optimum of ShapeFit. What is delivered is mostly not that optimum: it is
    refined in angles, from ShapeFit's optimum or from LUD's, and may be adjusted after.
    """

    statement: Annotated[str, "Both in words."]
    from_certified_median: Annotated[
        float | None,
        "Median distance from the certified optimum after the similarity that fits best, as a share of the "
        "scene's radius; null where there is no distance.",
    ]
    from_certified_max: Annotated[float | None, "The largest of these distances."]

    @classmethod
    def compare(cls, placement: Placement, centers: FloatArray, *, adjusted: bool) -> Self:
        """Compare the delivered centers (k, d), NaN for those that are left out, with the certified optimum.

        The last step was a bundle adjustment, if `adjusted`.
        """
        solved, finish = placement.certified, placement.refined.finish
        delivered = f"{finish.start}, refined in angles" if finish.refined else finish.start
        delivered += ", then adjusted" if adjusted else ""
        to = f"to {max(solved.gap, 0.0):.1e}"
        certified = f"ShapeFit's optimum is certified {to}{_OTHERS[solved.unique]}"
        if solved.status is not Status.CONVERGED:
            certified = f"ShapeFit's optimum is not certified to the tolerance, only {to}"
        kept = np.isfinite(centers).all(axis=1)
        optimum, there = solved.locations[: len(centers)][kept], centers[kept]
        size = median_spread(there)
        onto = fit_similarity_l1(optimum, there, cap=_CAP_OF_SIZE * size)
        distances = np.linalg.norm(onto.apply(optimum) - there, axis=1) / size
        median, largest = float(np.median(distances)), float(distances.max())
        apart = f"{delivered}, {median:.2%} of the scene's radius from it (median; at most {largest:.2%})"
        apart = "that optimum itself" if largest <= _SAME else apart
        return cls(
            statement=f"{certified}; delivered: {apart}",
            from_certified_median=median,
            from_certified_max=largest,
        )


class InputFacts(Record):
    """What a command worked from."""

    @property
    def path(self) -> str:
        """Where it is, to name the result by."""
        raise NotImplementedError


class Facts(Record):
    """What is told of anything that stands in cameras.csv and pairs.csv, and drawn by the report."""

    schema_version: Version = SCHEMA_VERSION
    inputs: Annotated[InputFacts, "What was read."]
    verdict: Annotated[ModelVerdict, "One verdict for the whole model."]
    options: Options
    num_images: Annotated[int, "Images of the input, posed or not; nodes of a bare graph."]
    num_placed: Annotated[int, "Images that are in the output."]
    figures: Annotated[KeyFigures, "The figures that matter."]
    num_pairs: Annotated[int, "Pairs that were looked at."]
    sigma_of: Annotated[
        str,
        "Errors that the standard deviations of cameras.csv include: matching noise only, or, after an "
        "adjustment, noise, rotations and calibration; and what they are relative to.",
    ]
    residual_level_deg: Annotated[
        float | None, "Level of the agreeing pairs' residuals; null where no pair says any."
    ]
    pieces: Annotated[list[Piece], "Parallel-rigid pieces, most cameras first; none of joined models."]
    loose_groups: Annotated[list[LooseGroup], "Groups of cameras that hang loose; none of joined models."]
    timings_s: Timings
    warnings: Warnings
    versions: Versions

    @property
    def next_step(self) -> NextStep:
        """What to do next."""
        raise NotImplementedError

    def piece_rows(self) -> list[Row]:
        """Say where the further pieces stand."""
        return [Row("further pieces", [piece.statement for piece in self.pieces[1:] if piece.folder])]

    def scene_rows(self) -> list[Row]:
        """Return what is told of lenses, rigs, control points and the scene, where there is something."""
        return []

    def expert_sentences(self) -> list[str]:
        """Return what only those who know the method ask for."""
        level = self.residual_level_deg
        if level is None:
            return []
        return [f"Pairs that agree are off by a standard deviation of {level:.2g} degrees per axis."]


class PlacedFacts(Facts):
    """What stands in the locate.json of a model and of a bare graph."""

    num_pairs_rejected: Annotated[
        int, "Pairs without a usable direction, and those that contradict the solution."
    ]
    residuals_deg: Annotated[
        dict[str, float],
        "Angles between directions and solved baselines of the placed pairs, in degrees: quantile_Q, and "
        "share_beyond_A, the share of the pairs beyond A degrees.",
    ]
    delivered: Annotated[Delivered, "What became of the certified optimum."]
    solve: Annotated[Solve, "The certified solve."]
    finish: Annotated[Finish, "What became of its optimum."]

    def expert_sentences(self) -> list[str]:
        """Return what only those who know the method ask for."""
        return [*super().expert_sentences(), f"The certificate: {self.delivered.statement}."]


def facts_of_placement(
    placement: Judged,
    cameras: Table[CameraRow],
    solved: Iterable[tuple[int, str, int]],
    measures: tuple[float, str],
) -> dict[str, Any]:
    """Return what can be said of any placement, by the fields of `PlacedFacts`; nodes count as images.

    Pieces are `solved` as of `pieces_of`; `measures` are focal length in pixels and unit of positions.
    """
    residuals, graph = residuals_deg(placement), placement.graph
    others = ("pycolmap", "numpy", "scipy", "clarabel")
    return {
        "num_images": graph.num_nodes,
        "num_placed": len(placement.cameras),
        "figures": KeyFigures.of_cameras(cameras, pair_error_deg(placement), *measures),
        "num_pairs": placement.num_pairs,
        "num_pairs_rejected": len(placement.rejected_pairs),
        "sigma_of": sigma_of(placement),
        "residual_level_deg": placement.assessment.level_deg,
        "residuals_deg": residuals,
        "loose_groups": [
            LooseGroup(
                cameras=[graph.name_of(camera) for camera in placement.cameras[group.cameras].tolist()],
                cause=group.cause.value,
            )
            for group in placement.assessment.loose_groups
        ],
        "pieces": pieces_of(placement, solved),
        "solve": placement.certified.facts,
        "finish": placement.refined.finish,
        "versions": {"sfm_shapefit": __version__} | {name: version(name) for name in others},
    }


def sigma_of(placement: Judged, *, by_priors: bool = False) -> str:
    """Say what the standard deviations of the cameras know of, and what they are relative to.

    Priors that pulled the cameras leave no similarity open.
    """
    if placement.adjusted_covariances is None:
        return f"{NOISE_ONLY}; relative to the centroid and scale of the cameras that are held"
    held = ~placement.adjusted_covariances.any(axis=(1, 2))
    relative = f"{int(held.sum())} fixed cameras" if held.any() else "the model's mean position and scale"
    relative = BY_PRIORS if by_priors else relative
    return f"adjusted: noise, rotations, calibration; relative to {relative}"


def pair_error_deg(placement: Judged) -> float | None:
    """Return the median residual in degrees of the placed pairs that agree; None if none does."""
    agree = placement.assessment.inliers[placement.pairs]
    residuals = placement.assessment.residuals_deg[placement.pairs][agree]
    return float(np.median(residuals)) if len(residuals) else None


def residuals_deg(placement: Judged) -> dict[str, float]:
    """Return quantiles of the placed pairs' residuals in degrees, and the shares that lie beyond angles."""
    residuals = placement.assessment.residuals_deg[placement.pairs]
    facts = {f"quantile_{q}": float(quantile(residuals, q / 100.0)) for q in _QUANTILES}
    return facts | {f"share_beyond_{angle}": float(np.mean(residuals > angle)) for angle in _ANGLES_DEG}


class GraphInputs(InputFacts):
    """What `place` worked from."""

    graph: Annotated[str, "The file or folder of the graph, from the root on."]
    directions: Annotated[str, "As given, or from which rotations."]

    @property
    def path(self) -> str:
        """Path of the graph as it is typed here."""
        return from_here(self.graph)


class GraphFacts(PlacedFacts):
    """locate.json of a bare graph, and what `sfm-shapefit place --json` prints."""

    inputs: Annotated[GraphInputs, "What was read."]
    dimension: Annotated[int, "Number of coordinates of a location."]
    right_pairs: Annotated[TakenForRight, "What is certain if the pairs taken for right are right."]

    @property
    def next_step(self) -> NextStep:
        """What to do next."""
        return NextStep(
            "Next: the positions are in cameras.csv; look at them from all sides.",
            "see {out}/cameras.csv",
        )

    def told(self, left_out: Sequence[str], locations: str) -> Telling:
        """Return what the terminal says; `left_out` are nodes with the reason, `locations` their origin."""
        rejected, pairs = f"{self.num_pairs_rejected:,}", counted(self.num_pairs, "pair")
        quantiles = " / ".join(f"{self.residuals_deg[f'quantile_{q}']:.3g}" for q in _QUANTILES)
        beyond = ", ".join(f"{self.residuals_deg[f'share_beyond_{a}']:.1%} beyond {a}" for a in _ANGLES_DEG)
        within = f"{'/'.join(map(str, _QUANTILES))} % of the pairs within {quantiles} deg"
        lines = [
            f"{self.num_placed:,} of {counted(self.num_images, 'node')} placed",
            f"{rejected} of {pairs} contradict the result; typical error of a pair {self.figures.pair_error}",
            self.figures.uncertainty(self.sigma_of),
        ]
        details = [
            row("directions", self.inputs.directions),
            row("dimension", str(self.dimension)),
            Row("residuals", [within, f"{beyond} deg"]),
            row("locations", locations),
            row("certificate", self.delivered.statement),
            row("right pairs", self.right_pairs.statement),
        ]
        rows = [Row("not placed", left_out), *self.piece_rows(), Row("warning", self.warnings)]
        return Telling(lines, rows, details, step=self.next_step)
