"""Which cameras are trusted enough. Pure data, and cheap to import."""

from dataclasses import dataclass

from sfm_shapefit.base.settings import Settings, explained, option


@explained
@dataclass(frozen=True, kw_only=True)
class TrustOptions(Settings):
    """Trust in cameras."""

    min_trust: float = option(
        0.6,
        "Cameras of less trust are left out of the output and listed with the reason; 0 keeps all. "
        "See the column trust of cameras.csv.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_range("min_trust", 0.0, 1.0)
