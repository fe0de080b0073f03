"""Tiny checkpoints in the true on-disk formats of the roles' models: names and layouts are theirs, numbers ours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ahoy_core.models.adapter import Fill
from ahoy_core.models.catalogue import adapter
from ahoy_core.prior.text import build_tokenizer
from tests.body import licensed
from tests.models.commands import cap4d, synchuman
from tests.models.programs import TinyDensePose, TinyNlf, TinySapiens, script
from tests.prior.pipelines import save_wan

ALEX_HEADS, VGG_HEADS = (64, 192, 384, 256, 256), (64, 128, 256, 512, 512)


def alexnet_features() -> nn.Sequential:
    """The layers of torchvision's AlexNet, by their numbers in its file."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


def vgg16_features() -> nn.Sequential:
    """The layers of torchvision's VGG16."""
    layers: list[nn.Module] = []
    before = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
        layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()] if width else [nn.MaxPool2d(2, 2)]
        before = width or before
    return nn.Sequential(*layers)


def lpips(folder: Path, backbone: str) -> Path:
    """A folder with both files of LPIPS on "alex" or "vgg"; as torchvision's, the backbone's has a classifier too."""
    torch.manual_seed(1)
    features, name, widths = {
        "alex": (alexnet_features, "alexnet-owt-7be5be79.pth", ALEX_HEADS),
        "vgg": (vgg16_features, "vgg16-397923af.pth", VGG_HEADS),
    }[backbone]
    state = {f"features.{key}": value for key, value in features().state_dict().items()}
    folder.mkdir(parents=True, exist_ok=True)
    torch.save({**state, "classifier.1.weight": torch.zeros(4, 9)}, folder / name)
    heads = {f"lin{n}.model.1.weight": torch.rand(1, w, 1, 1) for n, w in enumerate(widths)}
    torch.save(heads, folder / f"{backbone}.pth")
    return folder


def clip_tokenizer() -> Any:
    """A tokenizer of CLIP's kind: bytes, bytes at a word's end, the two special words."""
    from transformers import CLIPTokenizer
    from transformers.convert_slow_tokenizer import bytes_to_unicode

    letters = list(bytes_to_unicode().values())
    words = [*letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    return CLIPTokenizer(vocab={word: number for number, word in enumerate(words)}, merges=[])


def sam3(folder: Path) -> Path:
    """SAM 3 as its makers publish it: detector and tracker in one `sam3_video` folder, with CLIP's tokenizer."""
    from transformers import Sam3VideoConfig, Sam3VideoModel

    torch.manual_seed(2)
    side, width, cells = 56, 128, 4
    heads = {"hidden_size": width, "num_attention_heads": 2}
    vit = {
        "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": side, "patch_size": 14, "window_size": 2, "global_attn_indexes": [1],
        "pretrain_image_size": 28,
    }  # fmt: skip
    vision = {
        "model_type": "sam3_vision_model", "backbone_config": vit, "fpn_hidden_size": width,
        "backbone_feature_sizes": [[4 * cells] * 2, [2 * cells] * 2, [cells] * 2],
    }  # fmt: skip
    layers = {**heads, "intermediate_size": 32, "num_layers": 1}
    text = {
        "model_type": "clip_text_model", "vocab_size": 514, "hidden_size": 32, "intermediate_size": 32,
        "projection_dim": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "max_position_embeddings": 32,
        "bos_token_id": 512, "eos_token_id": 513, "pad_token_id": 513,
    }  # fmt: skip
    detector = {
        "model_type": "sam3", "vision_config": vision, "text_config": text,
        "geometry_encoder_config": {**layers, "roi_size": 2}, "detr_encoder_config": layers,
        "detr_decoder_config": {**layers, "num_queries": 6}, "mask_decoder_config": heads,
    }  # fmt: skip
    tracker = {
        "model_type": "sam3_tracker_video", "vision_config": vision,
        "prompt_encoder_config": {"hidden_size": width, "image_size": side, "patch_size": 14},
        "mask_decoder_config": {**heads, "mlp_dim": 32, "iou_head_hidden_dim": 32, "num_hidden_layers": 1},
        "memory_attention_hidden_size": width, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 32, "memory_encoder_hidden_size": width,
        "memory_encoder_output_channels": 64, "memory_attention_rope_feat_sizes": [cells, cells],
        "mask_downsampler_embed_dim": width, "memory_fuser_num_layers": 1, "memory_fuser_embed_dim": width,
        "memory_fuser_intermediate_dim": 32,
    }  # fmt: skip
    # Untrained scores are about a quarter: thresholds below them, so that somebody is found and tracked.
    config = Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, low_res_mask_size=4 * cells,
        score_threshold_detection=0.01, new_det_thresh=0.01,
    )  # fmt: skip
    config.image_size = side
    model = Sam3VideoModel(config)
    with torch.no_grad():  # untrained masks are 0.5 everywhere, which is nobody: now they are somewhere 0, somewhere 1
        model.detector_model.mask_decoder.instance_projection.weight *= 300
    model.save_pretrained(folder)
    clip_tokenizer().save_pretrained(folder)
    return folder


def sapiens2(folder: Path) -> Path:
    """A segmentation model of Sapiens2's 29 classes, a few of them named."""
    from transformers import Sapiens2Config, Sapiens2ForSemanticSegmentation

    torch.manual_seed(3)
    names = dict.fromkeys(range(29), "Other") | {0: "Background", 2: "Eyeglass", 3: "Face_Neck", 4: "Hair"}
    head = {"upsample_out_channels": [16], "conv_out_channels": [16], "conv_kernel_sizes": [1]}
    config = Sapiens2Config(
        hidden_size=32, intermediate_size=48, num_hidden_layers=2, num_attention_heads=2, image_size=[64, 48],
        num_key_value_attention_heads=2, head_config=head, id2label=names,
    )  # fmt: skip
    Sapiens2ForSemanticSegmentation(config).save_pretrained(folder)
    return folder


def flux_fill(folder: Path) -> Path:
    """FLUX.1 Fill in diffusers' layout."""
    from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, FluxFillPipeline, FluxTransformer2DModel
    from transformers import CLIPTextConfig, CLIPTextModel, T5Config, T5EncoderModel

    torch.manual_seed(4)
    latents, factor = 4, 2
    transformer = FluxTransformer2DModel(
        in_channels=8 * latents + 4 * factor**2, out_channels=4 * latents, num_layers=1, num_single_layers=1,
        attention_head_dim=16, num_attention_heads=2, joint_attention_dim=32, pooled_projection_dim=32,
        guidance_embeds=True, axes_dims_rope=(4, 4, 8),
    )  # fmt: skip
    vae = AutoencoderKL(
        latent_channels=latents, block_out_channels=(8, 8), norm_num_groups=4, layers_per_block=1,
        down_block_types=("DownEncoderBlock2D",) * 2, up_block_types=("UpDecoderBlock2D",) * 2,
        use_quant_conv=False, use_post_quant_conv=False, shift_factor=0.1,
    )  # fmt: skip
    clip = CLIPTextConfig(
        vocab_size=514, hidden_size=32, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2,
        projection_dim=32, bos_token_id=512, eos_token_id=513, pad_token_id=513,
    )  # fmt: skip
    words = build_tokenizer()
    t5 = T5Config(vocab_size=len(words), d_model=32, d_kv=16, d_ff=32, num_layers=1, num_heads=2)
    first = clip_tokenizer()
    first.model_max_length = 77
    FluxFillPipeline(
        FlowMatchEulerDiscreteScheduler(use_dynamic_shifting=True), vae, CLIPTextModel(clip), first,
        T5EncoderModel(t5), words, transformer,
    ).save_pretrained(folder)  # fmt: skip
    return folder


BUILDERS: dict[tuple[str, str], Callable[[Path], Path]] = {
    ("body", "smplx"): lambda folder: licensed.write(folder, "smplx"),
    ("pose", "nlf"): lambda folder: script(TinyNlf(), folder / "nlf_l_multi_0.3.2.torchscript"),
    ("mask", "sam3"): sam3,
    ("surface", "densepose"): lambda folder: script(TinyDensePose(), folder / "densepose_rcnn_R_50_FPN_s1x.pt"),
    ("head", "sapiens"): lambda folder: script(TinySapiens(), folder / "sapiens_0.3b_goliath_torchscript.pt2"),
    ("head", "sapiens2"): sapiens2,
    ("inpaint", "flux-fill"): flux_fill,
    ("video", "wan2.2-5b"): lambda folder: save_wan(folder, "5b"),
    ("video", "wan2.2-a14b"): lambda folder: save_wan(folder, "a14b"),
    ("perceptual", "lpips-alex"): lambda folder: lpips(folder, "alex"),
    ("perceptual", "lpips-vgg"): lambda folder: lpips(folder, "vgg"),
}
"""(role, adapter) -> builds its checkpoint in a folder and returns the path that `Fill.path` takes."""

OPTIONS: dict[tuple[str, str], dict[str, Any]] = {
    ("head", "sapiens"): {"size": (64, 48)},
    ("head", "sapiens2"): {"size": (64, 48)},
    ("inpaint", "flux-fill"): {"steps": 2, "side": 32, "tokens": 16},
    ("video", "wan2.2-5b"): {"max_tokens": 16},
    ("video", "wan2.2-a14b"): {"max_tokens": 16},
    ("mask", "sam3"): {"min_score": 0.0, "min_overlap": 0.0},
}
"""Knobs that fit the size of these checkpoints."""


def build(role: str, name: str, folder: Path) -> Fill:
    """Build a checkpoint (or a command) and return the choice that uses it, on the CPU."""
    folder.mkdir(parents=True, exist_ok=True)
    if (role, name) in COMMANDS:
        return COMMANDS[role, name](folder)
    return Fill(
        fill=name,
        path=BUILDERS[role, name](folder),
        device="cpu",
        trust_code=adapter(role, name).is_code,
        own_weights=any(file.sha256 for file in adapter(role, name).files),
        options=OPTIONS.get((role, name), {}),
    )


COMMANDS: dict[tuple[str, str], Callable[[Path], Fill]] = {("views", "synchuman"): synchuman, ("face", "cap4d"): cap4d}
