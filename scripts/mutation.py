"""Mutation testing of the solver and the rigidity test: do the tests notice when the code is wrong?

    python scripts/mutation.py --state FOLDER --group newton [--per-group 30] [--seed 1]

The mutants are those of cosmic-ray (`pip install cosmic-ray`; arithmetic, comparisons, `and` and `or`, `not`,
True and False, numbers, break and continue, exceptions, loops that do not run), and of one operator more that
deletes a statement or what a function returns. Of each group of modules a random sample of places is drawn,
and of each place one mutant. Types, docstrings, imports and decorators are left alone.

A fresh compilation of the kernels for each mutant would take days. So the kernels of the group run as plain
Python, under those of the group's tests that are quick enough for it; all others stay compiled. The tests
are collected once. For each mutant a fork of the process puts the changed
code in place of the old one and runs the tests that reach the changed function, the shortest first, until one
fails. A mutant that takes far more processor time than the tests did counts as found.

Outcomes are kept in FOLDER, and what is there is not run again.
"""

import argparse
import ast
import difflib
import hashlib
import importlib
import inspect
import json
import os
import random
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, NamedTuple

from harness.process import thread_environment

# One thread in all libraries, before any is loaded: a process with threads must not fork.
os.environ.update(thread_environment(1))

import hypothesis
import pytest
from cosmic_ray import plugins
from cosmic_ray.ast import Visitor, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator

from sfm_shapefit import jit

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "sfm_shapefit"
GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "rigidity": (("rigidity/*.py",), ("rigidity",)),
    "certificate": (("solver/certificate.py",), ("certificate", "exact_certificate", "solver")),
    "newton": (("solver/newton/*.py",), ("newton", "exact_certificate", "solver")),
    "splitting": (("solver/splitting/*.py",), ("splitting", "certificate", "exact_certificate")),
    "program": (("solver/program.py", "solver/options.py"), ("solver", "newton")),
    "solve": (("solver/solve.py",), ("solver", "certificate", "splitting")),
    "angular": (("refinement/angular.py",), ("angular",)),
    "rigs": (("solver/rigs/*.py",), ("rigid_groups",)),
}
"""Files of the package, and the names of the tests that are to notice their mutants."""
LONGEST_TEST_S = 2.0
"""Of processor time, interpreted and observed: longer tests are left out."""
BUDGET_S = 12.0
"""Of tests per mutant, by their time in the first run."""
PATIENCE = 3.0
"""Times the tests' own time, after which a mutant counts as endless."""


def files_of(group: str) -> list[str]:
    """Return the files of a group, relative to the package."""
    found = [path for pattern in GROUPS[group][0] for path in sorted(PACKAGE.glob(pattern))]
    return [path.relative_to(PACKAGE).as_posix() for path in found]


class Mutant(NamedTuple):
    """One change of one file."""

    path: str
    operator: str
    occurrence: int
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.path}:{self.line}:{self.column} {self.operator} {self.occurrence}"


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


def _operators() -> dict[str, Operator]:
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
    for name, operator in _operators().items():
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


def sample(group: str, count: int, seed: int) -> list[Mutant]:
    """Return one random mutant of each of `count` random places."""
    rng = random.Random(f"{seed} {group}")
    places = [place for path in files_of(group) for place in mutants_of(path)]
    return [rng.choice(place) for place in rng.sample(places, min(count, len(places)))]


def interpret_kernels(group: str) -> None:
    """Let the kernels of a group be plain functions; call before they are imported."""
    compiled = jit.kernel
    names = {_module_name(path) for path in files_of(group)}

    def kernel(**options: bool) -> Callable[[Any], Any]:
        def decorate(function: Any) -> Any:
            return function if function.__module__ in names else compiled(**options)(function)

        return decorate

    jit.kernel = kernel


def _module_name(path: str) -> str:
    return "sfm_shapefit." + path.removesuffix(".py").replace("/", ".")


def put_in_place(path: str, source: str) -> None:
    """Give the loaded module of a file the code of another source, wherever its functions are known."""
    module = importlib.import_module(_module_name(path))
    fresh = {key: module.__dict__.get(key) for key in ("__name__", "__file__", "__package__")}
    exec(compile(source, str(module.__file__), "exec"), fresh)
    for name, new in fresh.items():
        old = module.__dict__.get(name)
        if name.startswith("__") or getattr(new, "__module__", module.__name__) != module.__name__:
            continue
        if inspect.isclass(new):
            for attribute, method in vars(new).items():
                _transplant(vars(old).get(attribute), method)
        elif callable(new) and hasattr(new, "__module__"):
            _transplant(old, new)
        elif isinstance(new, int | float | tuple | dict | str):
            _rebind(name, old, new)


def _transplant(old: Any, new: Any) -> None:
    """Put the code of one function into another."""
    for part in ("fget", "__func__"):
        old, new = getattr(old, part, old), getattr(new, part, new)
    if hasattr(old, "cache_clear"):
        old.cache_clear()
    old, new = inspect.unwrap(old) if callable(old) else old, inspect.unwrap(new) if callable(new) else new
    if isinstance(old, FunctionType) and isinstance(new, FunctionType):
        if old.__code__.co_freevars == new.__code__.co_freevars:
            old.__code__ = new.__code__
        old.__defaults__, old.__kwdefaults__ = new.__defaults__, new.__kwdefaults__


def _rebind(name: str, old: Any, new: Any) -> None:
    """Give a constant its new value in all modules that have it."""
    if type(old) is type(new) and old == new:
        return
    for key, module in list(sys.modules.items()):
        if key.startswith(("sfm_shapefit", "test_")) and module.__dict__.get(name) is old:
            setattr(module, name, new)


def place_of(mutant: Mutant) -> str:
    """Return the function that must run for a test to notice: the innermost around, else any of the file."""
    tree = ast.parse((PACKAGE / mutant.path).read_text())
    around = [
        (node.lineno, node.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and min([node.lineno, *(d.lineno for d in node.decorator_list)]) <= mutant.line <= node.end_lineno
    ]
    return f"{mutant.path}:{max(around, default=(0, ''))[1]}"


def places_of(codes: set[CodeType]) -> list[str]:
    """Return the functions of the package among these, as FILE:FUNCTION."""
    prefix = f"{PACKAGE}/"
    names = {f"{code.co_filename}:{code.co_name}" for code in codes if code.co_filename.startswith(prefix)}
    return sorted(name.removeprefix(prefix) for name in names)


class TooSlow(BaseException):
    """A test takes too long for this; no Exception, so that hypothesis lets it pass."""


class Runner:
    """Takes the place of pytest's loop over the tests."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.failed = False
        self.items: dict[str, Any] = {}
        args.state.mkdir(parents=True, exist_ok=True)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a failure."""
        self.failed |= report.failed or (report.skipped and report.when != "call")

    def pytest_runtestloop(self, session: Any) -> bool:
        """Time the tests, then run the mutants."""
        self.items = {item.nodeid: item for item in session.items}
        usable = {key: row for key, row in self._time_tests().items() if row["passed"]}
        print(f"{len(usable)} of {len(self.items)} tests are quick enough and pass uncompiled", flush=True)
        self._run_mutants(self._keep_sound(usable))
        return True

    def _keep(self, name: str, keys: Sequence[str], ask: Callable[[str], Any]) -> dict[str, Any]:
        """Return the answer of each key: what a file of the state has, or what is asked and put there."""
        record = self.args.state / f"{name}.json"
        known = json.loads(record.read_text()) if record.exists() else {}
        for key in keys:
            if key not in known:
                known[key] = ask(key)
                record.write_text(json.dumps(known, indent=0))
        return {key: known[key] for key in keys}

    def _time_tests(self) -> dict[str, Any]:
        """Observe every test that is not recorded for these sources."""
        sources = "".join((PACKAGE / path).read_text() for path in files_of(self.args.group))
        of_key = {}
        for name, item in self.items.items():
            text = sources + inspect.getsource(item.function)
            of_key[f"{name} {hashlib.sha256(text.encode()).hexdigest()[:12]}"] = item

        def observe(key: str) -> dict[str, Any]:
            seen = self._observe(of_key[key])
            # What it had to load or compile is there now.
            is_late = not seen["passed"] and seen["seconds"] > LONGEST_TEST_S
            return self._observe(of_key[key]) if is_late else seen

        rows = self._keep(f"tests_{self.args.group}", [*of_key], observe)
        return {of_key[key].nodeid: row for key, row in rows.items()}

    def _observe(self, item: Any) -> dict[str, Any]:
        """Run one test with an observer."""
        codes: set[CodeType] = set()
        self.failed = False

        def note(frame: FrameType, event: str, _argument: Any) -> None:
            if event == "call":
                codes.add(frame.f_code)

        def too_slow(*_: Any) -> None:
            raise TooSlow

        signal.signal(signal.SIGVTALRM, too_slow)
        signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST_TEST_S)
        start = time.process_time()
        sys.setprofile(note)
        try:
            item.ihook.pytest_runtest_protocol(item=item, nextitem=None)
        except TooSlow:
            self.failed = True
        finally:
            sys.setprofile(None)
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        seconds = time.process_time() - start
        print(f"{seconds:6.2f} s {'-' if self.failed else '+'} {item.nodeid}", flush=True)
        return {"seconds": seconds, "passed": not self.failed, "places": places_of(codes)}

    def _run_mutants(self, usable: dict[str, Any]) -> None:
        """Try every mutant that has no outcome yet, and print what survives."""
        mutants = {str(one): one for one in sample(self.args.group, self.args.per_group, self.args.seed)}
        outcomes = self._keep(self.args.group, [*mutants], lambda key: self._try(mutants[key], usable))
        survived = [name for name, outcome in outcomes.items() if outcome[0] == "survived"]
        print(f"{self.args.group}: {len(outcomes) - len(survived)} of {len(outcomes)} found")
        for name in survived:
            print(f"\n{name}\n{outcomes[name][2]}", flush=True)

    def _keep_sound(self, usable: dict[str, Any]) -> dict[str, Any]:
        """Return the tests that pass in a fork with unchanged code in place; others would find anything."""
        sources = {path: (PACKAGE / path).read_text() for path in files_of(self.args.group)}
        while True:
            seconds = sum(row["seconds"] for row in usable.values())
            verdict, by = self._run_forked(sources, [self.items[key] for key in usable], seconds)
            if verdict == "survived":
                return usable
            if by not in usable:
                raise RuntimeError(f"unchanged code is {verdict} {by}")
            print(f"{by} fails in a fork with unchanged code, and is left out", flush=True)
            usable = {key: row for key, row in usable.items() if key != by}

    def _try(self, mutant: Mutant, usable: dict[str, Any]) -> list[str]:
        """Return (found, endless or survived; by which test; the changed line) of a mutant."""
        source = (PACKAGE / mutant.path).read_text()
        changed = mutate_code(source, _operators()[mutant.operator], mutant.occurrence)
        place = place_of(mutant)
        # A place without a function is reached by all that runs in the file.
        reaching = [row | {"key": key} for key, row in usable.items() if _reaches(row["places"], place)]
        chosen, seconds = [], 0.0
        for row in sorted(reaching, key=lambda row: float(row["seconds"])):
            if seconds + row["seconds"] <= BUDGET_S:
                chosen.append(self.items[row["key"]])
                seconds += row["seconds"]
        outcome = [*self._run_forked({mutant.path: changed}, chosen, seconds), _difference(source, changed)]
        print(f"{outcome[0]:9}{mutant}  {outcome[1]}", flush=True)
        return outcome

    def _run_forked(self, sources: dict[str, str], chosen: list[Any], seconds: float) -> tuple[str, str]:
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            limit = int(PATIENCE * seconds) + 5
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            os.write(write, self._first_failure(sources, chosen).encode())
            os._exit(0)
        os.close(write)
        _, status = os.waitpid(child, 0)
        with os.fdopen(read) as pipe:
            by = pipe.read()
        if os.WIFSIGNALED(status):
            return ("endless" if os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL) else "crashed"), ""
        return ("survived", f"{len(chosen)} tests") if by == "" else ("found", by)

    def _first_failure(self, sources: dict[str, str], chosen: list[Any]) -> str:
        """In the fork: return the first test that fails, or an empty string."""
        try:
            for path, source in sources.items():
                put_in_place(path, source)
        except Exception as error:
            return f"import: {error!r}"
        for item in chosen:
            self.failed = False
            item.ihook.pytest_runtest_protocol(item=item, nextitem=None)
            if self.failed:
                return str(item.nodeid)
        return ""


def _reaches(places: Sequence[str], place: str) -> bool:
    """Return whether a function ran, or, of a place that is a file alone, any of that file."""
    return place in places or (place.endswith(":") and any(one.startswith(place) for one in places))


def _difference(before: str, after: str) -> str:
    """Return the lines that differ."""
    changes = difflib.ndiff(before.splitlines(), after.splitlines())
    return "\n".join(line for line in changes if line.startswith(("- ", "+ ")))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--state", type=Path, required=True, help="folder of the outcomes")
    parser.add_argument("--group", choices=GROUPS, required=True)
    parser.add_argument("--per-group", type=int, default=30, help="mutants of each group")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    interpret_kernels(args.group)
    # A failure need not be made small.
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile(
        "mutation", phases=phases, derandomize=True, database=None, deadline=None
    )
    hypothesis.settings.load_profile("mutation")
    options = ["-s", "-p", "no:cacheprovider", "-o", "addopts=", "--tb=native", "-W", "ignore", "-m"]
    names = GROUPS[args.group][1]
    tests = [str(path) for name in names for path in (ROOT / "tests").rglob(f"test_{name}.py")]
    os.chdir(ROOT)
    return int(pytest.main([*options, "not slow", *tests], plugins=[Runner(args)]))


if __name__ == "__main__":
    sys.exit(main())
