"""The parts of scripts/benchmark.py: one module per subcommand, and what they share.

    metrics.py   a measured value and what it must reach
    record.py    tables, the machine and its versions, the file of results
    real.py      subcommand `real`: real scenes against their ground truth
    glomap.py    GLOMAP's global positioning, run side by side

A subcommand is a module with `HELP`, `add_arguments(parser)` and `run(args) -> exit code`.
"""
