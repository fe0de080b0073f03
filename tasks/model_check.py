"""`ahoy models check`: load what is to fill a role, give it one tiny input, and say what came of it."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras, look_at, orbit_eyes, perspective_K
from ahoy_core.cost.meter import Bill, Meter
from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.catalogue import ADAPTERS, adapter
from ahoy_core.models.checkpoint import device_of
from ahoy_core.models.errors import ModelError
from ahoy_core.prior.conditioning import Context

HEIGHT, WIDTH = 96, 64


@dataclass(frozen=True)
class Checked:
    """What a check found.

    Attributes:
        adapter: what was loaded.
        device: where it ran.
        hashes: of its files, by name, and whether they are the published ones.
        shapes: of what came back, by name.
        load: what it cost to load it.
        run: what the one call cost; a GPU is waited for.
        memory_mib: of the GPU at its peak; of this process where there is none.
    """

    adapter: Adapter
    device: str
    hashes: Mapping[str, str]
    shapes: Mapping[str, str]
    load: Bill
    run: Bill
    memory_mib: float


def parse(text: str, trust_code: bool, own_weights: bool, fills: Mapping[str, Fill]) -> tuple[Adapter, Fill]:
    """`ROLE=FILL:PATH`, `ROLE=PATH` where one adapter's files are at the path, or `ROLE` from `roles.yaml`.

    Raises:
        ModelError: of another form, an unknown name, or a path at which no adapter's files are.
    """

    def fill(name: str, path: Path | None) -> Fill:
        return Fill(fill=name, path=path, trust_code=trust_code, own_weights=own_weights)

    role, equals, rest = text.partition("=")
    if not equals:
        if role not in fills:
            raise ModelError(f"expected ROLE=PATH or ROLE=FILL:PATH, got {text!r}, which roles.yaml does not fill")
        return adapter(role, fills[role].fill), fills[role]
    name, colon, path = rest.partition(":")
    known = [each.name for each in ADAPTERS if each.role == role]
    if not known or (colon and name in known) or rest in known:
        declared = adapter(role, name)
        given = fills.get(role) if declared.is_command else None
        return declared, given or fill(name, Path(path) if path else None)
    declared = recognised(role, Path(rest))
    return declared, fill(declared.name, Path(rest))


def recognised(role: str, path: Path) -> Adapter:
    """The adapter of a role whose files are at a path.

    Raises:
        ModelError: none or several; the text says how to name one.
    """
    able = [each for each in ADAPTERS if each.role == role and not each.is_command and each.fits(path)]
    if len(able) != 1:
        names = ", ".join(each.name for each in able or [a for a in ADAPTERS if a.role == role])
        found = "the files of several" if able else "no adapter's files"
        raise ModelError(f"{path} holds {found}; say which: {role}=FILL:{path}, FILL one of {names}")
    return able[0]


def check(declared: Adapter, fill: Fill) -> Checked:
    """Load and run once.

    Raises:
        ModelError: see `Adapter.open`.
    """
    device = device_of(fill)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with Meter() as loading:
        model = declared.open(fill)
    with Meter() as running, torch.no_grad():
        answer = PROBES[declared.role](model)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
    return Checked(
        declared,
        str(device),
        declared.hashes(fill),
        {name: _described(value) for name, value in answer.items()},
        loading.read(),
        running.read(),
        _peak_mib(device),
    )


def _peak_mib(device: torch.device) -> float:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def _described(value: Any) -> str:
    return f"{list(value.shape)} {str(value.dtype).removeprefix('torch.')}" if isinstance(value, Tensor) else str(value)


def _frames(count: int = 2) -> Tensor:
    return torch.rand(count, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))


def _boxes(count: int = 2) -> Tensor:
    return torch.tensor([[0.1 * WIDTH, 0.0, 0.9 * WIDTH, float(HEIGHT)]]).expand(count, 4)


def _hole() -> Tensor:
    hole = torch.zeros(1, HEIGHT, WIDTH)
    hole[:, 20:70, 15:50] = 1
    return hole


def _pose(model: Any) -> dict[str, Any]:
    found = model(_frames(), perspective_K(0.9, WIDTH, HEIGHT), _boxes())
    return {"pose": found.pose, "joints": found.joints, "found": f"{int(found.found.sum())} of {len(found.found)}"}


def _surface(model: Any) -> dict[str, Any]:
    found = model(_frames(), _boxes())
    return {"part": found.part, "uv": found.uv}


def _views(model: Any) -> dict[str, Any]:
    views, azimuths = model(_frames(1)[0], _hole())
    return {"views": views, "azimuths": azimuths}


def _face(model: Any) -> dict[str, Any]:
    eyes = orbit_eyes(torch.zeros(3), 1.0, torch.tensor([0.0, 0.5]))
    cameras = Cameras(look_at(eyes, torch.zeros(3)), perspective_K(0.3, 64, 64).expand(2, 3, 3), 64, 64)
    return {"images": model(_frames(1)[:, :, :64], torch.zeros(2, 52), cameras)}


def _video(model: Any) -> dict[str, Any]:
    latents = model.encode(torch.rand(1, 3, 5, 64, 64, generator=torch.Generator().manual_seed(0)))
    velocity = model.velocity(latents, 0.5, Context(model.embed(["a person"])))
    return {"latents": latents, "velocity": velocity, "frames": model.decode(latents)}


def _body(model: Any) -> dict[str, Any]:
    out = model(torch.zeros(1, model.n_joints, 3), model.default_betas[None], torch.zeros(1, 3))
    return {"vertices": out.vertices, "joints": out.joints, "expressions": model.n_expressions}


PROBES: Final[Mapping[str, Callable[[Any], dict[str, Any]]]] = {
    "body": _body,
    "pose": _pose,
    "mask": lambda model: {"mask": model(_frames(), _boxes())},
    "surface": _surface,
    "head": lambda model: {"head": model(_frames(), torch.ones(2, 1, HEIGHT, WIDTH))},
    "inpaint": lambda model: {"image": model(_frames(1)[0], _hole(), seed=0)},
    "views": _views,
    "video": _video,
    "face": _face,
    "perceptual": lambda model: {"distance": model(_frames(), _frames().flip(0))},
}
"""Role -> one tiny call of what fills it."""
