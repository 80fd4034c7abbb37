"""What COLMAP's commands and options are called here, for who types them out of habit."""

_MAP, _IMAGES = "map DATABASE OUT", "map IMAGES OUT"

COMMANDS = {
    **dict.fromkeys(("mapper", "global_mapper", "hierarchical_mapper"), _MAP),
    **dict.fromkeys(("rotation_averager", "view_graph_calibrator"), _MAP),
    "pose_prior_mapper": f"{_MAP} --priors database",
    **dict.fromkeys(("automatic_reconstructor", "feature_extractor", "exhaustive_matcher"), _IMAGES),
    "sequential_matcher": f"{_IMAGES} --pairing sequential",
    "vocab_tree_matcher": f"{_IMAGES} --pairing retrieval",
    "bundle_adjuster": "locate MODEL OUT --adjust full",
    "model_aligner": "locate MODEL OUT --priors FILE",
    "model_analyzer": "check MODEL",
    "model_comparer": "evaluate MODEL REF",
    "model_converter": "convert MODEL OUT",
    "model_merger": "join MODEL MODEL... OUT",
    "image_undistorter": "workspace MODEL IMAGES OUT",
}
"""Commands of COLMAP that have a counterpart."""

_INTRINSICS = "--intrinsics held, focal or all"
_OPTIONS = {
    **dict.fromkeys(("ba_refine_focal_length", "refine_focal_length"), _INTRINSICS),
    **dict.fromkeys(("ba_refine_principal_point", "refine_principal_point"), _INTRINSICS),
    **dict.fromkeys(("ba_refine_extra_params", "refine_extra_params"), _INTRINSICS),
    **dict.fromkeys(("ba_refine_sensor_from_rig", "refine_sensor_from_rig"), "--rigs held or free"),
    **dict.fromkeys(("multiple_models", "max_num_models", "min_model_size"), "--min-model-size"),
    "min_num_matches": "min_matches = ... in the file of --config",
    "use_prior_position": "--priors database",
    "num_threads": "--threads",
    "project_path": "--config FILE, in TOML",
    **dict.fromkeys(("log_level", "log_to_stderr", "log_target"), "--quiet or --verbose"),
    "single_camera": "--camera-mode single",
    "single_camera_per_folder": "--camera-mode per-folder",
    "single_camera_per_image": "--camera-mode per-image",
}
"""Options of COLMAP that have a counterpart, by their names without the group."""
_NEEDLESS = {
    **dict.fromkeys(
        ("use_gpu", "ba_use_gpu", "gpu_index", "ba_gpu_index"), "no GPU is used, so leave it out"
    ),
    **dict.fromkeys(
        ("random_seed", "default_random_seed"), "the same input gives the same result, so leave it out"
    ),
    **dict.fromkeys(
        ("input_path", "input_path1", "input_path2", "output_path"),
        "here paths go by their place, without a flag",
    ),
}
"""Options of COLMAP that are not needed here, and what to do."""


def answer_for(flag: str, known: set[str]) -> str | None:
    """Return what a flag of COLMAP's is in a command that has the `known` flags; None if it is none."""
    group, _, name = flag.removeprefix("--").rpartition(".")
    here = _OPTIONS.get(name, f"--{name.replace('_', '-')}")
    if name in _NEEDLESS:
        return f"{flag} is COLMAP's; {_NEEDLESS[name]}"
    if here.split()[0] in known or (name in _OPTIONS and not here.startswith("--")):
        return f"{flag} is COLMAP's; here it is {here}"
    return f"{flag} is COLMAP's, and this command has nothing like it; leave it out" if group else None
