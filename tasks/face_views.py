"""Which face views the stage `avatar` trains the head on, in words and as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from ahoy_core.avatar.face_role import generated_faces
from ahoy_core.avatar.face_texture import HeadTexture, head_observed, reprojected_faces
from ahoy_core.avatar.face_views import observed_faces
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.head import FaceViews, join_faces
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.formats.images import contact_sheet, to_uint8, write_png
from ahoy_core.maps.template import Template
from tasks.complete import completed
from tasks.stage import StageContext

COLUMNS = 8
_LEFT_OUT = (0.15, 0.25, 0.55)  # what has no weight: blue, which neither hair nor skin is


@dataclass(frozen=True)
class ChosenFaces:
    """Face views, or None and why; `note` says in a sentence which they are, empty where there are none."""

    views: FaceViews | None
    reason: str
    note: str = ""


def choose_faces(
    inputs: CoarseInputs, template: Template, expression: torch.Tensor, config: FullConfig, ctx: StageContext
) -> ChosenFaces:
    """The role "face" where somebody fills it and the face was seen; else what the configuration asks for.

    Args:
        inputs: the observed video and its completed texture.
        template: the bare body.
        expression: [T,E] face actions of the frames.
        config: of the stage.
        ctx: the stage's inputs and fills.
    """
    if not config.switches.head_split or config.weights.head == 0:
        return ChosenFaces(None, "switched off, or its weight is 0")
    kinematics = Kinematics.of(inputs.body, inputs.betas.float())
    seen, reason = observed_faces(inputs, template, kinematics, expression)
    face = ctx.fills.get("face")
    if face is not None and seen is not None:
        made = generated_faces(face, seen, template, kinematics)
        return ChosenFaces(made, "", f'face views: {len(made)} by the role "face", from {len(seen)} frames')
    if config.face_views == "observed":
        return _frames_alone(seen, reason, head_observed(inputs))
    texture = reprojected_faces(inputs, template, prior_filled(ctx))
    if config.face_views == "reprojected":
        seen, reason = None, "not asked for"
    return _together(seen, reason, texture)


def _together(seen: FaceViews | None, reason: str, texture: HeadTexture) -> ChosenFaces:
    if texture.views is None:
        return _frames_alone(seen, f"{reason}; {texture.reason}", texture.observed)
    parts = ([] if seen is None else [_frames(seen)]) + [f"the head's own texture from {len(texture.views)} sides"]
    shares = (
        f"of the head {texture.observed:.0%} was observed, {texture.filled:.0%} filled by the prior (hair and back of "
        f"the head alone), {1 - texture.observed - texture.filled:.0%} left alone"
    )
    views = texture.views if seen is None else join_faces(seen, texture.views)
    return ChosenFaces(views, "", f"face views: {' and '.join(parts)}; {shares}")


def _frames_alone(seen: FaceViews | None, reason: str, observed: float) -> ChosenFaces:
    if seen is None:
        return ChosenFaces(None, reason)
    shares = f"of the head {observed:.0%} was observed, and no face view says anything of the other {1 - observed:.0%}"
    return ChosenFaces(seen, "", f"face views: {_frames(seen)}; {shares}")


def _frames(seen: FaceViews) -> str:
    return f"{len(seen)} frame{'s' * (len(seen) > 1)} of the video"


def prior_filled(ctx: StageContext) -> bool:
    """Whether a prior completed the texture: it won the video's self-check, or was believed without."""
    folder = ctx.inputs.get("complete")
    if folder is None:
        return False
    return bool(completed(folder)["prior_used"])


def draw_faces(views: FaceViews, path: Path) -> None:
    """The face views, blue where they have no weight and tinted where they have less."""
    weights = views.weights[:, None]
    pictures = views.images * weights + torch.tensor(_LEFT_OUT)[:, None, None] * (1 - weights)
    sheet = contact_sheet([to_uint8(p) for p in pictures], [str(n) for n in range(len(views))], columns=COLUMNS)
    write_png(path, sheet)
