"""The order of the stages, in one place: what the flow, the command line and the tests all run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tasks.settings import Settings
from tasks.stage import Run, Source, Stage, StageRef, run_stage, skip_stage
from tasks.stages import STAGES

Call = Callable[[Stage, Settings, Mapping[str, StageRef | Source], Run], StageRef]
"""How a stage is called: directly, or as a Prefect task."""


@dataclass(frozen=True)
class Outcome:
    """What a run left: a reference per stage that was run or found, and a reason per stage that was not."""

    refs: Mapping[str, StageRef]
    skipped: Mapping[str, str]


def call_directly(stage: Stage, settings: Settings, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
    """Run a stage in this process, with no orchestrator."""
    return run_stage(stage, getattr(settings, stage.name), inputs, run)


def process(
    source: Source,
    settings: Settings,
    run: Run,
    *,
    only: Sequence[str] | None = None,
    call: Call = call_directly,
    stages: Sequence[Stage] = STAGES,
) -> Outcome:
    """Take one video through all stages, each fed by references to the ones it needs.

    Args:
        source: the video.
        settings: every knob.
        run: where artifacts and rows go.
        only: names of the stages wanted; those they need are run too, the others are skipped with that reason.
        call: how to run a stage.
        stages: the stages there are, in order.

    Raises:
        ValueError: `only` names a stage that does not exist.
        Exception: whatever a stage raises; finished stages stay in the store.
    """
    wanted = _with_needs(only, stages)
    refs: dict[str, StageRef] = {}
    skipped: dict[str, str] = {}
    for stage in stages:
        if stage.name not in wanted:
            skipped[stage.name] = f"not asked for (--stages {','.join(only or ())})"
            skip_stage(stage, skipped[stage.name], run)
            continue
        inputs = {name: source if name == "source" else refs[name] for name in stage.needs}
        refs[stage.name] = call(stage, settings, inputs, run)
    return Outcome(refs, skipped)


def _with_needs(only: Sequence[str] | None, stages: Sequence[Stage]) -> set[str]:
    names = [stage.name for stage in stages]
    if only is None:
        return set(names)
    unknown = sorted(set(only) - set(names))
    if unknown:
        raise ValueError(f"expected stages among {', '.join(names)}, got {', '.join(unknown)}; correct --stages")
    wanted = set(only)
    for stage in reversed(stages):  # later stages need earlier ones only
        if stage.name in wanted:
            wanted |= set(stage.needs) - {"source"}
    return wanted
