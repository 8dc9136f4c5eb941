"""Names of templates, and files of rigs that serve as one."""

from pathlib import Path

from rewild4d.errors import unknown_name
from rewild4d.priors.bodies.biped import BIPED, PRIMATE
from rewild4d.priors.bodies.body import Body
from rewild4d.priors.bodies.quadruped import QUADRUPED

KINDS: tuple[Body, ...] = (QUADRUPED, BIPED, PRIMATE)
"""Templates of the package, the usual one first."""
RIG_FILES = (".glb", ".gltf")


def bodies(name: str) -> tuple[Body, ...]:
    """Return the templates among which the fit chooses: all for an empty name, else the named one or that of a rig.

    Raises:
        UserError: no such template, or a rig file that cannot be used.
    """
    if not name:
        return KINDS
    if is_rig_file(name):
        from rewild4d.priors.bodies.rig_file import read_body

        return (read_body(Path(name)),)
    found = tuple(body for body in KINDS if body.name == name)
    if not found:
        raise unknown_name("template", name, [*(body.name for body in KINDS), "<your own rig>.glb"])
    return found


def identity(name: str) -> str:
    """Return what decides the templates of a name: the name itself, or the content of its rig file.

    Raises:
        UserError: a rig file that cannot be read.
    """
    if not is_rig_file(name):
        return name or "all"
    from rewild4d.datasets.rigs.reader import content

    return content(Path(name))


def is_rig_file(name: str) -> bool:
    """Tell whether a name is that of a rig file."""
    return Path(name).suffix.lower() in RIG_FILES
