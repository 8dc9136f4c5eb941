"""Networks that read a clip's masked pictures for a fit."""

from dataclasses import dataclass

from rewild4d.priors.heading.network import HeadingNetwork
from rewild4d.priors.learned.network import PointNetwork


@dataclass(frozen=True)
class Networks:
    """Those that take part in a fit, None for one that does not; they read quadrupeds.

    Attributes:
        points: finds points of the body.
        headings: reads which way the animal heads.
    """

    points: PointNetwork | None = None
    headings: HeadingNetwork | None = None


NO_NETWORKS = Networks()
