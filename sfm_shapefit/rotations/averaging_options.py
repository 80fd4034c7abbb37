"""What rotation averaging is told; cheap to import, as the command line is."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES

Sequencing = Literal["auto", "names", "none"]
"""Which images are taken for videos: those whose matches say so too, all whose names do, or none."""


@explained
@dataclass(frozen=True, kw_only=True)
class AveragingOptions(Settings):
    """Rotations from the matches, component by component."""

    min_matches: int = option(
        0, "Pairs with fewer inlier matches are left out of the averaging; 0 leaves none out."
    )
    sequence: Sequencing = option(
        "auto",
        "Images that are frames of a video, told by a running number in their names: pairs far apart in time "
        'must agree with the chain of those near in time, or they are left out. "auto" asks that the matches '
        'look like a video too; "names" believes the names; "none" takes all pairs alike.',
    )
    gravity: str = option(
        "",
        "Directions of gravity, which help to find rotations, and turn the model so that z points up: a "
        "text file of name x y z [sigma] per line, in axes of the camera (x right, y down, z ahead; sigma in "
        'degrees, 1 if not given), or "database": those of its pose priors.',
    )
    min_model_size: int = option(3, "Components with fewer images make no model.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_matches:
            self.check_range("min_matches", LEAST_MATCHES)
        self.check_range("min_model_size", 3)
