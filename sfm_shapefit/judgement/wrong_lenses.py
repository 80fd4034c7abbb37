"""Wrong lenses: whose images ask for another focal length when they are left out, one by one.

A lens that took one image is wrong if that changes by 2.5 % or more and ten standard deviations. Three do if
they are twice those of any other image: before a wall, seen from the front, a camera that stands nearer hides
nearly all of it. Where one took several, their points have bent to a wrong focal length, so that its value
shows less than that the images ask for unlike ones: it is wrong if half of them change by more than 0.4 % and
three deviations. With right lenses, no image of 17 scenes changed by ten deviations, and half of those of a
lens changed by 0.2 % at most, or by two deviations; with all lenses wrong by 0.8 to 1.3 and the points
adjusted to that, half of them changed by 0.5 % or more.

Poses that are rough, as of a network, put their errors on one lens. So it takes ten deviations all the same
to ask for a focal length that leaves the range of like lenses, by more than 2.5 % and three deviations; like
ones have the same model and size, and took one image each.
"""

from typing import Annotated, Self

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import label_lens
from sfm_shapefit.judgement.left_out import LeftOut, leave_one_out
from sfm_shapefit.judgement.limits import OUTNUMBERED, RIVAL_SHARE, SIGMAS, SMALLEST_SHAPE
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import ADJUSTED_ELSEWHERE, Lens
from sfm_shapefit.scene.structure import Structure

# Change of the focal length, and standard deviations, beyond which that of one image is wrong, and beyond
# which half of the images of a lens show that it is; see the header.
_ONE, _HALF = (0.025, 10.0), (0.004, SIGMAS)
_UNLIKE = 2.0  # scatters of what images ask for; a mean that is nearer names no other focal length


class ContradictedLens(Record):
    """A lens whose images, left out one by one, ask for another focal length."""

    camera: Annotated[int, "Its id in the model."]
    image: Annotated[str, "The first of its images."]
    num_images: Annotated[int, "Images that were asked."]
    focal_px: Annotated[float, "Mean focal length of the model."]
    asked_focal_px: Annotated[float, "Focal length that its images ask for, the median one."]
    asked_sigma_px: Annotated[
        float, "Standard deviation of it: by the noise for one image or two, by the scatter over more."
    ]
    remedy: Annotated[str, "What to do about it, or what has been done."]
    factor: float
    """The focal length that is asked for over that of the model."""
    sigma: float
    """The standard deviation as a share of the focal length that is asked for."""
    score: float
    """The change in standard deviations, the median one of its images."""

    @classmethod
    def of_lens(
        cls, lens: Lens, image: str, asked: tuple[float, float], num_images: int, score: float
    ) -> Self:
        """Return the record of a lens, and the first of its images.

        Args:
            lens, image: the two.
            asked: the factor of the focal length that its images ask for, and its standard deviation.
            num_images: number of images that were asked.
            score: the change in standard deviations.
        """
        factor, sigma = asked
        asked_px, remedy = factor * lens.focal_px, "intrinsics=focal lets it change, or calibrate that camera"
        if not lens.is_adjustable:
            remedy = f"{ADJUSTED_ELSEWHERE}; or calibrate that camera"
        elif lens.origin is not None and lens.parameters != lens.given:
            remedy = "it was adjusted already, so calibrate that camera"
        return cls(
            camera=lens.id,
            image=image,
            num_images=num_images,
            focal_px=lens.focal_px,
            asked_focal_px=asked_px,
            asked_sigma_px=sigma * asked_px,
            remedy=remedy,
            factor=factor,
            sigma=sigma,
            score=score,
        )

    @property
    def label(self) -> str:
        """Its id, and the images by which a user knows it."""
        return label_lens(self.camera, self.image, self.num_images)

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        asked = f"{self.asked_focal_px:,.0f} ± {self.asked_sigma_px:,.0f} px"
        if abs(self.asked_focal_px - self.focal_px) < _UNLIKE * self.asked_sigma_px:
            return (
                f"the focal length of {self.label}, {self.focal_px:,.0f} px, is doubtful: by the points "
                f"that the others make, its {self.num_images} images ask for lengths that differ ({asked}), "
                "so the lens or the places of images are wrong"
            )
        who = "its image asks" if self.num_images == 1 else f"its {self.num_images} images ask"
        return (
            f"the focal length of {self.label} is wrong: {who} for {asked}, not {self.focal_px:,.0f} "
            f"px, by the points that the others make; its images are wrong by that: {self.remedy}"
        )


def is_like_others(images: Images, lens: int, focal_px: float, sigma: float) -> bool:
    """Return whether a focal length, known to a share `sigma`, is in the range of like lenses, or has few."""
    single = np.bincount(images.lens_of, minlength=len(images.lenses)) == 1
    own = images.lenses[lens]
    like = [
        one.focal_px
        for k, one in enumerate(images.lenses)
        if single[k]
        and k != lens
        and (one.model, one.width, one.height) == (own.model, own.width, own.height)
    ]
    if not single[lens] or len(like) < SMALLEST_SHAPE:
        return True
    margin = (1.0 + _ONE[0]) * (1.0 + SIGMAS * sigma)
    return min(like) / margin <= focal_px <= max(like) * margin


def _ask_for_like(left_out: LeftOut, images: Images, lens: int, rows: IntArray) -> bool:
    """Return whether images of a lens ask for a focal length in the range of like ones."""
    if not len(rows):
        return True
    factor, sigma = np.exp(np.median(left_out.log_factors[rows])), left_out.sigmas[rows].max()
    return is_like_others(images, lens, float(factor * images.lenses[lens].focal_px), float(sigma))


def question_lenses(
    structure: Structure, threads: int = 1, asked: BoolArray | None = None
) -> tuple[LeftOut, tuple[ContradictedLens, ...]]:
    """Return what images say when they are left out, and the lenses that they contradict, the worst first.

    The rays of a wrong lens pull at the points of right ones. So what is named most clearly is taken out of
    the points of all, unless it took half of the images or more, until no other lens is named. Images not
    `among` those that make points are asked too, if their pixels fit about as well. Only those `asked` (i,)
    are left out; None: all.
    """
    images = structure.images
    make = np.ones(images.num_images, dtype=np.bool_) if structure.among is None else structure.among
    believed = make.copy()
    while True:
        found = leave_one_out(structure, threads, believed, asked)
        left_out = found.of_little_noise(make)
        wrong = wrong_lenses(left_out, images)
        fresh = [item for item in wrong if believed[images.camera_ids == item.camera].any()]
        worst = [item.camera for item in fresh if item.score >= RIVAL_SHARE * fresh[0].score]
        gone = np.isin(images.camera_ids, worst)
        if not fresh or 2 * np.sum(make & (~believed | gone)) >= np.sum(make):
            return left_out, wrong
        believed &= ~gone


def wrong_lenses(left_out: LeftOut, images: Images) -> tuple[ContradictedLens, ...]:
    """Return the lenses that the images contradict when they are left out, the most contradicted first."""
    found = []
    with np.errstate(divide="ignore", invalid="ignore"):
        scores = np.abs(left_out.log_factors) / left_out.sigmas
    for lens in range(len(images.lenses)):
        own = images.lens_of == lens
        rows, others = (np.flatnonzero(side & left_out.observable) for side in (own, ~own))
        (least, deviations), clear = _ONE, max(SIGMAS, OUTNUMBERED * scores[others].max(initial=0.0))
        if len(rows) >= SMALLEST_SHAPE:
            least, deviations = _HALF
        elif own.sum() < SMALLEST_SHAPE and len(others) >= SMALLEST_SHAPE:
            some = np.flatnonzero(own & (left_out.observable | (scores > clear)))
            if _ask_for_like(left_out, images, lens, some):
                deviations, rows = min(deviations, clear), some
        if not len(rows):
            continue
        changes = left_out.log_factors[rows]
        middle = float(np.median(changes))
        sigma = float(left_out.sigmas[rows].max())
        if len(rows) >= SMALLEST_SHAPE:
            sigma = SIGMA_PER_MEDIAN * float(np.median(np.abs(changes - middle)))
        score = float(np.median(scores[rows]))
        if np.median(np.abs(changes)) > least and score > deviations:
            first, asked = images.names[int(np.argmax(own))], (float(np.exp(middle)), sigma)
            found.append(ContradictedLens.of_lens(images.lenses[lens], first, asked, len(rows), score))
    return tuple(sorted(found, key=lambda item: -item.score))
