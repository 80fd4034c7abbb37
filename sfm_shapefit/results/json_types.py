"""What the commands print with --json, key by key with its sentence; the JSON Schema is made of these types.

Keys may be added, never renamed, within a schema version. Numbers that are not finite stand as null.
"""

from typing import Annotated, Any, Literal, TypedDict

from sfm_shapefit.evaluation import ErrorSummary, Recall
from sfm_shapefit.placement.diagnosis import Diagnosis

Options = Annotated[dict[str, Any], "The settings of the run, a key per option of the command."]
Timings = Annotated[dict[str, float], "Wall-clock seconds per stage."]
Versions = Annotated[dict[str, str], "Of the packages that the answer depends on."]
Residuals = Annotated[
    dict[str, float],
    "Angles between directions and solved baselines of the placed pairs, in degrees: quantile_Q, and "
    "share_beyond_A, the share of the pairs beyond A degrees.",
]
Warnings = Annotated[list[str], "What the user should know, a sentence each."]
Version = Annotated[Literal[1], "Keys are added, never renamed, within a version."]


class LooseGroup(TypedDict):
    """Cameras that are rigid by the graph but loose by the geometry."""

    cameras: Annotated[list[str], "The group's images."]
    cause: Annotated[str, "Why it hangs loose."]


class Piece(TypedDict):
    """A parallel-rigid piece of the view graph, most cameras first."""

    num_cameras: int
    scale: Annotated[str, "Its gauge, in words, or why it has none."]
    hinges: Annotated[list[str], "Cameras that it shares with other pieces."]
    folder: Annotated[str, "Where it stands in OUT; empty if it was not solved."]
    num_placed: Annotated[int, "Cameras of it that are in the output; the others are not trusted."]


class Solve(TypedDict):
    """The certified ShapeFit solve of the largest piece."""

    status: Annotated[str, "converged, inaccurate, max_iterations, cancelled, or not_solved for a baseline."]
    objective: Annotated[float | None, "R(T) / L(T) of the paper at the ShapeFit optimum, dimensionless."]
    dual_bound: Annotated[float | None, "No placement has a lower objective."]
    gap: Annotated[float | None, "objective - dual_bound."]
    equality_residual: Annotated[
        float | None, "Violation of the dual's equality, relative to the largest weighted degree."
    ]
    unique: Annotated[bool | None, "Whether the certificate proves the optimum unique; null if not examined."]
    iterations: int
    seconds: float
    method: Annotated[str, "The solver that ran."]
    method_reason: Annotated[str, "Why it was chosen."]


class Lud(TypedDict):
    """The LUD start and its own dual bound, in its own units."""

    objective: float
    dual_bound: float | None
    equality_residual: float | None
    iterations: int


class Finish(TypedDict):
    """From the certified optimum to the centres."""

    start: Annotated[str, "The convex start that was kept."]
    refined: bool
    reason: Annotated[str, "Why this start was kept."]
    disagreement: Annotated[float | None, "How far the two starts disagree about lengths, as a share."]
    costs: Annotated[dict[str, float], "Robust angular cost of each start after refinement."]
    levels_deg: Annotated[list[float], "Level of the residuals, of pairs and of directions to points."]
    moved_median: Annotated[
        float,
        "Median move of cameras and points from the start that is kept, as a share of their median distance "
        "from the centre.",
    ]
    moved_max: float
    num_turned_pairs: Annotated[
        int,
        "Directions, those to points too, that fit the start and not the refined locations, or the other way "
        "round.",
    ]
    num_put_back: Annotated[int, "Cameras that had left the scene and were put back."]
    lud: Lud | None


class RotationRefinement(TypedDict):
    """What --refine-rotations changed."""

    num_updated: int
    num_kept: int
    median_change_deg: float
    max_change_deg: float


class BundleAdjustment(TypedDict):
    """What --bundle-adjust reached; mean reprojection errors."""

    converged: bool
    iterations: int
    initial_error_px: float
    final_error_px: float


class RigidGroups(TypedDict):
    """Cameras that move together: frames of rigs, and fixed cameras."""

    num_groups: int
    num_placed: int
    num_fixed: Annotated[int, "Cameras that stay where the input has them."]
    num_inner_pairs: Annotated[int, "Pairs inside one group, which say nothing."]


class ModelInputs(TypedDict):
    """What `locate` worked from."""

    model: str
    database: str | None
    directions: Annotated[str, "Where the directions came from."]


class LocateSummary(TypedDict):
    """locate.json, and what `sfm-shapefit locate --json` prints."""

    schema_version: Version
    inputs: ModelInputs
    options: Options
    num_images: Annotated[int, "Of the input, posed or not."]
    num_placed: int
    not_trusted: Annotated[dict[str, str], "Images that are left out because they are not trusted, and why."]
    num_pairs: Annotated[int, "Pairs that were looked at."]
    num_pairs_rejected: Annotated[
        int, "Pairs without a usable direction, and those that contradict the solution."
    ]
    pairs: Annotated[
        dict[str, int],
        "Pairs by what became of them: usable, outlier, too_few_matches, few_inliers, no_parallax ...",
    ]
    num_points: int
    mean_reprojection_error_px: float | None
    num_points_as_nodes: Annotated[int, "Tracks that joined the view graph."]
    num_pairs_filtered: Annotated[int, "Pairs that --filter left out."]
    residual_level_deg: Annotated[float, "Level of the agreeing pairs' residuals."]
    residuals_deg: Residuals
    loose_groups: list[LooseGroup]
    scale: Annotated[str, "Scale, origin and axes of the output, in words."]
    rigid_groups: RigidGroups | None
    pieces: list[Piece]
    solve: Solve
    finish: Finish
    rotation_refinement: RotationRefinement | None
    bundle_adjustment: BundleAdjustment | None
    timings_s: Timings
    warnings: Warnings
    versions: Versions


class GraphInputs(TypedDict):
    """What `place` worked from."""

    graph: str
    directions: Annotated[str, "As given, or from which rotations."]


class GraphSummary(TypedDict):
    """locate.json of a bare graph, and what `sfm-shapefit place --json` prints."""

    schema_version: Version
    inputs: GraphInputs
    options: Options
    dimension: Annotated[int, "Of the locations."]
    num_images: Annotated[int, "Nodes of the graph."]
    num_placed: int
    num_pairs: Annotated[int, "Pairs that were looked at."]
    num_pairs_rejected: Annotated[int, "Pairs that contradict the solution."]
    num_pairs_filtered: Annotated[int, "Pairs that --filter left out."]
    residual_level_deg: Annotated[float, "Level of the agreeing pairs' residuals."]
    residuals_deg: Residuals
    loose_groups: list[LooseGroup]
    pieces: list[Piece]
    solve: Solve
    finish: Finish
    timings_s: Timings
    warnings: Warnings
    versions: Versions


class DatabaseInputs(TypedDict):
    """What `map` worked from."""

    database: str


class Averaging(TypedDict):
    """How rotations were averaged, and how well they agree with the pairs."""

    statement: str
    num_registered: int
    min_matches: int
    loss: str
    known_focal_lengths_only: bool
    agreeing_share: float
    num_tried: int


class Model(TypedDict):
    """One connected component of the images."""

    folder: str
    num_images: int
    num_placed: int
    averaging: Averaging
    located: LocateSummary


class MapSummary(TypedDict):
    """map.json, and what `sfm-shapefit map --json` prints."""

    schema_version: Version
    inputs: DatabaseInputs
    options: Options
    num_images: int
    num_placed: int
    num_pairs: Annotated[int, "Pairs with a relative rotation."]
    models: Annotated[list[Model], "One per connected component, most cameras first."]
    left_out: Annotated[dict[str, str], "Images in no model, and why."]
    timings_s: Timings
    warnings: Warnings


class Expected(TypedDict):
    """The memory that `locate` will take."""

    memory_mb: Annotated[dict[str, float], "Peak of each stage in millions of bytes."]
    peak_mb: float


class InspectSummary(TypedDict):
    """What `sfm-shapefit inspect --json` prints."""

    directions: Annotated[str, "Where they come from, and why."]
    num_images: int
    statuses: Annotated[dict[str, int], "Pairs by the sentence that says what became of them."]
    points: Annotated[str, "Whether 3D points join the graph, and why."]
    diagnosis: Diagnosis
    theory: Annotated[dict[str, Any] | None, "Constants of the recovery theorems, if asked for."]
    expected: Annotated[Expected | None, "What locate will take; null for a bare graph."]
    rigs: Annotated[str, "How many frames hang together, if the model has rigs."]


class Alignment(TypedDict):
    """The robust similarity of the centres."""

    scale: float
    rotation: list[list[float]]
    translation: list[float]


class EvaluateSummary(TypedDict):
    """What `sfm-shapefit evaluate --json` prints."""

    num_reference: int
    num_model: int
    num_common: int
    num_missing: int
    num_extra: int
    missing: list[str]
    extra: list[str]
    extent: Annotated[float, "Diagonal of the reference's cameras."]
    position_error: Annotated[ErrorSummary, "In the reference's units."]
    rotation_error_deg: ErrorSummary
    recall: list[Recall]
    ref_from_model: Alignment
    rotation_ref_from_model: list[list[float]]
    degenerate: Annotated[bool, "Whether the centres lie on a line."]
    warnings: Warnings
