"""The benchmarks: a module per subcommand of scripts/benchmark.py, under the same name.

A module has `BENCHMARK`, which `harness.driver` runs, or the functions `add_arguments(parser)` and
`run(args) -> exit code` of its own.
"""

INDEX = {
    "adjustment": "Our bundle adjustment beside pycolmap's on real sets, and large made problems.",
    "answers": "What every command answers: recorded, and compared with an earlier recording.",
    "averaging": "Rotation averaging: made graphs against an oracle, real sets beside pycolmap's.",
    "coherent": "Graphs whose wrong pairs agree on one false configuration, up to the theoretical limit.",
    "cores": "map and locate on 1, 2, 4, ... cores, beside pycolmap's global mapper on as many.",
    "corruption": "View graphs whose pairs are mostly wrong, up to 85 %, by a published generator.",
    "doubt": "Turned cameras and wrong focal lengths on real and bundled scenes: found, and no others.",
    "endtoend": "synth and locate at thousands of images: time by stage, memory and its forecast, exponents.",
    "graphs": "Families of graphs against the oracle: expanders, areas, communities, long chains, streets.",
    "join": "Models cut into pieces and joined by a few of the pairs between: right, refused, wrong.",
    "lengths": "Scale bars between points of made scenes: how often the told intervals hold the truth.",
    "map": "From a database to an adjusted model: map beside pycolmap's global and incremental mapping.",
    "onedsfm": "The published 1DSfM scene Madrid Metropolis: seconds per stage, residuals of each objective.",
    "panoramas": "Native panoramas against a cubemap rig of one rendered yard, beside global mapping.",
    "peers": "pytheia, gtsam and pycolmap beside ours, on bare graphs and real scenes.",
    "photographs": "From photographs to a verdict: map IMAGES OUT beside pycolmap called by hand.",
    "real": "Real scenes against their ground truth, as delivered and by the placement alone.",
    "rigs": "Metric scale and errors of a drive of two rigs, beside pycolmap's global mapping.",
    "rough": "Rough poses of other programs made exact, beside map from scratch; wrong ones named.",
    "scale": "Large graphs of four families: time, iterations, memory and rigid pieces as they grow.",
    "solver": "The Newton solver beside cvxpy and Clarabel on G(n, 1/2), and on real graphs.",
    "start": "The first run of each command in a fresh environment, as a clone and from the wheel.",
    "trust": "Standard deviations and trust against errors; wrong rotations recognized.",
    "uncertainty": "Errors of delivered cameras over their standard deviations.",
    "verdict": "Spoiled models: called good, named rightly; sound ones: doubted.",
    "viewgraphs": "A public benchmark of view graphs, ViewGraphBench, beside its own methods.",
}
