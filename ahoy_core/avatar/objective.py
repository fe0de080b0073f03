"""Equation 9: the terms of one step of the full avatar, each where its pictures and Gaussians meet."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ahoy_core.avatar.corrections import Corrections
from ahoy_core.avatar.deform import Canonical, deform, deform_each, dense_weights
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.full_inputs import FullInputs, Plan
from ahoy_core.avatar.head import expression_basis
from ahoy_core.avatar.losses import Neighbourhood, masked_l1, photometric, regularisers
from ahoy_core.avatar.render import Rendered, render
from ahoy_core.avatar.shots import Shot, at_target_resolution, shot_loss
from ahoy_core.conventions import Cameras
from ahoy_core.metrics.perceptual import Perceptual, patch_distance


class Terms(NamedTuple):
    """Weighted terms of one step; scalars."""

    body: Tensor
    observed: Tensor
    head: Tensor
    perceptual: Tensor
    regularisers: Tensor
    corrections: Tensor


class Objective:
    """The terms for given Gaussians and shots.

    Args:
        inputs: What is trained on.
        plan: Its shots.
        config: Weights and switches.
        perceptual: The perceptual role, or None.
    """

    def __init__(self, inputs: FullInputs, plan: Plan, config: FullConfig, perceptual: Perceptual | None) -> None:
        self.template, self.plan, self.config = inputs.template, plan, config
        self.around = Neighbourhood.of(inputs.template)
        self.notes: list[str] = []
        self.perceptual = perceptual if config.weights.perceptual > 0 else None
        if perceptual is None and config.weights.perceptual > 0:
            self.notes.append("no perceptual loss: nobody fills that role (`ahoy models pull` fetches its weights)")
        split = config.switches.head_split and config.weights.head > 0
        self.faces = inputs.faces if split else None
        if self.faces is None:
            reason = inputs.no_faces if split else "switched off, or its weight is 0"
            self.notes.append(f"head path skipped: {reason}")
        else:
            basis = expression_basis(inputs.observed.body, inputs.observed.betas.float(), inputs.template)
            head = inputs.template.head
            self.moved = torch.einsum("pe,enk->pnk", self.faces.expression.to(basis), basis[:, head])

    def terms(
        self,
        canonicals: Mapping[int, Canonical],
        change: Tensor,
        shots: Sequence[Shot],
        corrections: Corrections,
        generator: torch.Generator,
    ) -> Terms:
        """All terms of one step.

        Args:
            canonicals: Gaussians by map pose.
            change: Mean square of their pose-dependent part.
            shots: The step's pictures.
            corrections: Of the hallucinated ones.
            generator: Picks face views and the perceptual patch.
        """
        weights = self.config.weights
        body, observed = change.new_zeros(()), change.new_zeros(())
        pictures: list[tuple[Rendered, Shot]] = []
        count = {corrected: max(1, sum((s.row >= 0) == corrected for s in shots)) for corrected in (True, False)}
        for rendered, shot in self.render_shots(canonicals, shots, corrections):
            loss = shot_loss(rendered, shot, weights) / count[shot.row >= 0]
            body, observed = (body + loss, observed) if shot.row >= 0 else (body, observed + loss)
            pictures.append((rendered, shot))
        chosen = canonicals[self._pick(sorted(canonicals), generator)]
        rows = torch.tensor(sorted({shot.row for shot in shots if shot.row >= 0}), dtype=torch.int64)
        moving = self.config.switches.corrections and len(rows) > 0
        return Terms(
            weights.body * body,
            weights.observed * observed,
            weights.head * self._head(chosen, generator),
            weights.perceptual * self._perceptual(pictures, generator),
            regularisers(chosen, self.template, self.around, weights) + weights.pose_change * change,
            corrections.prior(rows, weights) if moving else change.new_zeros(()),
        )

    def render_shots(
        self, canonicals: Mapping[int, Canonical], shots: Sequence[Shot], corrections: Corrections | None
    ) -> list[tuple[Rendered, Shot]]:
        """Renders [1,3,h,w] of shots at their own resolution, with their corrections unless those are None."""
        by_group: dict[int, list[Shot]] = defaultdict(list)
        for shot in shots:
            by_group[shot.group].append(shot)
        made: list[tuple[Rendered, Shot]] = []
        for group, own in by_group.items():
            canonical = canonicals[group]
            lbs_weights = dense_weights(
                self.template.skin_indices, canonical.skin_weights, self.plan.kinematics.n_joints
            )
            covars = canonical.covars()
            relative = self._relative(own, corrections)
            means, posed = deform_each(canonical.means, covars, lbs_weights, relative)
            for number, shot in enumerate(own):
                camera, tone = shot.camera, None
                if corrections is not None and shot.row >= 0:
                    row = torch.tensor([shot.row])
                    viewmats = corrections.viewmats(row, camera.viewmats)
                    camera = Cameras(viewmats, camera.Ks, camera.width, camera.height, camera.camera_model)
                    tone = corrections.tones(row)
                rendered = render(means[number], posed[number], canonical.opacities, canonical.colors, camera)
                made.append((at_target_resolution(rendered, shot.factor, tone), shot))
        return made

    def _relative(self, shots: Sequence[Shot], corrections: Corrections | None) -> Tensor:
        if corrections is None or all(shot.row < 0 for shot in shots):
            return torch.stack([shot.relative for shot in shots])
        rows = torch.tensor([shot.row for shot in shots])
        turned = corrections.rotations(rows, torch.stack([shot.rotations for shot in shots]))
        return self.plan.kinematics.relative(turned, torch.stack([shot.transl for shot in shots]))

    def _head(self, canonical: Canonical, generator: torch.Generator) -> Tensor:
        """Equation 8 on the drawn face views: head Gaussians alone, moved by the expression."""
        faces = self.faces
        total = canonical.means.new_zeros(())
        if faces is None:
            return total
        head = self.template.head
        skin = dense_weights(
            self.template.skin_indices[head], canonical.skin_weights[head], self.plan.kinematics.n_joints
        )
        covars = canonical.covars()[head]
        chosen = torch.randperm(len(faces), generator=generator)[: self.config.faces_per_step].tolist()
        for view in chosen:
            means, posed = deform(canonical.means[head] + self.moved[view], covars, skin, faces.relative[view])
            rendered = render(means, posed, canonical.opacities[head], canonical.colors[head], faces.cameras[view])
            weight = faces.weights[view][None]
            area = (weight * faces.alphas[view]).sum()
            gradient = self.config.weights.gradient
            loss = photometric(rendered.images[0], faces.images[view], weight, gradient, area)
            alpha = masked_l1(rendered.alphas[0], faces.alphas[view][None], weight, area)
            total = total + faces.shares[view] * (loss + self.config.weights.alpha * alpha) / len(chosen)
        return total

    def _perceptual(self, pictures: Sequence[tuple[Rendered, Shot]], generator: torch.Generator) -> Tensor:
        """L_per on one patch of one picture; what has no weight shows the target on both sides."""
        zero = pictures[0][0].images.new_zeros(()) if pictures else torch.zeros(())
        if self.perceptual is None or not pictures:
            return zero
        rendered, shot = pictures[self._pick(range(len(pictures)), generator)]
        side = self.config.patch
        return patch_distance(self.perceptual, rendered.images[0], shot.target, shot.weight, side, generator)

    @staticmethod
    def _pick(options: Sequence[int], generator: torch.Generator) -> int:
        return options[int(torch.randint(len(options), (1,), generator=generator))]
