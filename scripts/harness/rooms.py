"""The rooms of the package, the floors that they stand on, and who imports whom; read from the sources."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "sfm_shapefit"

# Bottom first. A module imports from floors below its own and from its own room.
FLOORS = (
    ("base",),
    ("scene", "laplacian"),
    ("graph",),
    ("solver", "files"),
    ("pairs", "refinement"),
    ("tracks", "rotations", "synthetic"),
    ("adjustment",),
    ("placement",),
    ("judgement",),
    ("facts",),
    ("report",),
    ("pipeline",),
    ("commands", "synthetic/fixtures"),
    ("cli", "__main__"),
)
ROOMS = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}

MODULES = sorted(set(PACKAGE.rglob("*.py")) - {PACKAGE / "__init__.py"})  # which imports lazily, from all


@cache
def tree_of(path: Path) -> ast.Module:
    """A module, parsed once."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports_of(path: Path, *, at_run_time: bool = False) -> frozenset[str]:
    """Dotted names of all modules that a file imports, inside functions too."""
    nodes, found = list(ast.walk(tree_of(path))), set()
    checked = [
        node for node in nodes if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    unseen = {inner for node in checked if at_run_time for part in node.body for inner in ast.walk(part)}
    for node in nodes:
        if node in unseen:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def room_of(path: Path) -> str:
    """The folder of a module, or the module itself where it stands alone."""
    inside = str(path.relative_to(PACKAGE)).removesuffix(".py")
    return inside if inside in ROOMS else inside.split("/")[0]  # fixtures use what they are to test


@cache
def arrows() -> frozenset[tuple[str, str]]:
    """Room and room that it imports from, of all modules."""
    found = set()
    for path in MODULES:
        own = room_of(path)
        names = (name.removeprefix("sfm_shapefit.") for name in imports_of(path) if "." in name)
        used = {"/".join(name.split(".")[:k]) for name in names for k in (1, 2)} & set(ROOMS)
        found |= {(own, room) for room in used - {own}}
    return frozenset(found)


def reachable(room: str) -> frozenset[str]:
    """All rooms that a room imports from, directly or through others."""
    direct = {to for own, to in arrows() if own == room and ROOMS[to] < ROOMS[own]}
    return frozenset(direct.union(*map(reachable, direct)))


def essential_arrows() -> frozenset[tuple[str, str]]:
    """The arrows that no way through other rooms replaces: the transitive reduction."""
    down = {(own, to) for own, to in arrows() if ROOMS[to] < ROOMS[own]}
    return frozenset(
        (own, to) for own, to in down if not any(to in reachable(via) for a, via in down if a == own)
    )
