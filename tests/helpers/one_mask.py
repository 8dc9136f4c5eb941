"""A mask file by itself, without the folder that says what its values mean."""

from pathlib import Path

import numpy as np

from rewild4d.datasets.masking.masks import stored_values
from rewild4d.datasets.masking.meaning import Meaning


def read_values(file: Path) -> np.ndarray:
    """The shades of one mask file, uint8 [h, w]."""
    values = stored_values(file)
    most = values.max(initial=0)
    whole = 65535 if most > 255 else 1 if values.dtype.kind == "f" and most <= 1 else 255
    return Meaning(white=whole).mask(values, None)
