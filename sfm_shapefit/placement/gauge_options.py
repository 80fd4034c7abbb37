"""What is known of the scale, the origin and the axes of the output. Pure data, and cheap to import."""

from dataclasses import dataclass
from typing import Any, Literal

from sfm_shapefit.base.settings import Settings, explained, option

Scale = Literal["auto", "input", "unit"]
KnownDistance = tuple[str, str, float]
_LONGEST = 1e30  # units; squares of squares of longer ones overflow, and those of 1 over it vanish


@explained
@dataclass(frozen=True, kw_only=True)
class GaugeOptions(Settings):
    """Scale, origin and axes."""

    scale: Scale = option(
        "auto",
        "Scale and origin of the output, unless known positions or distances set them. What does, in this "
        "order: fixed cameras, rigs, control points, scale bars, known distances, priors; others are checks. "
        '"input" takes those of the input\'s centers; "unit" puts the centroid at 0 and the median distance '
        'from it at 1; "auto" is "input", or "unit" where the input has no centers.',
    )
    known_distance: tuple[KnownDistance, ...] = option(
        (),
        "Two images by name, and how far apart they are in the output's units. May be repeated; with "
        "several, the scale is a robust fit, and the output compares each with the model.",
    )
    control_points: str = option(
        "",
        "Ground control points, which set scale, origin and axes: a gcp_list.txt as of OpenDroneMap, whose "
        "first line names the projection, and whose others are x y z, pixels, image, name of the point.",
    )
    scale_bars: str = option(
        "",
        "Known lengths between points that images show, which set the scale: a file whose lines are a "
        "length, its standard deviation, pixels, image, name of the bar, and of the end marked there.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        known: tuple[Any, ...] = self.known_distance
        if known and isinstance(known[0], str):
            known = (known,)
        for one in known:
            _check_distance(one)
        object.__setattr__(self, "known_distance", tuple(map(tuple, known)))


def _check_distance(known: Any) -> None:
    """Refuse what is not two image names and a distance."""
    parts = known if isinstance(known, tuple | list) else ()
    fits = zip(parts, (str, str, int | float), strict=False)
    if len(parts) != 3 or not all(isinstance(part, kind) for part, kind in fits):
        raise ValueError(f"known_distance must be two image names and a number, got {known!r}")
    if not 1.0 / _LONGEST <= known[2] <= _LONGEST or known[0] == known[1]:
        span = f"from {1.0 / _LONGEST:g} to {_LONGEST:g}"
        raise ValueError(f"known_distance must be positive, {span}, of two different images, got {known!r}")
