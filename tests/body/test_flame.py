"""SMPL-X with a FLAME file beside it: the head's expressions are FLAME's, everything else stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ahoy_core.body.load import FLAME_EXPRESSIONS, body_files, load_body
from ahoy_core.formats.errors import BodyFileError
from tests.body import licensed


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flame")
    licensed.write(folder, "smplx")
    licensed.write_flame(folder)
    return folder


def test_flames_expressions_move_flames_vertices_in_our_axes_and_no_others(folder: Path, tmp_path: Path) -> None:
    body = load_body(str(folder / "SMPLX_NEUTRAL.npz"))
    plain = load_body(str(licensed.write(tmp_path, "smplx")))
    assert body.n_expressions == FLAME_EXPRESSIONS and body.n_betas == plain.n_betas
    still, betas = torch.zeros(1, 55, 3), 0.5 * torch.ones(1, body.n_betas)
    expression = torch.zeros(1, FLAME_EXPRESSIONS)
    neutral = body(still, betas, still[:, 0]).vertices[0]
    assert torch.equal(neutral, plain(still, betas, still[:, 0]).vertices[0]), "the shape is SMPL-X's own"
    expression[0, 37] = 1.0
    moved = body(still, betas, still[:, 0], expression).vertices[0] - neutral
    with np.load(folder / "FLAME_NEUTRAL.npz") as flame:
        direction = flame["shapedirs"][:, :, 300 + 37]
    ids = np.load(folder / "SMPL-X__FLAME_vertex_ids.npy")
    # The file is y up and faces +z; ours is z up and faces -y. Moving joints of the head moves vertices besides.
    expected = torch.from_numpy(direction[:, [0, 2, 1]] * [1, -1, 1]).float()
    assert float((moved[ids] - expected).abs().median()) < 1e-5
    others = np.setdiff1d(np.arange(len(neutral)), ids)
    assert float(moved[others].abs().median()) < 1e-6


def test_flame_belongs_to_the_bodys_hash(folder: Path) -> None:
    names = [path.name for path in body_files(str(folder / "SMPLX_NEUTRAL.npz"))]
    assert names == ["SMPLX_NEUTRAL.npz", "SMPL-X__FLAME_vertex_ids.npy", "FLAME_NEUTRAL.npz"]


def test_flame_without_its_list_of_vertices_or_beside_smpl_is_refused(tmp_path: Path) -> None:
    model = licensed.write(tmp_path, "smplx")
    licensed.write_flame(tmp_path)
    (tmp_path / "SMPL-X__FLAME_vertex_ids.npy").unlink()
    with pytest.raises(BodyFileError, match=r"5023 vertices that are FLAME's.*SMPL-X__FLAME_vertex_ids\.npy"):
        load_body(str(model))
    licensed.write_flame(tmp_path)
    np.save(tmp_path / "SMPL-X__FLAME_vertex_ids.npy", np.arange(7))
    with pytest.raises(BodyFileError, match="a list of 7"):
        load_body(str(model))


def test_another_file_under_flames_name_is_named(tmp_path: Path) -> None:
    model = licensed.write(tmp_path, "smplx")
    licensed.write_flame(tmp_path, shapedirs=np.zeros((licensed.FLAME_VERTICES, 3, 150)))
    with pytest.raises(BodyFileError, match=r"shapedirs \[V,3,more than 300\].*got .*150"):
        load_body(str(model))
    licensed.write_flame(tmp_path, weights=None)
    with pytest.raises(BodyFileError, match="FLAME's plain arrays"):
        load_body(str(model))
