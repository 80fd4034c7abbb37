"""What the user of `map` should know beyond the warnings of each model, a sentence each."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.scene import describe_repeated_pairs, describe_rival_pairs
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.placement.gauge_options import KnownDistance
from sfm_shapefit.scene.given import ScaleBars

_ALARMING_SHARE = 0.7  # share of a model's agreeing pairs; below, warn (castle-P30: 0.97, lego100: 0.89)
_DOUBTFUL_SHARE = 0.25  # share of an image's agreeing pairs; below, its averaged rotation is doubtful


def map_warnings(incomplete_rigs: Sequence[int], models: Sequence[LocateResult]) -> Iterator[str]:
    """Yield what the user should know, a sentence each."""
    if incomplete_rigs:
        rig, count = f"rig {incomplete_rigs[0]} of the database", len(incomplete_rigs)
        yield (
            f"{f'{count} rigs, {rig} for one, are' if count > 1 else f'{rig} is'} not used, since "
            "a sensor has no pose or an image no frame; their cameras are placed one by one: configure them "
            "with colmap rig_configurator to place them together"
        )
    for number, model in enumerate(models):
        averaging = model.averaging
        assert averaging is not None
        share, agreements = averaging.share, averaging.agreements
        is_good = model.verdict.grade is Grade.GOOD  # whatever its rotations were at first
        if share < _ALARMING_SHARE and not is_good:
            yield f"model {number}: only {share:.0%} of the pairs agree with the averaged rotations"
        if averaging.num_repeated:
            yield f"model {number}: {describe_repeated_pairs(averaging.num_repeated)}"
        if averaging.num_rivals:
            yield f"model {number}: {describe_rival_pairs(averaging.num_rivals)}"
        doubtful = np.flatnonzero(agreements < _DOUBTFUL_SHARE)
        if len(doubtful) and not is_good:
            worst = model.averaged_names[int(doubtful[np.argmin(agreements[doubtful])])]
            yield (
                f"model {number}: most pairs of {counted(len(doubtful), 'image')} contradict their averaged "
                f"rotations, above all those of {worst}"
            )


def lost_bars(
    known: ScaleBars | None, models: Sequence[LocateResult], joined: Sequence[JoinedModel]
) -> Iterator[str]:
    """Yield which scale bars no model shows."""
    shown = {bar.name for model in models for bar in model.scale_bars}
    shown |= {bar.name for one in joined for bar in one.facts.scale_bars}
    for name, place in zip(known.bars, known.places, strict=True) if known else ():
        if name not in shown:
            yield f"{place}: {name} is of no use: no image of a model has a mark of it"


def lost_distances(
    known: Iterable[KnownDistance], models: Sequence[LocateResult], joined: Sequence[JoinedModel]
) -> Iterator[str]:
    """Yield what became of known distances that are in no model."""
    model_of = {
        model.placed.names[image]: number
        for number, model in enumerate(models)
        for image in np.flatnonzero(model.placed.is_posed).tolist()
    }
    for first, second, _ in known:
        ends = [model_of.get(name) for name in (first, second)]
        if None in ends:
            name = (first, second)[ends.index(None)]
            yield f"the known distance of {first} and {second} is of no use: {name} is in no model"
        elif ends[0] != ends[1] and not any({*ends} <= {*one.models} for one in joined):
            yield (
                f"the known distance of {first} and {second} is of no use: they are in models {ends[0]} and "
                f"{ends[1]}, which are not joined"
            )
