"""What `locate`, `map` and `inspect` are told: each a composition of the groups of its stages.

Pure data, and cheap to import. Each option is stated once, in the group of the stage that it belongs to.
"""

import math
from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Composed, Settings, explained, group, option
from sfm_shapefit.judgement.trust_options import TrustOptions
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.placement.gauge_options import GaugeOptions
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.rotations.averaging_options import AveragingOptions
from sfm_shapefit.scene.freedom import FreedomOptions
from sfm_shapefit.tracks.structure_options import NodeOptions, StructureOptions

Rotations = Literal["auto", "held", "free"] | float
Source = Literal["auto", "matches", "tracks"]
Join = Literal["never", "safe"]


@explained
@dataclass(frozen=True, kw_only=True)
class SourceOptions(Settings):
    """What a model is located from."""

    directions: Source = option(
        "auto",
        "Where directions come from: the database's inlier matches, or the model's own tracks; "
        '"auto" takes matches if there is a database, else tracks.',
    )


@explained
@dataclass(frozen=True, kw_only=True)
class MemoryOptions(Settings):
    """Memory of the whole run."""

    max_memory_mb: int = option(
        0,
        "Peak memory in MB to stay below, 0 for no limit; the output says what was given up for it, and "
        "`inspect` forecasts the need. If nothing is enough, the run is refused with the number needed.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_range("max_memory_mb", 0)


@explained
@dataclass(frozen=True, kw_only=True, init=False)
class InspectOptions(Composed):
    """What decides what the view graph is, and what becomes of it."""

    source: SourceOptions = group(SourceOptions)
    directions: DirectionOptions = group(DirectionOptions)
    nodes: NodeOptions = group(NodeOptions)
    placement: PlacementOptions = group(PlacementOptions)
    freedom: FreedomOptions = group(FreedomOptions)


@explained
@dataclass(frozen=True, kw_only=True, init=False)
class LocateOptions(Composed):
    """The given model."""

    fix: str = option(
        "",
        "Cameras that stay exactly where the input has them, while the others are placed around them: "
        'a text file with one image name per line, or "solved": every image that observes a 3D point '
        "of the input, for new images in a solved model. With two or more the scale is theirs, with "
        "one only the origin.",
    )
    rotations: Rotations = option(
        "auto",
        'How far the given rotations are believed: "held", as measured by instruments, not doubted; "free", '
        "ignored by the adjustment; a number, their standard deviation about each axis in degrees: from "
        "0.3 on, the relative rotations of pairs first correct them; "
        '"auto" asks the matches how far off they are, and which cameras are turned.',
    )
    source: SourceOptions = group(SourceOptions)
    directions: DirectionOptions = group(DirectionOptions)
    nodes: NodeOptions = group(NodeOptions)
    placement: PlacementOptions = group(PlacementOptions)
    freedom: FreedomOptions = group(FreedomOptions)
    trust: TrustOptions = group(TrustOptions)
    structure: StructureOptions = group(StructureOptions)
    gauge: GaugeOptions = group(GaugeOptions)
    memory: MemoryOptions = group(MemoryOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.rotations, str) and not 0.0 < self.rotations < 180.0:
            raise ValueError(f"rotations must lie between 0 and 180 degrees, got {self.rotations}")
        if self.rotations not in ("auto", "held"):
            self.freedom.refuse_held("rotations", self.rotations)


@explained
@dataclass(frozen=True, kw_only=True, init=False)
class JoinOptions(Composed):
    """What becomes of models that are joined."""

    adjust: Literal["none", "full"] = option(
        "none",
        'Whether the whole is bundle adjusted after the join: "none", each model keeps its shape; "full", '
        "poses and points of all are adjusted together.",
    )
    directions: DirectionOptions = group(DirectionOptions)


@explained
@dataclass(frozen=True, kw_only=True, init=False)
class MapOptions(Composed):
    """What becomes of models that stand apart."""

    join: Join = option(
        "safe",
        'Whether several models are joined: "safe", into a further folder, those that position priors or '
        'points seen by both tie together beyond doubt; "never", none.',
    )
    averaging: AveragingOptions = group(AveragingOptions)
    directions: DirectionOptions = group(DirectionOptions)
    nodes: NodeOptions = group(NodeOptions)
    placement: PlacementOptions = group(PlacementOptions)
    freedom: FreedomOptions = group(FreedomOptions)
    trust: TrustOptions = group(TrustOptions)
    structure: StructureOptions = group(StructureOptions, min_points_per_image=30)
    gauge: GaugeOptions = group(GaugeOptions)
    memory: MemoryOptions = group(MemoryOptions)


PlacingOptions = LocateOptions | MapOptions
"""What the stages have in common that follow the rotations."""


def pull_of_rotations(rotations: Rotations) -> float | None:
    """Return by which standard deviation given rotations pull, see `Freedom`; None: as the matches say."""
    if not isinstance(rotations, str):
        return math.radians(rotations)
    return {"auto": None, "held": 0.0, "free": math.inf}[rotations]
