"""Colors of points, from the pictures that see them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from sfm_shapefit.base.paths import file_of, refuse_no_folder
from sfm_shapefit.base.threads import count_threads
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.facts.map_result import JoinedModel, MapResult
from sfm_shapefit.facts.result import GraphResult, LocateResult
from sfm_shapefit.files.colmap.picture_colors import PictureFolder, color_model
from sfm_shapefit.files.colmap.seed import pick_points

Result = TypeVar("Result", bound=LocateResult | GraphResult | MapResult | JoinedModel)
_PICKED = 1000  # points that are asked for a color; one that has it is enough


def has_colors(found: LocateResult | GraphResult | MapResult | JoinedModel) -> bool:
    """Return whether points of a result, of several models the largest, have colors; none need no color."""
    if isinstance(found, GraphResult):
        return True
    shown = found.models[0] if isinstance(found, MapResult) else found
    picked = pick_points(shown.model if isinstance(shown, LocateResult) else shown.reconstruction, _PICKED)
    return not picked.num_all or bool(picked.colors.any())


def with_colors(found: Result, images: Path | str) -> Result:
    """Return a result whose points without a color have that of the pictures which see them.

    Pictures that are missing or cannot be read give none, and a warning says so.

    Args:
        found: the result; a bare graph has no points, and stays as it is.
        images: folder of the pictures.

    Raises:
        InputError: if the folder is none.
    """
    if isinstance(found, GraphResult):
        return found
    refuse_no_folder(Path(images))
    pictures = PictureFolder(Path(images), count_threads())
    unread: set[str] = set()
    colored: Any = _colored(found, pictures, unread)
    warnings = [*found.warnings, *_color_warnings(pictures.folder, found.image_names, sorted(unread))]
    if isinstance(found, JoinedModel):
        told: dict[str, Any] = {"facts": replace(found.facts, warnings=warnings)}
    else:
        told = {"warnings": tuple(warnings)}
    result: Result = replace(colored, **told)
    return result


def _colored(found: Any, pictures: PictureFolder, unread: set[str]) -> Any:
    """Return a result with colors; names of unreadable pictures are added to `unread`."""
    if isinstance(found, MapResult):
        models = [_colored(one, pictures, unread) for one in found.models]
        joined = [_colored(one, pictures, unread) for one in found.joined]
        return replace(found, models=tuple(models), joined=tuple(joined))
    if isinstance(found, JoinedModel):
        model, missed = color_model(found.reconstruction, pictures)
        unread.update(missed)
        return replace(found, reconstruction=model)
    seed, missed = found.seed.colored(pictures)
    unread.update(missed)
    further = [_colored(one, pictures, unread) for one in found.further]
    return replace(found, seed=seed, further=tuple(further))


def _color_warnings(folder: Path, names: Sequence[str], unread: Sequence[str]) -> list[str]:
    missing, said = sum(file_of(folder, name) is None for name in names), []
    if missing:
        said.append(f"{folder} lacks {missing} of {counted(len(names), 'image')}: is it the right folder?")
    if unread:
        said.append(f"{counted(len(unread), 'picture')} in {folder} cannot be read: {first_of(unread)}")
    return said
