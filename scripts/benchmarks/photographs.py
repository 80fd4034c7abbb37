"""From photographs to a verdict: `map IMAGES OUT` beside pycolmap called by hand, on the tutorial's yard.

By hand means extraction, exhaustive matching with verification, and global mapping, one after the other, with
as many features and one lens for all. Ours is the command in a process of its own, with all that it loads and
writes: colors, tables, the report. Both have one thread; CPU seconds count, as other users of the machine
change the clock.
"""

import argparse
import tempfile
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pycolmap

import sfm_shapefit
from harness.driver import Benchmark, Case, positive
from harness.process import call, children_cpu_s, run_command, thread_environment, time_call
from harness.record import Row, at_most
from sfm_shapefit.files.colmap.quiet import quiet_log

MATCHING_SHARE, MAPPING_SHARE = 1.1, 0.3
"""CPU seconds that ours may take: so many times those of extraction and matching, and of global mapping."""
_YARD = "--images --shape courtyard --seed 1 --repeated-fraction 0.2"


class ByHand(NamedTuple):
    """CPU seconds of the three calls of pycolmap."""

    extraction_s: float
    matching_s: float
    mapping_s: float

    @property
    def limit_s(self) -> float:
        """What ours may take."""
        return MATCHING_SHARE * (self.extraction_s + self.matching_s) + MAPPING_SHARE * self.mapping_s


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=positive, default=16, help="photographs of the yard")
    parser.add_argument("--width", type=positive, default=640, help="pixels of a photograph")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the yard."""
    return {"yard": partial(measure, args.images, args.width)}


def measure(images: int, width: int) -> list[Row]:
    """Draw the yard, and map it both ways."""
    with tempfile.TemporaryDirectory() as folder:
        yard, hand, out = (Path(folder) / name for name in ("yard", "hand", "out"))
        size = f"--image-width {width} --image-height {3 * width // 4} --focal-length-px {3 * width // 4}"
        run_command("synth", yard, "--num-images", images, *_YARD.split(), *size.split())
        hand.mkdir()
        taken = ByHand(*call(map_by_hand, yard / "images", hand, environment=thread_environment(1)))
        before = children_cpu_s()
        run_command("map", yard / "images", out, "--threads", 1)
        ours_s = children_cpu_s() - before
        errors = {
            "pycolmap": _worst(hand / "0", yard / "sparse/0"),
            "map IMAGES OUT": _worst(out / "0", yard / "sparse/0"),
        }
    stages = {"extraction": taken.extraction_s, "matching": taken.matching_s, "mapping": taken.mapping_s}
    cells = {"photographs": f"{images} of {width} x {3 * width // 4}", "by": "pycolmap", "CPU s": sum(taken)}
    ours = {**cells, "by": "map IMAGES OUT", "CPU s": ours_s}
    return [
        Row(
            ours | dict.fromkeys(stages) | {"worst (m)": errors["map IMAGES OUT"]},
            at_most(CPU_s=(ours_s, taken.limit_s)),
        ),
        Row(cells | stages | {"worst (m)": errors["pycolmap"]}),
    ]


def map_by_hand(images: Path, out: Path) -> tuple[float, ...]:
    """Write the models of global mapping into a folder, and return the CPU seconds of the three calls."""
    database, extraction = out / "database.db", pycolmap.FeatureExtractionOptions(num_threads=1)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    single = pycolmap.CameraMode.SINGLE
    calls = (
        partial(
            pycolmap.extract_features, database, images, camera_mode=single, extraction_options=extraction
        ),
        partial(pycolmap.match_exhaustive, database, matching_options=matching),
        partial(
            pycolmap.global_mapping, database, images, out, pycolmap.GlobalPipelineOptions(num_threads=1)
        ),
    )
    with quiet_log():
        return tuple(time_call(one).cpu_s for one in calls)


def _worst(model: Path, truth: Path) -> float:
    return float(sfm_shapefit.evaluate(model, truth).position.max)


BENCHMARK = Benchmark(
    name="photographs",
    title="From photographs to a verdict",
    cases=cases,
    flags=flags,
    packages=("pycolmap", "numpy", "numba", "opencv-python-headless"),
    quick={"images": 8, "width": 320},
    notes={
        "": f"`map IMAGES OUT` may take {MATCHING_SHARE:g} times as long as extraction and matching by hand"
        f" and {MAPPING_SHARE:g} times as long as global mapping together; it starts, loads, adds colors and"
        " writes a report within that."
    },
    columns={
        "CPU s": "processor seconds of all; ours those of the whole process",
        "extraction, matching, mapping": "processor seconds of each call",
        "worst (m)": "largest distance of a camera from the truth after a robust similarity",
    },
)
