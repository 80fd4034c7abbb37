#!/usr/bin/env bash
# distributed 2026.8.0, the connection of a Client.
#
# Guess: once a task is done and its future is gone, the process that submitted it holds nothing of the task.
# Seen: each end of a connection keeps the last 1,000 batches that it sent, for developers, those below 1 MB whole,
#   with the arrays that tasks took: 300 tasks of 800 kB leave 480 MB in a process with client and scheduler,
#   half in each. With "distributed.admin.low-level-log-length" 0, set before the client is made, 2 MB.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet distributed==2026.8.0 dask==2026.8.0 numpy==2.4.6
cat > measure.py <<'PY'
import sys

import dask
import numpy as np
import psutil
from distributed import Client, LocalCluster

TASKS, NUMBERS = 300, 100_000


def resident_mb():
    return psutil.Process().memory_info().rss / 1e6


if __name__ == "__main__":
    dask.config.set({"distributed.admin.low-level-log-length": int(sys.argv[1])})
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        client.submit(len, np.zeros(NUMBERS)).result()
        before = resident_mb()
        for k in range(TASKS):
            assert client.submit(len, np.full(NUMBERS, float(k)), pure=False).result() == NUMBERS
        kept, grown = len(client.scheduler_comm.recent_message_log), resident_mb() - before
    print(f"log of {sys.argv[1]}: {kept} batches, {grown:.0f} MB")
    assert kept >= TASKS and grown > 200 if sys.argv[1] != "0" else not kept and grown < 50
PY
for length in 1000 0; do HOME="$folder" "$folder/env/bin/python" measure.py "$length"; done
echo "OK: as described"
