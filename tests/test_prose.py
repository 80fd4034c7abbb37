"""Comments and docstrings name the quantity, then its unit, then its reason; a name stands for one thing."""

import ast
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.test_architecture import MODULES, PACKAGE, tree_of

# The identifier would be the subject of such a sentence; the shape of an array may stand before it.
OPENING = re.compile(
    r"(\([^)]*\) )?(Of|Those|From so many|So many|By what|The latter)\b", flags=re.IGNORECASE
)
PHRASE = re.compile(r"\bwhat there is\b|\bthe latter\b|\btells?(?= *(?:[.,;:)]|$))", flags=re.IGNORECASE)


@cache
def texts_of(path: Path) -> tuple[tuple[int, str], ...]:
    """Line and text of each docstring, and of each run of comments at one column."""
    with path.open(encoding="utf-8") as file:
        tokens = list(tokenize.generate_tokens(file.readline))
    texts: list[tuple[int, str]] = []
    last = (-1, -1)
    for token in (token for token in tokens if token.type == tokenize.COMMENT):
        line, column = token.start
        text = token.string.lstrip("#").strip()
        alone = not token.line[:column].strip()
        if alone and last == (line - 1, column):
            texts[-1] = (texts[-1][0], f"{texts[-1][1]} {text}")
        else:
            texts.append((line, text))
        last = (line, column) if alone else (-1, -1)
    for node in ast.walk(tree_of(path)):
        for statement in getattr(node, "body", []) if not isinstance(node, ast.Lambda | ast.IfExp) else []:
            if text := string_of(statement):
                texts.append((statement.lineno, text))
    return tuple(texts)


def string_of(statement: ast.stmt | None) -> str:
    """The text of a docstring; empty for any other statement."""
    value = statement.value if isinstance(statement, ast.Expr) else None
    return value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) else ""


def faults_of(text: str) -> Iterator[str]:
    """Openings and phrases that the rule forbids."""
    for sentence in re.split(r"(?<=[.?!])\s+|\n\s*\n", text.strip()):
        if OPENING.match(sentence):
            yield sentence[:40]
    for match in PHRASE.finditer(text):
        yield match.group()


def constants_of(path: Path) -> Iterator[tuple[str, str]]:
    """Name and explanation of each numeric constant of a module: beside it, else below, else above."""
    lines, body = path.read_text(encoding="utf-8").splitlines(), tree_of(path).body
    comments = {
        line: said for line, said in texts_of(path) if lines[line - 1].strip().startswith("#") is False
    }
    for statement, following in zip(body, [*body[1:], None], strict=True):
        names = names_of(statement)
        if isinstance(statement, ast.Assign | ast.AnnAssign) and names and is_numeric(statement.value):
            beside = comments.get(statement.lineno) or comments.get(statement.end_lineno or 0)
            above = []
            for line in reversed(lines[: statement.lineno - 1]):
                if not line.startswith("#"):
                    break
                above.insert(0, line.lstrip("#").strip())
            yield names[0], beside or string_of(following) or " ".join(above)


def is_numeric(value: ast.expr | None) -> bool:
    """Whether an expression is made of literal numbers, and of nothing but numpy and math beside."""
    nodes = list(ast.walk(value)) if value else []
    literals = [node.value for node in nodes if isinstance(node, ast.Constant)]
    names = {node.id for node in nodes if isinstance(node, ast.Name)}
    return bool(literals) and {type(x) for x in literals} <= {int, float} and names <= {"np", "math"}


def names_of(statement: ast.stmt) -> list[str]:
    """What a statement of a module defines: a class, a function or variables."""
    if isinstance(statement, ast.ClassDef | ast.FunctionDef):
        return [statement.name]
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
    return [node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]


def explained(text: str) -> bool:
    """Whether a text has a second clause, the reason, behind the quantity and its unit."""
    return len([clause for clause in re.split(r"[;:.](?:\s+|$)", text) if clause]) > 1


def test_a_sentence_names_its_subject_and_a_constant_has_a_reason():
    faults = []
    for path in MODULES:
        inside = path.relative_to(PACKAGE)
        faults += [f"{inside}:{line}: {fault}" for line, text in texts_of(path) for fault in faults_of(text)]
        bare = [name for name, text in constants_of(path) if not explained(text)]
        faults += [f"{inside}: {name} has no reason" for name in bare]
    assert not faults, "\n".join(faults)


def test_no_two_public_names_are_alike():
    homes = defaultdict(list)
    for path in MODULES:
        for statement in tree_of(path).body:
            for name in names_of(statement):
                if not name.startswith("_"):
                    homes[name].append(str(path.relative_to(PACKAGE)))
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}


def test_the_rules_see_what_they_are_to_see():
    for text in (
        "Of each pair.",
        "Sound. Those that move.",
        "of pairs",
        "(k,) those that fit.",
        "What there is.",
        "nothing tells.",
    ):
        assert list(faults_of(text)), text
    for text in ("Offsets of groups.", "A pair of those.", "It tells them apart.", "Angle of each pair."):
        assert not list(faults_of(text)), text
    assert not explained("px")
    assert not explained("Pixels within which a match agrees.")
    assert explained("px; COLMAP's own limit")
    assert is_numeric(ast.parse("np.radians(3.0), -2", mode="eval").body)
    assert not is_numeric(ast.parse("Group(3)", mode="eval").body)
