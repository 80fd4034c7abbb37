"""Result of `inspect`: the diagnosis of a view graph before any solve, and the memory of a run."""

from typing import Annotated

from sfm_shapefit.base.display import Displayed, Row, Telling, row
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted
from sfm_shapefit.placement.diagnosis import Diagnosis

_SIZES = 8  # components whose sizes the terminal lists; --json has all


class Forecast(Record):
    """The memory that `locate` will take."""

    memory_mb: Annotated[dict[str, float], "Peak of each stage in millions of bytes."]
    peak_mb: Annotated[float, "The largest of these."]

    @property
    def statement(self) -> str:
        """What to expect, a sentence for the user."""
        worst = max(self.memory_mb, key=self.memory_mb.__getitem__)
        return f"about {self.peak_mb:.0f} MB at most (while {worst})"


class Inspection(Record, Displayed, repr=False):
    """What `sfm-shapefit inspect --json` prints."""

    directions: Annotated[str, "Origin of the directions, and why this one was chosen."]
    num_images: Annotated[int, "Images or nodes of the input, with a rotation or without."]
    statuses: Annotated[dict[str, int], "Pairs by the sentence that says what became of them."]
    points: Annotated[str, "Whether 3D points join the graph, and why."]
    diagnosis: Annotated[Diagnosis, "What the view graph says before anything is solved."]
    expected: Annotated[Forecast | None, "Memory that locate will take; null for a bare graph."] = None
    rigs: Annotated[str, "How many frames hang together, if the model has rigs."] = (
        "none: every image is a frame of its own"
    )
    warnings: Annotated[tuple[str, ...], "What was read otherwise than it stands, a sentence each."] = ()

    def _headline(self) -> str:
        return f"{self.num_images} images, {self.diagnosis.obstacle or 'which can be placed'}"

    @property
    def told(self) -> Telling:
        """What the terminal says."""
        seen, plan = self.diagnosis, self.diagnosis.plan
        sizes = ", ".join(map(str, seen.components[:_SIZES])) + ", ..." * (len(seen.components) > _SIZES)
        hinges = [f", hinged at {', '.join(p.hinges)}" if p.hinges else "" for p in seen.pieces]
        pieces = [
            counted(p.num_cameras, "camera") + hinge for p, hinge in zip(seen.pieces, hinges, strict=True)
        ]
        rows = [
            row("directions", self.directions),
            Row("pairs", ["\n".join(f"{count}: {status}" for status, count in self.statuses.items())]),
            row("points as nodes", self.points),
            row("rigs", self.rigs),
            row("components", f"{len(seen.components)} (of {sizes} cameras)"),
            Row("rigid pieces", pieces),
            Row("not placed", [f"{name}: {reason}" for name, reason in seen.left_out.items()]),
            Row("weak cameras", [f"{camera.name}: {'; '.join(camera.reasons)}" for camera in seen.weak]),
            row("contradicting", seen.corruption.statement),
            row("solver", f"{plan.solver}: {plan.solver_reason}" if plan else ""),
            row("finish", plan.finish if plan else ""),
            row("will take", self.expected.statement if self.expected else ""),
            Row("warning", self.warnings),
        ]
        return Telling((), rows, elsewhere="see --json")
