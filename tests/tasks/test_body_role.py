"""The body of a run: by name, or by the user's file, which keys know by its contents."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ahoy_core.body.load import PACKAGED, body_files, load_body
from tasks.roles import body_role, packaged_body
from tasks.settings import Settings


def test_the_packaged_body_is_the_default() -> None:
    assert Settings().body == PACKAGED
    assert body_role(PACKAGED) == packaged_body()
    assert load_body().name == "anny"


def test_settings_take_a_file_by_override() -> None:
    assert Settings().with_overrides(["body=/models/SMPLX_NEUTRAL.npz"]).body == "/models/SMPLX_NEUTRAL.npz"


def test_a_role_is_known_by_the_contents_of_its_files_and_not_by_their_place(tmp_path: Path) -> None:
    roles = []
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "SMPLX_NEUTRAL.npz"
        path.write_bytes(b"the same body")
        roles.append(body_role(str(path)))
    assert roles[0] == roles[1]
    assert "SMPLX_NEUTRAL" in roles[0].name and len(roles[0].weights_sha256) == 64
    np.save(tmp_path / "there" / "SMPL-X__FLAME_vertex_ids.npy", np.arange(3))
    (tmp_path / "there" / "uv.obj").write_text("vt 0 0")
    path = tmp_path / "there" / "SMPLX_NEUTRAL.npz"
    assert [file.name for file in body_files(str(path))] == [path.name, "uv.obj", "SMPL-X__FLAME_vertex_ids.npy"]
    assert body_role(str(path)).weights_sha256 != roles[0].weights_sha256, "what lies beside it shapes the result"


def test_a_body_that_is_not_there_is_refused_with_what_is_possible() -> None:
    for ask in (body_role, load_body):
        with pytest.raises(FileNotFoundError, match=r"'packaged' or the path of an SMPL"):
            ask("nowhere.npz")
