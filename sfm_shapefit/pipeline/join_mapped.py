"""The models of `map` joined, as `join` joins any, and by position priors of their images too."""

from collections.abc import Iterator, Sequence

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.facts.joins import Joined
from sfm_shapefit.facts.map_result import JoinedModel, MappedModel
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.priors import MissingPriorsError, database_priors
from sfm_shapefit.pipeline.inputs import see_matches
from sfm_shapefit.pipeline.join import judge_joins, merge_groups
from sfm_shapefit.pipeline.joined import Told, tell_group
from sfm_shapefit.pipeline.map_run import MapRun
from sfm_shapefit.pipeline.pieces import ModelPiece, tie_pieces
from sfm_shapefit.scene.given import PositionPriors


def join_mapped(
    models: Sequence[MappedModel], run: MapRun
) -> tuple[tuple[Joined, ...], tuple[JoinedModel, ...], tuple[str, ...]]:
    """Join the models of a run, largest first, where that is safe and wanted.

    Returns:
        What came of joining each model but the largest, the models in one world, larger ones first, and what
        was told and could not be used for it, a sentence each.
    """
    if len(models) < 2 or run.options.join == "never":
        return (), (), ()
    located = {number: model.located for number, model in enumerate(models)}
    pieces = [
        ModelPiece(
            label=f"model {number}",
            model=read_model(one.reconstruction),
            scale_sigma=(one.gauge.scale_sigma or 0.0) if one.images.has_rigs else None,
        )
        for number, one in located.items()
    ]
    warnings: list[str] = []
    priors = list(_priors_of(pieces, run, warnings))
    tied = tie_pieces(pieces, run.matches, run.without)
    joins = list(judge_joins(pieces, tied, priors))
    options, inputs = run.options, run.inputs
    told = Told(joins, flat_values(options), inputs, options.gauge.known_distance, located)
    joined = []
    for group in merge_groups(pieces, tied, joins):
        source = see_matches(run.matches, read_model(group.reconstruction).images, inputs)
        joined.append(tell_group(group, told, source, options.directions, run.clock.anew()))
    return tuple(joins), tuple(joined), tuple(warnings)


def _priors_of(
    pieces: Sequence[ModelPiece], run: MapRun, warnings: list[str]
) -> Iterator[PositionPriors | None]:
    """Yield the position priors of the images of each piece, told or those of the database."""
    priors = run.known.priors
    if priors is None:
        try:
            priors = database_priors(run.matches.file, run.images)
        except MissingPriorsError:
            pass
        except InputError as error:
            warnings.append(f"the position priors of the database join no models: {error}")
    for piece in pieces:
        own = (
            None if priors is None else priors.of(np.searchsorted(run.images.names, piece.model.images.names))
        )
        yield own if own else None
