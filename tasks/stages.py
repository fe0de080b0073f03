"""The stages of one video, in order. A later one slots in here without touching the others."""

from __future__ import annotations

from tasks.animate import ANIMATE
from tasks.avatar import AVATAR
from tasks.coarse import COARSE
from tasks.complete import COMPLETE
from tasks.hallucinate import HALLUCINATE
from tasks.identity import IDENTITY
from tasks.ingest import INGEST
from tasks.motions import MOTIONS
from tasks.perceive import PERCEIVE
from tasks.report import REPORT
from tasks.stage import Stage
from tasks.texture import TEXTURE

STAGES: tuple[Stage, ...] = (
    INGEST,
    PERCEIVE,
    TEXTURE,
    COMPLETE,
    COARSE,
    IDENTITY,
    MOTIONS,
    HALLUCINATE,
    AVATAR,
    ANIMATE,
    REPORT,
)
