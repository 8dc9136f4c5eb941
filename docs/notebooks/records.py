# %% [markdown]
# # Reading records
#
# Every run leaves one record. `rw.records` reads a folder of them into one long table: a row for each run and metric.
# The folder here is part of the repository: all methods on the built-in animals, three seeds.

# %%
import rewild4d as rw

frame = rw.records("results/2026-11-23-artemis-standard")
print(f"{frame.run_id.nunique()} runs, {frame.metric.nunique()} metrics")
frame[["case", "method", "seed", "metric", "value", "unit"]].head()

# %% [markdown]
# Held-out PSNR of each method and case, mean over the seeds, and the spread.

# %%
psnr = frame[(frame.metric == "psnr") & frame.latest]
psnr.groupby(["method", "case"]).value.mean().unstack().round(2)

# %%
psnr.groupby(["method", "case"]).value.std().unstack().round(2)

# %% [markdown]
# `plot` draws the same: a bar a method, whiskers from the lowest to the highest seed.

# %%
rw.plot(psnr, "psnr")

# %% [markdown]
# Other metrics rank differently: by LPIPS, GART is as good as `ours`, and by the shape no method is better than the
# prior alone.

# %%
chosen = frame[frame.latest & frame.metric.isin(["psnr", "lpips_alex", "chamfer_relative"])]
chosen.groupby(["method", "metric"]).value.mean().unstack().round(4)
