"""What COLMAP's commands and options are called here, for who types them out of habit."""

COMMANDS = {
    **dict.fromkeys(("mapper", "global_mapper", "hierarchical_mapper"), "map DATABASE OUT"),
    **dict.fromkeys(("rotation_averager", "view_graph_calibrator"), "map DATABASE OUT"),
    "pose_prior_mapper": "map DATABASE OUT --priors database",
    **dict.fromkeys(("automatic_reconstructor", "feature_extractor", "exhaustive_matcher"), "map IMAGES OUT"),
    "sequential_matcher": "map IMAGES OUT --pairing sequential",
    "vocab_tree_matcher": "map IMAGES OUT --pairing retrieval",
    "bundle_adjuster": "locate MODEL OUT --adjust full",
    "model_aligner": "locate MODEL OUT --priors FILE",
    "model_analyzer": "check MODEL",
    "model_comparer": "evaluate MODEL REF",
    "model_converter": "convert MODEL OUT",
    "model_merger": "join MODEL MODEL... OUT",
    "image_undistorter": "workspace MODEL IMAGES OUT",
}
"""Commands of COLMAP that have a counterpart."""

_REFINED = ("focal_length", "principal_point", "extra_params")
_OPTIONS = {
    **{f"{ba}refine_{what}": "--intrinsics held, focal or all" for ba in ("", "ba_") for what in _REFINED},
    **dict.fromkeys(("ba_refine_sensor_from_rig", "refine_sensor_from_rig"), "--rigs held or free"),
    **dict.fromkeys(("multiple_models", "max_num_models"), "--min-model-size"),
    "min_num_matches": "min_matches = ... in the file of --config",
    "use_prior_position": "--priors database",
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
        ("input_path", "input_path1", "input_path2", "output_path"),
        "here paths go by their place, without a flag",
    ),
}
"""Options of COLMAP that are not needed here, and what to do."""


_GONE = {"--executor": "threads share all work; for other machines there is --scheduler"}
"""Flags of earlier versions, and what to do instead."""


def answer_for(flag: str, known: set[str]) -> str | None:
    """Return what a flag of COLMAP's, or of an earlier version, is here; None if it is none.

    The command has the `known` flags.
    """
    if flag in _GONE:
        return f"{flag} is gone: {_GONE[flag]}"
    group, _, name = flag.removeprefix("--").rpartition(".")
    here = _OPTIONS.get(name, f"--{name.replace('_', '-')}")
    if name in _NEEDLESS:
        return f"{flag} is COLMAP's; {_NEEDLESS[name]}"
    if here.split()[0] in known or not here.startswith("--"):
        return f"{flag} is COLMAP's; here it is {here}"
    return f"{flag} is COLMAP's, and this command has nothing like it; leave it out" if group else None
