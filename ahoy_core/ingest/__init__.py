"""Video in, upright frames of a workable size out, with their times and shots."""

from ahoy_core.ingest.config import IngestConfig
from ahoy_core.ingest.run import Ingest, ingest
from ahoy_core.ingest.shots import ShotConfig, ShotDetector

__all__ = ["Ingest", "IngestConfig", "ShotConfig", "ShotDetector", "ingest"]
