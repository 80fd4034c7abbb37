"""The cases of `answers`: a name that stays, and a command line in the folder that `answer_inputs` makes.

A case whose output has a truth is followed by others that read that output. Of large sets the default alone
is run.
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
_SILENT = "--quiet --no-report"


class Case(NamedTuple):
    """One run of the command line."""

    name: str
    argv: tuple[str, ...]
    """Paths are relative to the folder of the inputs."""
    out: str = ""
    """What it writes, if it writes."""
    scene: str = ""
    """The scene or set it reads; the case is skipped where that is missing."""
    followers: tuple["Case", ...] = ()
    """Cases that read its output, run after it."""
    quick: bool = False


def _name_flags(*lines: str) -> dict[str, str]:
    """Return flags by names made of them: "--points never" is "points-never"."""
    return {line.removeprefix("--").replace(" --", "-").replace(" ", "-"): line for line in lines}


_PLACEMENT = {
    **_name_flags(*(f"--objective {name}" for name in ("shapefit", "lud", "least-squares", "linf"))),
    **_name_flags(*(f"--solver {name}" for name in ("newton", "admm", "conic"))),
    **_name_flags("--filter 1dsfm", "--filter triangles", "--no-refine", "--factor-memory 1"),
    "filter-triangles-least-squares": "--filter triangles --objective least-squares",
    "tol": "--tol 1e-5",
}
"""Flags of variants that `locate` and `solve` have in common; `solve` calls --solver --method."""

_LOCATE = {
    **_PLACEMENT,
    **_name_flags("--min-trust 0", "--points never", "--points always", "--threads 1"),
    **_name_flags(
        "--scale unit", "--scale input", "--scale prior", "--rotations free", "--no-adjust", "--bundle-adjust"
    ),
    **_name_flags("--directions tracks", "--directions relative-poses", "--fix solved"),
    "known-distance": "--known-distance 0001.jpg 0003.jpg 2.5",
    "config": "--config known.toml",
    "fix-names": "--fix scenes/{scene}/fixed.txt",
    "fix-solved": "--fix solved",
    "fix-solved-bundle-adjust": "--fix solved --bundle-adjust",
    "fix-solved-shapefit": "--fix solved --objective shapefit",
    "fix-names-bundle-adjust": "--fix scenes/{scene}/fixed.txt --bundle-adjust",
    "priors": "--priors scenes/{scene}/priors.txt",
    "priors-refine": "--priors scenes/{scene}/priors.txt --refine-with-priors",
    "gps": "--priors scenes/{scene}/gps.csv",
    "gps-refine": "--priors scenes/{scene}/gps.csv --refine-with-priors",
    "thresholds": "--min-inliers 40 --inlier-threshold-px 1 --max-reprojection-error-px 2",
    "processes": "--executor processes --threads 2",
    "max-memory": "--max-memory 1",
}
_FIXED = ("fix-solved-bundle-adjust", "fix-solved-shapefit")
_OF_ALL = " ".join(sorted({*_LOCATE} - {"min-trust-0", "scale-prior", "gps", "gps-refine"} - {*_FIXED}))
_LOCATED = {
    "courtyard": _OF_ALL,
    "castle-P19": _OF_ALL,
    "ring8": "directions-tracks directions-relative-poses points-never known-distance priors fix-names "
    "fix-solved objective-shapefit objective-linf bundle-adjust",
    "facade9": "directions-tracks points-never objective-least-squares priors fix-solved",
    "photographed": "bundle-adjust rotations-free no-adjust points-never fix-names priors-refine "
    "objective-shapefit filter-triangles no-refine thresholds",
    "kerry-park": "points-never fix-names fix-solved bundle-adjust objective-shapefit "
    "objective-least-squares priors-refine directions-tracks factor-memory-1",
    "rig": "objective-shapefit objective-lud objective-linf solver-admm fix-names priors priors-refine "
    "bundle-adjust directions-relative-poses points-always no-refine filter-1dsfm scale-unit "
    "rotations-free scale-prior",
    "ring8-hinged": "points-never priors",
    "ring8-pendant": "points-never",
    "ring8-cycle": "points-never",
    "courtyard-new": "fix-names fix-names-bundle-adjust fix-solved fix-solved-bundle-adjust "
    "fix-solved-shapefit priors-refine directions-tracks scale-input",
    "photographed-new": "fix-solved fix-solved-bundle-adjust",
    "castle-P30": "bundle-adjust objective-shapefit rotations-free no-adjust",
    "Herz-Jesus-P8": "directions-relative-poses filter-triangles",
    "lego100": "points-never objective-shapefit",
    "brighton-beach": "scale-prior gps gps-refine",
}
"""Variants of each scene, besides the default and min-trust-0."""

_MAP = {
    "default": "--json",
    **_name_flags("--bundle-adjust", "--min-trust 0", "--relative stored", "--min-matches 30"),
    **_name_flags("--min-model-size 20", "--no-adjust", "--points never"),
    "shapefit": "--objective shapefit",
}
_MAPPED = {
    "photographed": " ".join(_MAP),
    "fountain-P11": "default bundle-adjust",
    "castle-P19": "default bundle-adjust relative-stored",
    **dict.fromkeys(("ring8", "Herz-Jesus-P8", "lego100", "kerry-park", "brighton-beach", "rig"), "default"),
}

_SOLVE = {
    **{name: flags.replace("--solver", "--method") for name, flags in _PLACEMENT.items()},
    "default": "--json",
    "formats": "--g2o --1dsfm",
    **_name_flags("--g2o", "--reverse"),
    "rotations-txt": "--rotations graphs/1dsfm/rots.txt",
    "rotations-g2o": "--rotations graphs/poses.g2o",
    "max-rotation-error": "--max-rotation-error 0.3",
}
_SOLVED = {
    "graph40.txt": f"{' '.join(_PLACEMENT)} formats reverse",
    "random300.txt": " ".join(_PLACEMENT),
    "chain.txt": "objective-shapefit objective-lud objective-least-squares solver-admm no-refine",
    "pieces.txt": "objective-shapefit objective-least-squares formats solver-conic",
    "plane.txt": "objective-lud objective-linf g2o solver-admm",
    "space5.txt": "objective-shapefit filter-1dsfm",
    "box.txt": "factor-memory-1",
    "cycle.txt": "",
    "1dsfm": "rotations-txt objective-lud formats max-rotation-error",
    "poses.g2o": "rotations-g2o",
    "poses.txt": "objective-shapefit",
    MADRID: "",
}

_RING = "scenes/ring8/sparse/0"
_WRONG = {
    "no-command": "",
    "unknown-command": "place RING OUT",
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
    "scale-without-distance": "locate RING OUT --scale distance",
    "distance-and-unit": "locate RING OUT --scale unit --known-distance 0001.jpg 0003.jpg 2",
    "distance-of-unknown": "locate RING OUT --known-distance a.jpg 0003.jpg 2",
    "scale-prior-without": "locate RING OUT --scale prior",
    "missing-priors": "locate RING OUT --priors nowhere.txt",
    "priors-of-others": "locate RING OUT --priors scenes/rig/priors.txt",
    "fix-unknown": "locate RING OUT --fix scenes/rig/fixed.txt",
    "config-unknown-key": "locate RING OUT --config wrong.toml",
    "unknown-executor": "locate RING OUT --executor threads",
    "solve-missing": "solve graphs/nowhere.txt OUT",
    "solve-malformed": "solve graphs/malformed.txt OUT",
    "solve-model": "solve RING OUT",
    "solve-rotations-of-graph": "solve graphs/plane.txt OUT --rotations graphs/1dsfm/rots.txt",
    "solve-1dsfm-of-5-dimensions": "solve graphs/space5.txt OUT --1dsfm",
    "map-model": "map RING OUT",
    "map-tracks": "map scenes/ring8/database.db OUT --directions tracks",
    "inspect-missing": "inspect scenes/nowhere",
    "evaluate-others": "evaluate RING scenes/rig/truth",
    "evaluate-without-reference": "evaluate RING",
    "report-no-output": "report empty",
    "convert-unknown": "convert RING OUT.xyz",
    "synth-options": "synth OUT --jpeg-quality 50",
}
_OTHERS = {
    "convert/text": "convert RING OUT --format colmap-txt",
    "convert/nerf": "convert RING OUT.json",
    "convert/tum": "convert RING OUT.tum",
    "convert/csv": "convert RING OUT.csv",
    "convert/glb": "convert RING OUT.glb",
    "convert/ply": "convert RING OUT.ply",
    **{
        f"synth/{shape}": f"synth OUT --shape {shape} --num-images 8 --num-points 300 "
        "--corrupted-pair-fraction 0.2"
        for shape in ("ring", "facade", "drive", "cloud", "courtyard")
    },
    "table/locate": "locate RING OUT",
    "table/map": "map scenes/photographed/database.db OUT",
    "table/solve": "solve graphs/pieces.txt OUT",
    "table/inspect": "inspect scenes/ring8-hinged/sparse/0 --points never",
    "help/all": "--help",
    "help/version": "--version",
    **{
        f"help/{command}": f"{command} --help-all"
        for command in ("locate", "map", "solve", "inspect", "evaluate", "report", "convert", "synth")
    },
}
_QUICK = (
    *("locate/ring8/default", "locate/courtyard/default", "locate/ring8-hinged/points-never"),
    *("locate/rig/default", "map/photographed/default", "solve/graph40/default", "solve/graph40/no-refine"),
    *("solve/pieces/default", "inspect/ring8/default", "wrong/out-exists", "wrong/unknown-option"),
)


def all_cases(folders: Mapping[str, Path]) -> list[Case]:
    """Return all cases; `folders` are those of the scenes and sets that are at hand."""
    scenes = [*BUNDLED, *_SETS, *sorted(set(folders) - {*BUNDLED, *_SETS, MADRID}), *MADE]
    truths = {name: truth_of(folders[name]) for name in scenes if name in folders}
    truths |= dict.fromkeys(("rig", "courtyard-new", "photographed-new"), "truth")
    cases = [
        *(case for name in scenes for case in _locate_cases(name, truths.get(name, "sparse/0"))),
        *(case for name in _MAPPED for case in _map_cases(name, truths.get(name, "sparse/0"))),
        *(case for graph in _SOLVED for case in _solve_cases(graph)),
        *_inspect_cases(scenes),
        *(_case(name, line) for name, line in _OTHERS.items()),
        *(_case(f"wrong/{name}", line) for name, line in _WRONG.items()),
    ]
    return [case._replace(quick=case.name in _QUICK) for case in cases]


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
            _case("report/ring8", f"report {_out(name)}")._replace(out=_out(name)),
            _case("table/evaluate", f"evaluate {_out(name)} {reference}"),
            _case("convert/output", f"convert {_out(name)} OUT.csv"),
        ]
    model = f"scenes/{scene}/sparse/0"
    yield _case(name, f"locate {model} OUT --json", scene, tuple(followers))
    for variant in () if scene in _LARGE else ("min-trust-0", *_LOCATED.get(scene, "").split()):
        flags = _LOCATE[variant].format(scene=scene)
        yield _case(f"locate/{scene}/{variant}", f"locate {model} OUT {_SILENT} {flags}", scene)


def _map_cases(scene: str, truth: str) -> Iterator[Case]:
    """Yield the variants of one database, each of which is evaluated."""
    for variant in _MAPPED[scene].split():
        name = f"map/{scene}/{variant}"
        shown = "" if variant == "default" else _SILENT
        line = f"map scenes/{scene}/database.db OUT {shown} {_MAP[variant]}"
        yield _case(name, line, scene, (_evaluation(name, "/0", f"scenes/{scene}/{truth}", scene),))


def _solve_cases(graph: str) -> Iterator[Case]:
    """Yield the default and the variants of one graph."""
    name, scene = graph.removesuffix(".txt") if graph != "poses.txt" else graph, MADRID * (graph == MADRID)
    for variant in ("default", *_SOLVED[graph].split()):
        shown = "" if variant == "default" else _SILENT
        line = f"solve graphs/{graph} OUT {shown} {_SOLVE[variant]}"
        yield _case(f"solve/{name}/{variant}", line, scene)


def _inspect_cases(scenes: Sequence[str]) -> Iterator[Case]:
    """Yield the inspection of every scene and graph, with theory and without points for a few."""
    for scene in scenes:
        line = f"inspect scenes/{scene}/sparse/0 --json"
        yield _case(f"inspect/{scene}/default", line, scene)
        if scene in ("ring8", "ring8-hinged", "ring8-cycle", "rig", "castle-P19"):
            yield _case(f"inspect/{scene}/theory", f"{line} --theory", scene)
            yield _case(f"inspect/{scene}/points-never", f"{line} --points never", scene)
    for graph in (*(name for name in _SOLVED if name.endswith(".txt")), "malformed.txt"):
        yield _case(f"inspect/{graph}/theory", f"inspect graphs/{graph} --json --theory")
