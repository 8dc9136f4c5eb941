"""The paper's method."""

from rewild4d.contracts import MethodInfo
from rewild4d.ours.config import Config

__all__ = ["INFO", "Config"]

INFO = MethodInfo(
    title="ours",
    paper="Progressive Pose-Guided 4D Animal Reconstruction from Monocular Video; its code is not public",
    licence="MIT",
)
