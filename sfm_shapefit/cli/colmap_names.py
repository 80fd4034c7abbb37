"""What COLMAP's commands and options are called here, for who types them out of habit."""

from collections.abc import Set

_COMMANDS = {
    **dict.fromkeys(("mapper", "global_mapper", "hierarchical_mapper"), "map DATABASE OUT"),
    **dict.fromkeys(("rotation_averager", "view_graph_calibrator"), "map DATABASE OUT"),
    "pose_prior_mapper": "map DATABASE OUT --priors database",
    **dict.fromkeys(("automatic_reconstructor", "feature_extractor", "exhaustive_matcher"), "map IMAGES OUT"),
    "spatial_matcher": "map IMAGES OUT",
    "sequential_matcher": "map IMAGES OUT --pairing sequential",
    "vocab_tree_matcher": "map IMAGES OUT --pairing retrieval",
    "rig_configurator": "map IMAGES OUT --rig-config-path FILE",
    "point_triangulator": "locate MODEL OUT",
    "bundle_adjuster": "locate MODEL OUT --adjust full",
    "model_aligner": "locate MODEL OUT --priors FILE",
    "model_analyzer": "check MODEL",
    "model_comparer": "evaluate MODEL REF",
    "model_converter": "convert MODEL OUT",
    "model_merger": "join MODEL MODEL... OUT",
    "image_undistorter": "workspace MODEL IMAGES OUT",
    "model_orientation_aligner": "workspace MODEL IMAGES OUT --level auto",
}
"""Commands of COLMAP that have a counterpart."""
_DENSE = frozenset({"patch_match_stereo", "stereo_fusion", "poisson_mesher", "delaunay_mesher"})
"""Commands of COLMAP that go on from a workspace."""

_REFINED = ("focal_length", "extra_params")
_OPTIONS = {
    **{f"{ba}refine_{what}": "--intrinsics held, focal or all" for ba in ("", "ba_") for what in _REFINED},
    **dict.fromkeys(("ba_refine_sensor_from_rig", "refine_sensor_from_rig"), "--rigs held or free"),
    **{
        theirs: f"{ours} = ... in the file of --config"
        for theirs, ours in (
            ("min_num_matches", "min_matches"),
            ("filter_max_reproj_error", "max_reprojection_error_px"),
            ("max_normalized_reproj_error", "max_reprojection_error_px"),
            ("filter_min_tri_angle", "min_triangulation_angle_deg"),
            ("min_tri_angle_deg", "min_triangulation_angle_deg"),
            ("ignore_two_view_tracks", "ignore_two_view_tracks"),
            ("track_min_num_views_per_track", "min_track_length"),
        )
    },
    "constant_cameras": "--intrinsics held",
    "constant_rigs": "--rigs held",
    "fix_existing_frames": "sfm-shapefit locate MODEL OUT --fix solved",
    "use_prior_position": "--priors database",
    "use_gravity": "--gravity database",
    "num_threads": "--threads",
    "project_path": "--config FILE, in TOML",
    **dict.fromkeys(("log_level", "log_to_stderr", "log_target"), "--quiet or --verbose"),
    "single_camera": "--camera-mode single",
    "single_camera_per_folder": "--camera-mode per-folder",
    "single_camera_per_image": "--camera-mode per-image",
}
"""Options of COLMAP that have another name, without their group."""
_NEEDLESS = {
    **dict.fromkeys(
        ("use_gpu", "ba_use_gpu", "gpu_index", "ba_gpu_index"), "no GPU is used, so leave it out"
    ),
    **dict.fromkeys(("random_seed", "default_random_seed"), "nothing is random, so leave it out"),
    **dict.fromkeys(
        ("refine_principal_point", "ba_refine_principal_point"), "the principal point stays, so leave it out"
    ),
    "multiple_models": "the largest model is OUT/0, so leave it out",
    "max_num_models": "nothing is grown from a first pair, so leave it out",
    **dict.fromkeys(
        ("input_path", "input_path1", "input_path2", "output_path"),
        "here paths go by their place, without a flag",
    ),
}
"""Options of COLMAP that are not needed here, and what to do."""


_OF_GROWTH = ("init_", "ba_local_", "ba_global_")
"""How options begin that tell COLMAP how to grow a model image by image."""
_GONE = {"--executor": "threads share all work; for other machines there is --scheduler"}
"""Flags of earlier versions, and what to do instead."""


def answer_for_command(name: str) -> str | None:
    """Return what a command of COLMAP's is here; None if it is none, or has no counterpart."""
    if name in _DENSE:
        return f"{name} is COLMAP's; run it on the folder of sfm-shapefit {_COMMANDS['image_undistorter']}"
    return f"{name} is COLMAP's; here it is sfm-shapefit {_COMMANDS[name]}" if name in _COMMANDS else None


def answer_for(flag: str, known: Set[str]) -> str | None:
    """Return what a flag of COLMAP's, or of an earlier version, is here; None if it is none.

    The command has the `known` flags and keys of a file.
    """
    if flag in _GONE:
        return f"{flag} is gone: {_GONE[flag]}"
    group, _, name = flag.removeprefix("--").rpartition(".")
    here = _OPTIONS.get(name, f"--{name.replace('_', '-')}")
    if group and name.startswith(_OF_GROWTH) and name not in _NEEDLESS:
        name = "max_num_models"
    if name in _NEEDLESS:
        return f"{flag} is COLMAP's; {_NEEDLESS[name]}"
    if here.split()[0] in known or here.startswith("sfm-shapefit"):
        return f"{flag} is COLMAP's; here it is {here}"
    return f"{flag} is COLMAP's, and this command has nothing like it; leave it out" if group else None
