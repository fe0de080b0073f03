from __future__ import annotations

import pytest

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.perceive.networks import FULL, Networks, files_of
from tasks.model_files import ModelFileError, model_path


@pytest.fixture(scope="session")
def body() -> PackagedBody:
    return load_packaged_body()


@pytest.fixture(scope="session")
def networks() -> Networks:
    """The real networks; the test is skipped where they were never pulled."""
    try:
        return Networks({name: model_path(name) for name in files_of(FULL)})
    except ModelFileError as error:
        pytest.skip(str(error))
