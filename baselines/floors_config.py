"""Settings of the two floors, and what tables say of them; a light module, read before the methods are loaded."""

import msgspec

from rewild4d.contracts import MethodInfo
from rewild4d.ours.config import Count, Positive

EMPTY_INFO = MethodInfo(title="empty", paper="", licence="MIT", is_floor=True, uses_prior=False)
PRIOR_ONLY_INFO = MethodInfo(
    title="prior only", paper="after the 3D-Fauna row (Li et al. 2024)", licence="MIT", is_floor=True
)


class EmptyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


class PriorOnlyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the prior's surface is drawn."""

    gaussians: Count = 12000
    """Points on the surface: enough that their discs close at 512 pixels."""
    thickness: Positive = 0.3
    """Along the normal, as a share of the disc's radius: a thin shell."""
