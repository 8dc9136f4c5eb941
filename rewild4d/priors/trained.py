"""What was trained on random animals and takes part in a fit."""

from dataclasses import dataclass

from rewild4d.priors.bodies.body import Body
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.heading.network import HeadingNetwork
from rewild4d.priors.learned.network import PointNetwork
from rewild4d.priors.shapes.density import ShapeDensity


@dataclass(frozen=True)
class Trained:
    """The parts of a fit, None for one that does not take part; they are of quadrupeds.

    Attributes:
        points: finds points of the body in masked pictures.
        headings: reads which way the animal heads in them.
        shapes: where shapes of the template lie.
    """

    points: PointNetwork | None = None
    headings: HeadingNetwork | None = None
    shapes: ShapeDensity | None = None

    def shapes_of(self, body: Body) -> ShapeDensity | None:
        """Return where shapes of a kind of body lie, None where that is not known."""
        return self.shapes if body.name == QUADRUPED.name else None


UNTRAINED = Trained()
