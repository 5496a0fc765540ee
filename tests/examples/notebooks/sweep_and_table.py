# %% [markdown]
# # A sweep and its table
# Kernel x radius x count, computed in tensor batches; every job keeps a run directory of its own.

# %%
from staf_torch import sweep

runs = sweep(
    "kernel=gaussian,matern",
    "centers.radius=0.1,0.2",
    "centers.count=3,6",
    *("duration=0.5", "settle_time=0.2", "figures=false", "history=false"),
)
print(runs)

# %% [markdown]
# In a notebook `runs` is the table. The best of it, a part of it, all of it in order:

# %%
print(runs.best("ball_error"))
matern = runs.filter("kernel=matern").sort("ball_error")
assert len(runs) == 8
assert len(matern) == 4
assert matern[0].metrics["ball_error"] <= matern[3].metrics["ball_error"]

# %% [markdown]
# With the extra `tables`: `runs.pivot("kernel", ["centers.radius", "centers.count"], "ball_error")` is a
# DataFrame, and `polars.DataFrame(runs)` reads the same through Arrow.
