"""Which knobs buy the most accuracy within a time, from what single changes of them were measured to gain and cost.

Gains are taken to add up: each knob was changed alone, and what two changes gain together was not measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

from scipy.optimize import isotonic_regression

BETWEEN = 3  # values tried between two measured ones, where a knob is a number
MOST_COMBINATIONS = 100_000  # more, and the values in between are left out

Seconds = Callable[[Mapping[str, Any]], float]
"""Predicted seconds of a whole run with these knobs changed."""


@dataclass(frozen=True)
class Gains:
    """What single changes gain.

    Attributes:
        by_knob: knob -> value -> accuracy over the base, which is among the values with 0.
        base: knob -> value at the base.
    """

    by_knob: Mapping[str, Mapping[Any, float]]
    base: Mapping[str, Any]

    def at(self, knob: str, value: Any) -> float | None:
        """Gain of a value; between measured numbers on a straight line over the logarithm, outside None."""
        known = self.by_knob.get(knob, {})
        if value in known:
            return known[value]
        if not _is_number(value) or value <= 0:
            return None
        numbers = sorted(one for one in known if _is_number(one) and one > 0)
        for low, high in pairwise(numbers):
            if low < value < high:
                share = math.log(value / low) / math.log(high / low)
                return known[low] + share * (known[high] - known[low])
        return None

    def rising(self, knobs: Sequence[str]) -> Gains:
        """The same, but gains of these knobs never fall with their value: the nearest such ones (least squares)."""
        return Gains({k: self._risen(k) if k in knobs else values for k, values in self.by_knob.items()}, self.base)

    def _risen(self, knob: str) -> dict[Any, float]:
        ordered = sorted(self.by_knob[knob].items())
        risen = isotonic_regression([gain for _, gain in ordered]).x
        nearest = {value: float(gain) for (value, _), gain in zip(ordered, risen, strict=True)}
        return {value: gain - nearest[self.base[knob]] for value, gain in nearest.items()}

    def values(self, knob: str, between: int) -> list[Any]:
        """Measured values of a knob, and some between neighbours where they are whole numbers."""
        known = list(self.by_knob[knob])
        if not between or not all(isinstance(one, int) and not isinstance(one, bool) and one > 0 for one in known):
            return known
        ordered = sorted(known)
        steps = [
            round(low * (high / low) ** (n / (between + 1)))
            for low, high in pairwise(ordered)
            for n in range(1, between + 1)
        ]
        return sorted({*ordered, *steps})


@dataclass(frozen=True)
class Alternative:
    """One more change: what it gains and costs beside what was chosen."""

    knob: str
    before: Any
    value: Any
    gain: float
    seconds: float


@dataclass(frozen=True)
class Choice:
    """Knobs for a budget.

    Attributes:
        changes: knob -> value, where they differ from the base.
        gain: predicted, over the base.
        seconds: predicted.
        fits: within the budget; off, even the cheapest is dearer.
        beyond: single changes that would gain more and do not fit, what gains most a second first.
    """

    changes: Mapping[str, Any]
    gain: float
    seconds: float
    fits: bool
    beyond: tuple[Alternative, ...]


def choose(gains: Gains, seconds: Seconds, budget_s: float, steps: Sequence[str] = ()) -> Choice:
    """Try every combination of worthwhile values and take the most accurate that fits; of equal ones the cheapest.

    Args:
        gains: of the knobs that may be changed.
        seconds: predicts a run.
        budget_s: seconds to spend.
        steps: knobs that are steps of a training: values between measured ones are tried too, and gains that fall with
            more of them are taken for chance.

    Raises:
        ValueError: the budget is not positive.
    """
    if not budget_s > 0:
        raise ValueError(f"expected a budget above 0 s, got {budget_s}")
    gains = gains.rising(steps)
    options = {knob: _worthwhile(gains, knob, seconds, BETWEEN if knob in steps else 0) for knob in gains.by_knob}
    if math.prod(map(len, options.values())) > MOST_COMBINATIONS:
        options = {knob: _worthwhile(gains, knob, seconds, 0) for knob in gains.by_knob}
    best: tuple[float, float, dict[str, Any]] | None = None
    cheapest: tuple[float, float, dict[str, Any]] | None = None
    for values in product(*options.values()):
        changed = {k: v for k, v in zip(options, values, strict=True) if v != gains.base[k]}
        took = seconds(changed)
        gain = sum(gains.at(knob, value) or 0.0 for knob, value in changed.items())
        if took <= budget_s and (best is None or (-gain, took) < best[:2]):
            best = -gain, took, changed
        if cheapest is None or (took, -gain) < cheapest[:2]:
            cheapest = took, -gain, changed
    assert cheapest is not None  # the product of no knobs has one element
    fits = best is not None
    took, gain, changed = (best[1], -best[0], best[2]) if best else (cheapest[0], -cheapest[1], cheapest[2])
    now = {**gains.base, **changed}
    beyond = [one for one in alternatives(gains, now, seconds) if one.gain > 0]
    return Choice(changed, gain, took, fits, tuple(sorted(beyond, key=_price)))


def _worthwhile(gains: Gains, knob: str, seconds: Seconds, between: int) -> list[Any]:
    """Values of a knob than which no other is both as accurate and as cheap, and the base's.

    Which of two values is the cheaper one does not depend on the other knobs: each of them makes a run longer or
    shorter throughout.
    """
    priced = [(seconds({knob: v}), -(gains.at(knob, v) or 0.0), v) for v in gains.values(knob, between)]
    kept, least = [], math.inf
    for _, loss, value in sorted(priced, key=lambda one: one[:2]):
        if loss < least or value == gains.base[knob]:
            kept.append(value)
        least = min(least, loss)
    return kept


def alternatives(gains: Gains, now: Mapping[str, Any], seconds: Seconds) -> list[Alternative]:
    """Every measured single change of the knobs as they are; knobs whose value was not measured are left out.

    Args:
        gains: of single changes.
        now: knob -> value.
        seconds: predicts a run with knobs changed from the base.
    """
    took = seconds(now)
    found = []
    for knob, known in gains.by_knob.items():
        if knob not in now or (here := gains.at(knob, now[knob])) is None:
            continue
        for value, gain in known.items():
            if value != now[knob]:
                more = seconds({**now, knob: value}) - took
                found.append(Alternative(knob, now[knob], value, gain - here, more))
    return found


def worth_telling(
    found: Iterable[Alternative], least_gain: float, most: int
) -> tuple[list[Alternative], list[Alternative]]:
    """The changes that buy most a second, and those that save most for each bit of accuracy they cost.

    Args:
        found: single changes.
        least_gain: smaller gains are noise.
        most: of each kind.
    """
    found = list(found)
    buys = sorted((one for one in found if one.gain > least_gain and one.seconds > 0), key=_price)
    saves = [one for one in found if one.seconds < 0 and one.gain > -1.0]
    return buys[:most], sorted(saves, key=lambda one: max(-one.gain, least_gain) / -one.seconds)[:most]


def _price(one: Alternative) -> float:
    return one.seconds / one.gain


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
