"""The paper and its field: figures and theorems, and the programs that ours is compared with."""
