"""What perception finds on captures whose truth is known: `python -m benchmarks.perceive CAPTURES_DIR --json OUT`.

One JSON line per capture. Joints are the captures' 24, each our body's joint at the same place; errors are in the
camera's axes. `mpjpe_mm` is about the root; `pa_` after the best similarity of each frame, over joints that are on the
visible part of the person (`vis/`, two pixels of slack) and over the others. `root_mm` is the distance of the root,
`root_depth_mm` and `root_across_mm` the means of its parts along the camera's axis and across it, without sign;
`root_depth_bias_mm` keeps the sign. `jitter` is the mean second difference of the joints, in mm/frame^2. `texel_l1` is
the mean absolute colour difference, of 255, between texels that were seen, textured through our fit and mask, and the
true pictures, looked up through the true body. Seconds are CPU seconds of perception, on one thread unless told.

The capture's own camera is given to the method: intrinsics and, unless `--intrinsics-only`, where it stands.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.cost import Meter
from ahoy_core.perceive.networks import REQUIRED, Networks
from ahoy_core.perceive.perceive import PerceiveConfig, Perception, perceive
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.texture import build_texture
from benchmarks.captures import JOINTS24, Capture, capture_folders, read_capture, true_fit
from benchmarks.texture import colour_scores
from tasks.model_files import model_path

FPS = 15.0
SLACK = np.ones((5, 5), np.uint8)
HALF = 127  # of 255


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
    """Mean second difference of joints [T,J,3], the input's unit per frame^2."""
    return float(np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1).mean()) if len(joints) > 2 else 0.0


def our_joints(body: PackagedBody, found: Perception) -> NDArray[np.float64]:
    """The captures' 24 joints [T,24,3] on our body, in the camera's axes."""
    rows = [body.joint_names.index(name) for name in JOINTS24.values()]
    pose, betas, transl = (torch.from_numpy(x) for x in (found.pose, found.betas, found.transl))
    with torch.no_grad():
        joints = torch.cat([body(pose[t, None], betas[None], transl[t, None]).joints for t in range(len(pose))])
    view = found.viewmat.astype(np.float64)
    return np.asarray(joints[:, rows].double().numpy() @ view[:3, :3].T + view[:3, 3])


def measure(
    folder: Path,
    body: PackagedBody,
    networks: Networks,
    config: PerceiveConfig,
    stands: bool = True,
    texels: bool = True,
) -> dict[str, Any]:
    """Perceive one capture and compare; `stands`: tell where the camera stands; `texels`: texture it too."""
    capture = read_capture(folder)
    n = len(capture.frames)
    front = capture.cameras["front"]
    K, view = front.Ks[0].double().numpy(), front.viewmats[0].double().numpy()
    with Meter() as meter:
        found = perceive(
            capture.frames,
            np.arange(n) / FPS,
            np.zeros(n, np.int32),
            K,
            body,
            networks,
            config,
            viewmat=view if stands else None,
        )
    bill = meter.read()
    return {
        "capture": folder.name,
        **compare(capture, body, found),
        "texel_l1": _texel_error(capture, body, found) if texels else None,
        "seconds_per_frame": round(bill.cpu_s / n, 4),
        "peak_mb": bill.peak_rss_mb,
        "landmark_error_mm": round(found.notes["landmark_error_m"] * 1000, 1),
        "betas": found.notes["betas"],
    }


def compare(capture: Capture, body: PackagedBody, found: Perception) -> dict[str, float | None]:
    """Errors of the bodies and masks that were found."""
    n, front = len(capture.frames), capture.cameras["front"]
    K, view = front.Ks[0].double().numpy(), front.viewmats[0].double().numpy()
    joints = np.load(capture.folder / "motion.npz")["joints24"][:n]
    truth = joints @ view[:3, :3].T + view[:3, 3]
    ours = our_joints(body, found)
    visible = _visible(truth, K, capture.visible > HALF)
    errors = aligned_errors(ours, truth) * 1000
    centred = np.linalg.norm((ours - ours[:, :1]) - (truth - truth[:, :1]), axis=-1) * 1000
    root = (ours - truth)[:, 0] * 1000
    return {
        "mpjpe_mm": round(float(centred.mean()), 1),
        "pa_mpjpe_mm": round(float(errors.mean()), 1),
        "pa_mpjpe_visible_mm": round(float(errors[visible].mean()), 1),
        "pa_mpjpe_hidden_mm": round(float(errors[~visible].mean()), 1) if (~visible).any() else None,
        **_mask_scores(capture, found),
        "root_mm": round(float(np.linalg.norm(root, axis=1).mean()), 1),
        "root_depth_mm": round(float(np.abs(root[:, 2]).mean()), 1),
        "root_depth_bias_mm": round(float(root[:, 2].mean()), 1),
        "root_across_mm": round(float(np.linalg.norm(root[:, :2], axis=1).mean()), 1),
        "jitter": round(jitter(ours) * 1000, 2),
        "jitter_gt": round(jitter(truth) * 1000, 2),
    }


def _mask_scores(capture: Capture, found: Perception) -> dict[str, float]:
    n = len(capture.frames)
    paths = {t: path for t in range(n) if (path := capture.folder / "amodal" / f"{t:03d}.png").exists()}
    whole = {t: np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) > HALF for t, path in paths.items()}
    seen = capture.visible > HALF
    return {
        "mask_iou": round(float(np.mean([overlap(found.visible[t] > HALF, seen[t]) for t in range(n)])), 4),
        "amodal_iou": round(float(np.mean([overlap(found.amodal[t] > HALF, whole[t]) for t in whole])), 4),
    }


def _texel_error(capture: Capture, body: PackagedBody, found: Perception) -> float | None:
    """See the module's text; None for captures without true pictures."""
    if not capture.scored_frames():
        return None
    names = ("pose", "transl", "betas", "expression", "joint_confidence", "frame_confidence", "used", "viewmat", "K")
    fit = {name: getattr(found, name) for name in names}
    texture = build_texture(capture.frames, found.visible, fit, body, TextureConfig())
    return colour_scores(capture, body, true_fit(capture, body), texture)["texel_l1"]


def _visible(truth: NDArray[np.floating], K: NDArray[np.floating], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
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


def load_networks(threads: int = 1) -> Networks:
    """The networks that are in the cache."""
    return Networks({name: model_path(name) for name in REQUIRED}, num_threads=threads)


def mean_line(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over captures of every number, under the capture's name "mean"."""
    keys = [k for k, v in lines[0].items() if isinstance(v, (int, float)) or v is None]
    known = {k: [line[k] for line in lines if line[k] is not None] for k in keys}
    return {"capture": "mean", **{k: round(float(np.mean(v)), 4) if v else None for k, v in known.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--set", nargs="*", default=[], metavar="KNOB=VALUE", help="knobs of PerceiveConfig")
    parser.add_argument("--intrinsics-only", action="store_true", help="do not tell where the camera stands")
    parser.add_argument("--no-texels", action="store_true", help="leave texel_l1 out, which takes longer than the rest")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(arguments.threads)
    config = PerceiveConfig.model_validate_strings(dict(pair.split("=", 1) for pair in arguments.set))
    body, networks = load_packaged_body(), load_networks(arguments.threads)
    lines = []
    for folder in capture_folders(arguments.captures):
        lines.append(measure(folder, body, networks, config, not arguments.intrinsics_only, not arguments.no_texels))
        print(json.dumps(lines[-1]), flush=True)
    print(json.dumps(mean_line(lines)), flush=True)
    if arguments.json:
        arguments.json.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


if __name__ == "__main__":
    main()
