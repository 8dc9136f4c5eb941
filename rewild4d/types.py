"""The types that flow through the house: frozen, small, shapes in the comments.

Conventions, everywhere: OpenCV camera axes (x right, y down, z forward); pixel centres at +0.5 inside the package
(column u covers [u, u+1)); quaternions are wxyz; colours and mattes lie in [0, 1]; time is in seconds.

Two frames of reference:
  world   the dataset's own coordinates. `Reconstruction.at` answers here; held-out cameras live here.
  object  the animal's: x lateral (+x its left), y up, z towards the head, x = 0 the symmetry plane, and the rest
          shape's bounding-box diagonal scaled to `OBJECT_DIAGONAL`. A prior and `ours` work here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

OBJECT_DIAGONAL = 5.0
"""Rest-shape bounding-box diagonal in the object frame, so that one loss weight means the same on every scene."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        world_to_camera: rigid transform, float64, [4, 4].
        intrinsics: pixels, pixel centres at +0.5, float64, [3, 3].
        width: image width in pixels.
        height: image height in pixels.
    """

    world_to_camera: Tensor
    intrinsics: Tensor
    width: int
    height: int

    @property
    def center(self) -> Tensor:
        """Camera centre in the world, [3]."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points [..., 3] to pixels [..., 2] and depths [...]."""
        matrix = self.world_to_camera.to(points)
        local = points @ matrix[:3, :3].T + matrix[:3, 3]
        image = local @ self.intrinsics.to(points).T
        return image[..., :2] / image[..., 2:].clamp_min(1e-9), local[..., 2]

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same view at another image size (the two axes scale on their own)."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=self.intrinsics.dtype)
        return replace(self, intrinsics=scale[:, None] * self.intrinsics, width=width, height=height)

    def shifted(self, left: float, top: float, width: int, height: int) -> "Camera":
        """Return the view of a window whose upper left corner is at (left, top); negative values pad."""
        moved = self.intrinsics.clone()
        moved[0, 2] -= left
        moved[1, 2] -= top
        return replace(self, intrinsics=moved, width=width, height=height)


@dataclass(frozen=True)
class Crop:
    """The square of an original frame that an image shows; it may reach over the border, where the image is empty.

    Attributes:
        left: of the square, in the original's pixels.
        top: of the square, in the original's pixels.
        side: of the square, in the original's pixels.
        width: of the original in pixels.
        height: of the original in pixels.
    """

    left: float
    top: float
    side: float
    width: int
    height: int

    def to_original(self, points: Tensor, size: int) -> Tensor:
        """Convert pixels of the image (``size`` wide and high) to pixels of the original frame, [..., 2]."""
        return points * (self.side / size) + points.new_tensor((self.left, self.top))

    def from_original(self, points: Tensor, size: int) -> Tensor:
        """Convert pixels of the original frame to pixels of the image (``size`` wide and high), [..., 2]."""
        return (points - points.new_tensor((self.left, self.top))) * (size / self.side)

    def original_camera(self, camera: Camera) -> Camera:
        """Return the camera of the whole original frame, from the camera of the image."""
        scale = self.side / camera.width
        placed = torch.tensor(((scale, 0, self.left), (0, scale, self.top), (0, 0, 1)), dtype=camera.intrinsics.dtype)
        return replace(camera, intrinsics=placed @ camera.intrinsics, width=self.width, height=self.height)

    def cropped_camera(self, camera: Camera, size: int) -> Camera:
        """Return the camera of the image (``size`` wide and high), from the camera of the whole original frame."""
        moved = camera.intrinsics.clone()
        moved[0, 2] -= self.left
        moved[1, 2] -= self.top
        moved[:2] *= size / self.side
        return replace(camera, intrinsics=moved, width=size, height=size)


@dataclass(frozen=True)
class Keypoints:
    """Named points of the animal in one image.

    Attributes:
        names: of the points.
        points: (column, row) in the image's pixels, pixel centres at +0.5; meaningless where not visible, [n, 2].
        visible: which of them were annotated, bool, [n].
        confidence: where a network placed them and not a person: its score of each, in [0, 1], float32, [n]; all points
            have a meaning then.
    """

    names: tuple[str, ...]
    points: Tensor
    visible: Tensor
    confidence: Tensor | None = None


@dataclass(frozen=True)
class Frame:
    """One image of the animal.

    Attributes:
        time: seconds from the start of the clip.
        camera: world camera, or None where nobody knows it: `Reconstruction.camera` tells it then.
        rgb: colour already multiplied by the mask (black outside the animal), float32 in [0, 1], [3, h, w].
        mask: soft matte, float32 in [0, 1], [1, h, w].
        view: index of the camera in the dataset, or -1.
        crop: which square of the original frame this is; None: all of it.
        keypoints: annotated points in this image, where the data set has some.
    """

    time: float
    camera: Camera | None
    rgb: Tensor
    mask: Tensor
    view: int = -1
    crop: Crop | None = None
    keypoints: Keypoints | None = None

    def over(self, background: float | Tensor) -> Tensor:
        """Composite the frame on a background colour (a number or a tensor that broadcasts), [3, h, w]."""
        return self.rgb + (1.0 - self.mask) * background


@dataclass(frozen=True)
class Clip:
    """What a method may see: one image per moment.

    Attributes:
        name: case name, "<animal>/<motion>".
        species: free text, for reports only; nothing may depend on it.
        frames: in the order of time.
        fps: frames per second.
        licence: of the data.
        digest: SHA-256 over the pixels, mattes and cameras that the method gets.
        notes: what was left out or assumed when the clip was read, a sentence each.
        start: seconds from the start of the video to the moment that the clip calls 0.
        travel: motion of the animal over the background from each frame to the next, in pixels of the latter's image
            (x to the right, y down), measured in these whole frames alone; None where it is not known, [T - 1, 2].
        guessed_cameras: whether the data set has no cameras, and those of the frames are a prior's.
    """

    name: str
    species: str
    frames: tuple[Frame, ...]
    fps: float
    licence: str
    digest: str
    notes: tuple[str, ...] = ()
    start: float = 0.0
    travel: Tensor | None = None
    guessed_cameras: bool = False

    @property
    def times(self) -> tuple[float, ...]:
        return tuple(frame.time for frame in self.frames)

    def only(self, rows: Sequence[int]) -> "Clip":
        """Return the clip without its other frames; the digest stays that of the whole."""
        travel = self.travel
        if travel is not None:
            travel = torch.cat((travel.new_zeros(1, 2), travel.cumsum(0)))[list(rows)].diff(dim=0)
        return replace(self, frames=tuple(self.frames[row] for row in rows), travel=travel)


@dataclass(frozen=True)
class Rig:
    """The true shape and skeleton of an animal, world units, all float64 but the indices.

    Attributes:
        vertices: rest surface, [n, 3].
        faces: outward-facing triangles, int64, [f, 3].
        weights: skinning weights, rows sum to one, [n, J].
        bones_rest: global bone-to-world matrices at rest, [J, 4, 4].
        bones: the same at each of the clip's frames, [T, J, 4, 4].
        parents: parent of each bone, -1 for a root, int64, [J].
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor
    bones_rest: Tensor
    bones: Tensor
    parents: Tensor


@dataclass(frozen=True)
class Truth:
    """What only the evaluation sees.

    Attributes:
        held_out: frames of views (or moments) that the clip does not hold; a lazy sequence, each decoded on access.
        surface: time in seconds -> the true surface points at that time in the world, the same point in the same row
            at every time, float64, [n, 3]; None where the data set has no geometry.
        digest: SHA-256 over the held-out data.
        sample: (time, n, seed) -> n points of the same surface in the world, rows as in ``surface``; another seed draws
            an independent sampling, float64, [n, 3]; None where the data set has no geometry.
        diagonal: of the animal's bounding box in its rest pose, world units; None where unknown.
        up: direction that points up in the world, unit, float64, [3]; None where unknown.
        rig: makes the true shape and skeleton, for a bound (`--prior rig`); None where the data set has none.
        source: what the surface is made of ("voxels", "mesh of the rig"), for the record; "" where there is none.
    """

    held_out: Sequence[Frame]
    surface: Callable[[float], Tensor] | None
    digest: str
    sample: Callable[[float, int, int], Tensor] | None = None
    diagonal: float | None = None
    up: Tensor | None = None
    rig: Callable[[], Rig] | None = None
    source: str = ""


@dataclass(frozen=True)
class Prior:
    """A posed template: a start, never a constraint. Everything is in the object frame but `object_to_world`.

    Attributes:
        name: how it was made ("template", "learned", "coarse-<noise>", "rig", a file's name).
        provenance: one sentence for the record (what it saw, noise, version).
        vertices: rest shape, float32, [n, 3].
        faces: int64, [f, 3].
        weights: skinning weights, each row sums to one, float32, [n, J].
        bones: start (inner end, the pivot) and end of each bone at rest, float32, [J, 2, 3].
        parents: parent of each bone, -1 for a root, int64, [J].
        mirror: the bone on the other side of each bone (an involution), int64, [J].
        times: seconds of the frames it knows, float64, [T].
        object_to_world: similarity at each frame, float64, [T, 4, 4].
        cameras: per frame, in the object frame (rigid: the similarity's scale is divided out); the clip's pixels.
        transforms: rest -> posed, per bone, float32, [T, J, 4, 4].
        cameras_flip: the same for the horizontally flipped frames.
        transforms_flip: the same for the horizontally flipped frames, float32, [T, J, 4, 4].
        quality: named figures of the fit (mask_iou, ...), copied into the record.
        digest: SHA-256 of all of the above.
        notes: what was done to it for a clip and what speaks against it, a sentence each; not in its file.
        steady: whether a frame may be trained from the plain and from the flipped sequence, bool, [2, T]; None for all;
            not in its file.
    """

    name: str
    provenance: str
    vertices: Tensor
    faces: Tensor
    weights: Tensor
    bones: Tensor
    parents: Tensor
    mirror: Tensor
    times: Tensor
    object_to_world: Tensor
    cameras: tuple[Camera, ...]
    transforms: Tensor
    cameras_flip: tuple[Camera, ...]
    transforms_flip: Tensor
    quality: dict[str, float]
    digest: str
    notes: tuple[str, ...] = ()
    steady: Tensor | None = None


@dataclass(frozen=True)
class Case:
    """One unit of the benchmark."""

    clip: Clip
    prior: Prior
    truth: Truth


@dataclass(frozen=True)
class Splats:
    """The Gaussians of one moment, activated values.

    Attributes:
        means: [n, 3].
        quats: unit, wxyz, [n, 4].
        scales: standard deviations, [n, 3].
        opacities: in [0, 1], [n].
        colors: RGB in [0, 1] for k = 1; spherical-harmonic coefficients for k = 4, 9, 16, [n, k, 3].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]
