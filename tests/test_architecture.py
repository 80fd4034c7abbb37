"""The layers of the package: a module imports only those below it, and each heavy dependency has one door."""

import ast

import pytest

import architecture
from harness.rooms import FLOORS, MODULES, PACKAGE, ROOMS, arrows, imports_of, room_of, tree_of
from tests.base.test_jit import is_kernel
from tests.program import run_python

MOST_ARROWS = 91  # between rooms, beside those to base/; the list may only become shorter

# Lines of the package, docstrings and blank ones counted; who raises it says in the commit what they buy.
MOST_LINES = 67_500
MOST_LINES_OF_A_PAGE = 150  # of the pipeline of a command, so that its stages are seen at one glance
MOST_STAGES, MOST_FLOORS_OF_STAGES = 24, 7  # of pipeline/; what users call is a page of commands/
MOST_IMPORTED = 46  # names of a page or stage; one that does several things is to be split by these
SLACK_LINES = 300  # a budget further above the package than this is to be lowered

DOORS = {
    "numba": {"base/jit.py", "base/kernel_cache.py", "base/kernel_code.py"},
    "cvxpy": {"solver/conic.py"},
    "pymetis": {"laplacian"},
    "distributed": {"pipeline/execution.py"},
    "cv2": {"synthetic", "report/thumbnails.py", "files/colmap/pinholes.py"},
    "trimesh": {"synthetic/surfaces.py", "report/mesh.py"},
    "pycolmap": {
        "files/",
        "pairs/essential.py",
        "synthetic/workspace.py",
        "synthetic/models.py",
        "synthetic/rendered_workspace.py",
    },
    "sqlite3": {"files/colmap/", "synthetic/workspace.py"},
    "typer": {"cli"},
    "rich": {"cli"},
}

MOST_PARAMETERS = 6


def test_every_module_stands_in_a_room_of_a_floor():
    assert {room_of(path) for path in MODULES} == set(ROOMS)
    assert len(FLOORS) == 14
    assert len(ROOMS) <= 22


def test_a_module_imports_only_from_floors_below_its_own():
    assert {(own, room) for own, room in arrows() if ROOMS[room] >= ROOMS[own]} == {("__main__", "cli")}


def test_the_picture_of_the_rooms_is_that_of_the_imports():
    assert (PACKAGE.parent / "docs/architecture.svg").read_text(encoding="utf-8") == architecture.picture()


def test_rooms_have_few_arrows():
    assert len({arrow for arrow in arrows() if "base" not in arrow}) <= MOST_ARROWS


def test_the_package_keeps_within_its_budget_of_lines():
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES)
    assert MOST_LINES - SLACK_LINES <= lines <= MOST_LINES


@pytest.mark.parametrize(
    "command", ["check", "inspect", "join", "lengths", "locate", "map", "match", "place"]
)
def test_the_pipeline_of_a_command_is_a_page(command):
    text = (PACKAGE / f"commands/{command}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_LINES_OF_A_PAGE


def test_the_stages_are_few_and_stand_on_few_floors():
    stages = {path.stem: path for path in MODULES if room_of(path) == "pipeline" and path.stem != "__init__"}
    floors: dict[str, int] = {}
    while len(floors) < len(stages):  # from below: whose own imports have a floor already
        for name, path in stages.items():
            used = {one for one in stages if f"sfm_shapefit.pipeline.{one}" in imports_of(path)} - {name}
            if name not in floors and used <= set(floors):
                floors[name] = 1 + max((floors[one] for one in used), default=0)
    assert len(stages) <= MOST_STAGES
    assert max(floors.values()) <= MOST_FLOORS_OF_STAGES


@pytest.mark.parametrize("room", ["commands", "pipeline"])
def test_no_stage_or_page_imports_very_many_names(room):
    names = {
        path.stem: sum(
            len(node.names)
            for node in ast.walk(tree_of(path))
            if isinstance(node, ast.Import | ast.ImportFrom)
        )
        for path in MODULES
        if room_of(path) == room
    }
    assert {stem: count for stem, count in names.items() if count > MOST_IMPORTED} == {}


def test_only_kernels_and_commands_have_many_parameters():
    many = {}
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.FunctionDef) and room_of(path) != "cli":
                count = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
                compiled = is_kernel(node) or f"intrinsic({node.name})" in text
                many |= {node.name: count} if count > MOST_PARAMETERS and not compiled else {}
    assert not many


@pytest.mark.parametrize("dependency", DOORS)
def test_each_heavy_dependency_has_one_door(dependency):
    users = {
        path.relative_to(PACKAGE)
        for path in MODULES
        if any(name.split(".")[0] == dependency for name in imports_of(path, at_run_time=True))
    }
    assert users, f"nobody imports {dependency} any more; drop it from the list and from pyproject.toml"
    doors = tuple(DOORS[dependency])
    outside = {str(user) for user in users if not str(user).startswith(doors)}
    assert not outside


def test_the_command_line_starts_without_the_heavy_dependencies():
    heavy = {name for name in DOORS if name not in {"typer", "rich", "sqlite3"}} | {"scipy", "clarabel"}
    code = f"import sys; from sfm_shapefit.cli import app; print(*sorted({heavy!r} & set(sys.modules)))"
    done = run_python("-c", code)
    assert done.stdout == "\n"


def test_only_the_command_that_is_called_is_loaded():
    code = "import sys; from sfm_shapefit.cli.root import load_commands; load_commands(sys.argv[1:]); "
    code += "print(*sorted(set(map('sfm_shapefit.cli.{}'.format, sys.argv[-1].split())) & set(sys.modules)))"
    every = "check convert evaluate inspect locate map place synth warm_up"
    for words, loaded in (("locate", "locate"), ("--version check", "check"), ("warm-up", "warm_up")):
        done = run_python("-c", code, *words.split(), every)
        assert done.stdout.split() == [f"sfm_shapefit.cli.{loaded}"]
    for words in ("--help", "locat"):
        assert len(run_python("-c", code, words, every).stdout.split()) == 9


def test_what_draws_is_not_loaded_where_nothing_is_drawn():
    done = run_python("-c", "import sys, sfm_shapefit.commands.write; print(*sys.modules)")
    assert "sfm_shapefit.commands.write" in done.stdout
    assert "sfm_shapefit.report" not in done.stdout
