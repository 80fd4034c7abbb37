"""What the commands print with --json, key by key with its sentence; the JSON Schema is made of these types.

Keys may be added, never renamed, within a schema version. Numbers that are not finite stand as null.
"""

from typing import Annotated, Any, Literal, TypedDict

from sfm_shapefit.placement.diagnosis import Diagnosis
from sfm_shapefit.scene.evaluation import Recall, RelativePoseAuc
from sfm_shapefit.scene.pose_errors import ErrorSummary, TrajectoryErrors

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


class JudgedModel(TypedDict):
    """Whether the model can be used; the rules are in `judgement.grade`."""

    grade: Annotated[Literal["good", "look", "do not use"], "What to do with it."]
    statement: Annotated[str, "The same in a sentence."]
    cameras: Annotated[list[str], "To be looked at, the least trusted first."]
    reasons: Annotated[list[str], "Why the grade is not better."]


class EarthDatum(TypedDict):
    """A point on the WGS84 ellipsoid: the origin of axes east, north and up, in meters."""

    latitude_deg: Annotated[float, "Geodetic latitude."]
    longitude_deg: Annotated[float, "Longitude, east of Greenwich."]
    altitude_m: Annotated[float, "Height above the ellipsoid, or what the priors give for it."]


class KeyFigures(TypedDict):
    """The figures that terminal and report begin with, beside the number of placed cameras."""

    pair_error_deg: Annotated[
        float | None, "Median angle between the direction of a pair and the line between its cameras."
    ]
    pair_error_px: Annotated[
        float | None, "The same in pixels, at the images' median focal length; null for a bare graph."
    ]
    sigma: Annotated[
        float | None,
        "Median over the placed cameras of the largest standard deviation along the axes; null if not known.",
    ]
    sigma_of_extent: Annotated[float | None, "The same as a share of the extent of the placed cameras."]
    sigma_unit: Annotated[str, "What sigma is given in, to follow the number."]


class LooseGroup(TypedDict):
    """Cameras that are rigid by the graph but loose by the geometry."""

    cameras: Annotated[list[str], "The group's images."]
    cause: Annotated[str, "Why it hangs loose."]


class Piece(TypedDict):
    """A parallel-rigid piece of three cameras or more."""

    num_cameras: Annotated[int, "Cameras of it, placed or not."]
    scale: Annotated[str, "Its gauge, in words, or why it has none."]
    hinges: Annotated[list[str], "Cameras that it shares with other pieces."]
    folder: Annotated[str, 'Where it stands in OUT, "." for the largest; empty if it was not solved.']
    num_placed: Annotated[int, "Cameras of it that are in the output; the others are not trusted."]


class Solve(TypedDict):
    """The certified ShapeFit solve of the largest piece."""

    status: Annotated[str, "converged, inaccurate, max_iterations or cancelled."]
    objective: Annotated[float | None, "R(T) / L(T) of the paper at the ShapeFit optimum, dimensionless."]
    dual_bound: Annotated[float | None, "No placement has a lower objective."]
    gap: Annotated[float | None, "objective - dual_bound."]
    equality_residual: Annotated[
        float | None, "Violation of the dual's equality, relative to the largest weighted degree."
    ]
    unique: Annotated[bool | None, "Whether the certificate proves the optimum unique; null if not examined."]
    iterations: Annotated[int, "Of the solver that ran."]
    seconds: Annotated[float, "Wall-clock time of the solve."]
    method: Annotated[str, "The solver that ran."]
    method_reason: Annotated[str, "Why it was chosen."]


class Lud(TypedDict):
    """The LUD start and its own dual bound, in its own units."""

    objective: Annotated[float, "Value of the LUD program at its start."]
    dual_bound: Annotated[float | None, "No placement has a lower objective."]
    equality_residual: Annotated[float | None, "Violation of the dual's equality, as in `Solve`."]
    iterations: Annotated[int, "Of the solver."]


class Finish(TypedDict):
    """From the certified optimum to the centers."""

    start: Annotated[str, "The convex start that was kept."]
    refined: Annotated[bool, "Whether the angular refinement moved the start."]
    reason: Annotated[str, "Why this start was kept."]
    disagreement: Annotated[float | None, "How far the two starts disagree about lengths, as a share."]
    costs: Annotated[dict[str, float], "Robust angular cost of each start after refinement."]
    levels_deg: Annotated[list[float], "Level of the residuals, of pairs and of directions to points."]
    moved_median: Annotated[
        float,
        "Median move of cameras and points from the start that is kept, as a share of their median distance "
        "from the center.",
    ]
    moved_max: Annotated[float, "The largest such move."]
    num_turned_pairs: Annotated[
        int,
        "Directions, those to points too, that fit the start and not the refined locations, or the other way "
        "round.",
    ]
    num_put_back: Annotated[int, "Cameras that had left the scene and were put back."]
    lud: Annotated[Lud | None, "The second start; null if it was not solved."]


class PlacementAdjustment(TypedDict):
    """How placed cameras were adjusted to the pixels, and their given rotations treated."""

    statement: Annotated[str, "What was chosen and why, in words."]
    rotations: Annotated[Literal["held", "weighted", "free"], "How the given rotations were treated."]
    rotation_sigma_deg: Annotated[
        float | None, "Standard deviation per axis by which they were weighted; null if they were not."
    ]
    chance_deg: Annotated[
        float | None, "By how much chance would turn them per axis; null if the matches were not asked."
    ]


class RotationRefinement(TypedDict):
    """What the adjustment of the placement changed of the given rotations."""

    num_updated: Annotated[int, "Cameras that turned."]
    num_kept: Annotated[int, "Cameras that keep the rotation of the input."]
    median_change_deg: Annotated[float, "By how much those that turned did."]
    max_change_deg: Annotated[float, "By how much the camera turned that did most."]


class BundleAdjustment(TypedDict):
    """What --adjust full reached; mean reprojection errors."""

    converged: Annotated[bool, "Whether the last round met its tolerance."]
    iterations: Annotated[int, "Steps of all rounds together."]
    initial_error_px: Annotated[float, "At the seed's poses."]
    final_error_px: Annotated[float, "At the adjusted poses."]


class RigidGroups(TypedDict):
    """Cameras that move together: frames of rigs, and fixed cameras."""

    num_groups: Annotated[int, "Groups of the input."]
    num_placed: Annotated[int, "Groups with a camera in the output."]
    num_fixed: Annotated[int, "Cameras that stay where the input has them."]
    num_inner_pairs: Annotated[int, "Pairs inside one group, which say nothing."]


class CameraIntrinsics(TypedDict):
    """A camera whose intrinsics were in doubt, and what became of them."""

    camera: Annotated[int, "Its id in the model."]
    num_images: Annotated[int, "Placed images that it took."]
    model: Annotated[str, "COLMAP's name of its model."]
    origin: Annotated[str, "Where what was given comes from: a guess, EXIF data, or given."]
    decided_by: Annotated[
        Literal["adjusted", "view graph", "undetermined", "held"],
        "What decided about its focal length: the adjustments; the fundamental matrices alone; the matches "
        "do not tell it, so that it stays as given, and only the distortion may change; it was not to be "
        "changed.",
    ]
    given_focal_px: Annotated[float, "Mean focal length as given."]
    focal_px: Annotated[float, "Mean focal length of the output."]
    focal_sigma_px: Annotated[float | None, "Its standard deviation by the noise alone; null if not known."]
    given_parameters: Annotated[list[float], "All parameters as given, in COLMAP's order."]
    parameters: Annotated[list[float], "All parameters of the output."]


class RefinedSensor(TypedDict):
    """A sensor whose pose in its rig was refined."""

    camera: Annotated[int, "The id of its camera in the model."]
    turned_deg: Annotated[float, "By how much its rotation changed."]
    moved: Annotated[float, "How far it moved in its rig, in units of the output."]
    distance: Annotated[float, "From the reference sensor, in units of the output."]
    turn_sigma_deg: Annotated[float, "Standard deviation of its rotation per axis, by the noise alone."]
    place_sigma: Annotated[float, "Standard deviation of its place per axis, by the noise alone."]


class ModelInputs(TypedDict):
    """What `locate` worked from."""

    model: Annotated[str, "The model's folder or file."]
    database: Annotated[str | None, "The database whose matches were used, if any."]
    directions: Annotated[str, "Where the directions came from."]


class Delivered(TypedDict):
    """What is certified, and how far the cameras that are delivered stand from it."""

    statement: Annotated[str, "Both in words."]
    from_certified_median: Annotated[
        float | None,
        "Of the distances from the certified optimum after the similarity that fits best, as a share of the "
        "scene's radius; null where there is no distance.",
    ]
    from_certified_max: Annotated[float | None, "The largest of these distances."]


class PlacementSummary(TypedDict):
    """What stands in the locate.json of a model and of a bare graph."""

    schema_version: Version
    verdict: Annotated[JudgedModel, "One verdict for the whole model."]
    options: Options
    num_images: Annotated[int, "Images of the input, posed or not; nodes of a bare graph."]
    num_placed: Annotated[int, "Of these, how many are in the output."]
    figures: Annotated[KeyFigures, "The figures that matter."]
    num_pairs: Annotated[int, "Pairs that were looked at."]
    num_pairs_rejected: Annotated[
        int, "Pairs without a usable direction, and those that contradict the solution."
    ]
    sigma_of: Annotated[
        str,
        "What the standard deviations of cameras.csv know of: matching noise only, or, after an adjustment, "
        "noise, rotations and calibration; and what they are relative to.",
    ]
    residual_level_deg: Annotated[float, "Level of the agreeing pairs' residuals."]
    residuals_deg: Residuals
    loose_groups: Annotated[list[LooseGroup], "Groups of cameras that hang loose."]
    pieces: Annotated[list[Piece], "Parallel-rigid pieces, most cameras first."]
    delivered: Annotated[Delivered, "What became of the certified optimum."]
    solve: Annotated[Solve, "The certified solve."]
    finish: Annotated[Finish, "What became of its optimum."]
    timings_s: Timings
    warnings: Warnings
    versions: Versions


class Agreement(TypedDict):
    """What share of the evidence agrees with the cameras and points of the output."""

    pairs: Annotated[
        float | None,
        "Of the pairs of its cameras that say anything of a direction; null where none does.",
    ]
    observations: Annotated[
        float | None,
        "Of the keypoints matched in two or more of its other images, the share that sees a 3D point; null "
        "without a database.",
    ]
    contradicting: Annotated[
        float | None,
        "Of the same, the share that sees none and most of whose matches miss the epipolar lines of the "
        "cameras.",
    ]


class LoopOfVideo(TypedDict):
    """Pairs between two stretches of a video that are far apart in time."""

    first: Annotated[list[str], "First and last frame of the earlier stretch."]
    second: Annotated[list[str], "First and last frame of the later stretch."]
    num_pairs: Annotated[int, "Pairs between the two."]
    num_matches: Annotated[int, "Their inlier matches."]
    num_refused: Annotated[int, "Pairs left out, as they do not agree with the chain of pairs near in time."]
    angle_deg: Annotated[float, "Median angle between their relative rotations and the chain's."]
    tolerance_deg: Annotated[float, "Up to where they agree with it."]


class KnownDistance(TypedDict):
    """A distance that was told."""

    first: Annotated[str, "Name of an image."]
    second: Annotated[str, "Name of another."]
    known: Annotated[float, "How far apart they are, as told."]
    found: Annotated[float | None, "In the output; null if one of them is not in it."]


class ControlPoint(TypedDict):
    """A ground control point, and where the model has it."""

    name: Annotated[str, "As the file calls it, or else its coordinates."]
    use: Annotated[
        Literal["control", "check", "unused"],
        "Whether it sets scale and axes, only checks the model, or contradicts the others or has no place.",
    ]
    known: Annotated[list[float], "Where it is, in the output's axes."]
    residual: Annotated[list[float] | None, "The model's position minus the known one; null if it has none."]
    error: Annotated[float | None, "Length of the residual."]
    error_px: Annotated[float | None, "Mean distance of its marks from the point in the model, in pixels."]
    num_marks: Annotated[int, "Images of the model in which it is marked."]
    num_agreeing_marks: Annotated[int, "Of these, placed ones whose marks agree."]


class Alignment(TypedDict):
    """A similarity of the world: scale * rotation @ center + translation."""

    scale: Annotated[float, "Units of the one world in one of the other."]
    rotation: Annotated[list[list[float]], "3 rows."]
    translation: Annotated[list[float], "In units of the world that is mapped to."]


class Join(TypedDict):
    """A model of `map` beside the largest, and what came of joining it to a larger one."""

    model: Annotated[str, "Its folder."]
    to: Annotated[str, "The folder of the model that it was to be joined to."]
    joined: Annotated[bool, "Whether it was."]
    folder: Annotated[str | None, "Where both stand in one world; null if they are not joined."]
    statement: Annotated[str, "How and how surely, or why not, in words."]
    scale_sigma: Annotated[float | None, "Relative standard deviation of the scale between them."]
    turn_sigma_deg: Annotated[float | None, "Standard deviation of the turn between them."]
    center_sigma: Annotated[
        float | None,
        "Standard deviation of where its cameras come to lie, median, in units of the model that it is "
        "joined to.",
    ]
    similarity: Annotated[Alignment | None, "From its world to that of the model that it is joined to."]


class LocateSummary(PlacementSummary):
    """locate.json, and what `sfm-shapefit locate --json` prints."""

    inputs: Annotated[ModelInputs, "What was read."]
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
    agreement: Annotated[Agreement, "What share of the evidence agrees."]
    num_points: Annotated[int, "Triangulated 3D points."]
    mean_reprojection_error_px: Annotated[float | None, "Of these points; null if there are none."]
    num_points_as_nodes: Annotated[int, "Tracks that joined the view graph."]
    scale: Annotated[str, "Scale, origin and axes of the output, in words."]
    scale_sigma: Annotated[
        float | None,
        "Relative standard deviation of a scale that rigs, priors, known distances or control points tell; "
        "else null.",
    ]
    known_distances: Annotated[list[KnownDistance], "What was told of distances, and what the model has."]
    control_points: Annotated[list[ControlPoint], "Ground control points, with their residuals."]
    datum: Annotated[EarthDatum | None, "Where the output's origin is on Earth; null if that is not known."]
    rigid_groups: Annotated[RigidGroups | None, "Null where every camera moves by itself."]
    intrinsics: Annotated[
        list[CameraIntrinsics], "Cameras that were never calibrated, or were asked to be refined."
    ]
    refined_rigs: Annotated[list[RefinedSensor], "Sensors whose poses in their rigs were refined."]
    line_sigma: Annotated[
        float | None,
        "Median standard deviation of a position along the line on which all cameras stand, as a share of "
        "its length; null where they stand on none, or where it is not known.",
    ]
    num_doubtful_pairs: Annotated[
        int, "Pairs of doubtful_pairs.csv: used, but with far smaller scores than others."
    ]
    loops: Annotated[list[LoopOfVideo], "Of the videos among the images of `map`."]
    adjustment: Annotated[PlacementAdjustment | None, "Null if the placement stayed as it was found."]
    rotation_refinement: Annotated[RotationRefinement | None, "Null if the placement was not adjusted."]
    bundle_adjustment: Annotated[BundleAdjustment | None, "Null if it was not asked for."]
    join: Annotated[Join | None, "Of a model of `map` beside the largest; else null."]


class JoinedSummary(TypedDict):
    """joined_0/locate.json, of models of `map` that were joined: looked at, not placed anew."""

    schema_version: Version
    examined: Annotated[Literal[True], "Its positions were looked at as they stand."]
    inputs: Annotated[ModelInputs, "What the models were made of."]
    options: Options
    verdict: Annotated[JudgedModel, "No better than those of the models in it."]
    models: Annotated[list[str], "The folders of the models in it."]
    joins: Annotated[list[Join], "How they were joined."]
    num_images: Annotated[int, "Images of these models, placed or not."]
    num_placed: Annotated[int, "Cameras in it."]
    num_pairs: Annotated[int, "Pairs of these that were looked at, between the models too."]
    num_points: Annotated[int, "3D points."]
    figures: Annotated[KeyFigures, "What terminal and report begin with."]
    sigma_of: Annotated[str, "What the standard deviations of the cameras know of, and are relative to."]
    residual_level_deg: Annotated[
        float | None, "Level of the angles between directions and baselines; null where no pair says any."
    ]
    mean_reprojection_error_px: Annotated[float | None, "Of the 3D points; null if there are none."]
    median_track_length: Annotated[float | None, "Of the same."]
    scale: Annotated[str, "Scale, origin and axes, in words."]
    scale_sigma: Annotated[float | None, "Relative standard deviation of the scale; null if not known."]
    known_distances: Annotated[list[KnownDistance], "What was told of distances, and what the model has."]
    datum: Annotated[EarthDatum | None, "Where the origin is on Earth; null if that is not known."]
    pieces: Annotated[list[Piece], "None: it is one model."]
    loose_groups: Annotated[list[LooseGroup], "None: the models know theirs."]
    timings_s: Timings
    warnings: Warnings
    versions: Versions


class GraphInputs(TypedDict):
    """What `place` worked from."""

    graph: Annotated[str, "The file or folder of the graph."]
    directions: Annotated[str, "As given, or from which rotations."]


class GraphSummary(PlacementSummary):
    """locate.json of a bare graph, and what `sfm-shapefit place --json` prints."""

    inputs: Annotated[GraphInputs, "What was read."]
    dimension: Annotated[int, "Of the locations."]


class DatabaseInputs(TypedDict):
    """What `map` worked from."""

    database: Annotated[str, "The database's path."]


class Averaging(TypedDict):
    """How rotations were averaged, and how well they agree with the pairs."""

    statement: Annotated[str, "How the rotations were found, in words."]
    num_registered: Annotated[int, "Images that have a rotation."]
    num_pairs: Annotated[int, "Pairs whose residuals count."]
    agreeing_share: Annotated[float, "Share of the pairs, by the square root of their matches, that agree."]
    num_unsettled: Annotated[int, "Images that most of their pairs contradict, in every answer tried."]
    median_sigma_deg: Annotated[float | None, "Median standard deviation of a rotation; null if not known."]
    num_tried: Annotated[int, "Averagings of which this one is the most consistent."]
    certified: Annotated[
        bool | None, "Whether no rotations fit the kept pairs better; null if that was not checked."
    ]
    num_repeated_pairs: Annotated[
        int,
        "Pairs set aside since they would fold the images together, and lack matches that they should share.",
    ]
    num_rival_pairs: Annotated[int, "Pairs of another arrangement of the images that is as likely."]


class Model(TypedDict):
    """One connected component of the images."""

    folder: Annotated[str, "Where it stands in OUT."]
    num_images: Annotated[int, "Images that have an averaged rotation."]
    num_placed: Annotated[int, "Cameras in the output."]
    averaging: Annotated[Averaging, "Where its rotations come from."]
    located: Annotated[LocateSummary, "What stands in the model's own locate.json."]


class MapSummary(TypedDict):
    """map.json, and what `sfm-shapefit map --json` prints."""

    schema_version: Version
    inputs: Annotated[DatabaseInputs, "What was read."]
    options: Options
    num_images: Annotated[int, "Images of the database."]
    num_placed: Annotated[int, "Cameras in all models."]
    num_video_frames: Annotated[int, "Images that are frames of a video."]
    num_pairs: Annotated[int, "Pairs with a relative rotation."]
    models: Annotated[list[Model], "One per connected component, most cameras first."]
    joins: Annotated[list[Join], "What came of joining the models; one for each but the largest."]
    left_out: Annotated[dict[str, str], "Images in no model, and why."]
    timings_s: Timings
    warnings: Warnings


class PositionsSummary(TypedDict):
    """What `sfm-shapefit evaluate --json` prints against a table of known positions."""

    statement: Annotated[str, "What is compared with what, in words."]
    num_reference: Annotated[int, "Cameras of the table."]
    num_common: Annotated[int, "Cameras of both, by name."]
    missing: Annotated[list[str], "Names of the cameras that the model lacks."]
    position_error: Annotated[
        ErrorSummary | None, "As they stand, in the table's units; null if the model has no datum."
    ]
    median_offset: Annotated[
        list[float] | None, "Model minus table as they stand, the median of each axis; else null."
    ]
    aligned_position_error: Annotated[ErrorSummary, "After the robust similarity that fits best."]
    ref_from_model: Annotated[Alignment, "From the model's world to the table's."]


class Expected(TypedDict):
    """The memory that `locate` will take."""

    memory_mb: Annotated[dict[str, float], "Peak of each stage in millions of bytes."]
    peak_mb: Annotated[float, "The largest of these."]


class InspectSummary(TypedDict):
    """What `sfm-shapefit inspect --json` prints."""

    directions: Annotated[str, "Where they come from, and why."]
    num_images: Annotated[int, "Images or nodes of the input, with a rotation or without."]
    statuses: Annotated[dict[str, int], "Pairs by the sentence that says what became of them."]
    points: Annotated[str, "Whether 3D points join the graph, and why."]
    diagnosis: Annotated[Diagnosis, "What the view graph says before anything is solved."]
    expected: Annotated[Expected | None, "What locate will take; null for a bare graph."]
    rigs: Annotated[str, "How many frames hang together, if the model has rigs."]


class WorstCamera(TypedDict):
    """A camera that is farthest off."""

    name: Annotated[str, "Of its image."]
    position_error: Annotated[float, "In the reference's units."]
    rotation_error_deg: Annotated[float, "What remains after the best global rotation."]


class EvaluateSummary(TypedDict):
    """What `sfm-shapefit evaluate --json` prints."""

    num_reference: Annotated[int, "Cameras of the reference."]
    num_model: Annotated[int, "Cameras of the model."]
    num_common: Annotated[int, "Cameras of both, by name."]
    num_missing: Annotated[int, "Cameras that the model lacks."]
    num_extra: Annotated[int, "Cameras that the reference lacks."]
    missing: Annotated[list[str], "Names of the cameras that the model lacks."]
    extra: Annotated[list[str], "Names of the cameras that the reference lacks."]
    extent: Annotated[float, "Diagonal of the reference's cameras."]
    position_error: Annotated[ErrorSummary, "In the reference's units."]
    rotation_error_deg: Annotated[ErrorSummary, "What remains after the best global rotation."]
    recall: Annotated[list[Recall], "At shares of the extent, then at the thresholds that were asked for."]
    relative_pose_auc: Annotated[
        list[RelativePoseAuc], "Over all pairs of the reference's cameras, at 0.5, 1, 5 and 10 degrees."
    ]
    trajectory: Annotated[
        TrajectoryErrors | None,
        "ATE and RPE in the order of the names; null unless --trajectory asks for them.",
    ]
    worst: Annotated[list[WorstCamera], "The ten cameras with the largest position errors, the worst first."]
    ref_from_model: Annotated[Alignment, "From the model's world to the reference's."]
    rotation_ref_from_model: Annotated[list[list[float]], "The rotations' own alignment, 3 rows."]
    degenerate: Annotated[bool, "Whether the centers lie on a line."]
    warnings: Warnings
