"""The stages of one video, in order. A later one slots in here without touching the others."""

from __future__ import annotations

from tasks.animate import ANIMATE
from tasks.avatar import AVATAR
from tasks.coarse import COARSE
from tasks.ingest import INGEST
from tasks.perceive import PERCEIVE
from tasks.report import REPORT
from tasks.stage import Stage
from tasks.texture import TEXTURE

STAGES: tuple[Stage, ...] = (INGEST, PERCEIVE, TEXTURE, COARSE, AVATAR, ANIMATE, REPORT)
