from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from ahoy_core.avatar import Avatar, AvatarInfo, load_avatar, save_avatar
from ahoy_core.avatar.avatar import bake, network_config
from ahoy_core.avatar.deform import OffsetBounds, offset_channels
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.rotations import quaternion_to_matrix
from ahoy_core.maps import StyleUNet
from tests.avatar.scenes import body, dressed, poses

INFO = AvatarInfo(body=body().name, licence="CC0-1.0", provenance={"source": "made for this test"})


@cache
def _avatar() -> Avatar:
    start = dressed()
    network = StyleUNet(network_config(start, 8, offset_channels(start)), torch.Generator().manual_seed(0))
    with torch.no_grad():  # off the template, so that every field is exercised
        for decoder in network.decoders:
            for head in decoder.heads:
                head.weight.normal_(0, 0.05, generator=torch.Generator().manual_seed(1))
    return bake(start, network, OffsetBounds(), body().default_betas, poses(3)[0], INFO)


def test_a_saved_avatar_comes_back_bit_for_bit(tmp_path: Path):
    save_avatar(_avatar(), tmp_path)
    back = load_avatar(tmp_path)
    for name in ("means", "quats", "scales", "opacities", "colors", "skin_weights", "betas", "training_poses"):
        assert torch.equal(getattr(back, name), getattr(_avatar(), name)), name
    for name in ("uv", "observed", "head", "skin_indices"):
        assert torch.equal(getattr(back, name), getattr(_avatar(), name)), name
    assert (back.info, back.bounds, back.template.pitch) == (_avatar().info, _avatar().bounds, _avatar().template.pitch)
    pose = poses(1)[0][0]
    assert torch.equal(back.pose(body(), pose).covars, _avatar().pose(body(), pose).covars)


def test_a_loaded_network_makes_the_same_gaussians_so_training_can_go_on(tmp_path: Path):
    save_avatar(_avatar(), tmp_path)
    back = load_avatar(tmp_path)
    again = bake(back.template, back.network, back.bounds, back.betas, back.training_poses, back.info)
    assert torch.equal(again.means, _avatar().means)
    assert torch.equal(again.colors, _avatar().colors)


def test_the_file_says_what_was_invented_and_that_it_is_synthetic(tmp_path: Path):
    _, description = save_avatar(_avatar(), tmp_path)
    stored = json.loads(description.read_text())
    assert stored["observed_share"] + stored["invented_share"] == pytest.approx(1.0)
    assert "ynthetic" in stored["synthetic_media"]
    assert stored["provenance"] == {"source": "made for this test"}
    assert stored["body"] == body().name


def test_damaged_files_are_refused_by_name(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"avatar\.safetensors"):
        load_avatar(tmp_path)
    tensors, description = save_avatar(_avatar(), tmp_path)
    whole = tensors.read_bytes()
    tensors.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="damaged"):
        load_avatar(tmp_path)
    tensors.write_bytes(whole)
    description.write_text(json.dumps({**json.loads(description.read_text()), "format": 99}))
    with pytest.raises(ValueError, match="expected avatar format 2 or older, got 99"):
        load_avatar(tmp_path)


def test_posing_with_another_body_or_a_broken_pose_is_refused():
    pose = canonical_pose(body())
    other = replace(_avatar(), info=AvatarInfo(body="someone else"))
    with pytest.raises(ValueError, match="expected body 'someone else'"):
        other.pose(body(), pose)
    with pytest.raises(ValueError, match="finite pose"):
        _avatar().pose(body(), torch.full_like(pose, math.nan))
    with pytest.raises(ValueError, match="finite pose"):
        _avatar().pose(body(), pose[:-1])


def test_exported_gaussians_have_the_posed_covariances():
    pose = canonical_pose(body()).clone()
    pose[1:30] += 0.4 * torch.randn(29, 3, generator=torch.Generator().manual_seed(5))
    posed = _avatar().pose(body(), pose, torch.tensor([0.0, 3.0, 0.0]))
    exported = _avatar().to_gaussians(posed)
    rotation = quaternion_to_matrix(exported.quats.double())
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(len(rotation), dtype=torch.float64))
    half = rotation * exported.scales.double()[:, None]
    covars = half @ half.transpose(1, 2)
    size = posed.covars.double().norm(dim=(1, 2))
    assert float(((covars - posed.covars.double()).norm(dim=(1, 2)) / size).max()) < 1e-4
    assert torch.equal(exported.means, posed.means)


def test_the_canonical_export_is_the_avatar_itself():
    exported = _avatar().to_gaussians()
    assert torch.equal(exported.quats, _avatar().quats)
    assert torch.equal(exported.scales, _avatar().scales)
