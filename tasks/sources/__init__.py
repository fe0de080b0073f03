"""Where videos come from: local files, http(s), object stores through fsspec, pages through yt-dlp."""

from storage_schema.secrets import redact, shown
from tasks.sources.fetch import fetch_source
from tasks.sources.policy import SourcePolicy, policy_from_environment
from tasks.sources.uri import Uri, parse_source, safe_name, source_name, youtube_id

__all__ = [
    "SourcePolicy",
    "Uri",
    "fetch_source",
    "parse_source",
    "policy_from_environment",
    "redact",
    "safe_name",
    "shown",
    "source_name",
    "youtube_id",
]
