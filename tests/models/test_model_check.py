"""`ahoy models check`: every adapter on its tiny checkpoint, and what it says of a wrong one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
import yaml
from rich.console import Console
from typer.testing import CliRunner, Result

from ahoy_core.models.adapter import Adapter
from ahoy_core.models.catalogue import ADAPTERS, adapter
from flows.cli import app
from flows.models_cli import EXIT_BAD_MODEL
from tests.models.checkpoints import BUILDERS, build
from tests.models.conftest import Tiny

SAYS = {
    "body": "vertices   [1, 10475, 3] float32",
    "pose": "pose       [2, 24, 3] float32",
    "mask": "mask       [2, 1, 96, 64] float32",
    "surface": "part       [2, 96, 64] uint8",
    "head": "head       [2, 1, 96, 64] float32",
    "inpaint": "image      [3, 96, 64] float32",
    "views": "views      [4, 3, 96, 64] float32",
    "face": "images     [2, 3, 64, 64] float32",
    "video": "frames     [1, 3, 5, 64, 64] float32",
    "perceptual": "distance   [2] float32",
}


def check(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["models", "check", *arguments])


@pytest.mark.parametrize("declared", ADAPTERS, ids=lambda a: a.label)
def test_every_adapter_is_loaded_run_once_and_described(declared: Adapter, tiny: Tiny, tmp_path: Path) -> None:
    fill = tiny(declared.role, declared.name)
    file = tmp_path / "roles.yaml"
    file.write_text(yaml.safe_dump({declared.role: fill.model_dump(mode="json", exclude_defaults=True)}))
    result = check(declared.role, "--roles", str(file))
    assert result.exit_code == 0, result.output
    assert SAYS[declared.role] in result.output
    assert declared.title in result.output and declared.licence_at in result.output
    assert re.search(r"loaded in [\d.]+ s .*ran in [\d.]+ s .*peak [1-9]\d* MiB", result.output)
    if fill.path is not None:
        assert re.search(r"[0-9a-f]{64} \((none published|not compared)\)", result.output)


def test_the_adapter_is_told_by_what_is_at_the_path(tiny: Tiny) -> None:
    result = check(f"perceptual={tiny('perceptual', 'lpips-alex').path}", "--own-weights", "--device", "cpu")
    assert result.exit_code == 0 and "perceptual=lpips-alex" in result.output


def test_programs_want_the_flag(tiny: Tiny) -> None:
    path = tiny("pose", "nlf").path
    refused = check(f"pose={path}", "--device", "cpu")
    assert refused.exit_code == EXIT_BAD_MODEL and "--trust-code" in refused.output
    assert check(f"pose={path}", "--trust-code", "--device", "cpu").exit_code == 0


def test_weights_with_another_hash_than_the_published_one_are_refused(tiny: Tiny) -> None:
    result = check(f"perceptual={tiny('perceptual', 'lpips-alex').path}")
    assert result.exit_code == EXIT_BAD_MODEL
    assert re.search(r"expected .*alexnet-owt-7be5be79\.pth to have the published sha256 7be5be79, got", result.output)
    assert "get it from" in result.output and "--own-weights" in result.output


def test_missing_keys_and_where_the_right_file_is_are_named(tmp_path: Path) -> None:
    folder = BUILDERS["perceptual", "lpips-alex"](tmp_path)
    state = torch.load(folder / "alex.pth", weights_only=True)
    del state["lin3.model.1.weight"]
    torch.save(state, folder / "alex.pth")
    result = check(f"perceptual={folder}", "--own-weights")
    assert result.exit_code == EXIT_BAD_MODEL and "lacks lin3.model.1.weight" in result.output
    assert adapter("perceptual", "lpips-alex").source[:40] in result.output


def test_a_truncated_checkpoint_is_named(tmp_path: Path) -> None:
    fill = build("head", "sapiens2", tmp_path)
    assert fill.path is not None
    file = next(fill.path.glob("*.safetensors"))
    file.write_bytes(file.read_bytes()[:-100])
    result = check(f"head={fill.path}", "--device", "cpu")
    assert result.exit_code == EXIT_BAD_MODEL
    assert "cannot be read as" in result.output and "get it from" in result.output


def test_the_table_of_roles_keeps_words_in_brackets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.models_cli.console", Console(width=400))
    assert "FLUX.1 Fill [dev]" in CliRunner().invoke(app, ["models", "roles"]).output


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("ears=/x", "expected a role among"),
        ("mask", "which roles.yaml does not fill"),
        ("mask=/x", "no adapter's files"),
    ],
)
def test_what_cannot_be_meant_is_said(what: str, said: str) -> None:
    result = check(what)
    assert result.exit_code == EXIT_BAD_MODEL and said in result.output
