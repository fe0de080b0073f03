"""Trains the corrector of landmarks on rendered people: first `read`, then `train`.

    python -m benchmarks.rendered_people samples S1.npz --assets MAKEHUMAN --count 900 --seed 11
    python -m benchmarks.train_corrector read R1.npz S1.npz          # what the landmark network says of each picture
    python -m benchmarks.train_corrector train OUT.safetensors R1.npz R2.npz --json LOG

The last tenth of every file, other people than the rest, is held out: for the figures and the spreads' calibration.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor

from ahoy_core.perceive.corrector import (
    FEATURE_LIMIT,
    Corrector,
    Frame,
    N,
    features,
    mirrored,
    predict,
    weak_perspective,
)
from ahoy_core.perceive.detection import detect
from ahoy_core.perceive.landmarks import MIN_SCORE, read_crop
from ahoy_core.perceive.networks import Networks
from tasks.roles import landmark_networks

HELD_OUT = 0.1
STEPS, BATCH, RATE, DECAY, DROPOUT = 1500, 128, 1e-3, 0.1, 0.2
FOLDS = 5
RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0)  # of the variance of a normalised feature
LOG_SPREAD = 3.0  # that `Corrector.forward` takes off
NOISE = 0.006  # metres added to what the network reads


def read(out: Path, samples: Path, networks: Networks) -> None:
    """Write what the landmark network says of every picture, beside the truth in the camera's axes."""
    data = np.load(samples)
    ends = np.cumsum(data["jpeg_sizes"])
    rows: dict[str, list[NDArray[Any]]] = {
        name: [] for name in ("rays", "world", "visibility", "true_rays", "true_world", "up")
    }
    for i, end in enumerate(ends):
        raw = data["jpeg"][end - data["jpeg_sizes"][i] : end]
        image = np.ascontiguousarray(cv2.imdecode(raw, cv2.IMREAD_COLOR)[..., ::-1])
        answer = _read_like_a_clip(networks, image)
        if answer is None:
            continue
        points, world, visibility = answer
        K, view = data["K"][i], data["viewmat"][i]
        truth = data["landmarks"][i].astype(np.float64) @ view[:3, :3].T + view[:3, 3]
        focal = np.array([K[0, 0], K[1, 1]])
        rows["rays"].append((points - K[:2, 2]) / focal)
        rows["world"].append(world)
        rows["visibility"].append(visibility)
        rows["true_rays"].append(truth[:, :2] / truth[:, 2:])
        rows["true_world"].append(truth - truth[23:25].mean(0))
        rows["up"].append(view[:3, 2])
    np.savez(out, **{name: np.stack(values).astype(np.float32) for name, values in rows.items()})
    print(f"{len(rows['up'])} of {len(ends)} pictures read", flush=True)


def _read_like_a_clip(networks: Networks, image: NDArray[np.uint8]) -> tuple[NDArray[Any], ...] | None:
    """Points, world and visibility as `run_landmarks` would give them amid a clip, mirrored pass included."""
    found = detect(networks, image)
    if not found:
        return None
    first = read_crop(networks, image, found[0].roi)
    if first.score < MIN_SCORE:
        return None
    both = [read_crop(networks, image, first.next_roi(), mirrored=m) for m in (False, True)]
    if min(reading.score for reading in both) < MIN_SCORE:
        return None
    weights = np.stack([r.visibility + 1e-3 for r in both])[..., None]
    weights /= weights.sum(0)
    points, world = ((weights * np.stack([getattr(r, name) for r in both])).sum(0)[:33] for name in ("points", "world"))
    return points[:, :2], world, np.mean([r.visibility for r in both], axis=0)[:33]


def train(out: Path, files: list[Path], log: Path | None, steps: int, seed: int = 0) -> None:
    """Train on most people, report on the others, write the weights.

    The straight part is a ridge regression, its spreads one of the logarithms of what it misses in people left out; the
    bent part is trained on top and kept if it says more about the held-out people.
    """
    torch.manual_seed(seed)
    parts = [{k: torch.from_numpy(v) for k, v in np.load(path).items()} for path in files]
    cut = [int(len(part["up"]) * (1 - HELD_OUT)) for part in parts]
    known = _prepared({k: torch.cat([part[k][:n] for part, n in zip(parts, cut, strict=True)]) for k in parts[0]})
    fresh = _prepared({k: torch.cat([part[k][n:] for part, n in zip(parts, cut, strict=True)]) for k in parts[0]})
    network = Corrector(DROPOUT)
    read_by = features(known["points"], known["world"], known["visibility"], known["frame"], known["up"])
    network.mean.copy_(read_by.mean(0))
    network.spread.copy_(read_by.std(0).clamp_min(1e-3))
    for layer in (network.straight, network.bent[-1]):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    lines = [{"pictures": len(known["up"]), "held_out": len(fresh["up"]), "ridge": _straight(network, known, fresh)}]
    lines[-1] |= {"stage": "straight", "nll": _likelihood(network, fresh), **_report(network, fresh)}
    print(json.dumps(lines[-1]), flush=True)
    kept = "straight"
    if steps > 0:
        straight = {name: value.clone() for name, value in network.state_dict().items()}
        _bend(network, known, steps)
        lines.append({"stage": "bent", "nll": _likelihood(network, fresh), **_report(network, fresh)})
        print(json.dumps(lines[-1]), flush=True)
        kept = "bent" if lines[1]["nll"] <= lines[0]["nll"] else "straight"
        if kept == "straight":
            network.load_state_dict(straight)
    _calibrate(network, fresh)
    lines.append({"kept": kept, "scales": network.calibration.exp().tolist()})
    print(json.dumps(lines[-1]), flush=True)
    save_file({name: value.half().contiguous() for name, value in network.state_dict().items()}, str(out))
    if log:
        log.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def _straight(network: Corrector, known: dict[str, Any], fresh: dict[str, Any]) -> float:
    """Fill the straight part; returns the ridge that was best on held-out people."""
    inputs, targets = _both_ways(network, known)
    groups = torch.arange(len(known["up"])).repeat(len(inputs) // len(known["up"])) * FOLDS // len(known["up"])
    n2 = 2 * N
    best, kept = float("inf"), RIDGES[0]
    for ridge in RIDGES:
        missed = torch.zeros_like(targets)
        for fold in range(FOLDS):
            rest = groups != fold
            missed[~rest] = targets[~rest] - _apply(_ridge(inputs[rest], targets[rest], ridge), inputs[~rest])
        distances = torch.cat(
            [missed[:, :n2].unflatten(1, (N, 2)).norm(dim=-1), missed[:, n2:].unflatten(1, (N, 3)).norm(dim=-1)], 1
        )
        if float(distances.mean()) < best:
            best, kept, logs = float(distances.mean()), ridge, distances.clamp_min(1e-3).log()
    weights, bias = _ridge(inputs, targets, kept)
    # Interleaved as `Corrector.forward` splits them; a Laplace scale is about the mean distance over the dimensions.
    spreads = torch.stack([logs[:, :N] - math.log(2.0), logs[:, N:] - math.log(3.0)], dim=-1).flatten(1) + LOG_SPREAD
    spread_weights, spread_bias = _ridge(inputs, spreads, 10 * kept)
    network.straight.weight.data.copy_(torch.cat([weights, spread_weights], 1).T)
    network.straight.bias.data.copy_(torch.cat([bias, spread_bias]))
    return kept


def _both_ways(network: Corrector, data: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Normalised inputs and targets of every picture: as it is and mirrored, with and without the upward direction."""
    inputs, targets = [], []
    for flip in (False, True):
        points, world, seen, up, frame = (data[k] for k in ("points", "world", "visibility", "up", "frame"))
        to_points, to_world = data["to_points"], data["to_world"]
        if flip:
            to_points, to_world, _ = mirrored(to_points, to_world, seen)
            points, world, seen = mirrored(points, world, seen)
            up = up * torch.tensor([-1.0, 1.0, 1.0])
            frame = Frame(frame.centre * torch.tensor([-1.0, 1.0]), frame.scale)
        for sky in (up, torch.zeros_like(up)):
            inputs.append(features(points, world, seen, frame, sky))
            targets.append(torch.cat([to_points.flatten(1), to_world.flatten(1)], dim=1))
    x = (torch.cat(inputs) - network.mean) / network.spread
    return x.clamp(-FEATURE_LIMIT, FEATURE_LIMIT).double(), torch.cat(targets).double()


def _ridge(inputs: Tensor, targets: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    middle, mean = inputs.mean(0), targets.mean(0)
    centred = inputs - middle
    square = centred.T @ centred + ridge * len(inputs) * torch.eye(inputs.shape[1]).double()
    weights = torch.linalg.solve(square, centred.T @ (targets - mean))
    return weights, mean - middle @ weights


def _apply(solution: tuple[Tensor, Tensor], inputs: Tensor) -> Tensor:
    return inputs @ solution[0] + solution[1]


def _bend(network: Corrector, known: dict[str, Any], steps: int) -> None:
    """Train the bent part, the straight one held."""
    network.train()
    optimiser = torch.optim.AdamW(network.bent.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, max(steps, 1))
    for _ in range(steps):
        batch = _augmented(known, torch.randint(len(known["up"]), (BATCH,)))
        loss = _nll(network(batch["features"]), batch["to_points"], batch["to_world"])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def _likelihood(network: Corrector, data: dict[str, Any]) -> float:
    """Mean negative log-likelihood of the held-out people, the upward direction unknown."""
    network.eval()
    with torch.no_grad():
        up = torch.zeros_like(data["up"])
        answer = predict(network, data["points"], data["world"], data["visibility"], data["frame"], up)
    return float(_nll(answer, data["to_points"], data["to_world"]))


def _nll(answer: tuple[Tensor, Tensor, Tensor], to_points: Tensor, to_world: Tensor) -> Tensor:
    moved, lifted, spreads = answer
    return _loss(moved - to_points, spreads[..., 0], 2) + _loss(lifted - to_world, spreads[..., 1], 3)


def _prepared(rows: dict[str, Tensor]) -> dict[str, Any]:
    """Metres, and where they should have been."""
    frame = weak_perspective(rows["rays"], rows["world"], rows["visibility"])
    points = frame.to_metres(rows["rays"])
    return {
        "frame": frame, "points": points, "world": rows["world"], "visibility": rows["visibility"], "up": rows["up"],
        "to_points": frame.to_metres(rows["true_rays"]) - points, "to_world": rows["true_world"] - rows["world"],
    }  # fmt: skip


def _augmented(data: dict[str, Any], rows: Tensor) -> dict[str, Tensor]:
    """A batch: half of it mirrored, half of it without the upward direction, all of it a little noisy."""
    points, world, visibility, up = (data[name][rows] for name in ("points", "world", "visibility", "up"))
    frame = Frame(data["frame"].centre[rows], data["frame"].scale[rows])
    to_points, to_world = data["to_points"][rows], data["to_world"][rows]
    if torch.rand(()) < 0.5:
        points, world, visibility = mirrored(points, world, visibility)
        to_points, to_world, _ = mirrored(to_points, to_world, visibility)
        up = up * torch.tensor([-1.0, 1.0, 1.0])
        frame = Frame(frame.centre * torch.tensor([-1.0, 1.0]), frame.scale)
    up = up * (torch.rand(len(rows), 1) < 0.5)
    noise = NOISE * torch.randn_like(points)
    shift = NOISE * torch.randn_like(world)
    read_by = features(points + noise, world + shift, visibility, frame, up)
    return {"features": read_by, "to_points": to_points - noise, "to_world": to_world - shift}


def _loss(error: Tensor, log_spread: Tensor, size: int) -> Tensor:
    """Laplace's negative log-likelihood of distances: a few wild ones do not rule."""
    log_spread = log_spread.clamp(-5.5, 1.0)
    return (size * log_spread + (error.square().sum(-1) + 1e-6).sqrt() / log_spread.exp()).mean()


def _report(network: Corrector, data: dict[str, Any]) -> dict[str, float]:
    """Mean distances in mm on the held-out people, before and after, likely seen and likely hidden apart."""
    network.eval()
    figures = {}
    seen = data["visibility"] > 0.9
    for name, up in (("", torch.zeros_like(data["up"])), ("_up", data["up"])):
        with torch.no_grad():
            moved, lifted, _ = predict(network, data["points"], data["world"], data["visibility"], data["frame"], up)
        for key, error in (("image", data["to_points"] - moved), ("world", data["to_world"] - lifted)):
            distance = error.norm(dim=-1) * 1000
            figures |= {
                f"{key}{name}_seen": float(distance[seen].mean()),
                f"{key}{name}_hidden": float(distance[~seen].mean()),
            }
    for key in ("image", "world"):
        distance = data[f"to_{'points' if key == 'image' else key}"].norm(dim=-1) * 1000
        figures |= {f"{key}_raw_seen": float(distance[seen].mean()), f"{key}_raw_hidden": float(distance[~seen].mean())}
    network.train()
    return {k: round(v, 1) for k, v in figures.items()}


def _calibrate(network: Corrector, data: dict[str, Any]) -> None:
    """Scale the spreads so that errors over spreads have the median that normal errors have, on held-out people."""
    network.eval()
    with torch.no_grad():
        moved, lifted, spreads = predict(
            network, data["points"], data["world"], data["visibility"], data["frame"], torch.zeros_like(data["up"])
        )
        for i, (error, median) in enumerate(((data["to_points"] - moved, 1.1774), (data["to_world"] - lifted, 1.5382))):
            ratio = (error.norm(dim=-1) / spreads[..., i].exp()).median() / median  # medians of Rayleigh and Maxwell
            network.calibration[i] = ratio.log()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("read", "train"))
    parser.add_argument("out", type=Path)
    parser.add_argument("inputs", type=Path, nargs="+")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--steps", type=int, default=STEPS, help="of training the bent part; 0: a straight map")
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)
    if arguments.what == "read":
        read(arguments.out, arguments.inputs[0], landmark_networks())
    else:
        train(arguments.out, arguments.inputs, arguments.json, arguments.steps)


if __name__ == "__main__":
    main()
