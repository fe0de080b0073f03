"""Wrong and truncated checkpoints: every adapter says what is missing and where the right file is."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.catalogue import ADAPTERS, adapter
from ahoy_core.models.errors import CheckpointError, UntrustedCodeError
from tests.models.checkpoints import build

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = [("head", "sapiens2"), ("mask", "sam3"), ("inpaint", "flux-fill"), ("video", "wan2.2-a14b")]
PROGRAMS = [each for each in ADAPTERS if each.is_code]
LARGEST = {"inpaint": "transformer", "video": "transformer_2"}


def weights_of(fill: Fill, role: str) -> Path:
    assert fill.path is not None
    return next((fill.path / LARGEST.get(role, "")).glob("*.safetensors"))


@pytest.mark.parametrize(("role", "name"), FOLDERS)
def test_missing_and_truncated_weights_are_named(role: str, name: str, tmp_path: Path) -> None:
    fill, declared = build(role, name, tmp_path), adapter(role, name)
    file = weights_of(fill, role)
    state = load_file(file)
    gone = next(key for key in sorted(state) if key.endswith(".weight") and "gamma" not in key)  # that one is renamed
    save_file({key: value for key, value in state.items() if key != gone}, file, metadata={"format": "pt"})
    tail = gone.split(".")[-2]
    with pytest.raises(CheckpointError, match=rf"lacks .*{tail}.*get it from {declared.source[:20]}"):
        declared.open(fill)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=r"cannot be read as .*get it from"):
        declared.open(fill)
    file.unlink()
    with pytest.raises(CheckpointError, match=r"lacks .*safetensors"):
        declared.open(fill)


@pytest.mark.parametrize("declared", PROGRAMS, ids=lambda a: a.label)
def test_programs_run_only_where_they_are_trusted_and_whole(declared: Adapter, tmp_path: Path) -> None:
    fill = build(declared.role, declared.name, tmp_path)
    assert fill.path is not None
    with pytest.raises(UntrustedCodeError, match="trust_code"):
        declared.open(fill.model_copy(update={"trust_code": False}))
    fill.path.write_bytes(fill.path.read_bytes()[:900])
    with pytest.raises(CheckpointError, match=r"truncated or no TorchScript: get it from"):
        declared.open(fill)


def test_another_program_is_refused_by_what_it_lacks(tmp_path: Path) -> None:
    other = build("head", "sapiens", tmp_path)
    with pytest.raises(CheckpointError, match="without detect_smpl_batched"):
        adapter("pose", "nlf").open(Fill(fill="nlf", path=other.path, trust_code=True, device="cpu"))


def test_flux_that_is_not_fill_is_told_by_its_channels(tmp_path: Path) -> None:
    fill = build("inpaint", "flux-fill", tmp_path)
    assert fill.path is not None
    from diffusers import AutoencoderKL

    blocks = {"down_block_types": ("DownEncoderBlock2D",) * 2, "up_block_types": ("UpDecoderBlock2D",) * 2}
    vae = AutoencoderKL(latent_channels=8, block_out_channels=(8, 8), norm_num_groups=4, layers_per_block=1, **blocks)
    shutil.rmtree(fill.path / "vae")
    vae.save_pretrained(fill.path / "vae")
    with pytest.raises(CheckpointError, match="FLUX, but not Fill"):
        adapter("inpaint", "flux-fill").open(fill)


def test_the_two_forms_of_wan_are_not_taken_for_each_other(tmp_path: Path) -> None:
    fill = build("video", "wan2.2-5b", tmp_path)
    for path in ("transformer_2",):
        shutil.copytree(fill.path / "transformer", fill.path / path)  # type: ignore[operator]
    with pytest.raises(CheckpointError, match="1 experts and AutoencoderKLWan instead of 2"):
        adapter("video", "wan2.2-a14b").open(fill.model_copy(update={"fill": "wan2.2-a14b"}))


def test_a_body_file_without_an_array_is_named(tmp_path: Path) -> None:
    from tests.body import licensed

    path = licensed.write(tmp_path, "smplx", posedirs=None)
    with pytest.raises(CheckpointError, match=r"posedirs.*get it from"):
        adapter("body", "smplx").open(Fill(fill="smplx", path=path))


def test_a_program_that_suppresses_overlaps_loads_where_torchvision_never_was(tmp_path: Path) -> None:
    fill = build("pose", "nlf", tmp_path)
    code = (
        "import sys, torch; from pathlib import Path; from ahoy_core.models.adapter import Fill;"
        "from ahoy_core.models.catalogue import adapter;"
        "model = adapter('pose', 'nlf').open(Fill(fill='nlf', path=Path(sys.argv[1]), trust_code=True, device='cpu'));"
        "boxes = torch.tensor([[0., 0, 10, 10], [1, 1, 10, 10], [20, 20, 30, 30]]);"
        "print(torch.ops.torchvision.nms(boxes, torch.tensor([.5, .9, .1]), .5).tolist(), 'torchvision' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(fill.path)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "[1, 2] False", done.stdout + done.stderr
