"""Tables and JSON as files: what stands in a cell, and names and paths that are no UTF-8."""

import csv
import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from sfm_shapefit.base.record import dumps, write_json
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, write_rows
from tests.program import run, run_python
from tests.scenes import RING

SIGMAS = ["sigma_x", "sigma_y", "sigma_z"]
RHOS = ["rho_xy", "rho_xz", "rho_yz"]
TURNED = ["turned_deg", "moved", "prior_off"]
NOT_UTF8 = os.fsdecode(b"mod\xe8le")


def lines_of(path):
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.reader(stream))


def test_a_row_has_one_cell_per_axis_and_empty_cells_for_what_is_not_known(tmp_path):
    nan = math.nan
    told = {
        "name": ['a,"b', "c"],
        "placed": [True, False],
        "reason": ["", "why"],
        "piece": [0, None],
        "center": [(0.1, -2.0, 1e-30), (nan,) * 3],
        "degree": [3, 0],
        "trust": [0.5, nan],
        "correlation": [(0.25, -1.0, 0.0), (nan,) * 3],
        "turned_deg": [1.5, nan],
    }
    rows = Table(CameraRow, 3, told)
    write_rows(rows, tmp_path / "cameras.csv")
    assert lines_of(tmp_path / "cameras.csv") == [
        ["name", "placed", "reason", "piece", "x", "y", "z", "degree", "trust", *SIGMAS, *RHOS, *TURNED],
        [
            'a,"b',
            "true",
            "",
            "0",
            "0.1",
            "-2.0",
            "1e-30",
            "3",
            "0.5",
            "",
            "",
            "",
            "0.25",
            "-1.0",
            "0.0",
            "1.5",
            "",
            "",
        ],
        ["c", "false", "why", "", "", "", "", "0", *[""] * 10],
    ]
    first, last = rows
    assert first.center == rows[0].center == (0.1, -2.0, 1e-30)
    assert (first.placed, first.piece, first.degree, first.sigma) == (True, 0, 3, ())
    assert [row.name for row in rows[1:]] == [row.name for row in rows.taken([1])] == ["c"]
    assert [row.name for row in rows.followed_by(rows)] == 2 * ['a,"b', "c"]
    assert (last.name, last.placed, last.piece, last.center) == ("c", False, None, ())


def test_cells_far_down_a_table_are_quoted_where_they_need_it(tmp_path):
    names = [f"{k}.jpg" for k in range(20_000)]  # more than are written together
    names[3], names[-2], names[-1] = 'a,"b', "two\nlines", "a\rreturn"
    told = {"name": names, "trust": [*np.linspace(0.0, 1.0, 19_999), np.inf], "piece": [None, *range(19_999)]}
    write_rows(Table(CameraRow, 3, told), tmp_path / "cameras.csv")
    header, *rows = lines_of(tmp_path / "cameras.csv")
    assert [row[0] for row in rows] == names
    trust = [row[header.index("trust")] for row in rows]
    assert [float(cell) for cell in trust[:-1]] == told["trust"][:-1]
    assert (trust[-1], rows[0][header.index("piece")], rows[-1][header.index("piece")]) == ("", "", "19998")
    last = (tmp_path / "cameras.csv").read_bytes().splitlines(keepends=True)[-2:]
    assert last[0] == b'"a\r'  # other programs end a line there unless all cells stand in quotes
    assert last[1].startswith(b'return","false","","19998"')


@pytest.mark.parametrize(("dimension", "axes"), [(2, ["vx", "vy"]), (4, ["vx1", "vx2", "vx3", "vx4"])])
def test_a_pair_has_one_column_per_dimension(tmp_path, dimension, axes):
    told = {"name1": ["1"], "name2": ["2"], "direction": [(0.5,) * dimension], "leverage": [0.25]}
    rows = Table(PairRow, dimension, told)
    write_rows(rows, tmp_path / "pairs.csv")
    header, cells = lines_of(tmp_path / "pairs.csv")
    assert cells[header.index("leverage")] == "0.25"
    assert (rows[0].scores.leverage, rows[0].direction) == (0.25, (0.5,) * dimension)
    assert math.isnan(rows[0].scores.weight)
    assert header[2 : 2 + dimension] == axes
    assert cells[2 : 2 + dimension] == ["0.5"] * dimension
    assert len(header) == len(cells)


def test_bytes_that_are_no_utf8_come_back_from_the_json_and_are_escaped_in_a_table(tmp_path):
    text = dumps({"path": NOT_UTF8, "name": "é"})
    write_json({"path": NOT_UTF8, "name": "é"}, tmp_path / "out.json")
    assert (tmp_path / "out.json").read_bytes() == text.encode("utf-8") + b"\n"
    assert "é" in text
    assert os.fsencode(json.loads(text)["path"]) == b"mod\xe8le"
    write_rows(Table(CameraRow, 3, {"name": [NOT_UTF8]}), tmp_path / "cameras.csv")
    assert lines_of(tmp_path / "cameras.csv")[1][0] == r"mod\udce8le"


def test_a_model_whose_path_is_no_utf8_is_located_and_reported(tmp_path):
    try:
        scene = Path(shutil.copytree(RING, tmp_path / NOT_UTF8))
    except OSError:
        pytest.skip("this file system takes names in UTF-8 only")
    locate = ("locate", scene / "sparse" / "0", tmp_path / "out")
    done = run_python("-m", "sfm_shapefit.cli", *locate, "--json", PYTHONIOENCODING="utf-8:strict")
    assert (done.returncode, done.stderr) == (0, "")
    written = json.loads((tmp_path / "out" / "locate.json").read_text(encoding="utf-8"))
    assert os.fsencode(written["inputs"]["model"]) == os.fsencode(scene / "sparse" / "0")
    assert json.loads(done.stdout)["inputs"] == written["inputs"]
    assert run(*locate, "--overwrite", code=0).stderr == ""
