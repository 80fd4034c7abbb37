"""What all benchmarks share: the driver, metrics and tables, fresh processes, bare graphs, our own calls."""
