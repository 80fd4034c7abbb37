"""Evidence against a model, made by hand."""

from typing import Any

from sfm_shapefit.judgement.places import AmbiguousPlace
from sfm_shapefit.judgement.seams import GroupApart
from sfm_shapefit.judgement.second_opinion import SecondOpinion
from sfm_shapefit.judgement.ties import UntiedGroup
from sfm_shapefit.judgement.wrong_lenses import ContradictedLens
from sfm_shapefit.scene.lens import Lens


def place_of(image: str, num_here: int = 5, num_there: int = 6, **more: Any) -> AmbiguousPlace:
    return AmbiguousPlace(image=image, num_here=num_here, num_there=num_there, offset=(1.0, 1.0, 1.0), **more)


def wrong_lens(lens: Lens, image: str = "one.jpg") -> ContradictedLens:
    """A lens whose eight images ask for a longer focal length."""
    return ContradictedLens.of_lens(lens, image, (1.2, 0.01), 8, 20.0)


def group_apart(*images: str) -> GroupApart:
    return GroupApart(images=images, num_agreeing=0, num_contradicting=9, num_turned=0, turn_deg=None)


def untied_group(*images: str, is_loose: bool = True) -> UntiedGroup:
    return UntiedGroup(images=images, num_agreeing=1, num_contradicting=2, num_points=0, is_loose=is_loose)


def opinion_with(**more: Any) -> SecondOpinion:
    return SecondOpinion(**{"num_common": 8, "usual": 0.01, "num_for": 0, "num_against": 3} | more)
