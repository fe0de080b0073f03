"""Avatars in a scene to a video: read, plan, render in parallel, go on where a killed run stopped."""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.files import DESCRIPTION, TENSORS, load_avatar
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.formats.cameras import read_cameras
from ahoy_core.formats.images import read_png, write_png
from ahoy_core.formats.video import write_mp4
from ahoy_core.motion import Motion, load_motion, placed, projected_motion
from ahoy_core.scene.cameras import make_cameras
from ahoy_core.scene.cost import Ledger, Rates, calibrate
from ahoy_core.scene.plan import BASE, Plan, Request, plan_effects
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.render import Stage
from ahoy_core.scene.room import make_room
from ahoy_core.scene.scene import Scene, empty_scene, make_scene, read_splats
from ahoy_core.scene.shot import Shot

Progress = Callable[[int, int], None]
VERSION = 2  # of what a request's frames look like: those of an older one are not gone on with
ROOM = "room"
_AXES = {
    "x": (1.0, 0, 0),
    "y": (0, 1.0, 0),
    "z": (0, 0, 1.0),
    "-x": (-1.0, 0, 0),
    "-y": (0, -1.0, 0),
    "-z": (0, 0, -1.0),
}


class RenderRequest(BaseModel):
    """What to render; one motion and one place for each avatar (the last given serves for those left)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    avatars: tuple[str, ...] = Field(min_length=1, description="folders of saved avatars")
    motions: tuple[str, ...] = Field(("turn",), min_length=1, description="built-in names or files")
    places: tuple[tuple[float, float, float], ...] = Field(
        ((0.0, 0.0, 0.0),), description="x, y (metres), heading (degrees)"
    )
    scene: str | None = Field(None, description="a splat file, 'room', or none")
    scene_cameras: str | None = Field(None, description="the cameras that the scene was made from")
    scene_up: str | None = Field(None, description="axis that is up in the scene's file: x, y, z, -x, -y or -z")
    scene_scale: float | None = Field(None, gt=0, description="metres a unit of the scene's file")
    camera: str = "auto"
    effects: str = "auto"
    height: int = Field(512, ge=16, le=4096)
    width: int = Field(512, ge=16, le=4096)
    fps: float = Field(24.0, gt=0, le=240)
    frames: int | None = Field(None, ge=1)
    shutter: float = Field(0.5, ge=0, le=1)
    aperture: float = Field(0.0, ge=0, le=1)
    focus: float = Field(0.0, ge=0)
    background: float = Field(0.5, ge=0, le=1)
    pca: float = Field(0.0, ge=0, le=1, description="how strongly poses are pulled towards the training poses")
    strengths: dict[str, float] = Field(default_factory=dict)

    def key(self) -> str:
        """Hash of everything that decides the frames: these fields and the contents of the files they name."""
        digest = hashlib.sha256(f"{VERSION} {self.model_dump_json()}".encode())
        for path in sorted(self._files()):
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def _files(self) -> set[Path]:
        files = {Path(avatar) / name for avatar in self.avatars for name in (TENSORS, DESCRIPTION)}
        named = (*self.motions, self.scene or "", self.scene_cameras or "", self.camera.partition("#")[0])
        return {path for path in (*files, *map(Path, named)) if path.is_file()}


@dataclass(frozen=True)
class Job:
    """A request with everything read and planned; `pull` is how far (radians) each frame's pose was pulled."""

    request: RenderRequest
    scene: Scene
    puppets: tuple[Puppet, ...]
    shot: Shot
    plan: Plan
    notes: tuple[str, ...]
    pull: tuple[list[float], ...] = ()


def prepare(request: RenderRequest, rates: Rates | None = None) -> Job:
    """Read avatars, motions, scene and cameras, place them, and plan the effects.

    Args:
        request: What to render.
        rates: Of this machine; measured if not given.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file or an option cannot be used.
    """
    body = load_packaged_body()
    scene = load_scene(request)
    puppets, notes, pulls = [], list(scene.notes), []
    for number, folder in enumerate(request.avatars):
        avatar = load_avatar(Path(folder))
        puppet, said, pull = _puppet(request, number, avatar, body)
        puppets.append(puppet)
        notes += [f"{Path(folder).name}: {note}" for note in said]
        pulls.append(pull)
    frames = min(len(puppet.motion) for puppet in puppets)
    puppets = [Puppet(p.avatar, p.body, _cut(p, frames)) for p in puppets]
    cameras = make_cameras(request.camera, scene, puppets, frames, request.height, request.width)
    shot = Shot(cameras, request.fps, request.shutter, request.aperture, request.focus, request.background)
    chosen: Any = request.effects if request.effects in ("auto", "all", "none") else tuple(request.effects.split(","))
    rates = calibrate() if rates is None else rates
    plan = plan_effects(scene, puppets, shot, Request(chosen, rates, request.strengths))
    notes += _warnings(scene, puppets)
    return Job(request, scene, tuple(puppets), shot, plan, tuple(notes), tuple(pulls))


def load_scene(request: RenderRequest) -> Scene:
    """The scene of a request."""
    if request.scene is None:
        return empty_scene()
    if request.scene == ROOM:
        return make_room()
    if request.scene_up is not None and request.scene_up not in _AXES:
        raise ValueError(f"expected scene_up among {', '.join(_AXES)}, got {request.scene_up!r}")
    gaussians, sh_rest = read_splats(request.scene)
    cameras = None if request.scene_cameras is None else read_cameras(request.scene_cameras)
    up = None if request.scene_up is None else torch.tensor(_AXES[request.scene_up])
    return make_scene(
        gaussians,
        sh_rest,
        name=Path(request.scene).name,
        cameras=cameras,
        up=up,
        metres_per_unit=request.scene_scale,
        memory_budget=psutil.virtual_memory().available,
    )


def _puppet(
    request: RenderRequest, number: int, avatar: Avatar, body: PackagedBody
) -> tuple[Puppet, tuple[str, ...], list[float]]:
    motion = load_motion(_nth(request.motions, number), body, avatar.betas, request.fps, request.frames)
    pull: list[float] = []
    if request.pca:
        motion, angles = projected_motion(motion, avatar.training_poses, request.pca)
        pull = [round(float(angle), 5) for angle in angles]
    puppet = Puppet(avatar, body, motion)
    x, y, heading = _nth(request.places, number)
    moved = placed(motion, torch.tensor([x, y, 0.0]), float(np.deg2rad(heading)), puppet.rest[0])
    return Puppet(avatar, body, moved), motion.notes, pull


def _nth(values: tuple[Any, ...], number: int) -> Any:
    return values[min(number, len(values) - 1)]


def _cut(puppet: Puppet, frames: int) -> Motion:
    motion = puppet.motion
    expression = None if motion.expression is None else motion.expression[:frames]
    return replace(motion, pose=motion.pose[:frames], transl=motion.transl[:frames], expression=expression)


def _warnings(scene: Scene, puppets: list[Puppet]) -> list[str]:
    """What is likely a mistake of placing: an avatar inside something solid."""
    said = []
    for puppet in puppets:
        share = buried_share(scene, puppet)
        if share > 0.05:
            said.append(f"{share:.0%} of an avatar's start is inside the scene: move it with --at")
    return said


def buried_share(scene: Scene, puppet: Puppet) -> float:
    """Share of an avatar's surface, above the ground, that touches opaque Gaussians of the scene in the first frame."""
    places = puppet.surface([0])[0][0]
    places = places[places[:, 2] > 0.1]
    gaussians = scene.gaussians
    near = (gaussians.means > places.amin(0) - 0.1).all(1) & (gaussians.means < places.amax(0) + 0.1).all(1)
    near &= (gaussians.means[:, 2] > 0.05) & (gaussians.opacities > 0.3)
    if not bool(near.any()) or not len(places):
        return 0.0
    means, inverse = gaussians.means[near], torch.linalg.pinv(scene.covars[near].double()).float()
    inside = torch.zeros(len(places), dtype=torch.bool)
    for start in range(0, len(means), 4096):
        offset = places[:, None] - means[start : start + 4096]
        reach = torch.einsum("pgi,gij,pgj->pg", offset, inverse[start : start + 4096], offset)
        inside |= (reach < 4).any(1)
    return float(inside.float().mean())


def render_clip(
    job: Job, out: Path, *, workers: int = 2, progress: Progress | None = None, keep_frames: bool = False
) -> dict[str, Any]:
    """Render every frame that is not there yet, and the video.

    Frames go to a folder beside the video, each complete or absent; a run with the same request and the same input
    files goes on from what is there.

    Args:
        job: From `prepare`.
        out: `.mp4`, or a folder for PNGs.
        workers: Frames at a time, each on one thread.
        progress: Called with (frames done, frames).
        keep_frames: Leave the folder of frames beside the video.

    Returns:
        The record that is stored beside the video: plan, estimates, measured costs.
    """
    folder = out if out.suffix.lower() != ".mp4" else out.with_name(out.name + ".frames")
    key = job.request.key()
    _claim(folder, key)
    frames = job.plan.frames
    wanted = [f for f in range(frames) if not _usable(_frame(folder, f))]
    stage = Stage(job.scene, job.puppets, job.shot, job.plan) if wanted else None
    done = frames - len(wanted)
    lock = threading.Lock()

    def one(frame: int) -> None:
        nonlocal done
        assert stage is not None
        picture = stage.picture(frame)
        with stage.ledger.section(BASE):
            write_png(_frame(folder, frame), picture)
        with lock:
            done += 1
            if progress is not None:
                progress(done, frames)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(workers) as pool:
            for _ in pool.map(one, wanted):
                pass
    finally:
        torch.set_num_threads(before)
    record = job_record(job, stage.ledger if stage else Ledger(), len(wanted))
    out.parent.mkdir(parents=True, exist_ok=True)
    record_path = out.with_name(out.name + ".json") if out.suffix.lower() == ".mp4" else folder / "render.json"
    if out.suffix.lower() == ".mp4":
        write_mp4(out, (read_png(_frame(folder, f)) for f in range(frames)), job.shot.fps, metadata=_label(job))
        if not keep_frames:
            shutil.rmtree(folder)
    record_path.write_text(json.dumps(record, indent=1), encoding="utf-8")
    return record


def _frame(folder: Path, frame: int) -> Path:
    return folder / f"{frame:05d}.png"


def _usable(path: Path) -> bool:
    try:
        return read_png(path).ndim == 3
    except (FileNotFoundError, ValueError):
        return False


def _claim(folder: Path, key: str) -> None:
    """Make the folder of frames this request's own: frames of another request are deleted."""
    mark = folder / "request"
    if mark.is_file() and mark.read_text() != key:
        for stale in folder.glob("[0-9]*.png"):
            stale.unlink()
    folder.mkdir(parents=True, exist_ok=True)
    mark.write_text(key)


def _label(job: Job) -> dict[str, str]:
    infos = [puppet.avatar.info for puppet in job.puppets]
    sources = ", ".join(sorted({info.provenance.get("source", "unknown") for info in infos}))
    return {"title": "Ahoy avatar", "comment": infos[0].synthetic_media, "description": f"source: {sources}"}


def job_record(job: Job, ledger: Ledger, rendered: int) -> dict[str, Any]:
    """Plan, estimates and what was measured, for `rendered` of the clip's frames."""
    share = rendered / max(1, job.plan.frames)
    effects = [
        {
            **asdict(effect),
            "evidence": dict(effect.evidence),
            "measured_seconds": round(ledger.seconds.get(effect.name, 0.0), 4),
            "calls": ledger.calls.get(effect.name, 0),
        }
        for effect in job.plan.effects
    ]
    return {
        "effects": effects,
        "base": {"seconds": job.plan.base_seconds, "measured_seconds": round(ledger.seconds.get(BASE, 0.0), 4)},
        "estimated_seconds": round(job.plan.seconds * share, 3),
        "measured_seconds": round(sum(ledger.seconds.values()), 3),
        "frames": job.plan.frames,
        "rendered": rendered,
        "notes": list(job.notes),
        "pull_radians": list(job.pull),
        "synthetic_media": job.puppets[0].avatar.info.synthetic_media,
        "request": json.loads(job.request.model_dump_json()),
    }
