"""Declarations of what can fill the roles that measure: perceptual."""

from __future__ import annotations

from typing import Final

from ahoy_core.models.adapter import Adapter, ExpectedFile

_HEADS = "github.com/richzhang/PerceptualSimilarity (also inside the wheel lpips==0.1.4, lpips/weights/v0.1/)"
_TERMS = "heads BSD-2-Clause; backbone: torchvision's BSD-3-Clause weights, trained on ImageNet (its terms: research)"

MEASURES: Final = (
    Adapter(
        role="perceptual",
        name="lpips-alex",
        title="LPIPS v0.1 (AlexNet)",
        licence=_TERMS,
        commercial="conditions",
        licence_at="github.com/richzhang/PerceptualSimilarity/blob/master/LICENSE",
        source=f"a folder with alexnet-owt-7be5be79.pth (PyTorch's model hub) and alex.pth ({_HEADS})",
        files=(
            ExpectedFile("alexnet-owt-7be5be79.pth", "AlexNet of torchvision", "7be5be79"),
            ExpectedFile(
                "alex.pth", "linear heads v0.1", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
            ),
        ),
        parameters=0.0025,
        load="ahoy_core.metrics.lpips:load_alex",
    ),
    Adapter(
        role="perceptual",
        name="lpips-vgg",
        title="LPIPS v0.1 (VGG16)",
        licence=_TERMS,
        commercial="conditions",
        licence_at="github.com/richzhang/PerceptualSimilarity/blob/master/LICENSE",
        source=f"a folder with vgg16-397923af.pth (PyTorch's model hub) and vgg.pth ({_HEADS})",
        files=(
            ExpectedFile("vgg16-397923af.pth", "VGG16 of torchvision", "397923af"),
            ExpectedFile(
                "vgg.pth", "linear heads v0.1", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"
            ),
        ),
        parameters=0.0147,
        load="ahoy_core.metrics.lpips:load_vgg",
    ),
)
