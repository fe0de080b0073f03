"""The avatar file: `avatar.safetensors` (tensors) and `avatar.json` (what it is, and where it comes from)."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ahoy_core.avatar.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.deform import OffsetBounds
from ahoy_core.avatar.posing import PoseDependence
from ahoy_core.maps.style_unet import StyleUNet, StyleUNetConfig
from ahoy_core.maps.template import Template

FORMAT = 2
_READ = (1, 2)  # 1 has no pose-dependent avatars
TENSORS, DESCRIPTION = "avatar.safetensors", "avatar.json"
_GAUSSIANS = ("means", "quats", "scales", "opacities", "colors", "skin_weights", "betas", "training_poses")
_POSING = ("base", "map_rotations")
_TEMPLATE = tuple(field.name for field in fields(Template) if field.name not in ("map_size", "pitch"))


def save_avatar(avatar: Avatar, folder: Path) -> tuple[Path, Path]:
    """Write an avatar.

    Args:
        avatar: What to write.
        folder: Made if absent; files of the same names are replaced.

    Returns:
        Paths of the tensors and of the description.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: getattr(avatar, name) for name in _GAUSSIANS}
    tensors |= {f"template.{name}": getattr(avatar.template, name) for name in _TEMPLATE}
    if avatar.posing is not None:
        tensors |= {f"posing.{name}": getattr(avatar.posing, name) for name in _POSING}
    tensors |= {f"network.{name}": value for name, value in avatar.network.state_dict().items()}
    description = {
        "format": FORMAT,
        **avatar.info.model_dump(),
        "gaussians": len(avatar),
        "observed_share": round(avatar.observed_share, 6),
        "invented_share": round(1 - avatar.observed_share, 6),
        "map_size": avatar.template.map_size,
        "pitch": avatar.template.pitch,
        "network": avatar.network.config.model_dump(),
        "bounds": avatar.bounds.model_dump(),
        "posing": None
        if avatar.posing is None
        else {name: getattr(avatar.posing, name) for name in ("reduction", "components", "strength")},
    }
    label = {"synthetic_media": avatar.info.synthetic_media}
    save_file({name: value.detach().contiguous() for name, value in tensors.items()}, folder / TENSORS, label)
    (folder / DESCRIPTION).write_text(json.dumps(description, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return folder / TENSORS, folder / DESCRIPTION


def load_avatar(folder: Path) -> Avatar:
    """Read what `save_avatar` wrote.

    Args:
        folder: Holds the two files.

    Raises:
        FileNotFoundError: If one of the files is missing.
        ValueError: If a file is damaged, incomplete or of a newer format.
    """
    for name in (TENSORS, DESCRIPTION):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"expected {name} in {folder}, found none; give the folder of a saved avatar")
    try:
        description = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
        tensors = load_file(folder / TENSORS)
    except (json.JSONDecodeError, UnicodeDecodeError, SafetensorError) as error:
        raise ValueError(f"expected an avatar in {folder}, got a damaged file ({error}); make it again") from error
    if description.get("format") not in _READ:
        raise ValueError(
            f"expected avatar format {FORMAT} or older, got {description.get('format')}; update this program"
        )
    described = description.get("posing")
    wanted = [*_GAUSSIANS, *(f"template.{n}" for n in _TEMPLATE), *(f"posing.{n}" for n in _POSING if described)]
    missing = [name for name in wanted if name not in tensors]
    if missing:
        raise ValueError(f"expected tensors {missing} in {folder / TENSORS}, found none; make the avatar again")
    network = StyleUNet(StyleUNetConfig(**description["network"]), torch.Generator().manual_seed(0))
    network.load_state_dict({n[len("network.") :]: value for n, value in tensors.items() if n.startswith("network.")})
    template = Template(
        map_size=description["map_size"],
        pitch=description["pitch"],
        **{name: tensors[f"template.{name}"] for name in _TEMPLATE},
    )
    info = AvatarInfo(**{name: description[name] for name in AvatarInfo.model_fields})
    bounds = OffsetBounds(**description["bounds"])
    return Avatar(
        template=template,
        network=network,
        bounds=bounds,
        info=info,
        posing=PoseDependence(tensors["posing.base"], tensors["posing.map_rotations"], **described)
        if described
        else None,
        **{name: tensors[name] for name in _GAUSSIANS},
    )
