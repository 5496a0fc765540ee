"""The commands `staf`, `staf-table` and `staf-export`."""

import os

# OpenMP reads it when it is loaded, so before torch is. Threads otherwise wait in a loop at the end of every
# operation: beside one other busy program `staf trajectories=100000` takes 25 to 60 s so, 10 s with it.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
