from __future__ import annotations

import pytest

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.perceive.networks import Networks
from tasks.model_files import ModelFileError
from tasks.roles import landmark_networks


@pytest.fixture(scope="session")
def body() -> PackagedBody:
    return load_packaged_body()


@pytest.fixture(scope="session")
def networks() -> Networks:
    """The real networks; the test is skipped where they were never pulled."""
    try:
        return landmark_networks()
    except ModelFileError as error:
        pytest.skip(str(error))
