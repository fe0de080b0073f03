"""Role "head" by part segmentation: Sapiens (Khirodkar et al., ECCV 2024; TorchScript) and Sapiens2 (transformers).

Only what the visible person's mask holds is head, so with SAM 3 as the mask this is the paper's pair of models.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn.functional import interpolate

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.boxes import mask_bounds
from ahoy_core.models.checkpoint import device_of, dtype_of, in_batches, pretrained
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.offline import stay_offline
from ahoy_core.models.torchscript import load_script

HEAD_CLASSES: Final = (2, 3, 23, 24, 25, 26, 27)
"""Of Sapiens' 28: face and neck, hair, lips, teeth, tongue."""
HEAD_WORDS: Final = ("face", "hair", "lip", "teeth", "tongue", "eyeglass", "glasses")
SIZE: Final = (1024, 768)
"""Height and width that both were trained at."""
MARGIN: Final = 0.1  # of the person's box on each side: hair and hats stand over a mask's edge
_SAPIENS = (0.4843, 0.4569, 0.4059), (0.2294, 0.2235, 0.2255)
_IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class SapiensOptions(BaseModel):
    """Knobs.

    Attributes:
        batch: frames at a time; halved where memory runs out.
        size: height and width of the crop that the model sees.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    batch: int = Field(default=4, ge=1)
    size: tuple[int, int] = SIZE


class PartHead:
    """A part segmentation network as the role "head".

    Args:
        name: of the network.
        logits: pictures [n,3,h,w], normalized -> logits [n,C,h',w'].
        classes: those of C that are head.
        centre: mean and spread [3] of the network's pictures.
        options: the knobs.
    """

    def __init__(
        self,
        name: str,
        logits: Callable[[Tensor], Tensor],
        classes: tuple[int, ...],
        centre: tuple[tuple[float, ...], tuple[float, ...]],
        options: SapiensOptions,
    ) -> None:
        self.name = name
        self._logits, self._classes, self._centre, self._options = logits, classes, centre, options

    @torch.no_grad()
    def __call__(self, frames: Tensor, masks: Tensor) -> Tensor:
        """The head's alpha [T,1,H,W], nowhere above the mask; 0 where the mask is empty.

        Args:
            frames: [T,3,H,W] in [0,1].
            masks: [T,1,H,W] visible person, [0,1].
        """
        out = torch.zeros_like(masks, dtype=torch.float32)
        bounds = [mask_bounds(mask[0]) for mask in masks]
        there = [t for t, box in enumerate(bounds) if float(box[2]) > float(box[0])]
        if not there:
            return out
        crops = [_crop_box(bounds[t], frames.shape[2:], self._options.size) for t in there]
        cut = torch.stack([_resample(frames[t], box, self._options.size) for t, box in zip(there, crops, strict=True)])
        shares = in_batches(self._share, cut, self._options.batch)
        for t, box, share in zip(there, crops, shares, strict=True):
            out[t] = _paste(share, box, frames.shape[2:]) * masks[t].float()
        return out

    def _share(self, crops: Tensor) -> Tensor:
        """Probability [n,1,h,w] that a pixel shows the head."""
        mean, spread = (crops.new_tensor(values)[:, None, None] for values in self._centre)
        probability = self._logits((crops - mean) / spread).float().softmax(1)
        share = probability[:, list(self._classes)].sum(1, keepdim=True)
        return interpolate(share, crops.shape[2:], mode="bilinear", align_corners=False)


def _crop_box(bounds: Tensor, frame: torch.Size, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """y0 x0 y1 x1 of the aspect of `size` round a person's box; may reach over the frame's edge."""
    x0, y0, x1, y1 = bounds.tolist()
    tall = max((y1 - y0), (x1 - x0) * size[0] / size[1]) * (1 + 2 * MARGIN)
    wide = tall * size[1] / size[0]
    top, left = (y0 + y1 - tall) / 2, (x0 + x1 - wide) / 2
    return round(top), round(left), round(top) + max(1, round(tall)), round(left) + max(1, round(wide))


def _resample(frame: Tensor, box: tuple[int, int, int, int], size: tuple[int, int]) -> Tensor:
    """A frame's crop [3,h,w], black beyond the frame's edge."""
    y0, x0, y1, x1 = box
    whole = frame.new_zeros(3, y1 - y0, x1 - x0)
    (ys, yd), (xs, xd) = _overlap(y0, y1, frame.shape[1]), _overlap(x0, x1, frame.shape[2])
    whole[:, yd, xd] = frame[:, ys, xs]
    return interpolate(whole[None].float(), size, mode="bilinear", antialias=True, align_corners=False)[0]


def _paste(share: Tensor, box: tuple[int, int, int, int], frame: torch.Size) -> Tensor:
    """A crop's map [1,h,w] back in the frame [1,H,W]."""
    y0, x0, y1, x1 = box
    sized = interpolate(share[None], (y1 - y0, x1 - x0), mode="bilinear", align_corners=False)[0].clamp(0, 1)
    out = share.new_zeros(1, *frame)
    (ys, yd), (xs, xd) = _overlap(y0, y1, frame[0]), _overlap(x0, x1, frame[1])
    out[:, ys, xs] = sized[:, yd, xd]
    return out


def _overlap(low: int, high: int, size: int) -> tuple[slice, slice]:
    """Where [low,high) meets [0,size): in the frame, and in the crop."""
    start, stop = min(max(low, 0), size), min(max(high, 0), size)
    return slice(start, stop), slice(start - low, stop - low)


def load_sapiens(fill: Fill, adapter: Adapter) -> PartHead:
    """Read a Sapiens segmentation export.

    Args:
        fill: `path` is the TorchScript file (28 classes), `trust_code` is set; `options`: `SapiensOptions`.
        adapter: its declaration.

    Raises:
        CheckpointError: it is no TorchScript.
    """
    model, device = load_script(fill, adapter), device_of(fill)

    def logits(crops: Tensor) -> Tensor:
        out: Tensor = model(crops.to(device))
        if out.ndim != 4 or out.shape[1] <= max(HEAD_CLASSES):
            raise CheckpointError(
                f"{adapter.label}: expected logits [n,28,h,w], got {tuple(out.shape)}: another Sapiens model's file; "
                f"{adapter.how_to_get()}"
            )
        return out

    return PartHead("Sapiens", logits, HEAD_CLASSES, _SAPIENS, SapiensOptions(**fill.options))


def load_sapiens2(fill: Fill, adapter: Adapter) -> PartHead:
    """Read a Sapiens2 segmentation model from a folder in transformers' layout.

    Args:
        fill: `path` is the folder; `options`: `SapiensOptions`.
        adapter: its declaration.

    Raises:
        CheckpointError: it is another model's, or its classes have no names.
    """
    assert fill.path is not None
    stay_offline()
    from transformers import Sapiens2ForSemanticSegmentation

    dtype, device = dtype_of(fill, adapter), device_of(fill)
    model = pretrained(Sapiens2ForSemanticSegmentation, fill.path, fill, adapter, dtype=dtype)
    classes = head_classes(model.config.id2label, adapter)
    return PartHead(
        "Sapiens2",
        lambda crops: model(crops.to(device, dtype)).logits,
        classes,
        _IMAGENET,
        SapiensOptions(**fill.options),
    )


def head_classes(names: Mapping[int, str], adapter: Adapter) -> tuple[int, ...]:
    """Numbers of the classes that are head, by their names; by Sapiens' numbers where 28 have none.

    Raises:
        CheckpointError: no name says head, and the number of classes is another one.
    """
    named = tuple(sorted(int(n) for n, name in names.items() if any(word in name.lower() for word in HEAD_WORDS)))
    if named:
        return named
    if len(names) == max(HEAD_CLASSES) + 1:
        return HEAD_CLASSES
    raise CheckpointError(
        f"{adapter.label}: expected classes named face, hair, ... (id2label in config.json), got {len(names)} without "
        f"such names; {adapter.how_to_get()}"
    )
