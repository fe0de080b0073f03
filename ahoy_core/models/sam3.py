"""Role "mask" by SAM 3 (Carion et al., 2025), through transformers: one frame at a time, or a shot as a video.

The processors of transformers need torchvision; what they do is written out here: pictures resized to the model's
square, mean and spread 0.5. The score of a detection is sigmoid(logit) * sigmoid(presence).
"""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn.functional import interpolate

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.boxes import box_overlap, mask_bounds
from ahoy_core.models.checkpoint import dtype_of, in_batches, loading_device, pretrained
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.offline import stay_offline

TOKENS = 32  # of a prompt: what SAM 3 was trained with


class Sam3Options(BaseModel):
    """Knobs.

    Attributes:
        mode: "video" follows people through a shot with SAM 3's tracker; "image" looks at each frame alone.
        prompt: what is looked for.
        batch: frames at a time ("image"); halved where memory runs out.
        frames: longest piece of a shot that is tracked at once ("video"): bounds the memory.
        min_score: detections below it are nobody ("image"; the tracker has thresholds of its own).
        min_overlap: share of the subject's box that a person's box must meet to be the subject.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["video", "image"] = "video"
    prompt: str = "person"
    batch: int = Field(default=4, ge=1)
    frames: int = Field(default=240, ge=1)
    min_score: float = Field(default=0.3, ge=0, le=1)
    min_overlap: float = Field(default=0.2, ge=0, le=1)


class _Prompted:
    """SAM 3 with a prompt.

    Args:
        model: `Sam3Model` or `Sam3VideoModel`.
        ids: [1,32] of the prompt.
        attention: [1,32].
        options: the knobs.
    """

    def __init__(self, model: Any, ids: Tensor, attention: Tensor, options: Sam3Options) -> None:
        self.model, self.ids, self.attention, self.options = model, ids, attention, options


class Sam3Image(_Prompted):
    """Frames one by one: of the people found, the one whose box meets the subject's best."""

    name = "SAM 3 (image)"

    @torch.no_grad()
    def __call__(self, frames: Tensor, boxes: Tensor) -> Tensor:
        """Visible person [T,1,H,W] in [0,1]; 0 where no box is given or nobody is found there.

        Args:
            frames: [T,3,H,W] in [0,1].
            boxes: [T,4] x0 y0 x1 y1, pixels; NaN where the subject is not.
        """
        masks = torch.zeros(len(frames), 1, *frames.shape[2:])
        there = torch.nonzero(torch.isfinite(boxes).all(1)).flatten()
        if len(there):
            text = self.model.get_text_features(self.ids, self.attention, return_dict=True).pooler_output
            packed = torch.cat([frames[there].flatten(1), boxes[there].to(frames)], 1)
            found = in_batches(lambda rows: self._batch(rows, frames.shape[1:], text), packed, self.options.batch)
            masks[there] = found
        return masks

    def _batch(self, rows: Tensor, shape: torch.Size, text: Tensor) -> Tensor:
        frames, boxes = rows[:, :-4].unflatten(1, shape), rows[:, -4:]
        pixels = prepared(frames, self.model)
        words = SimpleNamespace(pooler_output=text.expand(len(frames), -1, -1))  # all that the model reads of it
        out = self.model(pixel_values=pixels, text_embeds=words, attention_mask=self.attention.expand(len(frames), -1))
        scores = out.pred_logits.float().sigmoid() * out.presence_logits.float().sigmoid()
        size = torch.tensor([shape[2], shape[1], shape[2], shape[1]], device=scores.device)
        overlap = box_overlap(out.pred_boxes.float() * size, boxes[:, None].to(scores))
        rank = torch.where((scores >= self.options.min_score) & (overlap >= self.options.min_overlap), overlap, -1.0)
        best, which = rank.max(1)
        chosen = out.pred_masks.float()[torch.arange(len(frames)), which][:, None]
        mask = interpolate(chosen, shape[1:], mode="bilinear", align_corners=False).sigmoid()
        return mask * (best >= 0)[:, None, None, None]


class Sam3Video(_Prompted):
    """A shot as a video: of the people that SAM 3 tracks, the one that stays in the subject's boxes."""

    name = "SAM 3 (video)"

    @torch.no_grad()
    def __call__(self, frames: Tensor, boxes: Tensor) -> Tensor:
        """See `Sam3Image`; the frames are one shot, in order, and frames without a box are masked too.

        Args:
            frames: [T,3,H,W] in [0,1].
            boxes: [T,4] x0 y0 x1 y1, pixels; NaN where the subject is not.
        """
        if not bool(torch.isfinite(boxes).all(1).any()):
            return torch.zeros(len(frames), 1, *frames.shape[2:])
        # Pieces of equal length: a last piece of one frame would have nothing to follow.
        count = math.ceil(len(frames) / self.options.frames)
        pieces = [self._piece(*piece) for piece in zip(frames.chunk(count), boxes.chunk(count), strict=True)]
        return torch.cat(pieces)

    def _piece(self, frames: Tensor, boxes: Tensor) -> Tensor:
        people: dict[int, Tensor] = {}
        height, width = frames.shape[2:]
        for out in self.model.propagate_in_video_iterator(self._session(frames)):
            hidden = {*(out.suppressed_obj_ids or ()), *(out.removed_obj_ids or ())}
            for number, mask in out.obj_id_to_mask.items():
                if number not in hidden:
                    kept = people.setdefault(number, torch.zeros(len(frames), 1, height, width))
                    sized = interpolate(mask[None].float(), (height, width), mode="bilinear", align_corners=False)
                    kept[out.frame_idx] = sized[0].sigmoid().cpu()
        return self._subject(people, boxes, torch.zeros(len(frames), 1, height, width))

    def _session(self, frames: Tensor) -> Any:
        from transformers.models.sam3_video.modeling_sam3_video import Sam3VideoInferenceSession

        parameter = next(self.model.parameters())
        # Small pieces, so that the whole shot is never held twice in float32.
        pixels = torch.cat([prepared(frame[None], self.model).cpu() for frame in frames])
        session = Sam3VideoInferenceSession(
            video=pixels,
            video_height=frames.shape[2],
            video_width=frames.shape[3],
            inference_device=parameter.device,
            inference_state_device=parameter.device,
            dtype=parameter.dtype,
        )
        prompt = session.add_prompt(self.options.prompt)
        session.prompt_input_ids[prompt], session.prompt_attention_masks[prompt] = self.ids, self.attention
        return session

    def _subject(self, people: dict[int, Tensor], boxes: Tensor, nobody: Tensor) -> Tensor:
        """The person whose masks meet the boxes best, over the frames that have one."""
        there = torch.isfinite(boxes).all(1)
        best, worth = nobody, self.options.min_overlap
        for _, masks in sorted(people.items()):
            own = torch.stack([mask_bounds(mask[0]) for mask in masks[there]]) if bool(there.any()) else boxes[there]
            overlap = float(box_overlap(own, boxes[there].to(own)).nan_to_num().mean()) if len(own) else 0.0
            if overlap >= worth:
                best, worth = masks, overlap
        return best


def prepared(frames: Tensor, model: Any) -> Tensor:
    """Frames [T,3,H,W] in [0,1] as SAM 3 takes them: its square, mean and spread 0.5, its device and dtype."""
    parameter = next(model.parameters())
    config = model.config
    vision = getattr(config, "detector_config", config).vision_config
    side = vision.backbone_config.image_size
    small = interpolate(frames.to(parameter.device), (side, side), mode="bilinear", antialias=True, align_corners=False)
    return ((small.clamp(0, 1) - 0.5) / 0.5).to(parameter.dtype)


def load_sam3(fill: Fill, adapter: Adapter) -> Sam3Image | Sam3Video:
    """Read SAM 3 from a folder in transformers' layout.

    Args:
        fill: `path` is that folder (configuration of `sam3_video` or `sam3`, weights, tokenizer); `options`: the knobs.
        adapter: its declaration.

    Raises:
        CheckpointError: it is another model's; missing weights are named.
    """
    assert fill.path is not None
    stay_offline()
    from transformers import Sam3Model, Sam3VideoModel

    options = Sam3Options(**fill.options)
    video = options.mode == "video"
    model = pretrained(Sam3VideoModel if video else Sam3Model, fill.path, fill, adapter, dtype=dtype_of(fill, adapter))
    ids, attention = (part.to(loading_device(fill)) for part in _tokens(fill.path, options.prompt, adapter))
    return Sam3Video(model, ids, attention, options) if video else Sam3Image(model, ids, attention, options)


def _tokens(folder: Path, prompt: str, adapter: Adapter) -> tuple[Tensor, Tensor]:
    from transformers import AutoTokenizer

    try:
        tokenizer = AutoTokenizer.from_pretrained(str(folder), local_files_only=True)
        coded = tokenizer(prompt, padding="max_length", truncation=True, max_length=TOKENS, return_tensors="pt")
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{adapter.label}: {folder} has no tokenizer that can be read ({error}); {adapter.how_to_get()}"
        ) from error
    return coded.input_ids, coded.attention_mask
