"""The layers of the package: a module imports only those below it, and each heavy dependency has one door."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sfm_shapefit"

# Bottom first; a folder is one layer whose modules may import each other.
LAYERS = [
    "errors",
    "arrays",
    "workers",
    "output",
    "jit",
    "geometry",
    "viewgraph",
    "bodies",
    "formats",
    "rigidity",
    "laplacian",
    "solver",
    "theory",
    "baselines",
    "directions",
    "robust",
    "epipolar",
    "rotations",
    "partitioned",
    "placement",
    "body_placement",
    "gauge",
    "evaluation",
    "synthetic",
    "colmap",
    "tracks",
    "forecast",
    "diagnosis",
    "options",
    "report",
    "visual",
    "results",
    "pipeline",
    "synthetic/fixtures",
    "mapping",
    "conversion",
    "cli",
]

DOORS = {
    "numba": {"jit.py"},
    "cvxpy": {"solver/conic.py", "baselines/linf.py"},
    "distributed": {"pipeline/execution.py"},
    "cv2": {"synthetic"},
    "trimesh": {"synthetic/surfaces.py", "visual/mesh.py"},
    "pycolmap": {"colmap"},
    "sqlite3": {"colmap"},
    "plotly": {"visual/report_page.py"},
    "viser": {"visual/viewer.py"},
    "typer": {"cli"},
    "rich": {"cli"},
}

MODULES = sorted(set(PACKAGE.rglob("*.py")) - {PACKAGE / "__init__.py"})  # which imports lazily, from all


def imports_of(path: Path) -> set[str]:
    """Dotted names of all modules that a file imports, inside functions too, but not for type checking."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = [ast.Pass()]
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def layer_of(path: Path) -> str:
    inside = str(path.relative_to(PACKAGE)).removesuffix(".py")
    return inside if inside in LAYERS else inside.split("/")[0]  # fixtures use what they are to test


def test_every_module_has_a_layer():
    assert {layer_of(path) for path in MODULES} == set(LAYERS)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_only_what_lies_below_it(path):
    own = LAYERS.index(layer_of(path))
    used = {name.split(".")[1] for name in imports_of(path) if name.startswith("sfm_shapefit.")}
    above = {layer for layer in used & set(LAYERS) if LAYERS.index(layer) > own}
    assert not above


@pytest.mark.parametrize("dependency", DOORS)
def test_each_heavy_dependency_has_one_door(dependency):
    users = {
        path.relative_to(PACKAGE)
        for path in MODULES
        if any(name.split(".")[0] == dependency for name in imports_of(path))
    }
    assert users, f"nobody imports {dependency} any more; drop it from the list and from pyproject.toml"
    outside = {
        user
        for user in users
        if str(user) not in DOORS[dependency] and user.parts[0] not in DOORS[dependency]
    }
    assert not outside


def test_nothing_is_unpickled_evaluated_or_sent_to_a_shell():
    for path in MODULES:
        assert not imports_of(path) & {"pickle", "subprocess", "marshal", "shelve"}, path
        calls = {
            ast.unparse(node.func)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call)
        }
        assert not calls & {"eval", "exec", "os.system", "os.popen"}, path


def test_the_command_line_starts_without_the_heavy_dependencies():
    heavy = {name for name in DOORS if name not in {"typer", "rich", "sqlite3"}} | {"scipy", "clarabel"}
    code = f"import sys, sfm_shapefit.cli; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    assert done.stdout == "\n"
