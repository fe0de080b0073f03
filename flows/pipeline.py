"""The order of the stages, in one place: what the flow, the command line and the tests all run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tasks.running import run_stage, skip_stage
from tasks.settings import Settings
from tasks.stage import Run, Source, Stage, StageRef
from tasks.stages import STAGES

Call = Callable[[Stage, Settings, Mapping[str, StageRef | Source], Run], StageRef]
"""How a stage is called: directly, or as a Prefect task."""


@dataclass(frozen=True)
class Outcome:
    """What a run left: a reference per stage (and item) that was run or found, and a reason per stage that was not."""

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
        inputs = _inputs(stage, source, refs)
        summaries = _summaries(stage, inputs, run)
        if stage.name not in wanted:
            reason = f"not asked for (--stages {','.join(only or ())})"
        elif left_out := [name for name in stage.needs if name in skipped]:
            reason = f"needs {left_out[0]}, which was skipped"
        else:
            reason = stage.obstacle(run, summaries) if stage.obstacle else ""
        if reason:
            skipped[stage.name] = reason
            skip_stage(stage, reason, run)
            continue
        for each in _mapped(stage, summaries):
            refs[each.title] = call(each, settings, inputs, replace(run, skipped=dict(skipped)))
    return Outcome(refs, skipped)


def _inputs(stage: Stage, source: Source, refs: Mapping[str, StageRef]) -> dict[str, StageRef | Source]:
    """What the stage needs, and of what it wants that which was made."""
    inputs: dict[str, StageRef | Source] = {"source": source} if "source" in stage.needs else {}
    # By title: whoever runs the stages may hand on another artifact in a stage's place.
    asked = (*stage.needs, *stage.wants)
    return inputs | {title: ref for title, ref in refs.items() if title.partition("/")[0] in asked}


def _summaries(stage: Stage, inputs: Mapping[str, StageRef | Source], run: Run) -> dict[str, Mapping[str, Any]]:
    """What the inputs found, for a stage that asks."""
    if not (stage.obstacle or stage.over):
        return {}
    made = {title: ref for title, ref in inputs.items() if isinstance(ref, StageRef)}
    manifests = {title: run.store.lookup(ref.key, stage=ref.stage, verify=False) for title, ref in made.items()}
    return {title: {} if manifest is None else manifest.summary for title, manifest in manifests.items()}


def _mapped(stage: Stage, summaries: Mapping[str, Mapping[str, Any]]) -> list[Stage]:
    """The stage itself, or one for each item that it is mapped over."""
    if not stage.over:
        return [stage]
    return [replace(stage, item=str(item)) for item in summaries[stage.over].get("items", ())]


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
            wanted |= {*stage.needs, *stage.wants} - {"source"}
    return wanted
