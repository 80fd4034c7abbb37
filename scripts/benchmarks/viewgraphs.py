"""ViewGraphBench, a public benchmark of view graphs with labels of every pair, beside its own methods.

The package `viewgraphforge` (the extra `peers`) makes each graph again from its seed; nothing is downloaded.
The true rotations are given, as in the benchmark's own task, so that only translation averaging is measured.
Repetitions 0 to 2 are the published ones. Those from 100 on have seeds of the same generator that nobody
published: with repetition 0 they are the ones to develop on, and nothing is chosen on 1 and 2.
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
SPLITS = ("outliers", "symmetry", "topology", "density", "heavytail", "noise")
REPETITIONS = (0, 100, 101, 102)
WRONG_DIRECTION = (1, 3, 4)  # the package's types of outliers; type 2 spoils the rotation alone
MOST_OF_LUD = 1.1  # times the median error of the benchmark's LUD


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
    """Median and mean, over the extent of all cameras."""
    cpu_s: float = np.nan
    f1: float = np.nan
    precision: float = np.nan
    """Average precision of the wrong pairs."""
    z: float = np.nan


def flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--repetitions", type=int, nargs="+", default=REPETITIONS, help="of the seeds (0, 100 to 102)")
    add("--values", type=float, nargs="+", help="of what a split varies (all)")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the graphs of all splits by name, such as "outliers corridor 2 0.6 r100"."""
    if find_spec(PACKAGE) is None:
        return {"viewgraphs": f"needs the package {PACKAGE}, of the extra `peers`"}
    found: dict[str, Case] = {}
    for split in SPLITS[:1] if args.quick else SPLITS:
        # Jobs of one case and value differ in their seeds only.
        jobs = {(job.tags["case_index"], job.tags["value"]): job for job in expand(split)}
        for index, value in list(jobs)[:1] if args.quick else jobs:
            if args.values and value is not None and value not in args.values:
                continue
            for repetition in args.repetitions:
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


def measure(split: str, which: tuple[int, float | None], family: str, repetition: int) -> Row:
    """Place a graph by all methods."""
    for objective in ("auto", "mixture"):  # so that nothing is compiled while the clock runs
        sfm_shapefit.place(draw(GraphSpec("er2", n=20, sigma=0.01)).view_graph, objective=objective)
    made = make(split, which, repetition)
    averaging = methods("translation_averaging")
    lud, linear = (answer_theirs(made, method) for method in (averaging.lud, averaging.linear_cross))
    auto, mixture = (answer_ours(made, objective) for objective in ("auto", "mixture"))
    oracle = answer_ours(made._replace(graph=made.graph.subset(~made.is_wrong)), "auto", judged=False)
    answers = {"LUD": lud, "linear": linear, "auto": auto, "mixture": mixture, "right pairs": oracle}
    judges = {"cycles": answer_cycles(made), "auto": auto, "mixture": mixture}
    cells: dict[str, Any] = {"family": family, "value": "-" if which[1] is None else which[1]}
    cells |= {"repetition": repetition, "wrong": f"{np.mean(made.is_wrong):.0%}"}
    cells |= {name: " / ".join(map(number, answer.error)) for name, answer in answers.items()}
    for name, answer in judges.items():
        cells[f"F1, AP {name}"] = f"{number(answer.f1)}, {number(answer.precision)}"
    cells["z"] = mixture.z
    cells["CPU"] = " / ".join(number(answers[name].cpu_s) for name in ("LUD", "auto", "mixture"))
    checks = at_most(mixture=(mixture.error[0], MOST_OF_LUD * lud.error[0]))
    return Row(cells, checks, split, more={"answers": answers, "judges": judges})


def answer_theirs(made: Made, method: Callable[..., FloatArray]) -> Answer:
    """Place a graph by one of the benchmark's own methods."""
    start = time.process_time()
    found = method(made.own, made.own.R_wc)
    return Answer(error_of(made, found, np.arange(len(made.truth))), time.process_time() - start)


def answer_cycles(made: Made) -> Answer:
    """Judge the pairs by the benchmark's filter of cycles of rotations and directions."""
    flagged, scores, _ = methods("outlier_filter").run_cycle_filter(made.own)
    f1, precision = pairs_of(flagged, made.own.arrays["edge_is_outlier"].astype(bool), scores)
    return Answer(f1=f1, precision=precision)


def answer_ours(made: Made, objective: str, *, judged: bool = True) -> Answer:
    """Place a graph; a pair that is not placed counts as kept, with an even chance."""
    start = time.process_time()
    found = sfm_shapefit.place(made.graph, objective=objective)
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
    return Answer(error, cpu_s, *pairs_of(flagged, made.is_wrong, scores), z)


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
    """Yield a line per split: how often the mixture is as good as another, and medians."""
    yield "## All splits"
    lines = []
    for split in dict.fromkeys(row.table for row in rows):
        all_answers = [row["answers"] for row in rows if row.table == split]
        judges = [row["judges"] for row in rows if row.table == split]
        line = [split, str(len(all_answers))]
        for other, share in (("LUD", MOST_OF_LUD), ("auto", 1.02), ("right pairs", 1.1)):
            ratios = [ratio(a["mixture"].error[0], a[other].error[0]) for a in all_answers]
            line.append(f"{sum(r <= share for r in ratios)} ({number(median(ratios))})")
        line += [number(median([j[name].f1 for j in judges])) for name in ("cycles", "auto", "mixture")]
        line.append(number(median([ratio(a["mixture"].cpu_s, a["auto"].cpu_s) for a in all_answers])))
        lines.append(line)
    heads = ["within 1.1 of LUD", "1.02 of auto", "1.1 of right pairs", "F1 cycles", "auto", "mixture", "CPU"]
    yield table(["split", "graphs", *heads], lines)


BENCHMARK = Benchmark(
    name="viewgraphs",
    title="ViewGraphBench",
    cases=cases,
    closing=show_splits,
    flags=flags,
    packages=("numpy", "scipy", "numba", PACKAGE),
    quick={"repetitions": (100,), "values": None},
    notes={
        "": "Graphs of the package's own generator, true rotations given. Errors are median / mean over the"
        " extent of all cameras, of the cameras that a method places. Repetitions 1 and 2 serve no choice."
    },
    columns={
        "value": "of what the split varies: share of outliers, odds that a repeated side is confused, ...",
        "repetition": "of the seed; 0 to 2 are published",
        "wrong": "1; share of the pairs whose direction is wrong",
        "LUD, linear": "1; error of the benchmark's own methods",
        "auto, mixture": "1; error of `place` by objective",
        "right pairs": '1; error of `place` (objective "auto") on the pairs that are not wrong',
        "F1, AP": "1; of pairs: the benchmark's cycle filter against its labels of outliers, rotations too,"
        " `place` against wrong directions",
        "z": "1; rms of errors over standard deviations (mixture)",
        "CPU": "s; LUD / auto / mixture; in the last table the mixture's over auto's, median",
        "within, F1": "of graphs, and in brackets the median of the ratios of the errors; median of F1",
    },
)
