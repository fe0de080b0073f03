"""Which frames of a multi-view sequence are the input, and which show poses that the input never shows."""

from __future__ import annotations

UNSEEN_SHARE = 0.25


def learned_and_unseen(count: int) -> tuple[range, range]:
    """The first three quarters of a sequence's frames, and the rest.

    Raises:
        ValueError: fewer than two frames.
    """
    if count < 2:
        raise ValueError(f"expected at least 2 frames, got {count}; one is for learning, one for an unseen pose")
    unseen = max(1, round(UNSEEN_SHARE * count))
    return range(count - unseen), range(count - unseen, count)
