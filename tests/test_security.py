"""What a stranger's files and a curious neighbor must not be able to do."""

import ast
import os
import signal
import sqlite3
import stat
import tempfile
import tomllib
from contextlib import closing

import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.read_binary import read_folder
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.graph_text import read_graph
from tests.program import run
from tests.scenes import RING, ROOT, copied, edit_database, view_of
from tests.test_architecture import tree_of

SOURCES = [*sorted((ROOT / "sfm_shapefit").rglob("*.py"))]
FORBIDDEN_IMPORTS = {
    *("pickle", "marshal", "shelve", "dill", "joblib", "subprocess", "pty", "code", "codeop"),
    *("socket", "ssl", "http", "urllib.request", "ftplib", "smtplib", "requests", "telnetlib", "xmlrpc"),
}
FORBIDDEN_CALLS = {
    *("eval", "exec", "compile", "__import__", "input", "os.system", "os.popen", "os.execv", "os.fork"),
    *("np.load", "numpy.load", "pickle.load", "pickle.loads", "yaml.load", "tempfile.mktemp"),
}


def imported(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def offenses(tree):
    for name in imported(tree):
        if name in FORBIDDEN_IMPORTS or name.split(".")[0] in FORBIDDEN_IMPORTS:
            yield f"imports {name}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            if ast.unparse(node.func) in FORBIDDEN_CALLS:
                yield f"calls {ast.unparse(node.func)}"
            if any(k.arg == "shell" and ast.unparse(k.value) != "False" for k in node.keywords):
                yield "starts a shell"


# Compiled kernels are pickled, as numba does it, in folders that only the user and this package write to. One
# call reads the file, the other the code in it, once it is known which modules need not be imported for that.
ALLOWED = {"kernel_code.py": ["imports pickle", "calls pickle.loads", "calls pickle.loads"]}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_is_unpickled_evaluated_executed_or_sent_out(path):
    assert list(offenses(tree_of(path))) == ALLOWED.get(path.name, [])


def test_the_scan_sees_what_it_looks_for():
    text = "import pickle\nfrom urllib.request import urlopen\neval('1')\nrun('ls', shell=True)"
    assert sorted(offenses(ast.parse(text))) == [
        "calls eval",
        "imports pickle",
        "imports urllib.request",
        "starts a shell",
    ]


def test_a_database_is_opened_for_reading_without_trust_and_with_limits():
    with closing(DatabaseFile(RING / "database.db")) as file:
        connection = file.connection
        assert connection.execute("PRAGMA trusted_schema").fetchone() == (0,)
        assert connection.execute("PRAGMA query_only").fetchone() == (1,)
        assert connection.getlimit(sqlite3.SQLITE_LIMIT_LENGTH) == 2**29
        assert connection.getlimit(sqlite3.SQLITE_LIMIT_VDBE_OP) == 10_000
        for limit in (sqlite3.SQLITE_LIMIT_ATTACHED, sqlite3.SQLITE_LIMIT_WORKER_THREADS):
            assert connection.getlimit(limit) == 0
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            connection.execute("DELETE FROM images")
        with pytest.raises(sqlite3.Error):
            connection.execute("ATTACH ':memory:' AS other")


COMPUTED = {
    "a view": "CREATE VIEW {0} AS SELECT * FROM real",
    "an endless view": "CREATE VIEW {0} AS WITH RECURSIVE n(x) AS "
    "(VALUES (1) UNION ALL SELECT x + 1 FROM n) SELECT x AS image_id, x AS name FROM n",
    "a virtual table": "CREATE VIRTUAL TABLE {0} USING fts5(image_id, name)",
    "a computed column": "CREATE TABLE {0} (image_id, name GENERATED ALWAYS AS (zeroblob(1000000000)))",
}


@pytest.mark.parametrize("kind", COMPUTED)
def test_a_table_whose_rows_are_computed_is_refused(tmp_path, kind):
    scene = copied(RING, tmp_path)
    rename = "ALTER TABLE images RENAME TO real"
    edit_database(scene / "database.db", rename, COMPUTED[kind].format("images"))
    with (
        pytest.raises(InputError, match="is not a COLMAP database: its images"),
        view_of(scene / "database.db", read_model(scene / "sparse" / "0").images),
    ):
        pytest.fail("it must not be opened")


def test_private_copies_of_a_database_are_private(tmp_path, monkeypatch):
    scene = copied(RING, tmp_path)
    writer = sqlite3.connect(scene / "database.db")
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("UPDATE images SET name = name")
    writer.commit()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    with closing(DatabaseFile(scene / "database.db")):
        (folder,) = (tmp_path / "tmp").iterdir()
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert list((tmp_path / "tmp").iterdir()) == []
    writer.close()


@pytest.mark.parametrize("kind", ["pipe", "endless device"])
def test_a_pipe_or_a_device_in_the_place_of_a_file_is_refused_at_once(tmp_path, kind):
    scene = copied(RING, tmp_path)
    model, graph = scene / "sparse" / "0", tmp_path / "graph.txt"
    sound = read_model(model)
    for path in (graph, model / "points3D.bin", scene / "database.db"):
        path.unlink(missing_ok=True)
        os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match=r"graph\.txt cannot be read: it is a pipe or a device"):
        read_graph(graph)
    with pytest.raises(InputError, match=r"points3D\.bin cannot be read: it is a pipe or a device"):
        read_folder(model)
    with (
        pytest.raises(InputError, match="it is a pipe or a device"),
        view_of(scene / "database.db", sound.images),
    ):
        pytest.fail("it must not be opened")


@pytest.fixture
def impatient():
    """Ends a call that waits: for a pipe that nobody writes to, that would be for ever."""

    def give_up(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


MODEL = str(RING / "sparse" / "0")
READING = {
    "a graph": ("solve", "{pipe}", "{out}"),
    "a model file": ("convert", "{pipe}", "{out}"),
    "priors": ("locate", MODEL, "{out}", "--priors", "{pipe}"),
    "control points": ("locate", MODEL, "{out}", "--control-points", "{pipe}"),
    "gravity": ("map", str(RING / "database.db"), "{out}", "--gravity", "{pipe}"),
    "names": ("locate", MODEL, "{out}", "--fix", "{pipe}"),
    "options": ("locate", MODEL, "{out}", "--config", "{pipe}"),
}


@pytest.mark.parametrize("what", READING)
def test_no_command_waits_for_a_pipe(tmp_path, impatient, what):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    arguments = [word.format(pipe=pipe, out=tmp_path / "out") for word in READING[what]]
    result = run(*arguments, code=3)
    assert "it is a pipe or a device" in result.output or "give the folder" in result.output
    assert sorted(tmp_path.iterdir()) == [pipe]


def test_every_dependency_has_bounds_and_the_lock_file_of_ci_pins_every_package_and_names_no_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    numbered_by_year = ("pymetis", "distributed")  # which says nothing about compatibility
    extras = {name: lines for name, lines in project["optional-dependencies"].items() if name != "dev"}
    for line in [*project["dependencies"], *(line for lines in extras.values() for line in lines)]:
        is_pinned = "==" in line  # a benchmark that is to be made again
        assert is_pinned or ">=" in line, line
        assert is_pinned or "<" in line or line.startswith(numbered_by_year), line

    lines = (ROOT / "requirements" / "ci.lock").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(line.count("==") == 1 and "/" not in line and ":" not in line for line in pins)
    pinned = {line.split("==")[0].strip().lower().replace("_", "-") for line in pins}
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    names = {
        line.split(">")[0].split("=")[0].split("[")[0].strip().lower().replace("_", "-") for line in wanted
    }
    assert names <= pinned
