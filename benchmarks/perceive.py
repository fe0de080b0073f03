"""What perception finds on captures whose truth is known: `python -m benchmarks.perceive CAPTURES_DIR --json OUT`.

One JSON line per capture. Joints are the captures' 24, found on our body by the bone that each one is; errors are in
the camera's axes. Hidden joints are those whose place is not on the visible part of the person (`vis/`), with two
pixels of slack. The capture's own camera is given to the method.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.cost import Meter
from ahoy_core.perceive.networks import REQUIRED, Networks
from ahoy_core.perceive.perceive import PerceiveConfig, Perception, perceive
from tasks.model_files import model_path

FPS = 15.0
SLACK = np.ones((5, 5), np.uint8)


def alpha(path: Path) -> NDArray[np.bool_]:
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    return np.asarray((image if image.ndim == 2 else image[..., -1]) > 127)


def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def aligned_errors(ours: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Distances [T,J] after the best similarity of each frame, same unit as the input [T,J,3]."""
    errors = []
    for a, b in zip(ours.astype(np.float64), truth.astype(np.float64), strict=True):
        a, b = a - a.mean(0), b - b.mean(0)
        u, s, vt = np.linalg.svd(a.T @ b)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        errors.append(np.linalg.norm((s * sign).sum() / (a**2).sum() * a @ ((u * sign) @ vt) - b, axis=1))
    return np.stack(errors)


def jitter(joints: NDArray[np.floating]) -> float:
    """Mean acceleration in m/s^2 of joints [T,J,3]."""
    return float(np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1).mean() * FPS**2)


def our_joints(body: PackagedBody, found: Perception, motion: Any) -> NDArray[np.float64]:
    """The captures' 24 joints [T,24,3] on our body, in the camera's axes."""
    heads = motion["bone_heads_world"][0]
    nearest = np.linalg.norm(motion["joints24"][0][:, None] - heads[None], axis=-1).argmin(1)
    rows = [body.joint_names.index(str(motion["bone_names"][i])) for i in nearest]
    pose, betas, transl = (torch.from_numpy(x) for x in (found.pose, found.betas, found.transl))
    with torch.no_grad():
        joints = torch.cat([body(pose[t, None], betas[None], transl[t, None]).joints for t in range(len(pose))])
    return np.asarray(joints[:, rows].double().numpy() @ found.viewmat[:3, :3].T.astype(np.float64))


def measure(capture: Path, body: PackagedBody, networks: Networks, config: PerceiveConfig) -> dict[str, Any]:
    with av.open(str(capture / "front.mp4")) as container:
        frames: NDArray[np.uint8] = np.stack(
            [frame.to_ndarray(format="rgb24").astype(np.uint8) for frame in container.decode(video=0)]
        )
    n = len(frames)
    camera = json.loads((capture / "cameras.json").read_text(encoding="utf-8"))["cameras"]["front"]
    K = np.array(camera["K"])
    with Meter() as meter:
        found = perceive(frames, np.arange(n) / FPS, np.zeros(n, np.int32), K, body, networks, config)
    bill = meter.read()
    motion = np.load(capture / "motion.npz")
    truth = motion["joints24"][:n] @ np.array(camera["R"]).T + np.array(camera["t"])
    ours = our_joints(body, found, motion)
    seen = [alpha(capture / "vis" / f"{t:03d}.png") for t in range(n)]
    whole = {t: alpha(path) for t in range(n) if (path := capture / "amodal" / f"{t:03d}.png").exists()}
    visible = _visible(truth, K, seen)
    errors = aligned_errors(ours, truth) * 1000
    placed = np.linalg.norm(ours - truth, axis=-1) * 1000
    centred = np.linalg.norm((ours - ours[:, :1]) - (truth - truth[:, :1]), axis=-1) * 1000
    return {
        "capture": capture.name,
        "mpjpe_mm": round(float(centred.mean()), 1),
        "pa_mpjpe_mm": round(float(errors.mean()), 1),
        "pa_mpjpe_visible_mm": round(float(errors[visible].mean()), 1),
        "pa_mpjpe_hidden_mm": round(float(errors[~visible].mean()), 1),
        "mask_iou": round(float(np.mean([overlap(found.visible[t] > 127, seen[t]) for t in range(n)])), 4),
        "amodal_iou": round(float(np.mean([overlap(found.amodal[t] > 127, whole[t]) for t in whole])), 4),
        "amodal_joined_iou": round(
            float(np.mean([overlap((found.amodal[t] > 127) | (found.visible[t] > 127), whole[t]) for t in whole])), 4
        ),
        "root_mm": round(float(placed[:, 0].mean()), 1),
        "root_depth_mm": round(float((ours - truth)[:, 0, 2].mean()) * 1000, 1),
        "jitter": round(jitter(ours), 3),
        "jitter_gt": round(jitter(truth), 3),
        "seconds_per_frame": round(bill.cpu_s / n, 4),
        "peak_mb": bill.peak_rss_mb,
        "landmark_error_mm": round(found.notes["landmark_error_m"] * 1000, 1),
        "betas": found.notes["betas"],
    }


def _visible(truth: NDArray[np.floating], K: NDArray[np.floating], seen: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Whether each joint [T,J] projects onto the visible part of the person."""
    pixels = truth @ K.T
    pixels = np.floor(pixels[..., :2] / pixels[..., 2:]).astype(int)
    result = np.zeros(truth.shape[:2], np.bool_)
    for t, mask in enumerate(seen):
        grown = cv2.dilate(mask.astype(np.uint8), SLACK)
        inside = ((pixels[t] >= 0) & (pixels[t] < np.array(mask.shape[::-1]))).all(1)
        x, y = pixels[t][inside].T
        result[t, inside] = grown[y, x] > 0
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--set", nargs="*", default=[], metavar="KNOB=VALUE", help="knobs of PerceiveConfig")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(arguments.threads)
    config = PerceiveConfig.model_validate_strings(dict(pair.split("=", 1) for pair in arguments.set))
    body = load_packaged_body()
    networks = Networks({name: model_path(name) for name in REQUIRED}, num_threads=arguments.threads)
    lines = []
    for capture in sorted(path.parent for path in arguments.captures.glob("*/cameras.json")):
        lines.append(json.dumps(measure(capture, body, networks, config)))
        print(lines[-1], flush=True)
    if arguments.json:
        arguments.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
