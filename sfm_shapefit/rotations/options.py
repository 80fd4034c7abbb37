"""What rotation averaging is told; cheap to import, as the command line is."""

from typing import Literal

Sequencing = Literal["auto", "names", "none"]
"""Which images are taken for videos: those whose matches say so too, all whose names do, or none."""
