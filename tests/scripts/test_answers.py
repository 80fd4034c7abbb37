"""scripts/benchmark.py answers: the same code gives equal recordings, and what differs is reported."""

import copy
import math
from unittest.mock import Mock

import pytest

from benchmarks import answers
from benchmarks.answer_cases import Case, all_cases
from tests.scenes import ROOT

CASE = "place/graph40/unrefined"


def changed(recorded, path, value):
    """Return a copy of a recording with one entry of the case's answer replaced."""
    found = copy.deepcopy(recorded)
    *parents, last = path
    place = found[CASE]
    for key in parents:
        place = place[key]
    place[last] = value
    return found


def recorded_once(folder):
    folders = answers.folders_of(folder)
    chosen = answers.choose(folders, only=CASE, quick=True)
    return {name: one for found in answers.record(ROOT, folders, chosen) for name, one in found.items()}


@pytest.mark.slow
def test_equal_code_gives_equal_answers_and_what_differs_is_reported(tmp_path, monkeypatch):
    warm_up = Mock()  # before any case, whose CPU seconds it is not to have; here all is compiled
    monkeypatch.setattr(answers.Runner, "warm_up", warm_up)
    first, second = recorded_once(tmp_path), recorded_once(tmp_path)
    assert warm_up.call_count == 2
    assert list(first) == [CASE]
    assert first[CASE]["exit"] == 0
    assert 50.0 < first[CASE]["memory_mb"] < 1000.0
    assert 0.1 < first[CASE]["cpu_s"] < 100.0
    for exact in (False, True):
        text, is_equal = answers.compare_recordings(first, second, exact=exact)
        assert is_equal
        assert "worst of positions: 0.0e+00" in text
        assert "1 of 1 cases equal" in text

    def compared(path, value, **how):
        return answers.compare_recordings(first, changed(first, path, value), **how)

    x = float(first[CASE]["tables"]["cameras.csv"]["x"][4])
    place = ("tables", "cameras.csv", "x", 4)
    text, is_equal = compared(place, repr(x + 1e-3))
    assert not is_equal
    assert "tables cameras.csv positions 4 " in text
    assert "0 of 1 cases equal" in text
    assert compared(place, repr(math.nextafter(x, 9)))[1]
    assert not compared(place, repr(math.nextafter(x, 9)), exact=True)[1]

    gap = ("json", "locate.json", "solve", "objective")
    objective = first[CASE]["json"]["locate.json"]["solve"]["objective"]
    assert compared(gap, objective * (1.0 + 1e-6))[1]
    assert not compared(gap, objective * (1.0 + 1e-4))[1]
    assert not compared(gap, math.nextafter(objective, 9), exact=True)[1]

    assert "-> 'doubtful'" in compared(("tables", "pairs.csv", "verdict", 0), "doubtful")[0]
    assert "exit 0 -> 3" in compared(("exit",), 3)[0]
    grade = ("json", "locate.json", "verdict", "grade")
    assert "-> 'do not use'" in compared(grade, "do not use")[0]
    assert not compared(grade, "do not use")[1]
    assert compared(("json", "locate.json", "options"), {})[1]
    text, is_equal = compared(("json", "locate.json", "inputs", "directions"), "the directions are given")
    assert is_equal
    assert "words (1), which do not count:" in text


def recording(**changes):
    """Return a recording of one case that answers nothing."""
    parts = {part: {} for part in ("models", "tables", "json", "texts", "pages", "digests")}
    used = {"memory_mb": 200.0, "cpu_s": 2.0}
    return {
        CASE: {"exit": 0, "verdict": "good", "said": "", "printed": "", "files": [], **parts, **used}
        | changes
    }


def test_a_peak_that_grows_is_told_and_counts_where_memory_is_asked_for():
    for peak, is_told in ((204.9, False), (206.0, True), (190.0, True)):
        text, is_equal = answers.compare_recordings(recording(), recording(memory_mb=peak), memory=True)
        assert ("peak 200 ->" in text) is is_told
        assert is_equal is (peak != 206.0)
        assert answers.compare_recordings(recording(), recording(memory_mb=peak))[1]
    assert "CPU time: median ratio 1.500" in answers.compare_recordings(recording(), recording(cpu_s=3.0))[0]


def test_bytes_of_models_count_only_to_the_bit_and_cases_without_an_answer_are_told():
    other = recording(digests={"images.bin": "0"})
    assert answers.compare_recordings(recording(), other)[1]
    assert not answers.compare_recordings(recording(), other, exact=True)[1]
    assert not answers.compare_recordings(recording(), recording(verdict="look"))[1]
    for unanswered in (recording(exit="timeout"), {CASE: {"skipped": "no words"}}):
        text, is_equal = answers.compare_recordings(recording(), unanswered)
        assert not is_equal
        assert f"skipped or without an answer in time, not compared: 1 cases, ['{CASE}']" in text


def test_an_interrupted_recording_is_read_and_continued(tmp_path):
    path, one = tmp_path / "a.json.gz", recording()
    answers.write(path, {"first": one[CASE]})
    whole = path.read_bytes()
    answers.write(path, one, mode="at")
    assert answers.read(path) == {"first": one[CASE], **one}
    path.write_bytes(path.read_bytes()[:-20])
    assert answers.read(path) == {"first": one[CASE]}
    assert path.read_bytes().startswith(whole)
    folders = answers.folders_of(tmp_path)
    assert [case.name for case in answers.choose(folders, only=CASE)] == [CASE]
    assert answers.choose(folders, only=CASE, done=[CASE]) == []


def test_a_word_with_a_value_becomes_a_key_of_the_configuration(tmp_path):
    class Noted(answers.Runner):
        def run(self, command):
            (told,) = self.work.glob("told-*.toml")
            return answers.Run(0, f"{' '.join(command[3:])}; {told.read_text()}", "", 1.0, 1.0)

    case = Case("place/a", ("place", "graph.txt", "tol=1e-5", "refine=false", "objective=lud", "--strict"))
    (answer,) = Noted(ROOT, tmp_path).ask(case).values()
    words, _, keys = answer["printed"].partition("; ")
    assert words == "place graph.txt --strict --config told-place-a.toml"
    assert keys == 'tol = # refine = false objective = "lud"'  # printed numbers are not compared


def test_names_of_cases_are_unique_and_missing_sets_are_skipped(tmp_path):
    folders = answers.folders_of(tmp_path)
    names = [c.name for case in all_cases(folders) for c in (case, *case.followers)]
    assert len(set(names)) == len(names)
    chosen = answers.choose(folders, only="locate/castle-P30/default")
    found = answers.record(tmp_path, folders, chosen)
    assert next(found)["locate/castle-P30/default"] == {"skipped": "castle-P30 is not at hand"}
    with pytest.raises(SystemExit, match="has no package sfm_shapefit"):
        next(found)
