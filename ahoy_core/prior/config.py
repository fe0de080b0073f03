"""The prior's knobs. They stand apart from what reads them, so that settings do not import a diffusion library."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ahoy_core.prior.solvers import Solver


class IdentityConfig(BaseModel):
    """Knobs of the fine-tuning. Rank and steps cite their row: docs/prior.md, "Rank and steps".

    Attributes:
        rank: of the low-rank updates.
        steps: of the optimizer.
        batch: frames a step.
        lr: of the low-rank updates.
        token_lr: of the learned word.
        pure_noise: share of the flow times that are 1 exactly, where the colours of a garment are decided.
        mirror: learn from each frame's mirror image too, for sides that the video never shows.
        seed: of the frames, noise and times drawn.
    """

    model_config = ConfigDict(frozen=True)

    rank: int = Field(4, ge=1)
    steps: int = Field(80, ge=1)
    batch: int = Field(8, ge=1)
    lr: float = Field(4e-3, gt=0)
    token_lr: float = Field(1e-2, gt=0)
    pure_noise: float = Field(0.3, ge=0, le=1)
    mirror: bool = True
    seed: int = 0


class InversionConfig(BaseModel):
    """Knobs of RF-inversion.

    Attributes:
        mode: "steered" goes forward under the neutral prior without the identity adapter, so that only pose and
            silhouette are encoded, and back with it; "paper" reads equation 4 to the letter: the adapted field both
            ways, all the way to noise, nothing held.
        solver: see `solvers`. By docs/prior.md, "Solvers", pictures are the same from any of second order from
            16 evaluations both ways on; this is the closest of the cheapest.
        steps: each way.
        tau_max: flow time at which the forward pass stops; 1 is pure noise.
        gamma: pull of the forward pass towards drawn noise, 0 (none) to 1 (nothing but it, as SDEdit does).
        eta: pull of the way back towards the coarse latents, 0 to 1.
        eta_start: share of the way back, from noise, after which the pull begins.
        eta_stop: share after which it ends.
    """

    model_config = ConfigDict(frozen=True)

    mode: Literal["steered", "paper"] = "steered"
    solver: Solver = "fireflow"
    steps: int = Field(7, ge=1)
    tau_max: float = Field(0.8, gt=0, le=1)
    gamma: float = Field(0.5, ge=0, le=1)
    eta: float = Field(0.0, ge=0, le=1)
    eta_start: float = Field(0.0, ge=0, le=1)
    eta_stop: float = Field(0.3, ge=0, le=1)

    @model_validator(mode="after")
    def _window(self) -> InversionConfig:
        if self.eta_start > self.eta_stop:
            raise ValueError(f"expected eta_start <= eta_stop, got {self.eta_start} > {self.eta_stop}")
        if self.mode == "paper" and (self.tau_max, self.gamma, self.eta) != (1.0, 0.0, 0.0):
            raise ValueError("expected tau_max 1, gamma 0 and eta 0 in paper mode, which knows no controller")
        return self


class PriorConfig(BaseModel):
    """How the prior is asked.

    Attributes:
        method: "clean-up" reads the coarse latents as input; "inversion" goes through noise and back.
        steps: of the clean-up; 1 is the posterior mean.
        inversion: knobs of the other method.
        hold: keep latents whose surface was well observed.
        seed: of the noise.
    """

    model_config = ConfigDict(frozen=True)

    method: Literal["clean-up", "inversion"] = "clean-up"
    steps: int = Field(1, ge=1)
    inversion: InversionConfig = InversionConfig()
    hold: bool = True
    seed: int = 0
