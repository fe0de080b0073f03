"""The table of adapters, `roles.yaml`, and what a key knows of a choice."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ahoy_core.models import adapter as adapters
from ahoy_core.models.adapter import Fill
from ahoy_core.models.catalogue import ADAPTERS, adapter
from ahoy_core.models.errors import CheckpointError, MissingPackageError, ModelError, UntrustedCodeError
from tasks.fills import ENVIRONMENT, Fills, fills_from_environment, read_fills, with_flags
from tasks.role import Role
from tests.models.checkpoints import BUILDERS, build

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("each", ADAPTERS, ids=lambda a: a.label)
def test_every_adapter_declares_what_a_lawyer_and_an_operator_need(each: adapters.Adapter) -> None:
    assert each.licence and each.licence_at and each.source and each.title
    module, _, function = each.load.partition(":")
    assert callable(getattr(importlib.import_module(module), function))
    assert bool(each.packages) == (each.extra is not None)
    assert each.files or each.is_command
    for file in each.files:
        assert all(c in "0123456789abcdef" for c in file.sha256) and len(file.sha256) <= 64


def test_every_extra_asks_for_something_and_brings_what_its_adapters_import() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]

    def brought(extra: str) -> set[str]:
        names = {re.split(r"[\[<>=]", wanted)[0] for wanted in extras[extra]}
        inner = [name for wanted in extras[extra] for name in re.findall(r"ahoy-avatars\[(.+)\]", wanted)]
        return names.union(*(brought(name) for group in inner for name in group.split(",")))

    empty = {name for name, wanted in extras.items() if not wanted}
    assert empty == {"smplx"}, "an extra that asks for nothing has to be one whose loader is ours"
    for each in ADAPTERS:
        assert each.extra is None or set(each.packages) <= brought(each.extra), each.label
        assert each.extra is None or set(each.packages) <= brought("all"), each.label


def test_names_are_told_apart() -> None:
    labels = [each.label for each in ADAPTERS]
    assert len(set(labels)) == len(labels)


def test_the_table_is_read_without_any_model_library() -> None:
    code = (
        "import sys, ahoy_core.models.catalogue;"
        "print([n for n in ('torch', 'transformers', 'diffusers', 'numba', 'cv2') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_roles_yaml_is_checked_by_name_and_field(tmp_path: Path) -> None:
    fills = read_fills("perceptual: {fill: lpips-alex, path: /models/lpips, device: cpu}")
    assert fills.chosen["perceptual"].path == Path("/models/lpips")
    assert read_fills("").chosen == {} and read_fills("perceptual: {fill: embedded}").chosen == {}
    for text, expected in (
        ("perceptual: {fill: lpips-squeeze}", "lpips-alex"),
        ("ears: {fill: big}", "expected a role among .*perceptual"),
        ("perceptual: {fill: lpips-alex, pth: x}", "pth"),
        ("perceptual: {fill: lpips-alex, device: tpu}", "device"),
        ("a: b: c", "no YAML"),
        ("[1, 2]", "ROLE: "),
    ):
        with pytest.raises(ModelError, match=expected):
            read_fills(text)


def test_yaml_makes_no_objects() -> None:
    with pytest.raises(ModelError):
        read_fills("perceptual: !!python/object/apply:os.system ['true']")


def test_flags_lie_over_the_file_and_can_take_a_role_back(tmp_path: Path) -> None:
    fills = read_fills("perceptual: {fill: lpips-alex, path: /a}")
    assert with_flags(fills, ["perceptual=lpips-vgg:/b:c"], False).chosen["perceptual"].path == Path("/b:c")
    assert with_flags(fills, ["perceptual=embedded"], False).chosen == {}
    with pytest.raises(ModelError, match="ROLE=FILL:PATH"):
        with_flags(fills, ["perceptual"], False)


def test_the_environment_names_a_file_or_holds_the_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "roles.yaml"
    file.write_text("perceptual: {fill: lpips-alex, path: /a}")
    monkeypatch.setenv(ENVIRONMENT, str(file))
    fills = fills_from_environment()
    monkeypatch.setenv(ENVIRONMENT, fills.to_json())
    assert fills_from_environment() == fills and fills.chosen["perceptual"].fill == "lpips-alex"
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "none.yaml"))
    with pytest.raises(ModelError, match="no such file"):
        fills_from_environment()
    monkeypatch.delenv(ENVIRONMENT)
    assert fills_from_environment() == Fills()


def test_a_key_knows_contents_and_knobs_but_no_path_and_no_device(tmp_path: Path) -> None:
    build = BUILDERS["perceptual", "lpips-alex"]
    here, there = build(tmp_path / "here"), build(tmp_path / "there")

    def sha(**fields: object) -> str:
        found = Fills({"perceptual": Fill(fill="lpips-alex", own_weights=True, **fields)}).role("perceptual")  # type: ignore[arg-type]
        assert found is not None and found.name == "LPIPS v0.1 (AlexNet), weights of the user's own"
        return found.weights_sha256

    assert sha(path=here) == sha(path=there, device="cpu")
    assert sha(path=here) != sha(path=here, options={"a": 1})
    before = sha(path=there)
    (there / "alex.pth").write_bytes(b"another")
    assert sha(path=there) != before


def test_published_hashes_are_compared_and_a_file_is_read_again_only_when_it_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = BUILDERS["perceptual", "lpips-alex"](tmp_path)
    declared = adapter("perceptual", "lpips-alex")
    published = [
        dataclasses.replace(f, sha256=hashlib.sha256((path / f.name).read_bytes()).hexdigest()) for f in declared.files
    ]
    honest = dataclasses.replace(declared, files=tuple(published))
    fill = Fill(fill="lpips-alex", path=path, device="cpu")
    assert honest.open(fill).name == "LPIPS v0.1 (AlexNet)"
    assert all("as published" in words for words in honest.hashes(fill).values())
    read: list[object] = []
    whole = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda file, kind: read.append(file) or whole(file, kind))
    honest.require(fill)
    assert not read
    (path / "alex.pth").write_bytes((path / "alex.pth").read_bytes() + b"x")
    with pytest.raises(CheckpointError, match=rf"published sha256 {published[1].sha256}, got .* own_weights: true"):
        honest.open(fill)
    assert len(read) == 1


def test_a_model_is_loaded_once(tmp_path: Path) -> None:
    path = BUILDERS["perceptual", "lpips-alex"](tmp_path)
    own = Fill(fill="lpips-alex", path=path, device="cpu", own_weights=True)
    fills = Fills({"perceptual": own})
    assert fills.preload() == ["perceptual"], "what works on the CPU can be handed to forks"
    assert fills.get("perceptual") is fills.get("perceptual")
    assert fills.get("mask") is None


def test_a_stage_takes_a_gpus_slot_only_where_its_own_models_work_on_one(monkeypatch: pytest.MonkeyPatch) -> None:
    fills = Fills({"mask": Fill(fill="sam3", device="cpu"), "views": Fill(fill="synchuman", command=("x",))})
    assert fills.slots(("mask", "views")) == ()
    busy = Fills({"views": Fill(fill="synchuman", command=("x",), device="cuda")})
    assert busy.slots(("views",)) == ("gpu",) and busy.slots(("mask",)) == ()
    auto = Fills({"mask": Fill(fill="sam3")})
    for there, expected in ((True, ("gpu",)), (False, ())):
        monkeypatch.setattr("torch.cuda.is_available", lambda there=there: there)
        assert auto.slots(("mask",)) == expected


def test_the_example_of_deploy_is_read_and_fills_every_role() -> None:
    fills = read_fills((ROOT / "deploy" / "roles.yaml").read_text())
    assert set(fills.chosen) == {each.role for each in ADAPTERS}


def test_a_stage_keeps_its_defaults_where_nothing_is_chosen(tmp_path: Path) -> None:
    default = {"perceptual": Role("ST-LPIPS", "BSD-2-Clause", "1" * 64), "body": Role("b", "x")}
    fills = Fills({"perceptual": build("perceptual", "lpips-alex", tmp_path)})
    assert fills.filled(default, ()) == default
    changed = fills.filled(default, ("perceptual",))
    assert changed["body"] == default["body"] and changed["perceptual"].name.startswith("LPIPS")


def test_what_cannot_work_is_refused_before_anything_is_loaded(tmp_path: Path) -> None:
    declared = adapter("perceptual", "lpips-alex")
    with pytest.raises(CheckpointError, match="expected a path"):
        declared.require(Fill(fill="lpips-alex"))
    with pytest.raises(CheckpointError, match="nothing is at"):
        declared.require(Fill(fill="lpips-alex", path=tmp_path / "gone"))
    with pytest.raises(CheckpointError, match=r"lacks alexnet-owt-7be5be79\.pth, alex\.pth; get it from"):
        declared.require(Fill(fill="lpips-alex", path=tmp_path))
    missing = dataclasses.replace(declared, extra="flux", packages=("no_such_package",))
    with pytest.raises(MissingPackageError, match=r"no_such_package.*pip install 'ahoy-avatars\[flux\]'"):
        missing.require(Fill(fill="lpips-alex", path=tmp_path))
    program = dataclasses.replace(declared, files=(), is_code=True)
    with pytest.raises(UntrustedCodeError, match="trust_code"):
        program.require(Fill(fill="lpips-alex", path=tmp_path))
    program.require(Fill(fill="lpips-alex", path=tmp_path, trust_code=True))
