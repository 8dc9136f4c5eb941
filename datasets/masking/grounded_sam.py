"""Masks by Grounding DINO (Liu et al. 2023) and SAM 2 (Ravi et al. 2024), through Hugging Face's `transformers`.

The words name the animal, Grounding DINO finds its box in every frame, SAM 2 fills the box. An optional extra
(`pip install -e '.[masks]'`); nothing is imported before it is used, and the weights are the user's to fetch.
Images are prepared here, in plain torch, because the image processors of `transformers` want torchvision.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from rewild4d.datasets.masking import DETECTOR, SEGMENTER
from rewild4d.datasets.masking.makers import MaskMaker, Unmasked
from rewild4d.errors import UserError

MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
SHORTEST, LONGEST = 800, 1333
"""Grounding DINO sees frames with their shorter side at the first, unless the longer one then exceeds the second."""
LEAST_SCORE = 0.25
"""Boxes that Grounding DINO is less sure of are none."""
FAITH = 0.3
"""What overlap with the box of the frame before is worth in score: it keeps to one of two animals."""


@dataclass(frozen=True)
class Networks:
    """The two networks and the tokenizer of the first."""

    detector: Any
    tokenizer: Any
    segmenter: Any
    device: torch.device


def grounded_masks(
    text: str, detector: str = DETECTOR, segmenter: str = SEGMENTER, device: torch.device | None = None
) -> MaskMaker:
    """Return a maker of masks by both networks.

    Args:
        text: what the animal is called.
        detector: name or folder of a Grounding DINO model.
        segmenter: name or folder of a SAM 2 model.
        device: where to compute.

    Raises:
        UserError: `transformers` is missing, or a model cannot be loaded.
    """
    networks = load_networks(detector, segmenter, device or torch.device("cpu"))
    prompt = text.strip().lower().rstrip(".") + "."

    def maker(source: Unmasked) -> Iterator[np.ndarray]:
        before: Tensor | None = None
        for index, image in enumerate(source.images()):
            if index in source.boxes:
                left, top, width, height = source.boxes[index]
                box: Tensor | None = torch.tensor((left, top, left + width, top + height))
            else:
                box = find_box(networks, image, prompt, before)
            before = box if box is not None else before
            yield np.zeros(image.shape[:2], np.uint8) if box is None else fill_box(networks, image, box)

    return maker


def load_networks(detector: str, segmenter: str, device: torch.device) -> Networks:
    """Load both networks; its errors are those of `grounded_masks`."""
    try:
        from transformers import AutoModelForZeroShotObjectDetection, AutoTokenizer, Sam2Model
    except (ImportError, RuntimeError) as error:  # a torchvision that does not fit torch is a RuntimeError
        raise UserError(
            "--tool grounded-sam2: expected the package transformers (4.56 or newer), run: pip install -e "
            f"'.[masks]' ({_first_line(error)})."
        ) from error
    wanted = (AutoModelForZeroShotObjectDetection, detector), (AutoTokenizer, detector), (Sam2Model, segmenter)
    loaded = []
    for kind, name in wanted:
        try:
            loaded.append(kind.from_pretrained(name))
        except (OSError, ValueError, RuntimeError, KeyError) as error:
            where = "the folder" if Path(name).exists() else "Hugging Face"
            raise UserError(f"{name}: expected a model that loads from {where}, but: {_first_line(error)}.") from error
    found, tokenizer, segments = loaded
    return Networks(found.to(device).eval(), tokenizer, segments.to(device).eval(), device)


@torch.no_grad()
def find_box(networks: Networks, image: np.ndarray, prompt: str, before: Tensor | None) -> Tensor | None:
    """Return left, top, right, bottom of what the prompt names, pixels, [4]; None where nothing is sure enough.

    Args:
        networks: both of them.
        image: uint8 [h, w, 3].
        prompt: lower case, with a full stop.
        before: the box in the frame before, [4].
    """
    height, width = image.shape[:2]
    scale = min(SHORTEST / min(height, width), LONGEST / max(height, width))
    pixels = prepared(image, (round(width * scale), round(height * scale)), networks.device)
    words = networks.tokenizer(prompt, return_tensors="pt").to(networks.device)
    mask = torch.ones((1, *pixels.shape[2:]), dtype=torch.int64, device=networks.device)
    out = networks.detector(pixel_values=pixels, pixel_mask=mask, **words)
    scores = out.logits[0].sigmoid().amax(dim=1).cpu()
    middle, extent = out.pred_boxes[0].cpu().split(2, dim=1)
    boxes = torch.cat((middle - extent / 2, middle + extent / 2), dim=1) * torch.tensor((width, height, width, height))
    value = scores + (FAITH * overlap(boxes, before) if before is not None else 0)
    value[scores < LEAST_SCORE] = -1
    best = int(value.argmax())
    return boxes[best] if float(value[best]) >= 0 else None


@torch.no_grad()
def fill_box(networks: Networks, image: np.ndarray, box: Tensor) -> np.ndarray:
    """Return the mask of what a box holds, uint8 [h, w]; SAM 2 sees the frame stretched to a square."""
    height, width = image.shape[:2]
    side = networks.segmenter.config.prompt_encoder_config.image_size
    side = int(side if isinstance(side, int) else side[0])
    pixels = prepared(image, (side, side), networks.device)
    scaled = box * torch.tensor((side / width, side / height, side / width, side / height))
    out = networks.segmenter(
        pixel_values=pixels, input_boxes=scaled[None, None].to(networks.device), multimask_output=False
    )
    logits = out.pred_masks.reshape(-1, *out.pred_masks.shape[-2:])[0].float().cpu().numpy()
    return np.where(cv2.resize(logits, (width, height), interpolation=cv2.INTER_LINEAR) > 0, 255, 0).astype(np.uint8)


def prepared(image: np.ndarray, size: tuple[int, int], device: torch.device) -> Tensor:
    """Return a frame as the networks want it: resized and normalised, [1, 3, h, w]."""
    values = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].to(device, torch.float32) / 255
    values = torch.nn.functional.interpolate(values, size[::-1], mode="bilinear", antialias=True)
    mean, spread = (values.new_tensor(numbers)[:, None, None] for numbers in (MEAN, SPREAD))
    return (values - mean) / spread


def overlap(boxes: Tensor, box: Tensor) -> Tensor:
    """Return the intersection over union of boxes with one, [n, 4] and [4] -> [n]."""
    lower, upper = torch.maximum(boxes[:, :2], box[:2]), torch.minimum(boxes[:, 2:], box[2:])
    shared = (upper - lower).clamp_min(0).prod(dim=1)
    areas = [(each[..., 2:] - each[..., :2]).clamp_min(0).prod(dim=-1) for each in (boxes, box)]
    return shared / (areas[0] + areas[1] - shared).clamp_min(1e-9)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
