"""Reading checkpoints without running what is in them, and saying precisely what is wrong with a wrong one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.hashes import sha256_of
from ahoy_core.models.shelf import is_filling, network

if TYPE_CHECKING:
    from ahoy_core.models.adapter import Adapter, DType, Fill

NAMED = 6  # missing keys spelled out in an error; the rest are counted


def read_state(path: Path, adapter: Adapter) -> dict[str, Tensor]:
    """The tensors of a `.pth` file, on the CPU, whatever device they were saved from; nothing is unpickled.

    Raises:
        CheckpointError: the file is truncated, or holds something else than tensors by name.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its readers meet in a broken file
        raise CheckpointError(
            f"{adapter.label}: {path} cannot be read as weights ({short(error)}, {path.stat().st_size} bytes, sha256 "
            f"{sha256_of(path)[:12]}); it is truncated or no weights file: {adapter.how_to_get()}"
        ) from error
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(f"{adapter.label}: {path} holds no table of tensors; {adapter.how_to_get()}")
    return dict(state)


def take(state: Mapping[str, Tensor], wanted: Mapping[str, Tensor], path: Path, adapter: Adapter) -> dict[str, Tensor]:
    """Those tensors of a state that are wanted, checked for presence and shape.

    Args:
        state: by name, as the file has them.
        wanted: name in the file -> a tensor of the right shape.
        path: for the message.
        adapter: likewise.

    Raises:
        CheckpointError: naming what is missing, or shaped otherwise.
    """
    missing = [name for name in wanted if name not in state]
    if missing:
        raise CheckpointError(
            f"{adapter.label}: {path} lacks {_some(missing)}; it is another model's, or cut short: "
            f"{adapter.how_to_get()}"
        )
    odd = [
        f"{name} {tuple(state[name].shape)} instead of {tuple(like.shape)}"
        for name, like in wanted.items()
        if state[name].shape != like.shape
    ]
    if odd:
        raise CheckpointError(f"{adapter.label}: {path} holds {_some(odd)}; {adapter.how_to_get()}")
    return {name: state[name] for name in wanted}


def pretrained(cls: Any, folder: Path, fill: Fill, adapter: Adapter, **more: Any) -> Any:
    """A model of transformers or diffusers from a folder, never from a network, complete and in evaluation mode.

    Both libraries fill missing weights with random ones and only log it: here that is an error.

    Raises:
        CheckpointError: naming the missing weights.
    """
    kind = f"{cls.__qualname__} {sorted((name, str(value)) for name, value in more.items())}"
    placed: nn.Module = network(folder, kind, device_of(fill), lambda: _complete(cls, folder, adapter, more))
    return placed


def _complete(cls: Any, folder: Path, adapter: Adapter, more: Mapping[str, Any]) -> nn.Module:
    kwargs = {"local_files_only": True, "use_safetensors": True, "output_loading_info": True, **more}
    try:
        model, info = cls.from_pretrained(str(folder), **kwargs)
    except Exception as error:  # the libraries raise OSError, ValueError, RuntimeError and safetensors' own
        raise CheckpointError(
            f"{adapter.label}: {folder} cannot be read as {cls.__name__} ({short(error)}); {adapter.how_to_get()}"
        ) from error
    bad = [*info.get("missing_keys", ()), *(str(each) for each in info.get("mismatched_keys", ()))]
    if bad:
        raise CheckpointError(
            f"{adapter.label}: {folder} lacks {_some(sorted(bad))} of {cls.__name__}; it is another model's, or cut "
            f"short: {adapter.how_to_get()}"
        )
    whole: nn.Module = model.eval().requires_grad_(False)
    return whole


def device_of(fill: Fill) -> torch.device:
    """The device that a configuration names.

    Raises:
        CheckpointError: a GPU is asked for where there is none.
    """
    if fill.device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if fill.device.startswith("cuda") and not torch.cuda.is_available():
        raise CheckpointError(f"expected a GPU for device {fill.device!r}, got none here; say device: cpu or auto")
    return torch.device(fill.device)


def loading_device(fill: Fill) -> torch.device:
    """Where what is read goes: `device_of`, but the CPU while models are being read for forks."""
    return torch.device("cpu") if is_filling() else device_of(fill)


def dtype_of(fill: Fill, adapter: Adapter) -> torch.dtype:
    """The dtype of the weights; half precision on a GPU alone unless it is asked for by name."""
    name: DType = fill.dtype or (adapter.dtype if device_of(fill).type == "cuda" else "float32")
    return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[name]


def in_batches(
    run: Callable[[Tensor], Tensor], items: Tensor, size: int, empty: Callable[[], Tensor] | None = None
) -> Tensor:
    """`run` over `items` [N,...], `size` at a time, joined on the CPU in float32.

    A batch that does not fit into a GPU's memory is cut in halves and tried again, down to one item.

    Args:
        run: maps [n,...] to [n,...].
        items: any device.
        size: most at a time.
        empty: what an empty `items` gives; without it, what `run` gives for none.
    """
    if len(items) == 0 and empty is not None:
        return empty()
    out: list[Tensor] = []
    start = 0
    while start < len(items):
        try:
            out.append(run(items[start : start + size]).detach().float().cpu())
            start += size
        except torch.OutOfMemoryError:
            if size == 1:
                raise
            torch.cuda.empty_cache()
            size = max(1, size // 2)
    return torch.cat(out)


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    more = f" and {len(listed) - NAMED} more" if len(listed) > NAMED else ""
    return ", ".join(listed[:NAMED]) + more


def short(error: BaseException) -> str:
    """Class and first line of an error."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0][:200] if text else ''}"
