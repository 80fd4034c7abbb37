"""Which names of two programs are the same image."""

import numpy as np
import pytest

from sfm_shapefit.scene.same_images import same_images


@pytest.mark.parametrize(
    ("name", "other"),
    [
        (r".\images\0001.jpg", "0001.jpg"),
        (r"D:/data\0001.jpg", "0001.jpg"),
        (r"cam1\0001.jpg", "cam1/0001.jpg"),
        ("0001.jpg", "images/0001.jpg"),
        ("/home/me/data/cam1/0001.jpg", "cam1//0001.jpg"),
        ("Zoe\u0308.jpg", "Zo\u00eb.jpg"),
        ("IMG_0001.JPG", "images/img_0001.jpg"),
        ("\udcd0\udcce.jpg", "images/\udcd0\udcce.jpg"),
    ],
)
def test_names_of_two_programs_are_the_same_image_either_way(name: str, other: str) -> None:
    for one, two in ((name, other), (other, name)):
        found = same_images([one], ["0002.jpg", two])
        assert found.places.tolist() == [1]
        assert not found.ambiguity


@pytest.mark.parametrize(
    ("names", "others", "places", "said"),
    [
        (["x.jpg"], ["cam1/x.jpg", "cam2/x.jpg"], [-1], "x.jpg may be cam1/x.jpg or cam2/x.jpg;"),
        (["a/x.jpg", "b/x.jpg"], ["x.jpg"], [-1, -1], "a/x.jpg or b/x.jpg may be x.jpg (and 1 more);"),
        (["a.jpg", "A.JPG"], ["a.JPg"], [-1, -1], "A.JPG or a.jpg may be a.JPg"),
    ],
)
def test_several_images_are_never_guessed_but_said(
    names: list[str], others: list[str], places: list[int], said: str
) -> None:
    found = same_images(names, others)
    assert found.places.tolist() == places
    assert found.ambiguity.startswith(said)


@pytest.mark.parametrize(
    ("names", "others", "places"),
    [
        (["x.jpg", "cam2/x.jpg"], ["x.jpg"], [0, -1]),  # equal names first
        (["./x.jpg", "images/x.jpg"], ["x.jpg"], [0, -1]),
        (["d/cam1/x.jpg", "d/x.jpg"], ["x.jpg", "cam1/x.jpg"], [1, 0]),  # the longest part in common
        (["left/x.jpg"], ["right/x.jpg"], [-1]),  # folders that contradict
        (["D:/data/x.jpg", "D:/data/y.jpg"], ["images/x.jpg"], [0, -1]),
        (["/d/left/x.jpg", "/d/y.jpg"], ["right/x.jpg", "y.jpg"], [-1, 1]),
        (["a.jpg", "A.jpg"], ["A.jpg", "a.jpg"], [1, 0]),
    ],
)
def test_the_strongest_rule_decides(names: list[str], others: list[str], places: list[int]) -> None:
    assert same_images(names, others).places.tolist() == places


def test_many_names_that_all_collide_cost_no_more_than_their_number() -> None:
    names = [f"{k}/x.jpg" for k in range(20_000)]
    found = same_images(names, ["x.jpg", "\\".join("y" * 20_000)])
    assert np.all(found.places == -1)
    assert "(and 19999 more)" in found.ambiguity
