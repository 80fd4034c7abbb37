"""What COLMAP's commands and options are called here, for who types them out of habit."""

from collections.abc import Iterable, Set

from sfm_shapefit.base.wording import counted

_COMMANDS = {
    **dict.fromkeys(("mapper", "global_mapper", "hierarchical_mapper"), "map DATABASE OUT"),
    **dict.fromkeys(("rotation_averager", "view_graph_calibrator", "image_registrator"), "map DATABASE OUT"),
    "mapper_resume": "map DATABASE OUT",
    "pose_prior_mapper": "map DATABASE OUT --priors database",
    "color_extractor": "map DATABASE OUT --images IMAGES",
    **dict.fromkeys(("automatic_reconstructor", "feature_extractor", "exhaustive_matcher"), "map IMAGES OUT"),
    **dict.fromkeys(("spatial_matcher", "transitive_matcher", "geometric_verifier"), "map IMAGES OUT"),
    **dict.fromkeys(("guided_geometric_verifier", "database_creator", "project_generator"), "map IMAGES OUT"),
    "sequential_matcher": "map IMAGES OUT --pairing sequential",
    **dict.fromkeys(("vocab_tree_matcher", "vocab_tree_retriever"), "map IMAGES OUT --pairing retrieval"),
    "rig_configurator": "map IMAGES OUT --rig-config-path FILE",
    "point_triangulator": "locate MODEL OUT",
    **dict.fromkeys(("bundle_adjuster", "rig_bundle_adjuster"), "locate MODEL OUT --adjust full"),
    "model_aligner": "locate MODEL OUT --priors FILE",
    "model_analyzer": "check MODEL",
    "gui": "check MODEL --report FILE",
    "model_comparer": "evaluate MODEL REF",
    "model_converter": "convert MODEL OUT",
    "model_merger": "join MODEL MODEL... OUT",
    **dict.fromkeys(("image_undistorter", "image_undistorter_standalone"), "workspace MODEL IMAGES OUT"),
    "image_rectifier": "workspace MODEL IMAGES OUT",
    "model_orientation_aligner": "workspace MODEL IMAGES OUT --level auto",
    "help": "--help",
    "version": "--version",
}
"""Commands of COLMAP, present and former, that have a counterpart."""
_BEFORE = frozenset(
    {"database_cleaner", "database_merger", "feature_importer", "matches_importer", "vocab_tree_builder"}
)
"""Commands of COLMAP that prepare a database."""
_AFTER = frozenset(
    {
        *("image_deleter", "image_filterer", "point_filtering", "model_clusterer", "model_cropper"),
        *("model_splitter", "model_transformer"),
    }
)
"""Commands of COLMAP that change a model."""
_DENSE = frozenset(
    {
        *("patch_match_stereo", "stereo_fusion", "poisson_mesher", "delaunay_mesher"),
        *("advancing_front_mesher", "mesh_simplifier", "mesh_texturer", "image_texturer"),
    }
)
"""Commands of COLMAP that go on from a workspace."""
_PROGRAMS = ("colmap", "glomap")

_OF_CONFIG = " in the file of --config"  # behind a key
_REFINED = ("focal_length", "extra_params")
_OPTIONS = {
    **{f"{ba}refine_{what}": "--intrinsics held, focal or all" for ba in ("", "ba_") for what in _REFINED},
    **dict.fromkeys(("ba_refine_sensor_from_rig", "refine_sensor_from_rig"), "--rigs held or free"),
    **{
        theirs: f"{ours} = ...{_OF_CONFIG}"
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
    "max_num_models": "images are placed and adjusted all at once, so leave it out",
    **dict.fromkeys(
        ("input_path", "input_path1", "input_path2", "output_path"),
        "here paths go by their place, without a flag",
    ),
}
"""Options of COLMAP that are not needed here, and what to do."""


_MAPPERS = ("Mapper", "GlobalMapper")
_OF_GROWTH = ("init_", "ba_local_", "ba_global_")
"""How options begin that tell COLMAP how to grow a model image by image."""
_GONE = {"--executor": "threads share all work; for other machines there is --scheduler"}
"""Flags of earlier versions, and what to do instead."""


def answer_for_command(name: str, following: str = "") -> str | None:
    """Return what a command of COLMAP's is here; None if it is none.

    Where the name is that of the program, its command is the `following` word.
    """
    if name in _PROGRAMS:
        ours = "`sfm-shapefit --help` lists the commands"
        return answer_for_command(following) or f"{name} is another program; {ours}"
    for names, where in (
        (_BEFORE, "run it on the database before sfm-shapefit map DATABASE OUT"),
        (_AFTER, "run it on a model that map or locate wrote"),
        (_DENSE, f"run it on the folder of sfm-shapefit {_COMMANDS['image_undistorter']}"),
    ):
        if name in names:
            return f"{name} is COLMAP's and has no counterpart here; {where}"
    return f"{name} is COLMAP's; here it is sfm-shapefit {_COMMANDS[name]}" if name in _COMMANDS else None


def answer_for(flag: str, known: Set[str]) -> str | None:
    """Return what a flag of COLMAP's, or of an earlier version, is here; None if it is none.

    The command has the `known` flags and keys of a file.
    """
    if flag in _GONE:
        return f"{flag} is gone: {_GONE[flag]}"
    name = flag.removeprefix("--")
    if here := _counterpart(name, known):
        return f"{flag} is COLMAP's; here it is {here}"
    if why := _needless(name):
        return f"{flag} is COLMAP's; {why}"
    return f"{flag} is COLMAP's, and this command has nothing like it; leave it out" if "." in name else None


def answer_for_file(names: Iterable[str], known: Set[str]) -> str | None:
    """Return what options of a file are here, by names as Mapper.min_num_matches; None if none is COLMAP's.

    The command has the `known` flags and keys of a file.
    """
    names = list(names)
    if not any(_is_colmaps(name) for name in names):
        return None
    others = [name for name in names if not name.endswith("_path")]
    here = {name: _counterpart(name, known) for name in others}
    told = [f"{name} is {ours.removesuffix(_OF_CONFIG)} here" for name, ours in here.items() if ours]
    told += ["paths are arguments here"] if len(others) < len(names) else []
    useless = sum(ours is None for ours in here.values())
    told += [f"{counted(useless, 'option')} can be left out"] if useless else []
    return f"has options of COLMAP, which are not read: {'; '.join(told)}"


def _is_colmaps(option: str) -> bool:
    group, _, name = option.rpartition(".")
    return group in _MAPPERS or name in _OPTIONS or name in _NEEDLESS


def _counterpart(name: str, known: Set[str]) -> str | None:
    """Return what an option of COLMAP's is here, its group before a point; None if it is nothing."""
    group, _, name = name.rpartition(".")
    here = _OPTIONS.get(name, f"--{name.replace('_', '-')}")
    if name in _NEEDLESS or (group and name.startswith(_OF_GROWTH)):
        return None
    return here if here.split()[0] in known or here.startswith("sfm-shapefit") else None


def _needless(name: str) -> str | None:
    """Return why an option of COLMAP's is not needed here; None if it is another one."""
    group, _, name = name.rpartition(".")
    grows = group and name.startswith(_OF_GROWTH) and name not in _NEEDLESS
    return _NEEDLESS.get("max_num_models" if grows else name)
