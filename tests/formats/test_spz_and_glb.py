"""Compressed splats and binary glTF: round trips within their quantisation, damage, and readers of other people."""

from __future__ import annotations

import gzip
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from ahoy_core.formats.errors import GlbError, SpzError
from ahoy_core.formats.glb import read_glb, write_glb
from ahoy_core.formats.ply import read_ply, write_ply
from ahoy_core.formats.spz import MAGIC, read_spz, write_spz
from ahoy_core.splat import Gaussians
from tests.formats.splats import cloud, harmonics

OUTSIDE = "@playcanvas/splat-transform@3.7.0"


def turned_apart(a: Gaussians, b: Gaussians) -> float:
    """Largest sine of half the angle between two sets of rotations, whichever sign their quaternions have."""
    cosine = (a.quats * b.quats).sum(1).abs().clamp(max=1)
    return float((1 - cosine**2).sqrt().max())


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("terms", [0, 3, 8, 15])
def test_spz_returns_gaussians_within_its_quantisation(tmp_path: Path, version: int, terms: int):
    gaussians, rest = cloud(), harmonics(terms=terms) if terms else None
    write_spz(tmp_path / "a.spz", gaussians, rest, version=version)
    back = read_spz(tmp_path / "a.spz")
    assert back.version == version
    assert float((back.gaussians.means - gaussians.means).abs().max()) <= 0.5 / 4096 + 1e-6
    assert float((back.gaussians.scales / gaussians.scales).log().abs().max()) <= 0.5 / 16 + 1e-4
    assert float((back.gaussians.opacities - gaussians.opacities).abs().max()) <= 0.5 / 255 + 1e-6
    # One step of 8 bits over 0.15 is 0.026 of a harmonic, 0.0074 of a colour; half of that by rounding.
    assert float((back.gaussians.colors - gaussians.colors).abs().max()) <= 0.0038
    # 8 bits a component: w near 0 is off by sqrt(2 * 1.7 * 0.5 / 127.5); or 10 bits of the smallest three.
    assert turned_apart(back.gaussians, gaussians) <= (0.12 if version < 3 else 0.0025)
    if rest is None:
        assert back.sh_rest is None
    else:
        assert back.sh_rest is not None
        assert float((back.sh_rest - rest.clamp(-1, 127 / 128)).abs().max()) <= 0.5 / 128 + 1e-6


def test_spz_of_version_1_holds_half_floats(tmp_path: Path):
    """Written here by hand from the format's description: nothing writes it any more."""
    means = torch.tensor([[1.5, -2.25, 0.125]], dtype=torch.float16)
    body = struct.pack("<IIIBBBB", MAGIC, 1, 1, 0, 12, 0, 0) + means.numpy().tobytes()
    body += bytes([255]) + bytes([128] * 3) + bytes([160] * 3) + bytes([128, 128, 128])
    (tmp_path / "one.spz").write_bytes(gzip.compress(body))
    back = read_spz(tmp_path / "one.spz").gaussians
    assert torch.equal(back.means, means.float())
    assert torch.allclose(back.scales, torch.ones(1, 3))  # exp(160 / 16 - 10)
    assert float(back.opacities[0]) == 1.0
    assert float(back.quats[0, 0]) > 0.999


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.8, 0.99])
def test_cut_off_spz_is_refused(tmp_path: Path, version: int, share: float):
    write_spz(tmp_path / "a.spz", cloud(), harmonics(), version=version)
    data = (tmp_path / "a.spz").read_bytes()
    (tmp_path / "cut.spz").write_bytes(data[: int(share * len(data))])
    with pytest.raises(SpzError):
        read_spz(tmp_path / "cut.spz")


def test_spz_refuses_what_it_cannot_hold(tmp_path: Path):
    far = replace(cloud(3), means=torch.full((3, 3), 3000.0))
    with pytest.raises(SpzError, match="fewer bits"):
        write_spz(tmp_path / "far.spz", far)
    write_spz(tmp_path / "far.spz", far, fraction_bits=8)
    assert torch.allclose(read_spz(tmp_path / "far.spz").gaussians.means, far.means)
    with pytest.raises(SpzError, match="finite"):
        write_spz(tmp_path / "nan.spz", replace(cloud(3), opacities=torch.tensor([0.5, torch.nan, 1])))
    (tmp_path / "text.spz").write_bytes(b"ply\nformat")
    with pytest.raises(SpzError, match="neither"):
        read_spz(tmp_path / "text.spz")


def test_empty_and_extreme_gaussians_survive_spz(tmp_path: Path):
    empty = Gaussians(*(part[:0] for part in vars(cloud(1)).values() if part is not None))
    write_spz(tmp_path / "none.spz", empty)
    assert len(read_spz(tmp_path / "none.spz").gaussians) == 0
    odd = replace(cloud(2), scales=torch.tensor([[0.0, 1e-9, 1e9]] * 2), quats=torch.zeros(2, 4))
    write_spz(tmp_path / "odd.spz", odd)
    back = read_spz(tmp_path / "odd.spz").gaussians
    assert torch.isfinite(back.scales).all() and float(back.quats[0, 0]) == pytest.approx(1.0)


@pytest.mark.parametrize("terms", [0, 3, 8, 15])
def test_glb_returns_gaussians_exactly(tmp_path: Path, terms: int):
    gaussians, rest = cloud(), harmonics(terms=terms) if terms else None
    write_glb(tmp_path / "a.glb", gaussians, rest, {"observed": torch.ones(200)}, {"synthetic_media": "made up"})
    back = read_glb(tmp_path / "a.glb")
    for name in ("means", "scales", "opacities"):
        assert torch.equal(getattr(back.gaussians, name), getattr(gaussians, name))
    assert torch.allclose(back.gaussians.colors, gaussians.colors, atol=1e-6)
    assert torch.allclose(back.gaussians.quats, gaussians.quats, atol=1e-6)
    assert (back.sh_rest is None) == (rest is None) and (rest is None or torch.equal(back.sh_rest, rest))
    assert back.extra["observed"].tolist() == [1.0] * 200 and back.extras == {"synthetic_media": "made up"}


@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.999])
def test_cut_off_glb_is_refused(tmp_path: Path, share: float):
    write_glb(tmp_path / "a.glb", cloud())
    data = (tmp_path / "a.glb").read_bytes()
    (tmp_path / "cut.glb").write_bytes(data[: int(share * len(data))])
    with pytest.raises(GlbError):
        read_glb(tmp_path / "cut.glb")


def test_glb_refuses_nothing_and_nan(tmp_path: Path):
    with pytest.raises(GlbError, match="at least one"):
        write_glb(tmp_path / "a.glb", Gaussians(*(p[:0] for p in vars(cloud(1)).values() if p is not None)))
    with pytest.raises(GlbError, match="finite"):
        write_glb(tmp_path / "a.glb", replace(cloud(2), means=torch.full((2, 3), torch.nan)))


def test_trimesh_sees_the_points_and_their_plain_colours(tmp_path: Path):
    gaussians = cloud()
    write_glb(tmp_path / "a.glb", gaussians, harmonics())
    points = next(iter(trimesh.load(tmp_path / "a.glb").geometry.values()))
    assert isinstance(points, trimesh.PointCloud)
    assert torch.allclose(torch.tensor(points.vertices).float(), gaussians.means, atol=1e-6)
    found = torch.tensor(points.colors)[:, :3].float() / 255
    assert float((found - gaussians.colors).abs().max()) < 1 / 255


@pytest.fixture(scope="module")
def outside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of PlayCanvas's converter, a reader and writer of other people."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("needs npm and node, to check files with an outside reader")
    folder = tmp_path_factory.mktemp("outside")
    install = ["npm", "install", "--prefix", str(folder), "--no-audit", "--no-fund", "--ignore-scripts", OUTSIDE]
    done = subprocess.run(install, capture_output=True, text=True, timeout=240, check=False)
    command = folder / "node_modules" / ".bin" / "splat-transform"
    if done.returncode or not command.exists():
        pytest.skip(f"needs {OUTSIDE} from npm: {done.stderr[-200:]}")
    return command


def converted(command: Path, source: Path, target: Path) -> Path:
    done = subprocess.run([str(command), "-w", str(source), str(target)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return target


def test_an_outside_reader_finds_the_same_gaussians(tmp_path: Path, outside: Path):
    gaussians, rest = cloud(), harmonics()
    write_ply(tmp_path / "a.ply", gaussians, {"observed": torch.ones(200)}, sh_rest=rest)
    ply = read_ply(converted(outside, tmp_path / "a.ply", tmp_path / "b.ply"))
    assert torch.allclose(ply.gaussians.means, gaussians.means) and torch.allclose(ply.sh_rest, rest)
    assert ply.extra["observed"].tolist() == [1.0] * 200
    for version in (3, 4):
        write_spz(tmp_path / "a.spz", gaussians, rest, version=version)
        theirs = read_ply(converted(outside, tmp_path / "a.spz", tmp_path / f"s{version}.ply"))
        ours = read_spz(tmp_path / "a.spz")
        # It may turn the axes about x: up and back against down and forward.
        assert torch.allclose(theirs.gaussians.means.abs(), ours.gaussians.means.abs(), atol=1e-5)
        assert torch.allclose(theirs.gaussians.scales, ours.gaussians.scales, rtol=1e-4)
        assert torch.allclose(theirs.gaussians.colors, ours.gaussians.colors, atol=1e-4)


def test_an_outside_writers_glb_and_spz_are_read(tmp_path: Path, outside: Path):
    gaussians = cloud()
    write_ply(tmp_path / "a.ply", gaussians, sh_rest=harmonics())
    glb = read_glb(converted(outside, tmp_path / "a.ply", tmp_path / "b.glb"))
    assert torch.allclose(glb.gaussians.means.abs(), gaussians.means.abs(), atol=1e-6)
    assert torch.allclose(glb.gaussians.scales, gaussians.scales, rtol=1e-5)
    assert torch.allclose(glb.gaussians.opacities, gaussians.opacities, atol=1e-5)
    assert glb.sh_rest is not None and glb.sh_rest.shape == (200, 15, 3)
    spz = read_spz(converted(outside, tmp_path / "a.ply", tmp_path / "b.spz"))
    assert spz.gaussians.means.shape == (200, 3) and spz.sh_rest is not None
    assert float((spz.gaussians.colors - gaussians.colors).abs().max()) < 0.01
