"""Tests that patch what they test, or call what is private, hold up a change and guard nothing that a user
would notice: they are counted.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

MOST_PATCHES = 60
"""Attributes that tests patch, and private names of the package or of others that they use."""
PATCHED_FOR = {
    "adjustment/test_adjust.py": "a size that takes 0.6 GB",
    "base/test_atomic_folder.py": "faults of the file system, other systems and programs",
    "base/test_jit.py": "a numba without a place for its cache; the list of what makes arrays",
    "base/test_kernel_cache.py": "a folder of kernels that is empty; what llvmlite is given to read",
    "base/test_private_names.py": "a private name of numba, which is watched there",
    "base/test_scipy_parts.py": "a scipy without that part",
    "cli/test_cli.py": "interrupts at one exact moment; a package that is not installed",
    "cli/test_console.py": "terminals; a pycolmap that speaks",
    "cli/test_robustness.py": "an assertion that fails in pycolmap",
    "cli/test_single_files.py": "a disk that is full",
    "commands/test_map.py": "pixels that confirm nothing; a false loop; a straight street",
    "commands/test_pictures.py": "minutes that are over after some of a few pictures",
    "commands/test_warm_up.py": "a system that starts no process; a wheel for another numba",
    "files/test_colmap_reading.py": "pieces of a file of hundreds of megabytes",
    "files/test_colmap_writing.py": "likewise, and a million matches",
    "files/test_pair_focals.py": "what pycolmap makes of a view graph",
    "files/test_text_models.py": "a system without a folder for copies",
    "judgement/test_ties.py": "half a million links",
    "judgement/test_uncertainty.py": "a hundred thousand pairs",
    "pipeline/test_adjustment.py": "an adjustment that finds no point, of a scene that has some",
    "pipeline/test_evidence.py": "what is told of priors to the judgement, and to nobody else",
    "pipeline/test_stages.py": "a thousand cameras",
    "pipeline/test_wide_lenses.py": "a lens of COLMAP that is not known here: all are",
    "problems.py": "one level of noise where many would be looked for",
    "report/test_report_page.py": "pictures of four megabytes",
    "rotations/test_averaging.py": "graphs of so many cameras that they have no factor",
    "scene/test_matches.py": "sixteen million matches; memory that is short",
    "scene/test_pose_errors.py": "two million pairs",
    "scripts/test_answers.py": "a warm-up that compiles everything",
    "scripts/test_benchmarks.py": "processes of their own, for which compiled kernels would be loaded again",
    "scripts/test_judging.py": "a graph that is known, in place of a drawn one",
    "scripts/test_peers.py": "a peer that is not installed; processes of their own",
    "test_security.py": "a folder for copies that can be looked into",
    "test_work_counts.py": "counts at the points of its one table",
}
"""By file of the tests: what cannot be had otherwise, or not in seconds. All else goes by results."""
_PUBLIC = {"_replace", "_fields", "_exit", "_getframe", "_repr_html_"}
_PATCHES = {"setattr", "delattr", "setitem", "delitem", "object", "dict"}


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name not in _PUBLIC


def patches_in(path: Path) -> Iterator[str]:
    """Yield what a file of the tests patches, and the private names that it uses."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            yield from (one.name for one in node.names if _is_private(one.name))
        elif isinstance(node, ast.Attribute):
            owner = ast.unparse(node.value)
            is_patch = node.attr in _PATCHES and owner.endswith("patch")
            if is_patch or (_is_private(node.attr) and owner not in ("self", "cls")):
                yield f"{owner}.{node.attr}"


def test_tests_go_by_results_and_few_patch_what_they_test():
    tests = Path(__file__).parent
    found = {str(path.relative_to(tests)): len(list(patches_in(path))) for path in tests.rglob("*.py")}
    found = {name: count for name, count in found.items() if count}
    assert sum(found.values()) <= MOST_PATCHES, found
    assert set(found) == set(PATCHED_FOR)
