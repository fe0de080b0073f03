"""Status knows the stages of a run without importing them."""

from __future__ import annotations

from storage_schema.artifacts import RUN_STAGES
from tasks.stages import STAGES


def test_the_stages_that_status_lists_are_those_of_a_run_in_their_order() -> None:
    assert tuple(stage.name for stage in STAGES) == RUN_STAGES
