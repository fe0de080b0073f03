"""The loop every training here runs in: timed, resumable, with averaged weights and a row of figures now and then."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.prior.train.muon import Muon, split_parameters

Row = dict[str, float]


@dataclass
class TrainState:
    """A model in training.

    Attributes:
        model: what is trained.
        matrices: optimizer of its matrices.
        vectors: optimizer of the rest.
        average: exponential moving average of the weights, by name.
        step: updates done.
        seconds: CPU seconds spent on them, over all runs.
        seed: of this training; each step draws from (seed, step).
    """

    model: nn.Module
    matrices: Muon
    vectors: torch.optim.AdamW
    average: dict[str, Tensor] = field(default_factory=dict)
    step: int = 0
    seconds: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Schedule:
    """Learning rates and when to do what.

    Attributes:
        lr: of the matrices (Muon) and of the vectors (AdamW).
        warmup: steps.
        minutes: wall time of this run.
        cooldown: last share of this run in which the rate falls linearly to a twentieth.
        checkpoint_minutes: between checkpoints.
        log_steps: between rows.
        horizon: of the average, steps; shorter at the start.
    """

    lr: float = 2e-3
    warmup: int = 40
    minutes: float = 10.0
    cooldown: float = 0.0
    checkpoint_minutes: float = 3.0
    log_steps: int = 50
    horizon: float = 250.0


_SLOW: Final = 0.3


def new_state(
    model: nn.Module, seed: int, plain: tuple[str, ...] = (), slow: Callable[[str], bool] = lambda _: False
) -> TrainState:
    """A fresh state.

    Args:
        model: to train.
        seed: of the training.
        plain: names containing one of these are trained by AdamW even if they are matrices.
        slow: which names learn at `_SLOW` of the rate.
    """
    matrices, vectors = split_parameters(model, plain)
    names = {id(parameter): name for name, parameter in model.named_parameters()}

    def groups(parameters: list[nn.Parameter]) -> list[dict[str, Any]]:
        held_back = [p for p in parameters if slow(names[id(p)])]
        rest = [p for p in parameters if not slow(names[id(p)])]
        return [{"params": part, "share": share} for part, share in ((rest, 1.0), (held_back, _SLOW)) if part]

    average = {name: value.detach().clone() for name, value in model.state_dict().items()}
    return TrainState(
        model,
        Muon(groups(matrices), 1e-3),
        torch.optim.AdamW(groups(vectors), 1e-3, betas=(0.9, 0.97), weight_decay=0.0),
        average,
        seed=seed,
    )


def run(
    state: TrainState,
    schedule: Schedule,
    loss: Callable[[int], tuple[Tensor, Row]],
    checkpoint: Path,
    on_row: Callable[[Row], None],
    evaluate: Callable[[], Row] | None = None,
) -> None:
    """Trains until the time is up.

    Args:
        state: is changed.
        schedule: rates and times.
        loss: step number -> loss of one batch and figures to average into the next row.
        checkpoint: file; written atomically.
        on_row: gets a row every `log_steps` steps.
        evaluate: more figures for a row, taken with every checkpoint (under the averaged weights).
    """
    start = saved = time.monotonic()
    total = 60 * schedule.minutes
    figures: dict[str, list[float]] = {}
    clock = time.process_time()
    for elapsed in _until(start, total):
        _set_rate(state, schedule, elapsed / total)
        value, extra = loss(state.step)
        _update(state, value, schedule)
        for name, number in {"loss": float(value.detach()), **extra}.items():
            figures.setdefault(name, []).append(number)
        now = time.process_time()
        state.seconds, clock = state.seconds + now - clock, now
        if state.step % schedule.log_steps == 0:
            row = {name: sum(values) / len(values) for name, values in figures.items()}
            figures.clear()
            if evaluate is not None and time.monotonic() - saved > 60 * schedule.checkpoint_minutes:
                save_state(state, checkpoint)
                saved = time.monotonic()
                with averaged(state):
                    row |= evaluate()
            on_row({"step": state.step, "cpu_seconds": state.seconds, "wall_seconds": time.monotonic() - start, **row})
            clock = time.process_time()
    save_state(state, checkpoint)


def _until(start: float, total: float) -> Iterator[float]:
    while (elapsed := time.monotonic() - start) < total:
        yield elapsed


def _set_rate(state: TrainState, schedule: Schedule, share: float) -> None:
    rate = schedule.lr * min(1.0, (state.step + 1) / schedule.warmup)
    if schedule.cooldown > 0 and share > 1 - schedule.cooldown:
        rate *= max(0.05, (1 - share) / schedule.cooldown)
    for optimizer in (state.matrices, state.vectors):
        for group in optimizer.param_groups:
            group["lr"] = rate * group["share"]


def _update(state: TrainState, value: Tensor, schedule: Schedule) -> None:
    if not bool(torch.isfinite(value)):
        raise FloatingPointError(
            f"expected a finite loss, got {float(value)} at step {state.step}; resume with a lower rate"
        )
    for optimizer in (state.matrices, state.vectors):
        optimizer.zero_grad(set_to_none=True)
    value.backward()
    nn.utils.clip_grad_norm_([p for p in state.model.parameters() if p.grad is not None], 1.0)
    state.matrices.step()
    state.vectors.step()
    state.step += 1
    keep = min(1 - 1 / schedule.horizon, (1 + state.step) / (10 + state.step))
    with torch.no_grad():
        for name, current in state.model.state_dict().items():
            state.average[name].lerp_(current, 1 - keep)


class averaged:  # noqa: N801 - a context manager, named like a function
    """Within the block the model has the averaged weights, in evaluation mode."""

    def __init__(self, state: TrainState) -> None:
        self.state = state

    def __enter__(self) -> nn.Module:
        self._own = {name: value.clone() for name, value in self.state.model.state_dict().items()}
        self.state.model.load_state_dict(self.state.average)
        return self.state.model.eval()

    def __exit__(self, *_: object) -> None:
        self.state.model.load_state_dict(self._own)
        self.state.model.train()


def save_state(state: TrainState, path: Path) -> None:
    """Writes weights, average and optimizer states to one safetensors file, atomically."""
    tensors: dict[str, Tensor] = {}
    tensors |= {f"model.{name}": value for name, value in state.model.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in state.average.items()}
    for label, optimizer in (("matrices", state.matrices), ("vectors", state.vectors)):
        for index, entry in optimizer.state_dict()["state"].items():
            tensors |= {f"{label}.{index}.{key}": value for key, value in entry.items()}
    meta = {"step": state.step, "seconds": state.seconds, "seed": state.seed}
    with atomic_path(path) as temporary:
        save_file(
            {key: value.clone().contiguous() for key, value in tensors.items()}, temporary, {"ahoy": json.dumps(meta)}
        )


def load_state(state: TrainState, path: Path) -> None:
    """Puts a checkpoint into a fresh state of the same model.

    Raises:
        ValueError: when the checkpoint is of another model.
    """
    with safe_open(path, "pt") as handle:
        meta = json.loads(handle.metadata()["ahoy"])
        tensors = {key: handle.get_tensor(key) for key in handle.keys()}  # noqa: SIM118 - not a dict
    weights = _under(tensors, "model.")
    expected = set(state.model.state_dict())
    if set(weights) != expected:
        raise ValueError(
            f"expected the weights of this model, got {sorted(set(weights) ^ expected)[:3]}...; check the file"
        )
    state.model.load_state_dict(weights)
    state.average = {name: value.clone() for name, value in _under(tensors, "average.").items()}
    for label, optimizer in (("matrices", state.matrices), ("vectors", state.vectors)):
        entries: dict[int, dict[str, Any]] = {}
        for key, value in _under(tensors, f"{label}.").items():
            index, name = key.split(".", 1)
            entries.setdefault(int(index), {})[name] = value
        optimizer.load_state_dict({"state": entries, "param_groups": optimizer.state_dict()["param_groups"]})
    state.step, state.seconds, state.seed = meta["step"], meta["seconds"], meta["seed"]


def _under(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
