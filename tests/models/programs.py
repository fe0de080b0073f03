"""Tiny TorchScript programs with the interfaces of NLF, DensePose and Sapiens, as they are released."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from ahoy_core.models.torchscript import define_nms
from tests.body.licensed import rest_joints


class TinyNlf(nn.Module):
    """Everybody stands in a T-pose 3 m away in the middle of the picture; the uncertainty depends on the picture.

    Its interface is that of the release: `trans` in metres, joints and uncertainties in millimetres, lists by image.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("rest", torch.from_numpy(rest_joints("smpl")).float())
        self.register_buffer("rest_x", torch.from_numpy(rest_joints("smplx")).float())
        self.conv = nn.Conv2d(3, 1, 3)

    @torch.jit.export
    def detect_smpl_batched(
        self,
        images: Tensor,
        intrinsic_matrix: Tensor | None = None,
        internal_batch_size: int = 64,
        num_aug: int = 1,
        model_name: str = "smpl",
    ) -> dict[str, list[Tensor]]:
        rest = self.rest if model_name == "smpl" else self.rest_x
        out: dict[str, list[Tensor]] = {}
        for name in ["boxes", "pose", "betas", "trans", "joints3d", "joint_uncertainties"]:
            out[name] = torch.jit.annotate(list[Tensor], [])
        turn = torch.zeros(1, rest.shape[0] * 3, device=images.device)
        turn[0, 0] = 3.14159265
        flip = torch.tensor([1.0, -1.0, -1.0], device=images.device)
        for image in images:
            height, width = image.shape[1], image.shape[2]
            doubt = self.conv(image[None].float() / 255).sigmoid().mean()
            box = torch.tensor([[0.3 * width, 0.0, 0.4 * width, 1.0 * height, 0.9]], device=image.device)
            box = torch.cat([box, box])
            kept = torch.ops.torchvision.nms(box[:, :4], box[:, 4], 0.5)
            out["boxes"].append(box[kept])
            out["pose"].append(turn)
            out["betas"].append(torch.zeros(1, 10, device=image.device))
            out["trans"].append(torch.tensor([[0.0, 0.0, 3.0]], device=image.device))
            out["joints3d"].append(1000 * (flip * (rest - rest[:1]) + torch.tensor([0.0, 0.0, 3.0]))[None])
            out["joint_uncertainties"].append(40 * (0.5 + doubt) * torch.ones(1, rest.shape[0]))
        return out

    def forward(self, images: Tensor) -> Tensor:
        return images


class TinyDensePose(nn.Module):
    """One person over the middle of the picture, with a head, a torso, arms and legs where one expects them."""

    def __init__(self) -> None:
        super().__init__()
        fine = torch.full((1, 25, 28, 28), -4.0)
        places = (
            (23, (0, 5), (9, 19)), (2, (5, 14), (8, 20)), (15, (5, 14), (0, 8)),
            (16, (5, 14), (20, 28)), (7, (14, 28), (0, 14)), (8, (14, 28), (14, 28)),
        )  # fmt: skip
        for part, rows, columns in places:
            fine[0, part, rows[0] : rows[1], columns[0] : columns[1]] = 4
        self.fine = nn.Parameter(fine)
        self.coarse = nn.Parameter(torch.tensor([-1.0, 1.0])[None, :, None, None].expand(1, 2, 28, 28).clone())

    def forward(self, image: Tensor) -> dict[str, Tensor]:
        height, width = image.shape[0], image.shape[1]
        grid = torch.linspace(0.0, 1.0, 28).expand(1, 25, 28, 28)
        box = torch.tensor([[0.3 * width, 0.0, 0.7 * width, 1.0 * height]])
        return {
            "pred_boxes": box[torch.ops.torchvision.nms(box, torch.ones(1), 0.5)],
            "scores": torch.ones(1) * image.float().mean() / 255,
            "pred_densepose_coarse_segm": self.coarse,
            "pred_densepose_fine_segm": self.fine,
            "pred_densepose_u": grid,
            "pred_densepose_v": grid.transpose(2, 3),
        }


class TinySapiens(nn.Module):
    """Logits of Sapiens' 28 classes at half the size."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 28, 4, stride=2, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


def script(module: nn.Module, path: Path) -> Path:
    """Save as TorchScript."""
    define_nms()
    torch.manual_seed(0)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.jit.script(module.eval()).save(str(path))
    return path
