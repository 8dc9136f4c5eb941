"""U²-Net-p (Qin et al. 2020, "U²-Net: Going deeper with nested U-structure"): how far each pixel stands out.

1.1 million parameters; `weights fetch` brings the published file, which OpenCV runs.
"""

import cv2
import numpy as np

from rewild4d.metrics.weights import LoadedWeights

NAME = "u2netp"
SIDE = 320
"""Pictures are read at this width and height, whatever their own."""
MEAN, SPREAD = np.array((0.485, 0.456, 0.406), np.float32), np.array((0.229, 0.224, 0.225), np.float32)
"""Of the pictures that it learned from, red, green, blue."""


class Saliency:
    """Reads pictures of any size.

    Args:
        weights: of the network (`rewild4d.metrics.weights.load_weights("u2netp")`).
    """

    def __init__(self, weights: LoadedWeights) -> None:
        self._network = cv2.dnn.readNetFromONNX(weights.tensors["file"].numpy())
        self._output, *_ = self._network.getUnconnectedOutLayersNames()  # the others are its parts at each size

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return how far each pixel stands out, 0 to 1, float32 [h, w].

        Args:
            image: uint8 [h, w, 3], red, green, blue.
        """
        height, width = image.shape[:2]
        how = cv2.INTER_AREA if max(height, width) > SIDE else cv2.INTER_LINEAR
        picture = cv2.resize(image, (SIDE, SIDE), interpolation=how).astype(np.float32)
        picture = (picture / max(float(picture.max()), 1.0) - MEAN) / SPREAD
        self._network.setInput(picture.transpose(2, 0, 1)[None])
        found: np.ndarray = self._network.forward(self._output)[0, 0]
        return cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR).clip(0, 1)
