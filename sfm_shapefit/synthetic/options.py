"""What to photograph and what to write of it: `SceneOptions`, `WorkspaceOptions`.

Pure data, and cheap to import: the command line makes its flags of them.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:  # numpy is not cheap
    from sfm_shapefit.arrays import FloatArray

Shape = Literal["ring", "facade", "drive", "cloud", "courtyard"]
ModelContent = Literal["full", "rotations"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOptions:
    """What to photograph, and how badly. Every field is a flag of `sfm-shapefit synth`."""

    shape: Shape = "ring"
    """"ring": cameras around an object; "facade": a grid of cameras before a wall; "drive": forward along a
    street; "cloud": random cameras around random points; "courtyard": around the inside of four facades."""
    num_images: int = 25
    """Number of images, all by one camera."""
    num_points: int = 2000
    """Number of surface points; those seen by fewer than two images stay out of the model."""
    pixel_noise_px: float = 0.5
    """Standard deviation of each keypoint coordinate."""
    wrong_match_fraction: float = 0.0
    """Fraction of each pair's matches that join random keypoints of the list."""
    corrupted_pair_fraction: float = 0.0
    """Fraction of the pairs whose whole list agrees on a false baseline."""
    rotation_noise_deg: float = 0.0
    """Standard deviation, about each axis, of the error of the rotations that the model states."""
    max_pairs_per_image: int = 20
    """Each image is paired with that many others, those it shares most points with; a pair is kept if
    either of its images asks for it."""
    min_matches: int = 30
    """Images that share fewer points than this are no pair."""
    max_matches_per_pair: int | None = None
    """So many of a pair's matches are kept, drawn at random; all if not given."""
    max_keypoints_per_image: int = 1000
    """The points that appear largest (nearest and most frontal) are kept."""
    image_width: int = 1200
    """In pixels."""
    image_height: int = 900
    """In pixels."""
    focal_length_px: float = 1000.0
    """One for both axes; the principal point is the centre of the image."""
    seed: int = 0
    """Decides every random draw."""

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise ValueError(f"SceneOptions.shape must be one of {get_args(Shape)}, got {self.shape!r}")
        for name, least in _SMALLEST_INTEGERS.items():
            if getattr(self, name) < least:
                raise ValueError(f"SceneOptions.{name} must be >= {least}, got {getattr(self, name)}")
        most = self.max_matches_per_pair
        if most is not None and most < self.min_matches:
            raise ValueError(
                f"SceneOptions.max_matches_per_pair must be >= min_matches = {self.min_matches}, got {most}"
            )
        for name in ("pixel_noise_px", "rotation_noise_deg"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"SceneOptions.{name} must be finite and >= 0, got {getattr(self, name)}")
        for name in ("wrong_match_fraction", "corrupted_pair_fraction"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"SceneOptions.{name} must lie in [0, 1], got {getattr(self, name)}")
        if not 0.0 < self.focal_length_px < math.inf:
            raise ValueError(f"SceneOptions.focal_length_px must be positive, got {self.focal_length_px}")

    @property
    def calibration(self) -> "FloatArray":
        """The (3, 3) calibration matrix K of every image."""
        import numpy as np

        f, x, y = self.focal_length_px, self.image_width / 2.0, self.image_height / 2.0
        return np.array([[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]])


_SMALLEST_INTEGERS = {
    "num_images": 2,
    "num_points": 1,
    "max_pairs_per_image": 1,
    "min_matches": 8,
    "max_keypoints_per_image": 8,
    "image_width": 16,
    "image_height": 16,
    "seed": 0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """How a scene is drawn, where images are asked for. Every field is a flag of `sfm-shapefit synth`."""

    repeated_fraction: float = 0.0
    """Fraction of the houses (of the tower's sides in a ring) that look the same, so that matches of
    different ones are wrong and agree."""
    radial_k1: float = -0.05
    """First radial distortion coefficient of the lens, as OpenCV and COLMAP define it."""
    radial_k2: float = 0.01
    """Second radial distortion coefficient."""
    gray_noise: float = 2.0
    """Standard deviation of the sensor's noise, in grey levels of 255."""
    exposure_spread: float = 0.05
    """Standard deviation of the brightness factor from image to image."""
    jpeg_quality: int = 92
    """Of the image files, 1 to 100."""

    def __post_init__(self) -> None:
        for name in ("radial_k1", "radial_k2"):
            if not -0.5 <= getattr(self, name) <= 0.5:
                raise ValueError(f"RenderOptions.{name} must lie in [-0.5, 0.5], got {getattr(self, name)}")
        for name, most in (("repeated_fraction", 1.0), ("gray_noise", 100.0), ("exposure_spread", 0.3)):
            if not 0.0 <= getattr(self, name) <= most:
                raise ValueError(f"RenderOptions.{name} must lie in [0, {most}], got {getattr(self, name)}")
        if not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"RenderOptions.jpeg_quality must lie in [1, 100], got {self.jpeg_quality}")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkspaceOptions:
    """What stands in the workspace. Every field is a flag of `sfm-shapefit synth`."""

    model: ModelContent = "full"
    """What sparse/0 states: "full" is poses and points with their tracks; "rotations" keeps the rotations
    only, as from an inertial sensor: all centres at the origin, no points."""
    database: bool = True
    """Write database.db; without it the model's own tracks are the only source of directions."""
    relative_poses: bool = False
    """Store cam2_from_cam1 in the two-view geometries; COLMAP leaves it out by default."""

    def __post_init__(self) -> None:
        if self.model not in get_args(ModelContent):
            raise ValueError(
                f"WorkspaceOptions.model must be one of {get_args(ModelContent)}, got {self.model!r}"
            )
        if self.model == "rotations" and not self.database:
            raise ValueError(
                "WorkspaceOptions.model = 'rotations' needs WorkspaceOptions.database: without points and "
                "without matches nothing can be located"
            )
