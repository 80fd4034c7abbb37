"""Text models of COLMAP and other programs, read by our own reader; plain ones to the bit as by pycolmap."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model import ColmapModel, read_model
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from tests.scenes import ROOT, fingerprint

Change = Callable[[str], str]

PLAIN = {
    "cameras": "1 PINHOLE 640 480 500.125 501 320 240\n",
    "images": (
        "# two lines each\n1 1 0 0 0 0.1 0.2 0.3 1 a.jpg\n1.5 2.25 7 3 4 -1\n"
        "2 0.6 0.8 0 0 1e-3 -2 3 1 b/b.jpg\n5.1 6.2 7\n3 0 1 0 0 1 1 1 1 c.jpg\n\n"
    ),
    "points3D": "# a comment\n7 0.1 0.2 4 9 8 255 0.5 1 0 2 0\n9 1 1 5 0 0 0 -1\n",
}


def written(folder: Path, change: Change = str, **changed: str) -> Path:
    """Write the plain model, some of it otherwise."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in {**PLAIN, **changed}.items():
        (folder / f"{name}.txt").write_bytes(change(text).encode("utf-8", "surrogateescape"))
    return folder


def content(model: pycolmap.Reconstruction) -> list[object]:
    """Return all that a model holds, numbers by their bytes."""

    def pose(of: pycolmap.Rigid3d | None) -> object:
        return of and (of.rotation.quat.tobytes(), of.translation.tobytes())

    return [
        [(i, c.model_name, c.width, c.height, c.params.tobytes()) for i, c in sorted(model.cameras.items())],
        [
            (i, sorted((s.id, pose(p)) for s, p in r.non_ref_sensors.items()))
            for i, r in sorted(model.rigs.items())
        ],
        [(i, f.rig_id, pose(f.rig_from_world)) for i, f in sorted(model.frames.items())],
        [
            (i, m.name, m.camera_id, m.frame_id, [(p.xy.tobytes(), p.point3D_id) for p in m.points2D])
            for i, m in sorted(model.images.items())
        ],
        [
            (
                i,
                p.xyz.tobytes(),
                p.color.tolist(),
                p.error,
                [(e.image_id, e.point2D_idx) for e in p.track.elements],
            )
            for i, p in sorted(model.points3D.items())
        ],
    ]


def names_of(model: ColmapModel) -> tuple[str, ...]:
    return model.images.names


@pytest.mark.parametrize("with_rigs", [True, False])
def test_a_text_model_of_pycolmap_is_read_to_the_bit_as_pycolmap_does(
    tmp_path: Path, with_rigs: bool
) -> None:
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D = 40
    scene = pycolmap.synthesize_dataset(options)
    for point in scene.points3D.values():
        point.color = np.array([point.track.length(), 0, 255], dtype=np.uint8)
    scene.write_text(tmp_path)
    if not with_rigs:
        (tmp_path / "rigs.txt").unlink()
        (tmp_path / "frames.txt").unlink()
    before = fingerprint(tmp_path)
    assert content(read_model(tmp_path).reconstruction) == content(pycolmap.Reconstruction(tmp_path))
    assert fingerprint(tmp_path) == before


AS_IT_IS: dict[str, Change] = {
    "byte order mark": lambda text: "\ufeff" + text,
    "line ends of Windows": lambda text: text.replace("\n", "\r\n"),
    "tabs": lambda text: text.replace(" ", "\t"),
    "trailing blanks": lambda text: text.replace("\n", " \t\n"),
    "comments everywhere": lambda text: re.sub(r"(?<=\n)", "  # one more\n", text),
    "further lines at the end": lambda text: text + "\n\n# the end\n\n",
    "exponents of three digits": lambda text: re.sub(r"\b(\d+\.\d+)(?= )", r"\1e+000", text),
    "whole numbers with a point": lambda text: re.sub(r"^(\d+) PIN\w+ (\d+)", r"\1.0 PINHOLE \2.0", text),
}


@pytest.mark.parametrize("case", AS_IT_IS)
def test_texts_of_other_editors_and_programs_are_the_same_model(tmp_path: Path, case: str) -> None:
    plain = content(pycolmap.Reconstruction(written(tmp_path / "plain")))
    assert content(read_model(written(tmp_path / "other", AS_IT_IS[case])).reconstruction) == plain


def test_a_text_in_16_bits_is_read(tmp_path: Path) -> None:
    folder = written(tmp_path)
    for name, text in PLAIN.items():
        (folder / f"{name}.txt").write_bytes(text.replace("a.jpg", "ä.jpg").encode("utf-16"))
    assert names_of(read_model(folder)) == ("b/b.jpg", "c.jpg", "ä.jpg")


@pytest.mark.parametrize(
    "name",
    ["A wp-2 (0001).jpg", "0001 0002 0003.jpg", "x\u3000y (1).png", "\udcd0\udcce.jpg", "12 13"],
)
def test_a_name_is_the_rest_of_its_line(tmp_path: Path, name: str) -> None:
    model = read_model(written(tmp_path, images=PLAIN["images"].replace("a.jpg", f"{name} \t")))
    assert name in names_of(model)
    assert model.reconstruction.num_points3D() == 2
    assert not model.notes


def test_ids_beyond_the_whole_numbers_of_floating_point_are_exact(tmp_path: Path) -> None:
    number = 2**60 + 1
    changed = {name: re.sub(r"(?<!\S)7(?!\S)", str(number), PLAIN[name]) for name in ("images", "points3D")}
    model = read_model(written(tmp_path, **changed)).reconstruction
    assert sorted(model.points3D) == [9, number]
    assert model.image(2).points2D[0].point3D_id == number


def test_poses_typed_one_line_each_are_read_and_some_second_lines_alone_are_refused(tmp_path: Path) -> None:
    lines = [line for line in PLAIN["images"].splitlines() if "jpg" in line]
    one_each = "\n".join(lines)
    model = read_model(written(tmp_path, images=one_each, points3D=""))
    assert names_of(model) == ("a.jpg", "b/b.jpg", "c.jpg")
    (note,) = model.notes
    assert "images.txt has one line for each image and is read as poses without points" in note
    whole = read_model(written(tmp_path, images="\n\n".join(lines), points3D=""))
    assert content(whole.reconstruction) == content(model.reconstruction)
    assert not whole.notes  # the last image's empty line is no loss
    for some in (f"{lines[0]}\n\n{lines[1]}\n{lines[2]}\n", f"{lines[0]}\n{lines[1]}\n1 2 -1\n{lines[2]}\n"):
        with pytest.raises(InputError, match=r"images\.txt:\d: .*each image has two lines, .* may be empty"):
            read_model(written(tmp_path, images=some, points3D=""))
    with pytest.raises(
        InputError, match=r"images\.txt:6: the line of its points is missing; each image has two"
    ):
        read_model(written(tmp_path, images=PLAIN["images"].removesuffix("\n\n")))


def test_a_keypoint_that_only_a_track_gives_to_a_point_observes_it_as_for_pycolmap(tmp_path: Path) -> None:
    model = read_model(written(tmp_path, images=PLAIN["images"].replace("1.5 2.25 7", "1.5 2.25 -1")))
    assert content(model.reconstruction) == content(pycolmap.Reconstruction(tmp_path))
    assert TrackMatches(model).num_matches.tolist() == [1]


CONTRADICTIONS = {
    "unknown point": (
        "images",
        "5.1 6.2 7",
        "5.1 6.2 99",
        "image 2 observes 3D point 99, which points3D.txt",
    ),
    "first keypoint throughout": (
        "images",
        "1.5 2.25 7 3 4 -1",
        "3 4 9 1.5 2.25 7",
        "has keypoint 0 of image 1",
    ),
    "track of no keypoint": (
        "points3D",
        "2 0\n",
        "2 5\n",
        "a track refers to point 5 of image 2, which images",
    ),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_poses_serve_where_points_and_observations_contradict(tmp_path: Path, case: str) -> None:
    name, old, new, message = CONTRADICTIONS[case]
    assert old in PLAIN[name]
    model = read_model(written(tmp_path, **{name: PLAIN[name].replace(old, new)}))
    assert model.reconstruction.num_points3D() == 0
    assert len(model.images.names) == 3
    assert message in " ".join(model.notes)
    assert f"{name}.txt" in " ".join(model.notes)


def test_a_text_model_without_points_is_poses_and_no_copy_is_made(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    folder = written(tmp_path / "m")
    (folder / "points3D.txt").unlink()
    assert "has no points3D.txt" in read_model(folder).notes[0]
    with pytest.raises(InputError, match="refers to camera 5"):
        read_model(
            written(
                folder, cameras=PLAIN["cameras"].replace("1 PIN", "2 PIN"), images="1 1 0 0 0 0 0 0 5 a\n"
            )
        )


@pytest.mark.parametrize(
    ("rigs", "frames", "message"),
    [
        ("1 2 CAMERA 1\n", "", r"rigs\.txt:1: the line ends too early"),
        ("1 1 LENS 1\n", "", r"rigs\.txt:1: 'LENS' is no type of a sensor"),
        ("1 1 CAMERA 1\n", "1 1 1 0 0 0 0 0 x 1 CAMERA 1 1\n", r"frames\.txt:1: the pose holds something"),
        ("1 1 CAMERA 1\n", "1 1 1 0 0 0 0 0 0 99 CAMERA 1 1\n", r"frames\.txt:1: the line ends"),
        (
            "1 1 CAMERA 1\n",
            "1 1 1 0 0 0 0 0 0 1 CAMERA 1 1\n",
            r"frames\.txt: image 2 of images\.txt is in no",
        ),
    ],
)
def test_a_broken_line_of_rigs_or_frames_is_named(
    tmp_path: Path, rigs: str, frames: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read_model(written(tmp_path, rigs=rigs, frames=frames))


@pytest.mark.parametrize(
    ("case", "names", "said"),
    [
        ("gtsfm_text_refused", 3, "the track of 3D point 1 has keypoint 0 of image"),
        ("names_not_utf8", 11, ""),
    ],
)
def test_models_of_other_repositories_are_read(case: str, names: int, said: str) -> None:
    folder = ROOT.parent / "shared" / "zoo" / case / "model"
    if not folder.is_dir():
        pytest.skip(f"the model {case} is not at hand (../shared/zoo)")
    model = read_model(folder)
    assert len(model.images.names) == names
    assert said in " ".join(model.notes)
