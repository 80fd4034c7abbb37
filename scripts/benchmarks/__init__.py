"""The parts of scripts/benchmark.py: one module per subcommand, and what they share.

    metrics.py   a measured value and what it must reach
    record.py    tables, the machine and its versions, the file of results
    process.py   fresh processes with a number of threads and a time limit; memory
    graphs.py    bare graphs by family and size, and the paper's error
    real.py      subcommand `real`: real scenes against their ground truth
    directions.py    subcommand `directions`: speed and calibration of directions from matches
    glomap.py    GLOMAP's global positioning, run side by side
    solver.py    subcommand `solver`: Newton against a generic cone solver
    clarabel_direct.py    ... called without cvxpy
    scale.py     subcommand `scale`: large graphs as they grow
    rigs.py      subcommand `rigs`: rigs with known offsets, against global mapping
    trust.py     subcommand `trust`: standard deviations and trust against errors
    onedsfm.py   subcommand `onedsfm`: the published scene Madrid Metropolis
    peers.py     subcommand `peers`: pytheia, gtsam and pycolmap beside ours, in one table
    graph_peers.py    ... on bare graphs
    real_peers.py     ... on real scenes
    answers.py   subcommand `answers`: what every command answers, recorded and compared
    answer_cases.py       ... the cases
    answer_inputs.py      ... what they are given
    answer_differences.py    ... how two recordings differ

A subcommand is a module with `HELP`, `add_arguments(parser)` and `run(args) -> exit code`.
"""
