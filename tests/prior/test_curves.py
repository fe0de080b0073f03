"""What accuracy costs: every row is there, budgets are calls of the model, and a look on the way changes nothing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from ahoy_core.prior.clips import Clips, load_clips
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.config import IdentityConfig, InversionConfig
from ahoy_core.prior.evaluate import held_out, inverted, repaired
from ahoy_core.prior.identity import has_identity, train_identity
from ahoy_core.prior.identity_curve import Subject, corpus_subjects, generated, identity_curve, likeness, mean_rows
from ahoy_core.prior.round_trip import round_trips
from ahoy_core.prior.scores import NO_PERCEPTUAL, colour_distance, perceptual_distance
from ahoy_core.prior.solver_curve import solver_curve
from ahoy_core.prior.solvers import EVALUATIONS, Solver, SolverError
from ahoy_core.prior.text import IDENTITY_PROMPT
from ahoy_core.prior.video import VideoModel
from tests.prior.test_completion import clips
from tests.prior.test_training import CLIPS, write_shard

SOLVERS: tuple[Solver, ...] = tuple(EVALUATIONS)
BUDGETS = (4, 9)


class Counting:
    """A video model that counts how often its field is asked."""

    def __init__(self, video: VideoModel) -> None:
        self._video, self.calls = video, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._video, name)

    def velocity(self, latents: torch.Tensor, tau: float | torch.Tensor, context: Context) -> torch.Tensor:
        self.calls += 1
        return self._video.velocity(latents, tau, context)


class Grey:
    """A perceptual network: the mean difference."""

    name = "mean difference"

    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a - b).abs().mean((1, 2, 3))


def test_every_solver_and_budget_has_a_row_and_its_evaluations_are_calls_of_the_model(embedded: VideoModel) -> None:
    counting = Counting(embedded)
    rows = solver_curve(counting, clips(), BUDGETS, SOLVERS)
    assert [(row["solver"], row["evaluations"]) for row in rows] == [(s, b) for s in SOLVERS for b in BUDGETS]
    assert sum(row["evaluations_used"] for row in rows) == counting.calls
    for row in rows:
        assert row["evaluations_used"] <= 2 * row["evaluations"] and row["cpu_seconds"] > 0
        assert {"unobserved", "observed", "gradient", "colour torso", "colour legs"} <= set(row)
        assert math.isfinite(row["unobserved"])
    trips = round_trips(embedded, clips(), BUDGETS, SOLVERS, reference_steps=8).rows
    assert len(trips) == len(rows) and all(row["evaluations_used"] <= row["evaluations"] for row in trips)
    assert all({"round_trip", "z1_error", "cross_field", "cpu_seconds"} <= set(row) for row in trips)


def test_a_solver_that_fails_is_a_row_with_its_reason(embedded: VideoModel) -> None:
    class Broken(Counting):
        def velocity(self, latents: torch.Tensor, tau: float | torch.Tensor, context: Context) -> torch.Tensor:
            return super().velocity(latents, tau, context) * (math.nan if self.calls > 6 else 1.0)

    rows = solver_curve(Broken(embedded), clips(), (4,), ("euler", "midpoint"))
    assert "expected finite velocities" in rows[1]["failed"] and "unobserved" not in rows[1]
    with pytest.raises(SolverError):
        repaired(Broken(embedded), clips(), {"made": inverted(Broken(embedded), InversionConfig(steps=8))})


class Turning(Counting):
    """A smooth field, as an untrained network's is not: its words for a time turn a thousand times on the way."""

    def velocity(self, latents: torch.Tensor, tau: float | torch.Tensor, context: Context) -> torch.Tensor:
        return torch.full_like(latents, math.pi * math.cos(math.pi * float(tau))) + 0.5 * latents


def test_the_reference_is_converged_and_says_how_far(embedded: VideoModel) -> None:
    coarse, fine = (round_trips(Turning(embedded), clips(), (4,), ("euler",), steps) for steps in (2, 32))
    # Doubling the steps of a fourth-order method changes a sixteenth as much each time; float32 ends it at 1e-6.
    assert fine.reference.change < 1e-3 * coarse.reference.change
    assert fine.reference.change < 1e-4 * fine.rows[0]["z1_error"]
    assert fine.reference.steps == 32


def test_the_colour_distance_is_that_of_the_means_and_knows_light_from_colour() -> None:
    truth = torch.rand(2, 3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    weight = torch.ones(2, 3, 1, 8, 8)
    assert torch.equal(colour_distance(truth, truth, weight), torch.zeros(2))
    moved = truth + torch.tensor([0.1, 0.0, 0.0])[:, None, None]
    torch.testing.assert_close(colour_distance(moved, truth, weight), torch.full((2,), 0.1), rtol=1e-4, atol=0)
    darker = 0.5 * truth
    assert float(colour_distance(darker, truth, weight).min()) > 0.3
    assert float(colour_distance(darker, truth, weight, light_apart=True).max()) < 1e-6
    assert float(colour_distance(moved, truth, weight, light_apart=True).min()) > 0.02
    assert bool(colour_distance(truth, truth, 0 * weight).isnan().all())


def test_perception_counts_inside_its_weights_alone() -> None:
    truth = torch.zeros(2, 3, 8, 8)
    made, weight = truth.clone(), torch.zeros(2, 1, 8, 8)
    made[..., :4], weight[0, ..., 4:] = 1.0, 1
    distance = perceptual_distance(Grey(), made, truth, weight)
    assert float(distance[0]) == 0 and math.isnan(float(distance[1]))
    weight[0] = 1
    assert float(perceptual_distance(Grey(), made, truth, weight)[0]) == pytest.approx(0.5)


def test_without_a_perceptual_network_the_figures_say_so(embedded: VideoModel, tmp_path: Path) -> None:
    write_shard(tmp_path / "people-00000.safetensors", 0)
    without = held_out(embedded, tmp_path, 1)["people"]
    assert without["perceptual"] == NO_PERCEPTUAL
    assert not any(name.endswith("perceptual") for name in without["repaired"])
    figures = repaired(embedded, clips(), {}, Grey())
    assert figures["coarse/perceptual"] > 0 and figures["coarse/colour torso"] > 0.3


def test_backs_that_no_front_tells_of_are_not_asked_for(tmp_path: Path) -> None:
    write_shard(tmp_path / "people-00000.safetensors", 0)
    turns, everyone = (load_clips(tmp_path / "people-00000.safetensors", CLIPS, turning) for turning in (True, False))
    assert len(everyone) == CLIPS and torch.equal(turns.frames, everyone.frames[::2])


def subject(made: Clips) -> Subject:
    return corpus_subjects(made, "people")[0]


def test_a_clip_s_back_views_are_held_back() -> None:
    person = subject(clips())
    assert person.held_back.tolist() == [False, True] and len(person.seen.images) == 1
    assert likeness(person.views.images, person)["colour_distance/torso"] == 0
    assert likeness(person.views.images, person)["psnr_held_back"] > 90
    grey = torch.full_like(person.views.images, 0.5)
    assert likeness(grey, person)["colour_distance/torso"] == pytest.approx(math.hypot(0.3, 0.4, 0.4), rel=1e-4)


def test_a_look_on_the_way_sees_what_a_shorter_training_makes(embedded: VideoModel) -> None:
    person, base = subject(clips()), IdentityConfig(batch=2)
    rows = identity_curve(embedded, person, (2, 3), (3, 6), base)
    assert [(row["rank"], row["steps"]) for row in rows] == [(0, 0), (2, 3), (2, 6), (3, 3), (3, 6)]
    assert not has_identity(embedded), "the model was not given back as it was"
    assert rows[0]["cpu_seconds"] == 0 < rows[1]["cpu_seconds"] < rows[2]["cpu_seconds"]
    losses = train_identity(embedded, person.seen, base.model_copy(update={"rank": 2, "steps": 3})).losses
    again = likeness(generated(embedded, person.views, IDENTITY_PROMPT), person)
    assert {name: rows[1][name] for name in again} == again
    assert rows[1]["loss"] == float(losses.mean())


def test_means_over_subjects_are_by_rank_and_steps() -> None:
    rows = [{"subject": s, "rank": 2, "steps": n, "loss": float(n + k)} for k, s in enumerate("ab") for n in (1, 5)]
    assert mean_rows(rows) == [
        {"rank": 2, "steps": 1, "subjects": 2, "loss": 1.5},
        {"rank": 2, "steps": 5, "subjects": 2, "loss": 5.5},
    ]
