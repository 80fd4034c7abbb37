"""Are the intervals of lengths true? Scale bars between points of made scenes, four to set the scale.

Twelve further bars of each scene only check: how often is a bar, and how often is its true length, within the
interval that should hold 95 of 100? The marks err by as much as keypoints do, and the bars by a thousandth.
"""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

import sfm_shapefit
from harness.driver import Benchmark, Case
from harness.record import Row, at_least, at_most
from harness.scenes import temporary_scene

SHAPES = ("ring", "facade", "cloud", "courtyard")
SCENE = {"num_images": 12, "num_points": 800}
NUM_BARS, NUM_CONTROL = 16, 4
BAR_SIGMA, MARK_SIGMA_PX = 0.001, 0.5
WITHIN = 1.96
"""Standard deviations that hold 95 of 100."""
LEAST, MOST = 0.93, 0.97


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return a case for each shape."""
    return {shape: partial(measure, shape, args.repeats) for shape in SHAPES[: 1 if args.quick else None]}


def measure(shape: str, seeds: int) -> Row:
    """Locate made scenes by their bars, and take the check bars of all together."""
    bars, truth = [], list[float]()
    for seed in range(seeds):
        with temporary_scene({"shape": shape, "seed": seed, **SCENE}) as (_, folder):
            lengths = write_bars(folder / "sparse" / "0", folder / "bars.txt", seed)
            given = {"scale_bars": str(folder / "bars.txt")}
            found = sfm_shapefit.locate(folder / "sparse" / "0", folder / "database.db", **given)
        checked = [bar for bar in found.scale_bars if bar.use == "check"]
        bars += checked
        truth += [lengths[bar.name] for bar in checked]
    errors = np.array([bar.found for bar in bars]) - truth
    sigmas, scores = (np.array([getattr(bar, x) for bar in bars]) for x in ("found_sigma", "error_sigmas"))
    of_bars, of_truth = (float(np.mean(np.abs(x) < WITHIN)) for x in (scores, errors / sigmas))
    cells = {
        "scenes": f"{shape}, {seeds}",
        "check bars": len(bars),
        "median error": float(np.median(np.abs(errors))),
        "median sigma": float(np.median(sigmas)),
        "rms": f"{np.sqrt(np.mean((errors / sigmas) ** 2)):.2f}",
        "bars within": f"{of_bars:.1%}",
        "lengths within": f"{of_truth:.1%}",
    }
    least = at_least(bars_within=(of_bars, LEAST), lengths_within=(of_truth, LEAST))
    return Row(cells, least + at_most(bars_within=(of_bars, MOST), lengths_within=(of_truth, MOST)))


def write_bars(model: Path, file: Path, seed: int) -> Mapping[str, float]:
    """Write a file of scale bars between points of a model, and return their true lengths by name."""
    import pycolmap

    reconstruction, rng = pycolmap.Reconstruction(model), np.random.default_rng(seed)
    points = {k: one for k, one in reconstruction.points3D.items() if one.track.length() >= 3}
    lines, lengths = list[str](), dict[str, float]()
    for k, ends in enumerate(rng.choice(sorted(points), (NUM_BARS, 2), replace=False).tolist()):
        name = f"B{k}" if k < NUM_CONTROL else f"CHK-{k}"
        lengths[name] = float(np.linalg.norm(points[ends[0]].xyz - points[ends[1]].xyz))
        told = lengths[name] + BAR_SIGMA * float(rng.standard_normal())
        for end in ends:
            for seen in points[end].track.elements:
                image = reconstruction.image(seen.image_id)
                pixel = image.project_point(points[end].xyz) + MARK_SIGMA_PX * rng.standard_normal(2)
                if (pixel >= 0.0).all() and (pixel <= [image.camera.width, image.camera.height]).all():
                    numbers = " ".join(map(repr, [told, BAR_SIGMA, *pixel.tolist()]))
                    lines.append(f"{numbers} {image.name} {name} {end}")
    file.write_text("\n".join(lines))
    return lengths


BENCHMARK = Benchmark(
    name="lengths",
    title="Lengths and scale bars",
    cases=cases,
    quick={"repeats": 1},
    repeats=25,
    columns={
        "scenes": "shape, and how many are drawn",
        "median error": "scene's; of the true lengths of check bars",
        "median sigma": "scene's; standard deviation of a length, as told",
        "rms": "1; root of the mean square of errors over standard deviations",
        "bars within": "%; check bars off by less than 1.96 standard deviations of the difference",
        "lengths within": "%; their true lengths within the told interval of 95 %",
    },
)
