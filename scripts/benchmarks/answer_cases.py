"""The cases of `answers`: a name by meaning, which stays, and a command line in the folder of the inputs.

A word KEY=VALUE of a command line becomes a key of --config. A checkout that knows other words is recorded by
its own scripts, under the same names. A case whose output has a truth is followed by others that read that
output. Of large sets only defaults run.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.answer_inputs import MADE, MADRID, truth_of

BUNDLED = ("courtyard", "facade9", "photographed", "ring8")
_SETS = (
    *("Herz-Jesus-P25", "Herz-Jesus-P8", "brighton-beach", "castle-P19", "castle-P30", "fountain-P11"),
    *("kerry-park", "kitti-turn", "lego100", "liberty", "liberty-calibrated", "robots-1"),
)
_LARGE = ("kitti-turn", "liberty", "liberty-calibrated", "robots-1")
_WITHOUT_MODEL = "collection-guessed"
"""A set whose database is mapped; it has no model to start from."""
_SILENT = "--quiet --no-report"


class Case(NamedTuple):
    """One run of the command line."""

    name: str
    argv: tuple[str, ...]
    """Paths are relative to the folder of the inputs."""
    out: str = ""
    """Path of what it writes, if it writes."""
    scene: str = ""
    """Scene or set it reads; the case is skipped where that is missing."""
    followers: tuple["Case", ...] = ()
    """Cases that read its output, run after it."""
    quick: bool = False


_PLACEMENT = {
    "shapefit": "objective=shapefit",
    "lud": "objective=lud",
    "newton": "solver=newton",
    "admm": "solver=admm",
    "unrefined": "refine=false",
    "small-factor": "factor_memory_mb=1",
    "loose-gap": "tol=1e-5",
}
"""Variants that `locate` and `place` have in common."""

_FROM_PRIORS = {
    "priors": "--priors scenes/{scene}/priors.txt",
    "priors-pull": "--priors scenes/{scene}/priors.txt",
    "gps": "--priors scenes/{scene}/gps.csv",
    "gps-pull": "--priors scenes/{scene}/gps.csv",
    "control": "--control-points scenes/{scene}/control.txt",
    "control-adjusted": "--control-points scenes/{scene}/control.txt --adjust full",
    "distance": "--known-distance 0001.jpg 0003.jpg 2.5",
    "distances": "--known-distance 0001.jpg 0003.jpg 2.5 --known-distance 0002.jpg 0005.jpg 3.5",
    "database-priors": "--priors database",
}
"""Variants whose scale is told."""

_BOTH = {
    **_FROM_PRIORS,
    "all-trusted": "--min-trust 0",
    "points-never": "--points never",
    "points-always": "--points always",
    "unadjusted": "--adjust none",
    "adjusted": "--adjust full",
    "lenses-held": "--intrinsics held",
    "lenses-focal": "--intrinsics focal",
    "lenses-all": "--intrinsics all --adjust full",
    "sensors-free": "--rigs free --adjust full",
    "without-pairs": "--without scenes/{scene}/pairs.txt",
    "unit": "--scale unit",
    "one-thread": "--threads 1",
    "little-memory": "--max-memory-mb 1",
    "strict": "--strict",
}
"""Variants that `locate` and `map` have in common."""

_LOCATE = {
    **_PLACEMENT,
    **_BOTH,
    "input-scale": "--scale input",
    "rotations-free": "--rotations free",
    "rotations-held": "--rotations held",
    "rotations-sigma": "--rotations 0.5",
    "tracks": "directions=tracks",
    "tracks-adjusted": "directions=tracks --adjust full",
    "config": "--config told.toml",
    "fixed-names": "--fix scenes/{scene}/fixed.txt",
    "fixed-names-adjusted": "--fix scenes/{scene}/fixed.txt --adjust full",
    "fixed-solved": "--fix solved",
    "fixed-solved-adjusted": "--fix solved --adjust full",
    "fixed-solved-shapefit": "--fix solved objective=shapefit",
    "thresholds": "min_inliers=40 inlier_threshold_px=1 max_reprojection_error_px=2",
}
_NOT_OF_ALL = {"sensors-free", "database-priors", "gps", "gps-pull", "tracks-adjusted"}
_NOT_OF_ALL |= {"fixed-solved-adjusted", "fixed-solved-shapefit", "all-trusted"}
_OF_ALL = " ".join(name for name in _LOCATE if name not in _NOT_OF_ALL)
_LOCATED = {
    "courtyard": _OF_ALL,
    "castle-P19": " ".join(name for name in _OF_ALL.split() if not name.startswith("control")),
    "ring8": "tracks tracks-adjusted points-never distance priors fixed-names fixed-solved shapefit "
    "adjusted control-adjusted",
    "ring8-guessed": "adjusted lenses-held lenses-focal lenses-all",
    "facade9": "tracks-adjusted points-never priors priors-pull fixed-names fixed-solved control adjusted "
    "shapefit",
    "photographed": "adjusted rotations-free rotations-held rotations-sigma unadjusted points-never "
    "fixed-names priors-pull shapefit unrefined thresholds control-adjusted lenses-all without-pairs",
    "photographed-guessed": "adjusted lenses-held lenses-focal lenses-all",
    "kerry-park": "points-never fixed-names fixed-solved adjusted shapefit priors-pull tracks small-factor "
    "sensors-free",
    "rig": "shapefit lud admm fixed-names priors priors-pull adjusted points-always unrefined unit "
    "rotations-free database-priors sensors-free control",
    "ring8-hinged": "points-never priors adjusted",
    "ring8-pendant": "points-never",
    "ring8-cycle": "points-never",
    "courtyard-hinged": "points-never adjusted priors",
    "courtyard-broken": "fixed-solved rotations-free adjusted input-scale",
    "courtyard-new": "fixed-names fixed-names-adjusted fixed-solved fixed-solved-adjusted "
    "fixed-solved-shapefit priors-pull tracks input-scale",
    "photographed-new": "fixed-solved fixed-solved-adjusted",
    "castle-P30": "adjusted shapefit rotations-free unadjusted",
    "lego100": "points-never shapefit",
    "brighton-beach": "database-priors gps gps-pull",
}
"""Variants of each scene, besides the default and all-trusted."""

_MAP = {
    **_BOTH,
    "shapefit": "objective=shapefit",
    "many-matches": "min_matches=30",
    "large-models": "--min-model-size 20",
    "few-points-kept": "--min-points-per-image 0",
    "gravity": "--gravity scenes/{scene}/gravity.txt",
    "never-joined": "--join never --priors scenes/{scene}/priors.txt",
    "no-video": "--sequence none",
    "video": "--sequence names",
}
_MAPPED = {
    "photographed": "adjusted all-trusted many-matches large-models unadjusted points-never shapefit priors "
    "priors-pull control gravity few-points-kept one-thread",
    "photographed-guessed": "adjusted lenses-held lenses-all unadjusted",
    "courtyard": "adjusted gravity priors-pull control distances points-never without-pairs unadjusted",
    "ring8": "gravity distance priors points-never",
    "ring8-guessed": "lenses-held",
    "ring8-hinged": "points-never adjusted",
    "ring8-apart": "priors never-joined",
    "ring8-few": "distance",
    "courtyard-hinged": "points-never",
    "rig": "adjusted sensors-free priors unit",
    "fountain-P11": "adjusted gravity priors",
    "castle-P19": "adjusted gravity",
    "castle-P30": "",
    "Herz-Jesus-P8": "",
    "Herz-Jesus-P25": "",
    "lego100": "",
    "kerry-park": "adjusted",
    "brighton-beach": "gps gps-pull",
    **dict.fromkeys(("kitti-turn", "liberty", "liberty-calibrated", "robots-1", _WITHOUT_MODEL), ""),
}
"""Variants of each scene, besides the default."""

_PLACE = {
    **_PLACEMENT,
    "reversed": "--reverse",
    "rotations-1dsfm": "--rotations graphs/1dsfm/rots.txt",
    "rotations-g2o": "--rotations graphs/poses.g2o",
    "small-rotation-error": "--max-rotation-error 0.3",
}
_PLACED = {
    "graph40.txt": f"{' '.join(_PLACEMENT)} reversed",
    "random300.txt": " ".join(_PLACEMENT),
    "chain.txt": "shapefit lud admm unrefined",
    "pieces.txt": "shapefit admm",
    "plane.txt": "lud shapefit admm",
    "space5.txt": "shapefit",
    "box.txt": "small-factor",
    "cycle.txt": "",
    "1dsfm": "rotations-1dsfm lud small-rotation-error",
    "poses.g2o": "rotations-g2o",
    "poses.txt": "shapefit",
    MADRID: "",
}

_RING, _BROKEN = "scenes/ring8/sparse/0", "scenes/courtyard-broken"
_WRONG = {
    "no-command": "",
    "unknown-command": "frobnicate RING OUT",
    "no-model": "locate",
    "no-out": "locate RING",
    "missing-model": "locate scenes/nowhere/sparse/0 OUT",
    "empty-model": "locate empty OUT",
    "out-exists": "locate RING full",
    "overwrite-foreign": "locate RING full --overwrite",
    "out-is-model": "locate RING RING --overwrite",
    "swapped": "locate OUT RING",
    "unknown-option": "locate RING OUT --bundle",
    "unknown-objective": "locate RING OUT --objective best",
    "min-trust-2": "locate RING OUT --min-trust 2",
    "distance-of-unknown": "locate RING OUT --known-distance a.jpg 0003.jpg 2",
    "missing-priors": "locate RING OUT --priors nowhere.txt",
    "priors-of-others": "locate RING OUT --priors scenes/rig/priors.txt",
    "fix-unknown": "locate RING OUT --fix scenes/rig/fixed.txt",
    "control-of-others": "locate RING OUT --control-points scenes/rig/control.txt",
    "config-unknown-key": "locate RING OUT --config wrong.toml",
    "place-missing": "place graphs/nowhere.txt OUT",
    "place-malformed": "place graphs/malformed.txt OUT",
    "place-model": "place RING OUT",
    "place-rotations-of-graph": "place graphs/plane.txt OUT --rotations graphs/1dsfm/rots.txt",
    "map-model": "map RING OUT",
    "map-missing": "map scenes/nowhere/database.db OUT",
    "inspect-missing": "inspect scenes/nowhere",
    "evaluate-others": "evaluate RING scenes/rig/truth",
    "evaluate-without-reference": "evaluate RING",
    "check-empty": "check empty",
    "check-missing": "check scenes/nowhere",
    "convert-unknown": "convert RING OUT.xyz",
    "synth-options": "synth OUT --jpeg-quality 50",
}
_OTHERS = {
    "convert/text": "convert RING OUT --format colmap-txt",
    "convert/nerf": "convert RING OUT.json",
    "convert/tum": "convert RING OUT.tum",
    "convert/csv": "convert RING OUT.csv",
    **{
        f"synth/{shape}": f"synth OUT --shape {shape} --num-images 8 --num-points 300 "
        "--corrupted-pair-fraction 0.2"
        for shape in ("ring", "facade", "drive", "cloud", "courtyard")
    },
    "told/locate": "locate RING OUT",
    "told/map": "map scenes/photographed/database.db OUT",
    "told/place": "place graphs/pieces.txt OUT",
    "told/inspect": "inspect scenes/ring8-hinged/sparse/0 --points never",
    "help/all": "--help",
    "help/version": "--version",
    **{
        f"help/{command}": f"{command} --help"
        for command in ("locate", "map", "place", "inspect", "evaluate", "convert", "synth")
    },
}
_CHECKED = {
    **dict.fromkeys((*_SETS, "courtyard", "photographed", "ring8", "facade9", "courtyard-broken", "rig"), ""),
    "kerry-park": "global",
}
"""Models whose referee runs: the reference of each, or, of a broken scene, its sparse/0."""

_QUICK = {
    "courtyard": "default all-trusted adjusted unadjusted points-never priors priors-pull control distances "
    "shapefit lenses-all rotations-free admm without-pairs thresholds",
    "photographed": "default adjusted rotations-sigma",
    "ring8": "default tracks fixed-names control-adjusted",
    "facade9": "default adjusted priors-pull fixed-names",
    "rig": "default adjusted fixed-names sensors-free points-always",
    "ring8-hinged": "points-never",
    "courtyard-hinged": "points-never",
    "courtyard-new": "fixed-solved fixed-solved-adjusted",
    "photographed-guessed": "default",
}
_QUICK_CASES = {
    *(f"locate/{scene}/{variant}" for scene, variants in _QUICK.items() for variant in variants.split()),
    *(f"map/photographed/{variant}" for variant in ("default", "adjusted", "priors-pull")),
    *(f"map/{scene}/default" for scene in ("courtyard", "ring8-few", "rig", "photographed-guessed")),
    *("map/ring8/gravity", "map/ring8-apart/priors", "map/ring8-hinged/points-never"),
    *(f"place/graph40/{variant}" for variant in ("default", "unrefined", "shapefit", "admm")),
    *("place/pieces/default", "place/plane/default", "place/poses.txt/default", "place/1dsfm/default"),
    *(f"inspect/{scene}/default" for scene in ("courtyard", "ring8", "facade9", "rig", "ring8-hinged")),
    *(f"check/{scene}" for scene in ("courtyard", "photographed", "facade9", "courtyard-broken", "rig")),
    *("evaluate/errors", "convert/text", "convert/nerf", "synth/courtyard", "told/locate", "told/map"),
    *("wrong/out-exists", "wrong/unknown-option", "wrong/empty-model", "wrong/priors-of-others"),
}


def all_cases(folders: Mapping[str, Path]) -> list[Case]:
    """Return all cases; `folders` are those of the scenes and sets at hand."""
    further = sorted(set(folders) - {*BUNDLED, *_SETS, MADRID, _WITHOUT_MODEL})
    scenes = [*BUNDLED, *_SETS, *further, *MADE]
    truths = {name: truth_of(folder) for name, folder in folders.items() if name != MADRID}
    truths |= MADE
    cases = [
        *(case for name in scenes for case in _locate_cases(name, truths.get(name, ""))),
        *(case for name in _MAPPED for case in _map_cases(name, truths.get(name, ""))),
        *(case for graph in _PLACED for case in _place_cases(graph)),
        *_inspect_cases(scenes),
        *(_check_case(name, truths.get(name, "")) for name in _CHECKED),
        _case("evaluate/errors", f"evaluate {_BROKEN}/sparse/0 {_BROKEN}/truth --csv OUT.csv --json"),
        _case("evaluate/trajectory", f"evaluate {_BROKEN}/sparse/0 {_BROKEN}/truth --trajectory --json"),
        _case("evaluate/positions", f"evaluate {_RING} scenes/ring8/priors.txt --json"),
        *(_case(name, line) for name, line in _OTHERS.items()),
        *(_case(f"wrong/{name}", line) for name, line in _WRONG.items()),
    ]
    return [case._replace(quick=case.name in _QUICK_CASES) for case in cases]


def _out(name: str) -> str:
    return f"out/{name.replace('/', '-')}"


def _case(name: str, line: str, scene: str = "", followers: tuple[Case, ...] = ()) -> Case:
    """Return a case of its command line, in which OUT and RING stand for paths."""
    out = next((word.replace("OUT", _out(name)) for word in line.split() if word.startswith("OUT")), "")
    words = [out if word.startswith("OUT") else _RING if word == "RING" else word for word in line.split()]
    return Case(name=name, argv=tuple(words), out=out, scene=scene, followers=followers)


def _evaluation(name: str, model: str, truth: str, scene: str) -> Case:
    return _case(f"evaluate/{name}", f"evaluate {_out(name)}{model} {truth} --json", scene)


def _locate_cases(scene: str, truth: str) -> Iterator[Case]:
    """Yield the default, which is evaluated, and the variants of one scene."""
    name, reference = f"locate/{scene}/default", f"scenes/{scene}/{truth}"
    followers = [_evaluation(name, "", reference, scene)]
    if scene == "ring8":
        followers += [
            _case("told/evaluate", f"evaluate {_out(name)} {reference}"),
            _case("convert/output", f"convert {_out(name)} OUT.csv"),
        ]
    model = f"scenes/{scene}/sparse/0"
    yield _case(name, f"locate {model} OUT --json", scene, tuple(followers))
    for variant in () if scene in _LARGE else ("all-trusted", *_LOCATED.get(scene, "").split()):
        flags = _LOCATE[variant].format(scene=scene)
        yield _case(f"locate/{scene}/{variant}", f"locate {model} OUT {_SILENT} {flags}", scene)


def _map_cases(scene: str, truth: str) -> Iterator[Case]:
    """Yield the default and the variants of one database, each of which is evaluated."""
    for variant in ("default", *_MAPPED[scene].split()):
        name = f"map/{scene}/{variant}"
        flags = "--json" if variant == "default" else f"{_SILENT} {_MAP[variant].format(scene=scene)}"
        line = f"map scenes/{scene}/database.db OUT {flags}"
        yield _case(name, line, scene, (_evaluation(name, "/0", f"scenes/{scene}/{truth}", scene),))


def _place_cases(graph: str) -> Iterator[Case]:
    """Yield the default and the variants of one graph."""
    name, scene = graph.removesuffix(".txt") if graph != "poses.txt" else graph, MADRID * (graph == MADRID)
    for variant in ("default", *_PLACED[graph].split()):
        flags = "--json" if variant == "default" else f"{_SILENT} {_PLACE[variant]}"
        yield _case(f"place/{name}/{variant}", f"place graphs/{graph} OUT {flags}", scene)


def _inspect_cases(scenes: Sequence[str]) -> Iterator[Case]:
    """Yield the inspection of every scene and graph, and of a few without points."""
    for scene in scenes:
        line = f"inspect scenes/{scene}/sparse/0 --json"
        yield _case(f"inspect/{scene}/default", line, scene)
        if scene in ("ring8", "ring8-hinged", "ring8-cycle", "rig", "castle-P19", "courtyard-hinged"):
            yield _case(f"inspect/{scene}/points-never", f"{line} --points never", scene)
    for graph in (*(name for name in _PLACED if name.endswith(".txt")), "malformed.txt"):
        yield _case(f"inspect/{graph}", f"inspect graphs/{graph} --json")


def _check_case(scene: str, truth: str) -> Case:
    """Return the case of the referee of one model."""
    model = "sparse/0" if scene == "courtyard-broken" else _CHECKED[scene] or truth
    return _case(f"check/{scene}", f"check scenes/{scene}/{model} --report OUT.html", scene)
