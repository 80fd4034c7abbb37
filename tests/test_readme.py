"""What README and docs say runs as it stands: commands one after the other, Python blocks, and every link."""

import ast
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest
import typer

import figure
import options_table
import sfm_shapefit
from benchmarks import panoramas
from paper import fold
from sfm_shapefit.cli import app
from sfm_shapefit.synthetic import RenderOptions, SceneOptions, make_rendered_scene
from tests.program import run
from tests.scenes import PHOTOGRAPHED, ROOT
from tests.test_architecture import tree_of

README = ROOT / "README.md"
FOR_CONTRIBUTORS = ("architecture", "guides")
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"^    sfm-shapefit (.+?)(?:  +#.*)?$", flags=re.MULTILINE)
OPTIONS_OF_A_FILE = re.compile(r"^\| `(?:--)?([\w-]+)` \|", flags=re.MULTILINE)
BLOCK = re.compile(r"```python\n(.*?)```", flags=re.DOTALL)


def commands_of(page: Path) -> list[str]:
    return COMMAND.findall(page.read_text(encoding="utf-8"))


def test_the_readmes_python_example_runs_and_says_what_the_readme_says(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    text = README.read_text(encoding="utf-8")
    (example,) = BLOCK.findall(text)
    exec(example, {"__name__": "__main__"})
    said = capsys.readouterr().out
    assert re.search(r"^25 cameras: good$", said, flags=re.MULTILINE)
    error = re.search(r"median error (\S+) mm", said).group(1)
    assert f"The median camera is {error} mm" in text


def test_the_peers_fold_the_yard_and_map_does_not():
    names = ["0004.jpg", "0005.jpg"]
    for program, model in fold.map_by_each():
        found = sfm_shapefit.evaluate(model, PHOTOGRAPHED / "truth")
        errors = dict(zip(found.names, found.position_errors.tolist(), strict=True))
        if program == "`map`":
            assert max(errors.values()) < 0.02
            assert list(model.verdict.cameras) == names
        else:  # the global mapper's threads may put a third one wrong
            assert [round(errors[name]) for name in names] == [12, 10]


TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
EXAMPLES = [(page, k) for page in PAGES[1:] for k in range(len(BLOCK.findall(TEXTS[page])))]


def test_examples_and_commands_are_found_on_every_page_that_has_them():
    """The tests below run what these expressions find; here it is counted without them."""
    for page, text in TEXTS.items():
        assert len(BLOCK.findall(text)) == text.count("```python")
        assert len(commands_of(page)) == text.count("\n    sfm-shapefit ")
    assert EXAMPLES
    assert len([page for page in PAGES if commands_of(page)]) > 3


@pytest.mark.parametrize(
    ("page", "number"), EXAMPLES, ids=lambda value: value.name if isinstance(value, Path) else str(value)
)
def test_every_python_example_of_the_docs_runs(page, number, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    exec(BLOCK.findall(TEXTS[page])[number], {"__name__": "__main__"})
    assert capsys.readouterr().out


IN_FULL = "--image-width 640 --image-height 480 --focal-length-px 480"
IN_HALF = "--image-width 320 --image-height 240 --focal-length-px 240"
"""Photographs in half size are drawn in a quarter of the time."""


def take_pictures_of_360_degrees(folder: Path) -> None:
    """Draw what the page of 360-degree cameras begins with, and write the file of rigs that it shows."""
    size = {"image_width": 220, "image_height": 220, "focal_length_px": 110.0}
    plain = RenderOptions(radial_k1=0.0, radial_k2=0.0, gray_noise=0.0, exposure_spread=0.0)
    scene = make_rendered_scene(SceneOptions(shape="courtyard", num_images=8, seed=5, **size), plain)
    few = replace(scene, rotations=scene.rotations[:5], centers=scene.centers[:5])
    panoramas.draw(panoramas.PANORAMAS, few, folder / "tour")
    panoramas.draw(panoramas.FISHEYES, scene, folder / "frames")
    for k, name in enumerate(("front", "back")):
        (folder / "frames" / f"{k}").rename(folder / "frames" / name)
    (rigs,) = re.findall(r"^    (\[\{.+?\}\])$", TEXTS[ROOT / "docs/panoramas.md"], re.MULTILINE | re.DOTALL)
    (folder / "rigs.json").write_text(rigs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES[1:] if commands_of(page)], ids=lambda page: page.name
)
def test_every_command_runs_one_after_the_other(page, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data_synthetic").symlink_to(ROOT / "data_synthetic")
    if page.name == "panoramas.md":
        take_pictures_of_360_degrees(tmp_path)
    address = "tcp://10.0.0.5:8786"  # of a machine in the docs
    if page.name == "distributed.md":
        address = request.getfixturevalue("dask_client").cluster.scheduler_address
    # What the README shows, the page of commands shows too: it runs once.
    before = commands_of(README) if page.name == "commands.md" else []
    for command in dict.fromkeys([*before, *commands_of(page)]):
        result = run(*shlex.split(command.replace(IN_FULL, IN_HALF).replace("tcp://10.0.0.5:8786", address)))
        assert result.exit_code == 0, f"{command}\n{result.output}"


def test_the_readme_is_short_leads_with_light_pictures_and_has_the_commands_that_one_uses():
    text = TEXTS[README]
    assert len(text.split()) <= 700
    pictures = re.findall(r"^!\[[^]]+\]\(([^)]+)\)", text, flags=re.MULTILINE)
    assert len(pictures) == 1
    assert text.split("\n\n")[2].startswith("![")
    assert sum((ROOT / picture).stat().st_size for picture in pictures) < 350_000
    assert len({command.split()[0] for command in commands_of(README)}) == 5


def test_a_page_has_every_command():
    shown = {command.split()[0] for command in commands_of(ROOT / "docs/commands.md")}
    assert shown == {info.name for info in app.registered_commands if not info.hidden}


def test_every_file_that_a_page_points_to_exists_and_every_page_is_pointed_to():
    pointed_to = set()
    for page, text in TEXTS.items():
        targets = {(page.parent / t).resolve() for t in re.findall(r"\]\((?!http|#)([^)#]+)[^)]*\)", text)}
        scripts = {ROOT / script for script in re.findall(r"(?<![\w/.])((?:scripts|examples)/[\w.]+)", text)}
        assert [path for path in targets | scripts if not path.exists()] == [], page
        pointed_to |= targets
    assert set(PAGES[1:]) <= pointed_to
    assert set((ROOT / "docs").glob("*.png")) <= pointed_to, "a picture that no page shows"


def test_every_picture_is_made_by_a_command_that_a_page_names():
    named = TEXTS[ROOT / "docs/pictures.md"]
    for picture in (ROOT / "docs").glob("*.png"):
        command = re.search(rf"`python scripts/(\w+).py (\w+) .*docs/{picture.name}`", named)
        script, name = command.groups()
        assert (ROOT / f"scripts/{script}.py").exists(), picture.name
        assert script != "figure" or name in figure.NAMES, picture.name


def names_in(options: object) -> set[str]:
    """Return the names of pycolmap's options, and of those inside them."""
    told = options.todict(recursive=False)
    return {*told}.union(*(names_in(value) for value in told.values() if hasattr(value, "todict")))


def test_those_who_come_from_colmap_are_told_of_flags_that_there_are():
    there = names_in(pycolmap.IncrementalPipelineOptions()) | names_in(pycolmap.GlobalPipelineOptions())
    kept = OPTIONS_OF_A_FILE.findall(TEXTS[ROOT / "docs/options.md"])
    flags = {
        flag
        for command in typer.main.get_command(app).commands.values()
        for parameter in command.params
        for flag in parameter.opts
    }
    page = TEXTS[ROOT / "docs/coming_from.md"].split("## Flags")
    rows = [line.split("|")[1:3] for line in page[1].splitlines() if line.startswith("| `")]
    assert len(rows) > 15
    for theirs, ours in rows:
        for name in re.findall(r"`(\w+)`", theirs):
            assert name in there, name
        for name in re.findall(r"`(\w+)`", ours):
            assert name in kept, name
    assert set(re.findall(r"(?<=[ `])--[a-z-]+", page[1])) <= flags
    commands = {command.name for command in app.registered_commands}
    assert set(re.findall(r"sfm-shapefit ([a-z-]+)", page[0])) <= commands


def answered(*typed: str) -> tuple[set[str], bool]:
    """Return the flags and keys, or else the command, that the program names, and whether there are any."""
    said = " ".join(run(*typed, code=2).stderr.split()).partition(" is COLMAP's")[2]
    assert said, typed
    names = {*re.findall(r"--[a-z-]+|\w+(?= = )", said)} - {"--config"}
    command = set(re.findall(r"sfm-shapefit ([a-z]+)", said))
    return names or command, not said.endswith("leave it out")


def test_the_program_answers_colmaps_flags_and_commands_as_the_page_does():
    page = TEXTS[ROOT / "docs/coming_from.md"].split("## Flags")
    commands, flags = ([line.split("|")[1:3] for line in part.splitlines() if "|" in line] for part in page)
    asked = 0
    for theirs, ours in commands:
        if "`colmap " in theirs:
            for name in set(re.findall(r"`(?:colmap )?(\w+)(?: --[^`]*)?`", theirs)) - {"evo_ape"}:
                named, is_there = answered(name)
                asked += 1
                assert is_there, name
                assert named, name
                assert named <= set(re.findall(r"[\w-]+", ours)), name
    for theirs, ours in flags:
        for name in re.findall(r"`(\w+\*?)`", theirs):
            named, is_there = answered("map", "a", "b", f"--Mapper.{name.replace('*', 'x')}", "0")
            asked += 1
            assert is_there == bool(named) == ("none:" not in ours), name
            assert named <= set(re.findall(r"[\w-]+", ours)), name
    assert asked > 45


def strings_of(tree: ast.AST) -> list[str]:
    """Return the strings of a module, with a star where they are filled in."""
    nodes = list(ast.walk(tree))
    filled = [node for node in nodes if isinstance(node, ast.JoinedStr)]
    plain = [node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    parts = [[v.value if isinstance(v, ast.Constant) else "*" for v in node.values] for node in filled]
    return [*("".join(part) for part in parts), *(node.value for node in plain)]


def test_messages_that_troubleshooting_quotes_the_program_says():
    sources = (ROOT / "sfm_shapefit").rglob("*.py")
    said = [text for path in sources for text in strings_of(tree_of(path))]
    table = TEXTS[ROOT / "docs/troubleshooting.md"].split("| you see |")[1].split("\n\n", 1)[0]
    rows = table.splitlines()[2:]
    assert len(rows) == 15
    for row in rows:
        quoted = re.findall('"([^"]+)"', row.split("|")[1])
        assert quoted, row
        for sentence in quoted:
            filled = re.sub(r"\b[NX]\b", "*", sentence)
            assert any(filled in text for text in said), sentence


def test_the_docs_are_short_and_the_table_of_options_is_made_from_their_definitions():
    assert sum(len(TEXTS[page].split()) for page in PAGES[1:] if page.stem not in FOR_CONTRIBUTORS) <= 8250
    assert sum(len(TEXTS[ROOT / f"docs/{page}.md"].split()) for page in FOR_CONTRIBUTORS) <= 1400
    assert TEXTS[ROOT / "docs/options.md"].endswith(f"{options_table.table()}\n")


def test_the_dockerfile_installs_what_is_there_in_five_lines(tmp_path):
    """All but the daemon: what COPY takes is installed by RUN's pip, and has the command and its warm-up."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 5
    said = dict(line.split(maxsplit=1) for line in lines)
    assert said.keys() == {"FROM", "COPY", "RUN", "WORKDIR", "ENTRYPOINT"}
    assert said["COPY"] == ". /src"
    assert said["RUN"] == "pip install --no-cache-dir /src && sfm-shapefit warm-up"
    assert json.loads(said["ENTRYPOINT"]) == ["sfm-shapefit"]
    left_out = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert {".git", ".venv"} <= set(left_out)  # gigabytes
    heavy = shutil.ignore_patterns(*(line.removeprefix("**/") for line in left_out), "results", "tests")
    shutil.copytree(ROOT, tmp_path / "src", ignore=heavy)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--target"]
    subprocess.run([*pip, tmp_path / "site", tmp_path / "src"], check=True)
    (metadata,) = (tmp_path / "site").glob("*.dist-info")
    assert "sfm-shapefit = sfm_shapefit.cli:main" in (metadata / "entry_points.txt").read_text()
    assert said["FROM"].startswith("python:3.12")  # newer than what is required
    assert "\nRequires-Python: >=3.11\n" in (metadata / "METADATA").read_text(encoding="utf-8")
    here, there = ROOT / "sfm_shapefit", tmp_path / "site/sfm_shapefit"
    files = {path.relative_to(here) for path in here.rglob("*") if "__pycache__" not in path.parts}
    installed = {path.relative_to(there) for path in there.rglob("*")}
    assert files <= installed
    assert {Path("py.typed"), Path("schemas/output.schema.json")} <= installed
    assert {path.name.split("-")[0] for path in (tmp_path / "site").iterdir()} == {"bin", "sfm_shapefit"}


ADDRESS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"][
    "Repository"
]


def addresses_in(folder: Path) -> dict[str, str]:
    """The address of the project in each file that has one."""
    patterns = {"README.md": r"git clone (\S+)", "CITATION.cff": r'repository-code: "(.+)"'}
    return {
        name: re.search(pattern, (folder / name).read_text(encoding="utf-8"))[1]
        for name, pattern in patterns.items()
    }


def test_the_address_stands_in_one_place_from_which_the_others_have_it(tmp_path):
    assert set(addresses_in(ROOT).values()) == {ADDRESS}
    host = re.search(r"//([^/]+)", ADDRESS)[1]
    others = [path for path in PAGES[1:] if host in TEXTS[path]]
    assert not others, "a page with an address that scripts/address does not write"
    assert f"version: {sfm_shapefit.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    for name in ("pyproject.toml", *addresses_in(ROOT), "scripts/address"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    subprocess.run([tmp_path / "scripts/address", "https://fork.test/me/shapes.git"], check=True)
    assert set(addresses_in(tmp_path).values()) == {"https://fork.test/me/shapes.git"}
    assert "&& cd shapes  #" in (tmp_path / "README.md").read_text(encoding="utf-8")
    before, after = ((folder / "README.md").read_text(encoding="utf-8") for folder in (ROOT, tmp_path))
    changed = [a for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]
    assert len(changed) == 1
