"""ViewGraphBench, a public benchmark of view graphs with labels of every pair, beside its own methods.

The package `viewgraphforge` (the extra `peers`) makes each graph again from its seed; nothing is downloaded.
Positions are placed with the true rotations, as in the benchmark's own task, so that only translation
averaging is measured; rotations are averaged with numbers of matches, by which the benchmark's own method
starts. Repetitions 0 to 2 are the published ones. Those from 100 on have seeds of the same generator that
nobody published: with repetition 0 they are the ones to develop on, and nothing is chosen on 1 and 2.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

import sfm_shapefit
from harness.driver import Benchmark, Case
from harness.graphs import GraphSpec, draw
from harness.record import Row, at_most, median, number, ratio, table
from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import fit_similarity_l1, normalized
from sfm_shapefit.graph.viewgraph import ViewGraph

PACKAGE = "viewgraphforge"
SPLITS: dict[str, tuple[float, ...]] = {
    "outliers": (0.3, 0.5, 0.6),
    "symmetry": (0.2, 0.5),
    "topology": (),
    "density": (5, 20, 80),
    "heavytail": (3, 2),
    "noise": (2, 8),
    "matches": (10, 80),
    "twoview": (300,),
    "twoview_symmetry": (0.2, 0.5),
    "scale": (2500, 10_000),
}
"""Values of what each split varies that are measured unless others are asked for; topology varies nothing."""
REPETITIONS = (0, 100)
WRONG_DIRECTION = (1, 3, 4)  # the package's types of outliers; type 2 spoils the rotation alone
MOST_OF_LUD = 1.1  # times the median error of the benchmark's LUD
MOST_CAMERAS = 3_000  # cameras up to which the benchmark's own methods are run; its LUD takes minutes there
UNUSABLE = "do not use"  # the grade of positions that serve nothing
FOLDED = 0.03  # median error over the extent; an answer beyond it is wrong


class Made(NamedTuple):
    """A graph of the benchmark."""

    own: Any
    """As the package has it."""
    graph: ViewGraph
    truth: FloatArray
    """(n, 3) true centers."""
    is_wrong: BoolArray
    """(m,) whether the direction is wrong."""


class Answer(NamedTuple):
    """One method's answer of a graph."""

    error: tuple[float, float] = (np.nan, np.nan)
    """Median and mean, of positions over the extent of all cameras, of rotations in degrees."""
    cpu_s: float = np.nan
    f1: float = np.nan
    precision: float = np.nan
    """Average precision of the wrong pairs."""
    z: float = np.nan
    grade: str = "-"
    """What the verdict says of the use of the positions."""


def flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--repetitions", type=int, nargs="+", default=REPETITIONS, help="of the seeds (0 and 100)")
    add("--values", type=float, nargs="+", help="of what a split varies (a few of each)")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the graphs of all splits by name, such as "outliers corridor 2 0.6 r100"."""
    if find_spec(PACKAGE) is None:
        return {"viewgraphs": f"needs the package {PACKAGE}, of the extra `peers`"}
    found: dict[str, Case] = {}
    for split, usual in list(SPLITS.items())[: 1 if args.quick else None]:
        # Jobs of one case and value differ in their seeds only.
        jobs = {(job.tags["case_index"], job.tags["value"]): job for job in expand(split)}
        for index, value in list(jobs)[:1] if args.quick else jobs:
            if not (args.quick or value is None or value in (args.values or usual)):
                continue
            for repetition in args.repetitions[: 1 if args.quick else None]:
                job = jobs[index, value]
                family = f"{job.params['family']} {index}"
                name = f"{split} {family} {'-' if value is None else f'{value:g}'} r{repetition}"
                found[name] = partial(measure, split, (index, value), family, repetition)
    return found


def expand(split: str) -> list[Any]:
    """Return the jobs of a split of the whole benchmark."""
    config = import_module(f"{PACKAGE}.config").load_config("full")
    jobs: list[Any] = list(import_module(f"{PACKAGE}.splits").expand_config(config, [f"bench_{split}"]))
    return jobs


def make(split: str, which: tuple[int, float | None], repetition: int) -> Made:
    """Make a graph from its seed."""
    job = next(j for j in expand(split) if (j.tags["case_index"], j.tags["value"]) == which)
    seed = import_module(f"{PACKAGE}.config").load_config("full")["dataset"]["seed"]
    seed = import_module(f"{PACKAGE}.splits").job_seed(seed, f"bench_{split}", which[0], repetition)
    params = dict(job.params) | {"store_observations": False, "store_points": False}
    own = import_module(f"{PACKAGE}.generate").generate_graph(params, seed=seed)
    truth, edges = own.arrays["node_center"], np.column_stack([own.arrays["edge_i"], own.arrays["edge_j"]])
    to_second = methods("translation_averaging").world_directions(own, own.R_wc)
    graph = ViewGraph(len(truth), edges.astype(np.int64), normalized(-to_second))
    return Made(own, graph, truth, np.isin(own.arrays["edge_outlier_type"], WRONG_DIRECTION))


def methods(module: str) -> Any:
    return import_module(f"{PACKAGE}.benchmark.{module}")


def measure(split: str, which: tuple[int, float | None], family: str, repetition: int) -> list[Row]:
    """Place the cameras of a graph, and average their rotations, by all methods."""
    warm = draw(GraphSpec("er2", n=20, sigma=0.01)).view_graph
    sfm_shapefit.place(warm)  # so that nothing is compiled while the clock runs
    sfm_shapefit.average_rotations(warm.edges, np.tile(np.eye(3), (warm.num_edges, 1, 1)))
    made = make(split, which, repetition)
    value = "-" if which[1] is None else which[1]
    about = {"family": family, "value": value, "repetition": repetition}
    return [row_of_positions(made, split, about), row_of_rotations(made, split, about)]


def row_of_positions(made: Made, split: str, about: dict[str, Any]) -> Row:
    """Place a graph by all methods."""
    averaging = methods("translation_averaging")
    lud, linear = (answer_theirs(made, method) for method in (averaging.lud, averaging.linear_cross))
    placed = answer_ours(made)
    oracle = answer_ours(made._replace(graph=made.graph.subset(~made.is_wrong)), judged=False)
    answers = {"LUD": lud, "linear": linear, "place": placed, "right pairs": oracle}
    judges = {"cycles": answer_cycles(made), "place": placed}
    cells = about | {"wrong": f"{np.mean(made.is_wrong):.0%}"}
    cells |= {name: " / ".join(map(number, answer.error)) for name, answer in answers.items()}
    for name, answer in judges.items():
        cells[f"F1, AP {name}"] = f"{number(answer.f1)}, {number(answer.precision)}"
    cells |= {"z": placed.z, "grade": placed.grade}
    cells["CPU"] = " / ".join(number(answers[name].cpu_s) for name in ("LUD", "place"))
    limit = MOST_OF_LUD * lud.error[0] if np.isfinite(lud.error[0]) else None
    checks = at_most(place=(placed.error[0], limit))
    return Row(cells, checks, split, more={"answers": answers, "judges": judges})


def row_of_rotations(made: Made, split: str, about: dict[str, Any]) -> Row:
    """Average the rotations of a graph by the benchmark's best method and ours."""
    own, theirs, start = made.own, Answer(), time.process_time()
    if len(made.truth) <= MOST_CAMERAS:
        theirs = answer_rotations(made, methods("rotation_averaging").l1_irls(own), start)
    start, pairs = time.process_time(), np.column_stack([own.arrays["edge_i"], own.arrays["edge_j"]])
    averaged = sfm_shapefit.average_rotations(
        pairs, own.R_meas, num_images=len(made.truth), weights=own.arrays["edge_n_matches"]
    )
    ours = answer_rotations(made, averaged.rotations, start)
    answers = {"L1-IRLS": theirs, "average_rotations": ours}
    cells = about | {name: " / ".join(map(number, answer.error)) for name, answer in answers.items()}
    cells["matches"] = "set aside" if averaged.counts_mislead else "used"
    cells["CPU"] = " / ".join(number(answer.cpu_s) for answer in answers.values())
    limits = [error if np.isfinite(error) else None for error in theirs.error]
    checks = at_most(median=(ours.error[0], limits[0]), mean=(ours.error[1], limits[1]))
    return Row(cells, checks, f"{split}: rotations", more={"answers": answers})


def answer_rotations(made: Made, rotations: FloatArray, start: float) -> Answer:
    """Compare rotations (n, 3, 3) cam_from_world with the truth by the benchmark's alignment."""
    cpu_s = time.process_time() - start
    own = methods("metrics").rotation_metrics(rotations, made.own.R_wc)
    return Answer((own["rot_median_deg"], own["rot_mean_deg"]), cpu_s)


def answer_theirs(made: Made, method: Callable[..., FloatArray]) -> Answer:
    """Place a graph by one of the benchmark's own methods, unless it has very many cameras."""
    if len(made.truth) > MOST_CAMERAS:
        return Answer()
    start = time.process_time()
    found = method(made.own, made.own.R_wc)
    return Answer(error_of(made, found, np.arange(len(made.truth))), time.process_time() - start)


def answer_cycles(made: Made) -> Answer:
    """Judge the pairs by the benchmark's filter of cycles of rotations and directions."""
    flagged, scores, _ = methods("outlier_filter").run_cycle_filter(made.own)
    f1, precision = pairs_of(flagged, made.own.arrays["edge_is_outlier"].astype(bool), scores)
    return Answer(f1=f1, precision=precision)


def answer_ours(made: Made, *, judged: bool = True) -> Answer:
    """Place a graph; a pair that is not placed counts as kept, with an even chance."""
    start = time.process_time()
    found = sfm_shapefit.place(made.graph)
    cpu_s, error = time.process_time() - start, error_of(made, found.locations, found.cameras)
    if not judged:
        return Answer(error, cpu_s)
    flagged, scores = np.zeros(len(made.is_wrong), dtype=bool), np.full(len(made.is_wrong), 0.5)
    flagged[found.edges] = ~found.agreement.agrees
    scores[found.edges] = 1.0 - found.refined.posterior
    truth = made.truth[found.cameras]
    similarity = fit_similarity_l1(found.locations, truth, rotate=False)
    errors = np.linalg.norm(similarity.apply(found.locations) - truth, axis=1)
    sigmas = similarity.scale * np.sqrt(np.trace(found.covariances, axis1=1, axis2=2))
    known = np.isfinite(sigmas)
    z = float(np.sqrt(np.mean((errors[known] / sigmas[known]) ** 2))) if known.any() else np.nan
    verdict = getattr(found, "verdict", None)
    grade = "-" if verdict is None else verdict.grade.value
    return Answer(error, cpu_s, *pairs_of(flagged, made.is_wrong, scores), z, grade)


def error_of(made: Made, found: FloatArray, cameras: Any) -> tuple[float, float]:
    """Return median and mean error by the benchmark's alignment, over the extent of all cameras."""
    metrics = methods("metrics")
    own = metrics.position_metrics(np.asarray(found), made.truth[cameras])
    extent = metrics.scene_diameter(made.truth)
    return own["pos_median"] / extent, own["pos_mean"] / extent


def pairs_of(flagged: BoolArray, is_wrong: BoolArray, scores: FloatArray) -> tuple[float, float]:
    """Return F1 and average precision of pairs that are flagged as wrong; NaN where none is."""
    if not is_wrong.any():
        return np.nan, np.nan
    f1 = 2.0 * np.sum(flagged & is_wrong) / (np.sum(flagged) + np.sum(is_wrong))
    return float(f1), float(methods("metrics").average_precision(scores, is_wrong))


def show_splits(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a line per split of positions and one of rotations: how often ours is as good, and medians."""
    positions, rotations = (
        {
            name: [row for row in rows if row.table == name]
            for name in dict.fromkeys(row.table for row in part)
        }
        for part in ([r for r in rows if "judges" in r.more], [r for r in rows if "judges" not in r.more])
    )
    yield "## All splits"
    heads = ["within 1.1 of LUD", "1.1 of right pairs", "F1 cycles", "F1 place", "z", "CPU of LUD's"]
    heads += ["wrong but usable", "right but not to be used"]
    yield table(["split", "graphs", *heads], [[name, *sum_up(part)] for name, part in positions.items()])
    lines = [[name.partition(":")[0], *sum_up_rotations(part)] for name, part in rotations.items()]
    heads = [
        "no worse in the median",
        "in the mean",
        "worst of L1-IRLS",
        "worst of ours",
        "matches set aside",
    ]
    yield "## All splits: rotations\n\n" + table(["split", "graphs", *heads], lines)


def sum_up(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the cells of a split of positions."""
    answers, judges = [row["answers"] for row in rows], [row["judges"] for row in rows]
    yield str(len(rows))
    for other in ("LUD", "right pairs"):
        ratios = [ratio(each["place"].error[0], each[other].error[0]) for each in answers]
        yield f"{sum(r <= MOST_OF_LUD for r in ratios)} ({number(median(ratios))})"
    yield from (number(median([each[name].f1 for each in judges])) for name in ("cycles", "place"))
    yield number(median([each["place"].z for each in answers]))
    yield number(median([ratio(each["place"].cpu_s, each["LUD"].cpu_s) for each in answers]))
    is_usable = [each["place"].grade != UNUSABLE for each in answers]
    is_wrong = [each["place"].error[0] > FOLDED for each in answers]
    yield str(sum(wrong and usable for wrong, usable in zip(is_wrong, is_usable, strict=True)))
    yield str(sum(not wrong and not usable for wrong, usable in zip(is_wrong, is_usable, strict=True)))


def sum_up_rotations(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the cells of a split of rotations."""
    pairs = [(row["answers"]["L1-IRLS"].error, row["answers"]["average_rotations"].error) for row in rows]
    yield str(len(rows))
    yield from (str(sum(ours[k] <= theirs[k] for theirs, ours in pairs)) for k in (0, 1))
    yield from (number(max(errors[k][0] for errors in pairs)) for k in (0, 1))
    yield str(sum(row["matches"] == "set aside" for row in rows))


BENCHMARK = Benchmark(
    name="viewgraphs",
    title="ViewGraphBench",
    cases=cases,
    closing=show_splits,
    flags=flags,
    packages=("numpy", "scipy", "numba", PACKAGE),
    quick={"repetitions": (100,), "values": None},
    notes={
        "": "Graphs of the package's own generator. Errors are median / mean: of positions, true rotations"
        " given, of the cameras that a method places, over the extent of all; of rotations, in degrees."
        " Repetitions 1 and 2 serve no choice."
    },
    columns={
        "value": "of what the split varies: share of outliers, odds that a repeated side is confused, ...",
        "repetition": "of the seed; 0 to 2 are published",
        "wrong": "1; share of the pairs whose direction is wrong",
        "LUD, linear": f"1; error of the benchmark's own methods, up to {MOST_CAMERAS:,} cameras",
        "place": "1; error of `place`",
        "right pairs": "1; error of `place` on the pairs that are not wrong",
        "F1, AP": "1; of pairs: the benchmark's cycle filter against its labels of outliers, rotations too,"
        " `place` against wrong directions",
        "z": "1; rms of errors over standard deviations",
        "grade": "verdict of `place`",
        "L1-IRLS, average_rotations": "deg; error of rotations, the benchmark's best method and ours",
        "matches": "whether the numbers of matches were used, or set aside as misleading",
        "CPU": "s; LUD / place, or L1-IRLS / average_rotations; of a split the share of LUD's, median",
        "within, F1, z": "of graphs, and in brackets the median of the ratios of the errors; medians",
        "wrong but usable": f"graphs of a median error above {FOLDED:g} that are not called {UNUSABLE!r}",
        "right but not to be used": f"graphs of a median error up to {FOLDED:g} that are called so",
        "no worse": "graphs on which ours has at most the error of L1-IRLS",
        "worst": "deg; largest median error of a graph",
    },
)
