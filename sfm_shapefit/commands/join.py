"""`join`: models of one scene in one world, by one convex program.

models and matches -> ties between pieces -> joins (`model_joins`) -> adjusted -> judged as `check` does
"""

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.settings import flat_values, merge_options
from sfm_shapefit.facts.command_options import JoinOptions
from sfm_shapefit.facts.joined_cameras import JoinInputs
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.pipeline.bundle import adjust_joined
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source, read_left_out
from sfm_shapefit.pipeline.model_joins import judge_joins, merge_groups, tell_group
from sfm_shapefit.pipeline.pieces import ModelPiece, missing_images, read_pieces, tie_pieces

if TYPE_CHECKING:
    import pycolmap


def join(
    models: "Sequence[pycolmap.Reconstruction | Path | str]",
    database: Path | str | None = None,
    *,
    options: JoinOptions | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> JoinedModel:
    """Place models of one scene in one world: pieces of one capture, or captures of one place.

        found = sfm_shapefit.join(["sparse/0", "sparse/1"], "database.db")
        sfm_shapefit.write_result(found, "out")

    Args:
        models: two or more model folders or reconstructions, of any program in COLMAP's form; none is
            changed. The world is that of the first.
        database: the COLMAP database with the matches between their images. Without it, `database.db` is
            looked for beside the first model, as for `locate`; failing that, or if it lacks images of the
            others, images that two models share tie them.
        options: settings, see `help(JoinOptions)`; defaults if None.
        progress: called as stages advance.
        **overrides: single options by name.

    Returns:
        The models that could be joined, `joins` with how and how surely, or why not, and the verdict.

    Raises:
        InputError: if models or database cannot be used, or nothing ties the models to one another.
        UnsolvableError: if no two models can be joined safely; the message says why.
    """
    options = merge_options(options, JoinOptions, overrides)
    clock = Clock.of(progress)
    with clock("read"):
        if not isinstance(models, list | tuple) or len(models) < 2:
            raise InputError(
                "a join needs two models or more, in a list; those of `map_database` are its `models`"
            )
        inputs = choose_inputs(models[0], database)
        pieces = read_pieces(models, inputs.database)
        names = sorted({name for piece in pieces for name in piece.model.images.names})
        shares = len(names) < sum(piece.model.images.num_images for piece in pieces)
        if inputs.database is None or (shares and database is None):
            inputs = _without_foreign(inputs, names)
        inputs = read_left_out(inputs, names, options.directions.without)
    with ExitStack() as stack:
        with clock("ties"):
            matches = None
            if inputs.database is not None:
                matches = stack.enter_context(_opened(pieces, inputs.database, names))
            elif not shares:
                raise InputError(
                    "the models share no image, and there is no database with matches between them; give one"
                )
            tied = tie_pieces(pieces, matches, inputs.left_out)
        with clock("join"):
            joins = list(judge_joins(pieces, tied))
            groups = merge_groups(pieces, tied, joins)
        if not groups:
            raise UnsolvableError("; ".join(one.statement for one in joins))
        group = max(groups, key=lambda group: group.reconstruction.num_reg_images())
    if options.adjust == "full":
        with clock("adjustment"):
            adjusted = adjust_joined(group.reconstruction, clock.threads)
            group = group._replace(reconstruction=adjusted)
    notes = [f"{piece.label}: {note}" for piece in pieces for note in piece.model.notes]
    join_inputs = JoinInputs(joins, flat_values(options), inputs, notes=notes)
    with open_source(read_model(group.reconstruction), inputs) as source:
        return tell_group(group, join_inputs, source, options.directions, clock)


def _without_foreign(inputs: Inputs, names: Sequence[str]) -> Inputs:
    """Return the inputs without a database that was only found, and is that of the first model alone."""
    shared, path = "images that the models share", inputs.database
    if path is None:
        return replace(inputs, statement=shared)
    try:
        missing = missing_images(path, names)
    except InputError as error:
        return replace(inputs, database=None, statement=f"{shared}; the database beside the first: {error}")
    if not missing:
        return inputs
    statement = f"{shared}; {path}, found beside the first, lacks {len(missing)} of {len(names)} images"
    return replace(inputs, database=None, statement=statement)


def _opened(pieces: Sequence[ModelPiece], database: Path, names: Sequence[str]) -> Any:
    """Open a database, and refuse one that knows no image of a model."""
    matches = open_database(database, names)
    missing = {*matches.missing_names}
    for piece in pieces:
        if {*piece.model.images.names} <= missing:
            matches.close()
            raise InputError(
                f"{database} has no image of {piece.label}, such as {piece.model.images.names[0]}; give the "
                "database that all models were made from"
            )
    return closing(matches)
