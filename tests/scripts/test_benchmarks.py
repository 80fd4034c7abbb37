"""scripts/benchmark.py: its index is true, and the quick version of every benchmark writes its section."""

import pickle
import re
from importlib import import_module

import pytest

import benchmark
import sfm_shapefit
from benchmarks import INDEX
from harness import driver, process
from harness.driver import RESULTS
from paper import peers_on_graphs as on_graphs
from paper import peers_on_scenes as on_scenes
from tests.program import run
from tests.scenes import RING, ROOT, fingerprint

SCRIPTS = ROOT / "scripts"
PARTS = {"answer_cases", "answer_differences", "answer_inputs", "made_models", "nonsense"}
"""Modules that belong to another one."""
SECTIONS = sorted(set(INDEX) - {"answers"})


def test_the_index_names_every_module_and_every_section_the_command_that_writes_it():
    assert {path.stem for path in (SCRIPTS / "benchmarks").glob("*.py")} == {*INDEX, *PARTS, "__init__"}
    assert list(INDEX) == sorted(INDEX)
    for name in SECTIONS:
        assert f"python scripts/benchmark.py {name}" in (RESULTS / f"{name}.md").read_text().splitlines()[2]


def test_the_help_lists_every_benchmark_whatever_its_purpose_has_in_it(capsys):
    with pytest.raises(SystemExit) as ended:
        benchmark.main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in INDEX)


def test_the_readme_names_every_benchmark_script_and_section():
    text = (SCRIPTS / "README.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE)
    assert sorted(rows) == sorted(INDEX)
    assert {f"results/{path.name}" for path in RESULTS.glob("*")} == set(
        re.findall(r"\((results/.*?)\)", text)
    )
    folders = {path.parent.name for path in SCRIPTS.glob("*/*.py")}
    files = {path.name for path in SCRIPTS.glob("*") if path.is_file()} - {"README.md"}
    assert [
        name for name in sorted(folders | files) if f"`{name}" not in text and f"/{name}" not in text
    ] == []


def call_here(function, *args, **_limits):
    """Do what `harness.process.call` does, in this process: what goes to and fro must be picklable."""
    function, args = pickle.loads(pickle.dumps((function, args)))
    return pickle.loads(pickle.dumps(function(*args)))


@pytest.mark.slow
@pytest.mark.parametrize("name", SECTIONS)
def test_the_quick_version_writes_its_section(name, tmp_path, monkeypatch):
    for module in (driver, on_graphs, on_scenes, import_module(f"benchmarks.{name}")):
        if hasattr(module, "call"):
            monkeypatch.setattr(module, "call", call_here)
        if hasattr(module, "run_command"):
            monkeypatch.setattr(module, "run_command", lambda *words: run(*words, code=0).stdout)
    if name == "viewgraphs":
        pytest.importorskip("viewgraphforge")
    before = fingerprint(RING)
    out = tmp_path / "section.md"
    assert benchmark.main([name, "--quick", "--out", str(out)]) == 0
    text = out.read_text()
    assert f"- Command: `python scripts/benchmark.py {name} --quick`" in text
    assert "\n## What the columns mean\n" in text
    assert "failed" not in text
    assert str(ROOT) not in text
    assert fingerprint(RING) == before


def test_a_command_of_a_benchmark_is_run_and_one_that_fails_says_why():
    assert process.run_command("--version") == f"sfm-shapefit {sfm_shapefit.__version__}\n"
    with pytest.raises(RuntimeError, match=r"inspect ended with code 3: .*nowhere"):
        process.run_command("inspect", "nowhere")


def test_missing_data_is_a_sentence_per_case_and_no_failure(tmp_path, capsys):
    out = tmp_path / "section.md"
    only = ["--only", "lego100", "castle-P19"]
    assert benchmark.main(["real", "--data", str(tmp_path), *only, "--out", str(out)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert [line.partition(": ")[0] for line in said] == ["castle-P19", "lego100", "lego100, rotations of gt"]
    assert "give their folder with --data" in said[0]
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["real", "--only", "nowhere"], "no case begins with nowhere; known: fountain-P11"),
        (["real", "--repeats", "0"], "'0' is not a whole number of 1 or more"),
        (["unreal"], "invalid choice: 'unreal'"),
    ],
)
def test_wrong_usage_is_explained(words, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        benchmark.main(words)
    assert message in f"{stopped.value} {capsys.readouterr().err}"
