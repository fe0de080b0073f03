from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.smpl import SmplBody
from ahoy_core.body.smpl_load import load_smpl

from . import licensed

LICENSED = ("smpl", "smplh", "smplx")
BODIES = ("packaged", *LICENSED)


@pytest.fixture(scope="session")
def licensed_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One synthetic file a kind, of the true layout and size."""
    folder = tmp_path_factory.mktemp("licensed")
    files = {kind: licensed.write(folder, kind) for kind in LICENSED}
    files["smpl_uv"] = licensed.write_obj(folder / "smpl_uv.obj", "smpl")
    return files


@pytest.fixture(scope="session")
def bodies64(licensed_files: dict[str, Path]) -> dict[str, BodyModel]:
    """Every body model, in float64; SMPL and SMPL+H with a texture layout of the user's."""
    loaded: dict[str, BodyModel] = {"packaged": load_packaged_body(dtype=torch.float64)}
    for kind in LICENSED:
        uv = None if kind == "smplx" else licensed_files["smpl_uv"]
        loaded[kind] = load_smpl(licensed_files[kind], uv=uv, dtype=torch.float64)
    return loaded


@pytest.fixture(params=BODIES)
def any_body(request: pytest.FixtureRequest, bodies64: dict[str, BodyModel]) -> BodyModel:
    return bodies64[request.param]


@pytest.fixture(params=LICENSED)
def smpl_body(request: pytest.FixtureRequest, bodies64: dict[str, BodyModel]) -> SmplBody:
    body = bodies64[request.param]
    assert isinstance(body, SmplBody)
    return body
