"""The state of one training of the full avatar: what a step changes, what a checkpoint holds."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar, AvatarInfo, bake_full
from ahoy_core.avatar.checkpoint import State
from ahoy_core.avatar.corrections import Corrections, corrected_joints
from ahoy_core.avatar.deform import Canonical
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.full_inputs import FullInputs, Plan
from ahoy_core.avatar.full_model import FullModel
from ahoy_core.avatar.objective import Objective, Terms
from ahoy_core.avatar.pose_maps import PoseMaps
from ahoy_core.avatar.posing import PoseDependence
from ahoy_core.avatar.shots import Shot
from ahoy_core.metrics import input_view_pair, psnr, ssim
from ahoy_core.metrics.perceptual import Perceptual

T = TypeVar("T")

_NAN = float("nan")
_PREVIEW_SHOTS = 4


@dataclass(frozen=True)
class FullRow:
    """Terms of one step, weighted as they entered `total`; the last is NaN where it was not looked at."""

    step: int
    total: float
    body: float
    observed: float
    head: float
    perceptual: float
    regularisers: float
    corrections: float
    gradient_norm: float
    held_out_psnr: float


class Trainer:
    """Model, its moving average, corrections, optimiser and random numbers.

    Args:
        inputs: What is trained on.
        plan: Its shots.
        config: Sizes, rates, weights.
        perceptual: The perceptual role, or None.
    """

    def __init__(self, inputs: FullInputs, plan: Plan, config: FullConfig, perceptual: Perceptual | None) -> None:
        self.plan, self.config = plan, config
        self.generator = torch.Generator().manual_seed(config.seed)
        pose_maps = PoseMaps(inputs.template, plan.kinematics, config.map_reduction)
        self.model = FullModel(pose_maps, config.width, config.bounds, inputs.base, self.generator)
        self.corrections = Corrections(plan.registered, corrected_joints(inputs.observed.body), config.corrections)
        self.maps = pose_maps(plan.rotations)
        self.objective = Objective(inputs, plan, config, perceptual)
        self.rates = {"network": config.learning_rate, "base": config.base_rate, "corrections": config.correction_rate}
        self.optimizer = torch.optim.Adam(
            [
                {"params": list(self.model.network.parameters()), "name": "network"},
                {"params": [self.model.base], "name": "base"},
                {"params": list(self.corrections.parameters()), "name": "corrections"},
            ],
            betas=(0.9, 0.99),
        )
        self.average = _copy(self.model.state_dict())
        self.step, self.worse, self.skipped, self.stopped = 0, 0, 0, False
        self.rows: list[FullRow] = []
        self.notes: list[str] = []
        self.first_score = self.score()
        self.best = (self.first_score[0], _copy(self.average))

    def advance(self) -> None:
        """One step."""
        self.step += 1
        progress = self.step / self.config.steps
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate(group["name"], progress)
        shots = self._draw()
        groups = sorted({shot.group for shot in shots})
        canonicals, change = self.model(self.maps[groups])
        by_group = dict(zip(groups, canonicals, strict=True))
        terms = self.objective.terms(by_group, change, shots, self.corrections, self.generator)
        total = torch.stack(list(terms)).sum()
        self.optimizer.zero_grad()
        norm = _NAN
        if bool(torch.isfinite(total)):
            total.backward()
            norm = self._clip()
            if math.isfinite(norm):
                self.optimizer.step()
        if not math.isfinite(norm):
            self.skipped += 1
        self._average()
        self._row(total, terms, norm)

    def check(self) -> None:
        """Look at the held-out frame; remember the best network; stop when it keeps getting worse."""
        if self.plan.held_out is None:
            return
        score = self.score()[0]
        self.rows[-1] = replace(self.rows[-1], held_out_psnr=score)
        if score > self.best[0]:
            self.best = (score, _copy(self.average))
        self.worse = self.worse + 1 if score < self.best[0] - self.config.tolerance else 0
        if self.worse >= self.config.patience:
            self.stopped = True
            self.notes.append(f"stopped at step {self.step}: the held-out frame got worse in {self.worse} checks")

    def finish(self) -> None:
        """Leave the moving average in the model, or the best one where the last is clearly worse."""
        if self.plan.held_out is not None and self.score()[0] < self.best[0] - self.config.tolerance:
            self.average = _copy(self.best[1])
            self.notes.append(f"kept the network that scored {self.best[0]:.2f} dB on the held-out frame")
        self.model.load_state_dict(self.average)
        if self.skipped:
            self.notes.append(f"{self.skipped} steps left out: their loss or gradient was not finite")

    @torch.no_grad()
    def score(self) -> tuple[float, float]:
        """PSNR and SSIM of the held-out frame under the moving average; NaN without one."""
        if self.plan.held_out is None:
            return _NAN, _NAN
        shot = self.plan.held_out[1]
        image = self.objective.render_shots(self._averaged([shot]), [shot], None)[0][0].images[0]
        mask = shot.weight[0] / shot.weight.max().clamp(min=1e-6)
        pair = input_view_pair(image.clamp(0, 1), shot.target, mask)
        return psnr(*pair), ssim(*pair)

    @torch.no_grad()
    def picture(self) -> Tensor:
        """[3,H,W]: some targets above, the moving average's renders below."""
        pool = [shots[len(shots) // 2] for shots in [*self.plan.hallucinated, *self.plan.observed] if shots]
        chosen = pool[:: max(1, len(pool) // _PREVIEW_SHOTS)][:_PREVIEW_SHOTS]
        made = self.objective.render_shots(self._averaged(chosen), chosen, self.corrections)
        columns = [torch.cat([shot.target, rendered.images[0].clamp(0, 1)], 1) for rendered, shot in made]
        height = max(column.shape[1] for column in columns)
        padded = [torch.nn.functional.pad(c, (2, 2, 0, height - c.shape[1]), value=1.0) for c in columns]
        return torch.cat(padded, 2)

    def avatar(self, betas: Tensor, training_poses: Tensor, info: AvatarInfo) -> Avatar:
        """The avatar of the model as it is."""
        posing = PoseDependence(
            base=self.model.base.detach().clone(),
            map_rotations=self.plan.rotations,
            reduction=self.config.map_reduction,
            components=self.config.pose_components,
            strength=self.config.pose_strength,
        )
        return bake_full(self.model.maps, self.model.network, self.config.bounds, posing, betas, training_poses, info)

    def fingerprint(self) -> str:
        """Hash of what the state must fit: first weights, shots and map poses."""
        digest = hashlib.sha256()
        shots = [s for group in [*self.plan.hallucinated, *self.plan.observed] for s in group]
        for value in [self.model.base, self.plan.rotations, *(x for s in shots for x in (s.target, s.weight))]:
            digest.update(value.detach().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def state(self) -> State:
        """Everything that the next step depends on."""
        return {
            "step": self.step,
            "counts": [self.worse, self.skipped, int(self.stopped)],
            "model": self.model.state_dict(),
            "average": self.average,
            "best_score": self.best[0],
            "best": self.best[1],
            "corrections": self.corrections.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "rows": [list(astuple(row)) for row in self.rows],
            "notes": self.notes,
        }

    def load_state(self, state: State) -> None:
        """Go on where `state` was taken."""
        self.step = state["step"]
        self.worse, self.skipped = state["counts"][:2]
        self.stopped = bool(state["counts"][2])
        self.model.load_state_dict(state["model"])
        self.average, self.best = state["average"], (state["best_score"], state["best"])
        self.corrections.load_state_dict(state["corrections"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.rows = [FullRow(*row) for row in state["rows"]]
        self.notes = list(state["notes"])

    def _draw(self) -> list[Shot]:
        """Shots of some sequences, and observed ones of one map pose."""
        config, plan = self.config, self.plan
        shots: list[Shot] = []
        for sequence in self._choose(plan.hallucinated, config.sequences_per_step):
            shots += self._choose(sequence, config.shots_per_sequence)
        for cluster in self._choose(plan.observed, 1):
            shots += self._choose(cluster, config.frames_per_step)
        return shots

    def _choose(self, options: Sequence[T], count: int) -> list[T]:
        return [options[i] for i in torch.randperm(len(options), generator=self.generator)[:count].tolist()]

    def _rate(self, name: str, progress: float) -> float:
        """Warm-up, then half a cosine down to 5%; corrections wait until there is something to align to."""
        start = self.config.correct_from if name == "corrections" else 0.0
        if progress <= start or (name == "corrections" and not self.config.switches.corrections):
            return 0.0
        rise = min(1.0, (progress - start) / self.config.warm_up) if self.config.warm_up else 1.0
        return self.rates[name] * rise * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress)))

    def _clip(self) -> float:
        """Clip each parameter group's gradient; returns the norm over all of them, before clipping."""
        norms = [
            torch.nn.utils.clip_grad_norm_(group["params"], self.config.clip_norm)
            for group in self.optimizer.param_groups
        ]
        return float(torch.stack(norms).norm())

    @torch.no_grad()
    def _average(self) -> None:
        # The average starts short, or the first steps would still weigh at the end of a short training.
        decay = min(self.config.ema, self.step / (self.step + 9))
        for name, value in self.model.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def _averaged(self, shots: Sequence[Shot]) -> dict[int, Canonical]:
        """Gaussians of the moving average for the map poses of shots."""
        groups = sorted({shot.group for shot in shots})
        canonicals, _ = torch.func.functional_call(self.model, self.average, (self.maps[groups],))
        return dict(zip(groups, canonicals, strict=True))

    def _row(self, total: Tensor, terms: Terms, norm: float) -> None:
        values = {name: float(term.detach()) for name, term in terms._asdict().items()}
        row = FullRow(step=self.step, total=float(total.detach()), **values, gradient_norm=norm, held_out_psnr=_NAN)
        self.rows.append(row)


def _copy(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in state.items()}
