"""Settings of the two lower bounds, and their rows in tables; without torch, since flags read it first."""

import msgspec

from rewild4d.contracts import MethodInfo
from rewild4d.ours.numbers import Count, Positive

EMPTY_INFO = MethodInfo(title="empty", paper="", licence="MIT", is_floor=True, uses_prior=False)
PRIOR_ONLY_INFO = MethodInfo(
    title="prior only", paper="after the 3D-Fauna row (Li et al. 2024)", licence="MIT", is_floor=True
)


class EmptyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """No settings."""


class PriorOnlyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Gaussians on the prior's surface."""

    gaussians: Count = 12000
    """Number of Gaussians; the default leaves no gaps at 512 pixels."""
    thickness: Positive = 0.3
    """Scale along the normal over the scale in the surface."""
