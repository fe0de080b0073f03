"""Declarations of what can fill the roles that look at people: body, pose, mask, surface, head."""

from __future__ import annotations

from typing import Final

from ahoy_core.models.adapter import Adapter, ExpectedFile

TABLE_FILE: Final = "UV_Processed.mat"
"""DensePose's own name of its table of charts."""
SMPL_FILES: Final = ("SMPL_NEUTRAL.npz", "SMPL_MALE.npz", "SMPL_FEMALE.npz")

_WEIGHTS = ExpectedFile("*.safetensors", "weights; with *.safetensors.index.json where there are several files")

PEOPLE: Final = (
    Adapter(
        role="body",
        name="smplx",
        title="SMPL-X (your file)",
        licence="SMPL-X model licence: research; FLAME's expressions are part of it",
        commercial="no",
        licence_at="smpl-x.is.tue.mpg.de/modellicense.html",
        source="smpl-x.is.tue.mpg.de after registration: SMPLX_NEUTRAL.npz, as `path`",
        files=(ExpectedFile("", "SMPL, SMPL+H or SMPL-X as .npz"),),
        beside=(
            ExpectedFile("uv.obj|smpl_uv.obj|smplx_uv.obj", "texture coordinates, where the file has none"),
            ExpectedFile("SMPL-X__FLAME_vertex_ids.npy", "which vertices are the head"),
            ExpectedFile("FLAME_NEUTRAL.npz|flame2023.npz|generic_model.npz", "FLAME, for its expressions"),
        ),
        endings=(".npz",),
        load="ahoy_core.models.smpl_family:load_body_file",
    ),
    Adapter(
        role="pose",
        name="nlf",
        title="NLF (TorchScript)",
        licence="code MIT; weights: research only, as their release says; SMPL's or SMPL-X's terms besides",
        commercial="no",
        licence_at="github.com/isarandi/nlf",
        source="the releases of github.com/isarandi/nlf: nlf_l_multi_0.3.2.torchscript, as `path`",
        files=(ExpectedFile("", "nlf_l_multi_*.torchscript or nlf_s_multi_*.torchscript"),),
        endings=(".torchscript",),
        device="cuda",
        is_code=True,
        load="ahoy_core.models.nlf:load_nlf",
    ),
    Adapter(
        role="mask",
        name="sam3",
        title="SAM 3",
        licence="SAM License (Meta)",
        commercial="conditions",
        licence_at="github.com/facebookresearch/sam3/blob/main/LICENSE",
        source="Hugging Face, facebook/sam3, after accepting its terms: the whole folder",
        files=(
            ExpectedFile("config.json", "of sam3_video (tracker and detector) or sam3 (detector alone)"),
            _WEIGHTS,
            ExpectedFile("tokenizer.json|vocab.json", "tokenizer of CLIP"),
        ),
        parameters=0.85,
        dtype="bfloat16",
        device="cuda",
        extra="sam",
        packages=("transformers",),
        load="ahoy_core.models.sam3:load_sam3",
    ),
    Adapter(
        role="surface",
        name="densepose",
        title="DensePose (TorchScript)",
        licence="code Apache-2.0; weights CC-BY-SA-3.0, as detectron2's model zoo says",
        commercial="conditions",
        licence_at="github.com/facebookresearch/detectron2/blob/main/projects/DensePose/doc/DENSEPOSE_IUV.md",
        source="an export of densepose_rcnn_R_50_FPN_s1x (github.com/dajes/DensePose-TorchScript), as `path`",
        files=(ExpectedFile("", "densepose_rcnn_*.pt"),),
        beside=(
            ExpectedFile(TABLE_FILE, "DensePose's charts on SMPL's vertices: maps them to the body's UV"),
            ExpectedFile("|".join(SMPL_FILES), "SMPL's own file, where the body is another: its licence binds you"),
        ),
        endings=(".pt",),
        device="cuda",
        is_code=True,
        load="ahoy_core.models.densepose:load_densepose",
    ),
    Adapter(
        role="head",
        name="sapiens",
        title="Sapiens (TorchScript)",
        licence="Sapiens License (Meta); weights on Hugging Face are marked CC-BY-NC-4.0",
        commercial="no",
        licence_at="github.com/facebookresearch/sapiens/blob/main/LICENSE",
        source="Hugging Face, facebook/sapiens-seg-*-torchscript: the .pt2 of 28 classes, as `path`",
        files=(ExpectedFile("", "sapiens_*_goliath_*_torchscript.pt2"),),
        endings=(".pt2",),
        parameters=1.17,
        device="cuda",
        is_code=True,
        load="ahoy_core.models.sapiens:load_sapiens",
    ),
    Adapter(
        role="head",
        name="sapiens2",
        title="Sapiens2",
        licence="Sapiens2 License (Meta)",
        commercial="conditions",
        licence_at="github.com/facebookresearch/sapiens2/blob/main/LICENSE.md",
        source="Hugging Face, facebook/sapiens2-seg-0.4b (or a larger one): the whole folder",
        files=(ExpectedFile("config.json", "of sapiens2, with id2label"), _WEIGHTS),
        parameters=0.4,
        dtype="bfloat16",
        device="cuda",
        extra="sam",
        packages=("transformers",),
        load="ahoy_core.models.sapiens:load_sapiens2",
    ),
)
