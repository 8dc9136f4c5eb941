# %% [markdown]
# # A first fit
#
# Fit two methods to a small case, look at a held-out view, score both. The case is the template itself, walking, so
# that all of this runs in seconds; `rw.load_case("artemis", "horse/walk")` loads a built-in animal instead, and
# `rw.case_from_frames(frames, masks, fps)` your own video.

# %%
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import rewild4d as rw
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.running.conformance import tiny_case

made = tiny_case(frames=6)
case = rw.LoadedCase(made.clip, made.truth, find_protocol("artemis", "artemis-sweep-128-v4"), made)
print(f"{case.clip.name}: {len(case.clip.frames)} frames, {len(case.truth.held_out)} held-out images")

# %% [markdown]
# The prior alone is the lower bound, and a high one here: the images were drawn from it, so that nothing about it is
# wrong. Settings have the names of their flags; these keep the fit of `ours` short.

# %%
short = {"iterations": 80, "canonical.samples": 800, "warmup.regress": 40, "image_size": 96}
fitted = {
    "prior-only": rw.fit(case, "prior-only", settings={"gaussians": 1500}, progress=False),
    "ours": rw.fit(case, "ours", settings=short, progress=False),
}

# %% [markdown]
# A reconstruction is a function from time to Gaussians. Here it is seen from a camera that no method was shown.


# %%
def side_by_side(images: dict[str, np.ndarray]) -> Figure:
    """Draw images [h, w, 3] in a row, each with its name."""
    figure = Figure(figsize=(9, 2.4), layout="constrained")
    for axes, (name, image) in zip(figure.subplots(1, len(images)), images.items(), strict=True):
        axes.imshow(np.clip(image, 0, 1))
        axes.set_title(name)
        axes.axis("off")
    return figure


frame = case.truth.held_out[2]
images = {"truth": frame.over(1.0).permute(1, 2, 0).numpy()}
images |= {name: rw.render(each, frame.time, frame.camera) for name, each in fitted.items()}
side_by_side(images)

# %% [markdown]
# The protocol says what is measured. A score that cannot be computed here has no value, and its `note` says why.

# %%
scores = {name: rw.evaluate(each, case, progress=False) for name, each in fitted.items()}
pd.DataFrame({name: table["value"] for name, table in scores.items()}).join(scores["ours"][["unit", "better"]]).round(3)

# %% [markdown]
# After 80 steps `ours` is far from done: presets `quick`, `standard` and `paper` take 800, 3,000 and 20,000, and on
# data whose prior is fitted it ends above the lower bound ([methods](../experiments/methods.md)).
