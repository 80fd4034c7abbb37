"""Mutation testing of the solver and the rigidity test: do the tests notice when the code is wrong?

    python scripts/mutation.py --state FOLDER --group newton [--per-group 30] [--seed 1]

The mutants are those of cosmic-ray (`pip install cosmic-ray`; arithmetic, comparisons, `and` and `or`, `not`,
True and False, numbers, break and continue, exceptions, loops that do not run), and of one operator more that
deletes a statement or what a function returns. Of each group of modules a random sample of places is drawn,
and of each place one mutant. Types, docstrings, imports and decorators are left alone.

A fresh compilation of the kernels for each mutant would take days. So the kernels of the group run as plain
Python, under those of the group's tests that are quick enough for it; all others stay compiled. Each mutant
has a process of its own, in which the changed source is loaded in place of the file's, and the tests run,
the shortest first, until one fails. A mutant that takes far longer than the tests counts as found.

Outcomes are kept in FOLDER and not asked again; give another folder after a change of the code.
"""

import argparse
import ast
import contextlib
import difflib
import io
import itertools
import os
import random
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import hypothesis
import pytest
from cosmic_ray import plugins
from cosmic_ray.ast import Visitor, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator

from harness.driver import Kept
from harness.process import call, thread_environment
from sfm_shapefit.base import jit

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "sfm_shapefit"
GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "rigidity": (("graph/rigidity/*.py",), ("rigidity",)),
    "certificate": (("solver/certificate.py",), ("certificate", "exact_certificate", "solver")),
    "newton": (("solver/newton/*.py",), ("newton", "exact_certificate", "solver")),
    "splitting": (("solver/splitting/*.py",), ("splitting", "certificate", "exact_certificate")),
    "program": (("solver/program.py", "solver/solver_options.py"), ("solver", "newton")),
    "solve": (("solver/solve.py",), ("solver", "certificate", "splitting", "rigid_groups")),
    "angular": (("refinement/angular.py",), ("angular",)),
    "stages": (
        tuple(f"pipeline/{name}.py" for name in ("stages", "state", "remedies", "seed")),
        ("stages", "remedies"),
    ),
    "factors": (
        tuple(f"laplacian/{name}.py" for name in ("factor", "blocks", "operators", "superlu")),
        ("blocks", "laplacian", "selected_inverse", "iterative"),
    ),
    "judgement": (
        tuple(
            f"judgement/{name}.py" for name in ("seams", "ties", "places", "second_opinion", "wrong_lenses")
        ),
        ("seams", "ties", "places", "second_opinion", "left_out", "warnings_and_grades", "verdicts"),
    ),
    "reduction": (("solver/reduction.py", "solver/tied.py"), ("rigid_groups",)),
}
"""Files of the package, and the names of the tests that are to notice their mutants."""
LONGEST_TEST_S = 2.0
"""Of processor time, interpreted: longer tests are left out."""
BUDGET_S = 30.0
"""Of tests per mutant, by their time in the first run."""
PATIENCE, LOADING_S = 3, 30
"""A mutant is endless after so many times the tests' own time, and the seconds that loading may take."""
WAITING = 4
"""Or after so many times that by the clock: where threads wait for one another no processor time passes."""
OPTIONS = ("-s", "-p", "no:cacheprovider", "-o", "addopts=", "--tb=native", "-W", "ignore")
PROFILE = "mutation"
"""Of Hypothesis; the option of pytest outdoes the profile that `tests/conftest.py` loads."""


class Mutant(NamedTuple):
    """One change of one file."""

    path: str
    operator: str
    occurrence: int
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.path}:{self.line}:{self.column} {self.operator} {self.occurrence}"

    def sources(self) -> tuple[str, str]:
        """Return the source of its file, and the changed one."""
        source = (PACKAGE / self.path).read_text()
        return source, mutate_code(source, list_operators()[self.operator], self.occurrence)


class Delete(Operator):
    """Delete a statement that has an effect, or the value that a function returns."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        """Yield the place of a statement that can go without breaking the syntax."""
        if _is_deletable(node):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """Return what takes its place."""
        del index
        text = "return None" if node.type == "return_stmt" else "pass"
        statement = get_ast(f"{text}\n").children[0].children[0]
        first = statement.get_first_leaf() if hasattr(statement, "children") else statement
        first.prefix = node.get_first_leaf().prefix
        return statement

    @classmethod
    def examples(cls) -> tuple[Any, ...]:
        """Return none: cosmic-ray's own tests use them."""
        return ()


def _is_deletable(node: Any) -> bool:
    if node.parent is None or node.parent.type != "simple_stmt":
        return False
    if node.type in ("return_stmt", "raise_stmt"):
        return node.get_first_leaf() is not node.get_last_leaf()
    if node.type == "expr_stmt":
        # Without a plain assignment, a name would only be unknown.
        target, sign = node.children[:2]
        return target.type != "name" or (sign.type == "operator" and sign.value not in ("=", ":"))
    return node.type in ("atom_expr", "power")


def list_operators() -> dict[str, Operator]:
    """Return the operators that need no settings, by name."""
    unused = ("RemoveDecorator", "VariableReplacer", "VariableInserter")
    names = [n for n in sorted(plugins.operator_names()) if not n.endswith(unused)]
    found: dict[str, Operator] = {n.partition("/")[2]: plugins.get_operator(n)() for n in names}
    return {**found, "Delete": Delete()}


class _Positions(Visitor):  # type: ignore[misc]
    """Lists where an operator can act."""

    def __init__(self, operator: Operator, tree: Any) -> None:
        self.operator = operator
        self.found: list[tuple[int, int]] = []
        self.walk(tree)

    def visit(self, node: Any) -> Any:
        """Note the node's positions."""
        self.found += [start for start, _ in self.operator.mutation_positions(node)]
        return node


def mutants_of(path: str) -> list[list[Mutant]]:
    """Return the mutants of a file, together those of one place and one kind."""
    source = (PACKAGE / path).read_text()
    quiet = _quiet_spans(ast.parse(source))
    tree = get_ast(source)
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for name, operator in list_operators().items():
        for occurrence, (line, column) in enumerate(_Positions(operator, tree).found):
            if not any(first <= (line, column) < last for first, last in quiet):
                mutant = Mutant(path, name, occurrence, line, column)
                places.setdefault((name.partition("_")[0], line, column), []).append(mutant)
    return list(places.values())


def _quiet_spans(tree: ast.Module) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return where nothing is to be changed: types, decorators, imports."""
    quiet: list[ast.AST] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            quiet += node.decorator_list
        if isinstance(node, ast.FunctionDef):
            quiet += [node.returns] if node.returns else []
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation:
            quiet.append(node.annotation)
        if isinstance(node, ast.Import | ast.ImportFrom):
            quiet.append(node)
    return [((n.lineno, n.col_offset), (n.end_lineno, n.end_col_offset)) for n in quiet]  # type: ignore[attr-defined]


def files_of(group: str) -> list[str]:
    """Return the files of a group, relative to the package."""
    found = [path for pattern in GROUPS[group][0] for path in sorted(PACKAGE.glob(pattern))]
    return [path.relative_to(PACKAGE).as_posix() for path in found]


def sample(group: str, count: int, seed: int) -> list[Mutant]:
    """Return one random mutant of each of `count` random places, but for those that are no Python."""
    rng = random.Random(f"{seed} {group}")
    places = [place for path in files_of(group) for place in mutants_of(path)]
    drawn = [rng.choice(place) for place in rng.sample(places, min(count, len(places)))]
    return [mutant for mutant in drawn if _is_python(mutant.sources()[1])]


def _is_python(source: str) -> bool:
    """Return whether a source can be parsed: a `/` among parameters divides nothing."""
    with contextlib.suppress(SyntaxError):
        ast.parse(source)
        return True
    return False


def substitute(path: str, source: str) -> None:
    """Let a module of the package be loaded from another source than its file's."""
    load = SourceFileLoader.get_code

    def get_code(loader: SourceFileLoader, name: str) -> CodeType | None:
        own = name == module_name(path)
        return compile(source, str(PACKAGE / path), "exec") if own else load(loader, name)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign]


def module_name(path: str) -> str:
    """Return the module that a file of the package is."""
    return "sfm_shapefit." + path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


class Watch:
    """Times the tests of a run, ends those that take longer than allowed, and notes which failed."""

    def __init__(self, longest_s: float) -> None:
        self.longest_s = longest_s
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []
        signal.signal(signal.SIGVTALRM, self._end_test)

    @staticmethod
    def _end_test(*_: Any) -> None:
        raise TooSlow

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: Any) -> Any:
        """Let a test run, for so long."""
        start = time.process_time()
        signal.setitimer(signal.ITIMER_VIRTUAL, self.longest_s)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
            self.seconds[item.nodeid] = time.process_time() - start

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a failure."""
        if report.failed or (report.skipped and report.when != "call"):
            self.failed.append(report.nodeid)


class TooSlow(BaseException):
    """A test takes too long for this; no Exception, so that hypothesis lets it pass."""


def run_tests(
    group: str, words: Sequence[str], changed: tuple[str, str] | None = None, longest_s: float = 0.0
) -> Watch:
    """Run tests with the kernels of a group interpreted, and one file changed; once per process.

    Tests have no limit of time if it is 0.
    """
    os.chdir(ROOT)
    compiled, names = jit.kernel, {module_name(path) for path in files_of(group)}

    def kernel(function: Any) -> Any:
        return function if function.__module__ in names else compiled(function)

    jit.kernel = kernel
    if changed is not None:
        substitute(*changed)
    # A failure need not be made small.
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    settings = {"derandomize": True, "database": None, "deadline": None}
    hypothesis.settings.register_profile(PROFILE, phases=phases, **settings)
    watch = Watch(longest_s)
    with contextlib.redirect_stdout(io.StringIO()):
        code = pytest.main([*OPTIONS, f"--hypothesis-profile={PROFILE}", *words], plugins=[watch])
    if code not in (0, 1):
        watch.failed.append(f"pytest ended with code {int(code)}")
    return watch


def time_tests(group: str) -> dict[str, float]:
    """Return the seconds of the group's tests that pass and are quick enough, shortest first."""
    tests = [str(path) for name in GROUPS[group][1] for path in (ROOT / "tests").rglob(f"test_{name}.py")]
    # Once before, so that what they have to load and to compile is there.
    for _ in range(2):
        watch = run_tests(group, ["-m", "not slow", *tests], longest_s=LONGEST_TEST_S)
    passed = {name: seconds for name, seconds in watch.seconds.items() if name not in watch.failed}
    return dict(sorted(passed.items(), key=lambda item: item[1]))


def first_failure(group: str, path: str, source: str, tests: Sequence[str]) -> str:
    """Return the first test that fails with a file changed, or an empty string."""
    return next(iter(run_tests(group, ["-x", *tests], (path, source)).failed), "")


def try_mutant(mutant: Mutant, ask: Callable[[str, str], str]) -> tuple[str, str, str]:
    """Return found, endless or survived; by which test; the changed lines."""
    before, after = mutant.sources()
    try:
        by = ask(mutant.path, after)
        verdict = "found" if by else "survived"
    except (TimeoutError, RuntimeError) as error:
        verdict, by = "endless" if isinstance(error, TimeoutError) else "crashed", str(error)
    print(f"{verdict:9}{mutant}  {by}", flush=True)
    changes = difflib.ndiff(before.splitlines(), after.splitlines())
    return verdict, by, "\n".join(line for line in changes if line.startswith(("- ", "+ ")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--state", type=Path, required=True, help="folder of the outcomes")
    parser.add_argument("--group", choices=GROUPS, required=True)
    parser.add_argument("--per-group", type=int, default=30, help="mutants of each group")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    group, one_thread = args.group, thread_environment(1)
    kept = Kept(args.state / f"{group}.pickle", {"group": group})
    seconds = kept.get("tests", partial(call, time_tests, group, environment=one_thread))
    ends = zip(seconds, itertools.accumulate(seconds.values()), strict=True)
    tests = [name for name, end_s in ends if end_s <= BUDGET_S]
    print(f"{len(tests)} of {len(seconds)} tests that pass uncompiled are run", flush=True)
    limit_s = int(PATIENCE * sum(seconds[name] for name in tests)) + LOADING_S

    def ask(path: str, source: str) -> str:
        run = (first_failure, group, path, source, tests)
        limits = {"cpu_limit_s": limit_s, "timeout_s": WAITING * limit_s}
        return str(call(*run, environment=one_thread, **limits))

    unchanged = files_of(group)[-1]
    if by := ask(unchanged, (PACKAGE / unchanged).read_text()):
        raise RuntimeError(f"unchanged code is found by {by}")
    mutants = sample(group, args.per_group, args.seed)
    outcomes = {m: kept.get(str(m), partial(try_mutant, m, ask)) for m in mutants}
    survived = [m for m in mutants if outcomes[m][0] == "survived"]
    print(f"{group}: {len(mutants) - len(survived)} of {len(mutants)} found")
    for mutant in survived:
        print(f"\n{mutant}\n{outcomes[mutant][2]}", flush=True)


if __name__ == "__main__":
    main()
