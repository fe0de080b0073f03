"""What every effect is to the planner."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ahoy_core.scene.cost import Rates
from ahoy_core.scene.shot import Content


@dataclass(frozen=True)
class Verdict:
    """Whether the content calls for an effect, why in one sentence, and the numbers behind it.

    `quality` is the effect's own knob, chosen for this content: samples, occluders, pixels.
    """

    called_for: bool
    reason: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    quality: int = 1


@dataclass(frozen=True)
class Effect:
    """An effect: its name, when it is called for, and its CPU-seconds over the whole clip (given its verdict).

    `possible` is False for a verdict under which applying it would change nothing or has nothing to work on; `all` and
    a list of names turn on what is possible, `auto` what is called for.
    """

    name: str
    what: str
    judge: Callable[[Content], Verdict]
    seconds: Callable[[Content, Verdict, Rates], float]
    possible: Callable[[Content], bool] = lambda content: bool(content.puppets)
