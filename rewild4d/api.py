"""What a notebook imports: `import rewild4d as rw` offers every function of this file.

case = rw.load_case("artemis", "horse/walk")
fitted = rw.fit(case, "ours", preset="quick")
image = rw.render(fitted, time=0.5, camera=case.truth.held_out[0].camera)
print(rw.evaluate(fitted, case))
rw.plot(rw.records("runs"), "psnr")
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import torch
from PIL import Image

from rewild4d.cameras.rendering import render as render_splats
from rewild4d.config import load_preset
from rewild4d.contracts import DatasetReader, Log, Reconstruction
from rewild4d.errors import UserError, unknown_name
from rewild4d.evaluation.measuring import evaluate as measure
from rewild4d.evaluation.protocol import Protocol, find_protocol
from rewild4d.evaluation.refining import ready_to_score
from rewild4d.files import cache_folder, digest
from rewild4d.machine import pick_device
from rewild4d.priors.choose import PriorChoice, make_prior
from rewild4d.priors.config import PRESETS, STANDARD
from rewild4d.priors.placing import known_frames, with_cameras
from rewild4d.progress import Progress
from rewild4d.registry import load_builtin, load_dataset, load_method
from rewild4d.running.workers import share_cores, this_process
from rewild4d.types import Camera, Case, Clip, Truth

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class LoadedCase:
    """One case under one protocol.

    Attributes:
        clip: the frames that a method sees.
        truth: held-out frames and true geometry; never shown to a method.
        protocol: what is measured, and how.
        start: the clip without frames whose camera the prior does not know, the prior, and the truth.
    """

    clip: Clip
    truth: Truth
    protocol: Protocol
    start: Case


def load_case(
    dataset: str = "artemis",
    name: str | None = None,
    data: str | Path | None = None,
    *,
    protocol: str | None = None,
    prior: str = "template",
    preset: str = "quick",
    progress: bool = True,
    **options: Any,
) -> LoadedCase:
    """Load one case of a data set and fit its prior (kept in a cache, so that the next call is fast).

    Args:
        dataset: "artemis", "davis", "aptv2", "online", or one of an installed package.
        name: of the case, such as "horse/walk"; the first one where it is left out.
        data: folder or video file; the built-in animals where it is left out.
        protocol: its name; the data set's default where it is left out.
        prior: "template", "template:<which>", "masks", "learned:<weights>", "coarse:<noise>", "rig" or an .npz
            file, as `run --prior`.
        preset: effort of the prior's fit under known cameras: "quick", "standard" or "paper".
        progress: whether a bar is shown on standard error.
        options: of the data set's reader, such as ``masks``, ``start``, ``end`` (seconds), ``fps``.

    Raises:
        UserError: an unknown name, or data that cannot be used.
    """
    reader_type = load_dataset(dataset)
    if data is None:
        make_builtin = load_builtin(dataset)
        if make_builtin is None:
            raise UserError(f"data: the data set '{dataset}' has no built-in data; name its file or folder.")
        data = make_builtin(_log("built-in animals", progress))
    chosen = find_protocol(dataset, protocol)
    reader: DatasetReader = reader_type(Path(data).absolute(), **options)
    names = reader.cases(chosen.selection)
    if name is not None and name not in names:
        raise unknown_name("case", name, names)
    clip, truth = reader.load(name or names[0], chosen.selection)
    choice = PriorChoice(prior, PRESETS.get(preset, STANDARD), getattr(reader, "keypoint_mapping", None))
    choice.require()
    path = cache_folder() / "priors" / f"{choice.identity(clip, truth)}.npz"
    with _computing("cpu"):
        made = make_prior(choice, clip, truth, path, _log(f"{clip.name}: prior", progress))
    return LoadedCase(clip, truth, chosen, Case(with_cameras(known_frames(clip, made), made), made, truth))


def case_from_frames(
    frames: Sequence[np.ndarray], masks: Sequence[np.ndarray], fps: float, *, progress: bool = True
) -> LoadedCase:
    """Make a case of your own frames and masks; every fifth usable frame is held out.

    Args:
        frames: RGB images of one size, uint8, [h, w, 3] each.
        masks: of the animal, bool or uint8 with 0 outside, [h, w] each.
        fps: frames per second.
        progress: whether a bar is shown on standard error.

    Raises:
        UserError: different numbers or sizes, or masks that show nothing.
    """
    if len(frames) != len(masks):
        raise UserError(f"case_from_frames: expected one mask for each frame, got {len(frames)} and {len(masks)}.")
    parts = [np.ascontiguousarray(image) for image in (*frames, *masks)]
    root = cache_folder() / "notebooks" / digest(*parts, f"{fps}")[:16]
    for kind, images, dimensions in (("frames", frames, 3), ("masks", masks, 2)):
        (root / kind).mkdir(parents=True, exist_ok=True)
        for index, image in enumerate(images):
            if np.ndim(image) != dimensions:
                raise UserError(f"case_from_frames: expected {kind} of {dimensions} axes, got shape {np.shape(image)}.")
            pixels = image[..., :3] if kind == "frames" else (image > 0) * np.uint8(255)
            Image.fromarray(pixels).save(root / kind / f"{index:05d}.png")
    return load_case("online", data=root / "frames", masks=root / "masks", fps=fps, progress=progress)


def fit(
    case: LoadedCase,
    method: str = "ours",
    *,
    preset: str = "quick",
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: bool = True,
    workdir: str | Path | None = None,
) -> Reconstruction:
    """Fit a method to a case; it sees the clip and the prior, nothing else.

    Args:
        case: from `load_case`.
        method: its name (`rewild4d-bench list`).
        preset: "quick", "standard", "paper", ...
        settings: by the names of the flags, such as ``{"loss.ssim": 0.3}``.
        seed: the same seed gives the same result on one machine's CPU.
        device: "auto", "cpu" or "cuda".
        progress: whether a bar is shown on standard error.
        workdir: folder for checkpoints; a second call with it resumes.

    Raises:
        UserError: an unknown name or setting, or a value out of range.
    """
    found = load_method(method)
    config = with_settings(load_preset(method, found.Config, preset), settings or {})
    folder = Path(workdir) if workdir is not None else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    log = _log(f"{case.clip.name}: {method}", progress)
    with _computing(device) as chosen:
        return found.fit(
            case.start.clip, case.start.prior, config=config, seed=seed, device=chosen, log=log, workdir=folder
        )


def with_settings(config: msgspec.Struct, settings: Mapping[str, Any]) -> Any:
    """Replace settings by their flags' names ("loss.ssim"), checked as on the command line.

    Raises:
        UserError: no such setting, or a value that does not fit.
    """
    tree = msgspec.to_builtins(config)
    for name, value in settings.items():
        *groups, last = name.replace("-", "_").split(".")
        node = tree
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if not isinstance(node, dict) or last not in node:
            raise unknown_name("setting", name, _setting_names(tree))
        node[last] = value
    try:
        return msgspec.convert(tree, type=type(config))
    except msgspec.ValidationError as error:
        raise UserError(f"settings: expected values that fit {type(config).__name__}, but {error}.") from error


def render(
    reconstruction: Reconstruction, time: float, camera: Camera | None = None, background: float = 1.0
) -> np.ndarray:
    """Render a reconstruction at a time.

    Args:
        reconstruction: from `fit`.
        time: seconds.
        camera: in the world; the input camera where it is left out and the reconstruction knows it.
        background: grey level in [0, 1].

    Returns:
        RGB in [0, 1], float32, [h, w, 3].

    Raises:
        UserError: no camera.
    """
    camera = camera or reconstruction.camera(time)
    if camera is None:
        raise UserError("render: the reconstruction does not know the input camera; give one, such as a frame's.")
    colors, alpha = render_splats(reconstruction.at(time), camera)
    return (colors + (1 - alpha) * background).clamp(0, 1).permute(1, 2, 0).cpu().numpy()


def evaluate(reconstruction: Reconstruction, case: LoadedCase, progress: bool = True) -> "pd.DataFrame":
    """Score a reconstruction by the case's protocol.

    Returns:
        One row a score, indexed by its name: value (missing where it was not computed), unit, better ("higher" or
        "lower"), count (items the mean is over) and note.
    """
    import pandas as pd

    log = _log(f"{case.clip.name}: evaluate", progress)
    with _computing("cpu") as device:
        whole = with_cameras(case.clip, case.start.prior)
        ready, clip, truth = ready_to_score(reconstruction, whole, case.truth, case.start.clip, log)
        found = measure(ready, clip, truth, case.protocol, log, device)
    rows = {name: msgspec.to_builtins(score) for name, score in found.scores.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index")[["value", "unit", "better", "count", "note"]]
    return frame.rename_axis("metric")


def records(folder: str | Path) -> "pd.DataFrame":
    """Read all run records below a folder as one long frame: a row for each run and metric; see `records_frame`.

    Raises:
        UserError: no such folder, no record in it, or one that cannot be read.
    """
    from rewild4d.leaderboard.frame import records_frame

    return records_frame(Path(folder))


def items(folder: str | Path) -> "pd.DataFrame":
    """Read the values of single images below a folder: a row for each run, metric and image; see `items_frame`.

    Raises:
        UserError: no such folder, no record in it, or one that cannot be read.
    """
    from rewild4d.leaderboard.frame import items_frame

    return items_frame(Path(folder))


def plot(frame: "pd.DataFrame", metric: str = "psnr") -> "Figure":
    """Draw one metric of `records`: a group of bars a case, a bar a method (mean over seeds, whiskers from least to
    most).

    Raises:
        UserError: no run has that metric.
    """
    from matplotlib.figure import Figure

    chosen = frame[(frame["metric"] == metric) & frame["value"].notna()]
    if chosen.empty:
        raise unknown_name("metric", metric, sorted(frame["metric"].dropna().unique()))
    groups = chosen.groupby(["case", "method"], sort=False)["value"]
    mean, least, most = (found.unstack("method") for found in (groups.mean(), groups.min(), groups.max()))
    figure = Figure(figsize=(2 + 1.2 * len(mean), 4), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(mean.columns)
    for index, method in enumerate(mean.columns):
        places = np.arange(len(mean)) + (index - (len(mean.columns) - 1) / 2) * width
        whiskers = np.stack((mean[method] - least[method], most[method] - mean[method]))
        axes.bar(places, mean[method], width, yerr=whiskers, capsize=2, label=method)
    axes.set_xticks(np.arange(len(mean)), mean.index, rotation=30, ha="right")
    unit = chosen["unit"].iloc[0]
    axes.set_ylabel(metric if unit == "1" else f"{metric}, {unit}")
    axes.set_title(", ".join(sorted(chosen["protocol"].unique())))
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))  # beside the bars, not over them
    return figure


def _setting_names(tree: Mapping[str, Any], prefix: str = "") -> list[str]:
    names = []
    for name, value in tree.items():
        names += _setting_names(value, f"{prefix}{name}.") if isinstance(value, dict) else [f"{prefix}{name}"]
    return names


def _log(title: str, shown: bool) -> Log:
    return Progress(title) if shown else lambda *_: None


@contextmanager
def _computing(device: str) -> Iterator[torch.device]:
    """Compute as a run does: one thread of torch's, the other cores for our kernels."""
    chosen, before = pick_device(device), torch.get_num_threads()
    with this_process(share_cores(1, 1, chosen), "auto"):
        try:
            yield chosen
        finally:
            torch.set_num_threads(before)
