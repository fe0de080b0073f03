"""Learns the map from face landmarks to facial actions on rendered heads: first `read`, then `train`.

    python -m benchmarks.train_face read FACES.npz --assets MAKEHUMAN --count 800
    python -m benchmarks.train_face train OUT.safetensors FACES.npz --json LOG

    python -m benchmarks.train_face golden tests/perceive/faces.npz --assets MAKEHUMAN --count 24 --seed 77

Skill is measured on people left out of the training, one after the other.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save_file

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.perceive.face import STABLE, measures, on_reference, read_face
from ahoy_core.perceive.networks import Networks
from benchmarks.rendered.people import Person, Wardrobe
from benchmarks.rendered.render import View, render
from benchmarks.rendered.rooms import box, sample_room
from tasks.roles import landmark_networks

SIZE = 160  # pixels of the rendered square
PER_PERSON = 12  # pictures of one head
ROUNDS = 5  # of making the reference
RIDGES = (0.01, 0.03, 0.1, 0.3)  # of the variance of a measure
MIN_SKILL = 0.35  # correlation on people left out below which an action stays neutral
# Actions that show at the size of a head in a video, as people do them; the rest of the 52 stay neutral.
GROUPS = (
    ("jawOpen",), ("jawOpen",), ("eyeBlinkLeft", "eyeBlinkRight"), ("eyeBlinkLeft",), ("eyeBlinkRight",),
    ("mouthSmileLeft", "mouthSmileRight"), ("mouthSmileLeft", "mouthSmileRight"), ("mouthPucker",), ("mouthFunnel",),
    ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"), ("browDownLeft", "browDownRight"),
    ("mouthFrownLeft", "mouthFrownRight"), ("mouthLeft",), ("mouthRight",), ("eyeWideLeft", "eyeWideRight"),
)  # fmt: skip


def sample_expression(rng: np.random.Generator, names: tuple[str, ...]) -> NDArray[np.float32]:
    """One to three of `GROUPS` at random strengths [E]; a sixth of the faces rest."""
    values = np.zeros(len(names), np.float32)
    if rng.random() < 1 / 6:
        return values
    for group in rng.choice(len(GROUPS), size=rng.integers(1, 4), replace=False):
        strength = rng.uniform(0.3, 1.0)
        for name in GROUPS[group]:
            values[names.index(name)] = strength
    return values


def draw_head(
    rng: np.random.Generator, body: PackagedBody, person: Person, expression: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A head [SIZE,SIZE,3] from somewhere in front, blurred as a small one would be, and body landmarks [33,2]."""
    pose = torch.zeros(body.n_joints, 3)
    pose[body.joint_names.index("head")] = torch.tensor(rng.normal(0, (0.12, 0.08, 0.2))).float()
    shown = torch.from_numpy(expression)
    with torch.no_grad():
        marks = (
            keypoints(body, body(pose[None], person.betas[None], torch.zeros(1, 3), shown[None]))[0].double().numpy()
        )
    middle = marks[[2, 5, 9, 10]].mean(0)
    yaw, pitch, distance = rng.normal(0, 0.35), rng.normal(0.05, 0.12), rng.uniform(1.0, 3.0)
    away = np.array([np.sin(yaw) * np.cos(pitch), -np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    centre = middle + distance * away
    forward = -away
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ centre
    focal = SIZE * distance / rng.uniform(0.3, 0.45)
    K = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    light = np.array([rng.normal(0, 0.6), -rng.uniform(0.3, 1), rng.uniform(0.2, 1.2)])
    view = View(viewmat, K, SIZE, SIZE, 1.0, light / np.linalg.norm(light), rng.uniform(0.5, 0.75))
    posed = person.posed(body, pose, torch.zeros(3), shown)
    wall = box((-4, 1.5, -4), (4, 1.6, 4), sample_room(rng)[1].texture, 2.0)
    image = render([(person, posed)], [wall], view).rgb
    small = int(rng.integers(48, SIZE + 1))
    blurred = cv2.resize(
        cv2.resize(image, (small, small), interpolation=cv2.INTER_AREA), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC
    )
    camera = marks @ rotation.T + viewmat[:3, 3]
    return blurred, camera[:, :2] / camera[:, 2:] * focal + SIZE / 2


def read(out: Path, assets: Path, count: int, seed: int, networks: Networks) -> None:
    """Render heads and write the face network's landmarks beside the true actions."""
    body, rng = load_packaged_body(), np.random.default_rng(seed)
    wardrobe = Wardrobe(assets, body)
    points, actions, people, person = [], [], [], None
    for i in range(count):
        person = wardrobe.dress(rng) if person is None or i % PER_PERSON == 0 else person
        expression = sample_expression(rng, body.expression_names)
        image, marks = draw_head(rng, body, person, expression)
        found = read_face(networks, image, marks + rng.normal(0, 1.5, marks.shape))
        if found is not None and found.score > 0.5:
            points.append(found.points)
            actions.append(expression)
            people.append(i // PER_PERSON)
    np.savez(out, points=np.stack(points).astype(np.float32), actions=np.stack(actions), person=np.array(people))
    print(f"{len(points)} of {count} faces read", flush=True)


def write_golden(out: Path, assets: Path, count: int, seed: int) -> None:
    """Render heads for the tests: pictures, body landmarks and actions, of people that training never sees."""
    body, rng = load_packaged_body(), np.random.default_rng(seed)
    wardrobe, person = Wardrobe(assets, body), None
    pictures, landmarks, actions = [], [], []
    for i in range(count):
        person = wardrobe.dress(rng) if person is None or i % PER_PERSON == 0 else person
        actions.append(sample_expression(rng, body.expression_names))
        image, marks = draw_head(rng, body, person, actions[-1])
        pictures.append(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel())
        landmarks.append(marks)
    sizes = np.array([len(picture) for picture in pictures])
    np.savez(out, jpeg=np.concatenate(pictures), sizes=sizes, landmarks=np.stack(landmarks), actions=np.stack(actions))


def train(out: Path, files: list[Path], log: Path | None) -> None:
    """Fit the reference and the ridge regression, and write both with the skill on people left out."""
    data = [np.load(path) for path in files]
    points, actions = (np.concatenate([d[name] for d in data]).astype(np.float64) for name in ("points", "actions"))
    people = np.concatenate([1000 * i + d["person"] for i, d in enumerate(data)])
    resting = actions.sum(1) == 0
    reference = _reference(points[resting])
    rows = np.stack([measures(on_reference(p, reference)[0]) for p in points])
    middle = rows[resting].mean(0)
    for who in np.unique(people):
        own = people == who
        # As at run time, each face is read against itself at rest.
        rows[own] -= rows[own & resting].mean(0) if (own & resting).any() else np.median(rows[own], axis=0)
    guesses = {ridge: _left_out(rows, actions, people, ridge) for ridge in RIDGES}
    ridge = min(RIDGES, key=lambda r: float(((guesses[r] - actions) ** 2).mean()))
    guess = np.clip(guesses[ridge], 0, 1)
    skill = np.array([_correlation(g, t) for g, t in zip(guess.T, actions.T, strict=True)])
    weights = _solve(rows, actions, ridge) * (skill > MIN_SKILL)
    arrays = {"reference": reference, "middle": middle, "weights": weights, "skill": skill}
    save_file({k: np.ascontiguousarray(v.astype(np.float16)) for k, v in arrays.items()}, str(out))
    names, kept = load_packaged_body().expression_names, skill > MIN_SKILL
    facts = {
        "heads": len(points),
        "people": len(np.unique(people)),
        "ridge": ridge,
        "mean_absolute_error": round(float(np.abs(guess - actions)[:, kept].mean()), 3),
        "error_of_neutral": round(float(np.abs(actions)[:, kept].mean()), 3),
        "correlation": {n: round(float(s), 2) for n, s in zip(names, skill, strict=True) if s > MIN_SKILL},
    }
    print(json.dumps(facts))
    if log:
        log.write_text(json.dumps(facts) + "\n", encoding="utf-8")


def _left_out(
    rows: NDArray[np.float64], actions: NDArray[np.float64], people: NDArray[np.int64], ridge: float
) -> NDArray[np.float64]:
    """What each face would be taken for by a map that never saw its person."""
    guess = np.zeros_like(actions)
    for who in np.unique(people):
        own = people == who
        guess[own] = rows[own] @ _solve(rows[~own], actions[~own], ridge)
    return guess


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else 0.0


def _reference(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean resting face [468,3] of unit size, all laid on one another by the stable points."""
    reference = points[0]
    for _ in range(ROUNDS):
        reference = np.mean([on_reference(p, reference)[0] for p in points], axis=0)
        reference = reference - reference[list(STABLE)].mean(0)
        reference = reference / np.sqrt((reference**2).sum(1).mean())
    return reference


def _solve(rows: NDArray[np.float64], actions: NDArray[np.float64], ridge: float) -> NDArray[np.float64]:
    """Ridge regression [M,E] without a constant: nothing measured, nothing shown."""
    spread = rows.std(0) + 1e-9
    scaled = rows / spread
    square = scaled.T @ scaled + ridge * len(rows) * np.eye(rows.shape[1])
    return np.asarray(np.linalg.solve(square, scaled.T @ actions) / spread[:, None])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("read", "train", "golden"))
    parser.add_argument("out", type=Path)
    parser.add_argument("inputs", type=Path, nargs="*")
    parser.add_argument("--assets", type=Path, help="folder of MakeHuman's CC0 clothes and hair")
    parser.add_argument("--count", type=int, default=800)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--json", type=Path, default=None)
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)
    if arguments.what == "read":
        read(arguments.out, arguments.assets, arguments.count, arguments.seed, landmark_networks())
    elif arguments.what == "golden":
        write_golden(arguments.out, arguments.assets, arguments.count, arguments.seed)
    else:
        train(arguments.out, arguments.inputs, arguments.json)


if __name__ == "__main__":
    main()
