"""A scene: who, how they move, where the camera and the furniture stand; all drawn from one seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ahoy_core.body.packaged import PackagedBody
from benchmarks.rendered.motions import KINDS, Dofs, carry, pose_from_dofs, sample_motion
from benchmarks.rendered.people import Person, Wardrobe
from benchmarks.rendered.render import View
from benchmarks.rendered.rooms import Box, carried_box, sample_occluders, sample_room

FloatArray = NDArray[np.float64]
OCCLUDERS = ("desk", "shelf", "chair", "counter", "post", "none")
FPS = 15.0
SIZE = 256


@dataclass(frozen=True)
class Scene:
    """T frames of one person.

    Attributes:
        person: the subject.
        pose: [T,J,3] axis-angle of the packaged body.
        transl: [T,3] metres; the soles are on the floor z = 0.
        room: boxes that stay.
        carried: a box a frame, or none.
        view: camera and light.
        facts: kind of motion and furniture.
    """

    person: Person
    pose: torch.Tensor
    transl: torch.Tensor
    room: list[Box]
    carried: list[Box]
    view: View
    facts: Mapping[str, str]

    def boxes(self, frame: int) -> list[Box]:
        """Everything that is not a person."""
        return [*self.room, *self.carried[frame : frame + 1]]


def sample_scene(
    rng: np.random.Generator, wardrobe: Wardrobe, frames: int, fine: float = 2.0, person: Person | None = None
) -> Scene:
    """Draw a scene, with a person of its own unless given; `fine` squared rays a pixel."""
    body = wardrobe.body
    person = person or wardrobe.dress(rng)
    kind, furniture = str(rng.choice(KINDS)), str(rng.choice(OCCLUDERS, p=[0.27, 0.25, 0.13, 0.13, 0.12, 0.1]))
    dofs = sample_motion(rng, kind, max(frames, 2), FPS)
    holds = kind in ("stand", "step", "turn") and rng.random() < 0.3
    if holds:
        carry(dofs, rng)
    pose = _poses(body, person, dofs)[:frames]
    transl = _on_the_floor(body, person, pose, rng)
    carried: list[Box] = []
    if holds:
        carried = _held(rng, body, person, pose, transl)
    room = sample_room(rng) + sample_occluders(rng, furniture)
    return Scene(person, pose, transl, room, carried, sample_view(rng, fine), {"motion": kind, "occluder": furniture})


def sample_unseen(rng: np.random.Generator, scene: Scene, body: PackagedBody, frames: int) -> Scene:
    """The same person in another kind of motion, without furniture, in the same light."""
    kind = str(rng.choice([kind for kind in KINDS if kind not in (scene.facts["motion"], "stand")]))
    pose = _poses(body, scene.person, sample_motion(rng, kind, frames, FPS))
    return replace(
        scene, pose=pose, transl=_on_the_floor(body, scene.person, pose, rng), room=[], carried=[],
        facts={**scene.facts, "motion": kind},
    )  # fmt: skip


def views_around(view: View, rng: np.random.Generator) -> dict[str, View]:
    """The input's camera and three more of its kind, from the left, the back and the right of who faces it."""
    turns = {"front": 0.0} | {
        name: at + rng.uniform(-8, 8) for name, at in (("left", 90), ("back", 180), ("right", -90))
    }
    return {name: _turned_view(view, degrees) for name, degrees in turns.items()}


def _turned_view(view: View, degrees: float) -> View:
    """A camera carried about the vertical line through the origin."""
    carried = np.eye(4)
    carried[:3, :3] = Rotation.from_euler("z", -degrees, degrees=True).as_matrix()
    return replace(view, viewmat=view.viewmat @ carried)


def sample_view(rng: np.random.Generator, fine: float) -> View:
    """A camera that looks at somebody near the origin, mostly slightly down."""
    focal = rng.uniform(300, 480)
    distance = 3.24 * focal / 389 * rng.uniform(0.85, 1.3)
    azimuth, height = np.radians(rng.normal(0, 12)), rng.uniform(0.9, 1.9)
    centre = np.array([distance * np.sin(azimuth), -distance * np.cos(azimuth), height])
    target = np.array([rng.normal(0, 0.08), 0.0, rng.uniform(0.8, 1.0)])
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ centre
    K = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    light = np.array([rng.normal(0, 0.6), -rng.uniform(0.2, 1), rng.uniform(0.6, 1.5)])
    return View(viewmat, K, SIZE, SIZE, fine, light / np.linalg.norm(light), rng.uniform(0.45, 0.75))


def _poses(body: PackagedBody, person: Person, dofs: Dofs) -> torch.Tensor:
    """Poses [T,J,3] of a motion on somebody's own bones."""
    with torch.no_grad():
        rest = body(torch.zeros(1, body.n_joints, 3), person.betas[None], torch.zeros(1, 3))
    return torch.from_numpy(pose_from_dofs(body, rest.rest_joints[0].double().numpy(), dofs)).float()


def _on_the_floor(body: PackagedBody, person: Person, pose: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Roots [T,3] with the soles on the floor, and the standing feet in place."""
    with torch.no_grad():
        out = [body(p[None], person.betas[None], torch.zeros(1, 3)) for p in pose]
    index = {name: i for i, name in enumerate(body.joint_names)}
    feet = np.stack([o.joints[0, [index["foot.L"], index["foot.R"]]].double().numpy() for o in out])
    lowest = np.array([float(o.vertices[0, :, 2].min()) for o in out])
    transl = np.zeros((len(pose), 3))
    transl[:, 2] = 0.012 - lowest
    # Whichever foot is lower stands still.
    share = np.exp(-(feet[..., 2] - feet[..., 2].min(1, keepdims=True)) / 0.01)
    share /= share.sum(1, keepdims=True)
    slide = ((share[1:] + share[:-1])[..., None] / 2 * np.diff(feet[..., :2], axis=0)).sum(1)
    transl[1:, :2] = -np.cumsum(slide, axis=0)
    root = np.stack([o.joints[0, 0].double().numpy() for o in out])
    transl[:, :2] -= (root[:, :2] + transl[:, :2]).mean(0) - rng.normal(0, (0.12, 0.08))
    return torch.from_numpy(transl).float()


def _held(
    rng: np.random.Generator, body: PackagedBody, person: Person, pose: torch.Tensor, transl: torch.Tensor
) -> list[Box]:
    index = {name: i for i, name in enumerate(body.joint_names)}
    with torch.no_grad():
        joints = torch.cat(
            [body(p[None], person.betas[None], t[None]).joints for p, t in zip(pose, transl, strict=True)]
        )
    points = joints.double().numpy()
    left, right = (points[:, index[f"finger3-2.{side}"]] for side in "LR")
    forward = np.cross(np.array([0, 0, 1.0]), right - left)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return carried_box(
        rng, left, right, -forward if (forward[0] @ (points[0, 0] - 0.5 * (left[0] + right[0]))) > 0 else forward
    )
