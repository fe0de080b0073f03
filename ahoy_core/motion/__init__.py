"""Motions: poses over time that drive an avatar."""

from ahoy_core.motion.procedural import Motion, replay, turn, wave

__all__ = ["Motion", "replay", "turn", "wave"]
