"""What is known of the programs of others: which files they leave, in which axes, and whether these fit the cameras."""

from typing import Literal

import msgspec

Up = Literal["y", "-y", "z", "any"]


class Profile(msgspec.Struct, frozen=True, kw_only=True):
    """How a program's output is read.

    Attributes:
        title: of the program.
        paper: to cite, or "".
        patterns: of its files below the output folder, the first that fits any file counts.
        placed: its results stand where the input cameras see them; else they are rotated to the best input PSNR.
        up: the axis of its results that points up, where they are to be rotated; "any" tries all.
        elevation: of its own training camera in degrees: a start of that search.
        spread: it writes a number of moments of its own, at (i + 1) / (n + 1) of a clip whose frames lie at
            (k + 1) / (T + 1); else one a frame.
        moments: that number where it is always the same (or one a frame, where somebody made it so); 0 where any is.
        crops: it takes 3D-Fauna's crops and gives that one's camera with each mesh.
    """

    title: str
    paper: str = ""
    patterns: tuple[str, ...] = ()
    placed: bool = False
    up: Up = "any"
    elevation: float = 0.0
    spread: bool = False
    moments: int = 0
    crops: bool = False


PROFILES = {
    "frames": Profile(
        title="frame_0000.ply, ... : Gaussians or meshes (.ply, .obj), one a frame, in the world of the cameras",
        patterns=("frame_*.ply", "frame_*.obj"), placed=True,
    ),
    "glb": Profile(
        title="one animated .glb or .gltf (skinned or with morph targets), its clip as long as the video",
        patterns=("*.glb", "*.gltf"), placed=True, up="y",
    ),
    # Its own script only renders; `save_ply` of its Gaussian model, called once a time step, may turn z-up into -y-up.
    # As many moments as its --num_timesteps says: 24, or 32 in its own command lines.
    "gvfdiffusion": Profile(
        title="GVFDiffusion",
        paper="Zhang et al., Gaussian Variation Field Diffusion for High-fidelity Video-to-4D Synthesis, ICCV 2025",
        patterns=("gaussians/*.ply", "*.ply"), spread=True,
    ),
    # Trains at distance 3.8, field of view 20 degrees, elevation 5 degrees; exports 32 textured meshes of any video.
    "dreammesh4d": Profile(
        title="DreamMesh4D",
        paper="Li et al., DreamMesh4D: Video-to-4D Generation with Sparse-Controlled Gaussian-Mesh Hybrid "
              "Representation, NeurIPS 2024",
        patterns=("extracted_textured_meshes/extracted_mesh_*.obj", "**/extracted_mesh_*.obj"), up="z", elevation=5.0,
        spread=True, moments=32,
    ),
    "3d-fauna": Profile(
        title="3D-Fauna", paper="Li et al., Learning the 3D Fauna of the Web, CVPR 2024",
        patterns=("*_mesh.obj", "**/*_mesh.obj"), placed=True, crops=True,
    ),
}  # fmt: skip
"""By the names that `--profile` takes. Files, axes and cameras as their public code has them; sizes do not matter."""
