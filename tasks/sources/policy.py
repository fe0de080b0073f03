"""What a video's source may be: which schemes, which addresses, how large, how long to try."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field
from pydantic_settings import BaseSettings, SettingsConfigDict

YOUTUBE_HOSTS = ("youtube.com", "youtu.be", "youtube-nocookie.com")
OBJECT_PROTOCOLS = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss")


class SourcePolicy(BaseModel):
    """Who may name what; the defaults suit a machine whose lists are written by its own users.

    For lists that strangers write, set `local=False`.

    Attributes:
        local: paths and `file://` may be named.
        local_root: if set, only files below this folder, after following links.
        object_protocols: fsspec protocols that may be named. They use the credentials of this machine.
        page_hosts: hosts (with their subdomains) whose addresses are pages, handed to yt-dlp.
        private_hosts: hosts that may lead to addresses inside this network (`nas.example`, `127.0.0.1`); `*` for all.
        secrets_in_urls: accept user names, passwords and tokens in addresses. They end up in the batch's manifest and
            in the orchestrator's database, so by default they are refused.
        max_url_length: characters.
        max_bytes: of one video.
        max_redirects: of one request.
        connect_timeout_s: for a connection; `read_timeout_s`: without a byte; `total_timeout_s`: for one video.
        attempts: tries after transient errors, the first one included.
        backoff_s: wait before the second try; doubled before each later one, up to a minute.
        max_bytes_per_s: download no faster than this; None for no limit.
        max_height: of pages that offer several sizes, the largest that is at most so many lines high.
        netrc: a netrc file with user names and passwords by host.
        cookies: a Netscape cookies file for pages.
        cache_bytes: downloads kept on this machine; the longest unused ones go first.
        archive: yt-dlp's download archive: fetched pages are noted there, and `read_list` leaves out what it names.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    local: bool = True
    local_root: Path | None = None
    object_protocols: tuple[str, ...] = OBJECT_PROTOCOLS
    page_hosts: tuple[str, ...] = YOUTUBE_HOSTS
    private_hosts: tuple[str, ...] = ()
    secrets_in_urls: bool = False
    max_url_length: int = Field(default=2048, ge=16)
    max_bytes: int = Field(default=8 * 2**30, ge=1)
    max_redirects: int = Field(default=5, ge=0)
    connect_timeout_s: float = Field(default=10.0, gt=0)
    read_timeout_s: float = Field(default=30.0, gt=0)
    total_timeout_s: float = Field(default=3600.0, gt=0)
    attempts: int = Field(default=5, ge=1)
    backoff_s: float = Field(default=1.0, ge=0)
    max_bytes_per_s: int | None = Field(default=None, ge=1)
    cache_bytes: int = Field(default=100 * 2**30, ge=0)
    max_height: int = Field(default=1080, ge=144)
    netrc: Path | None = None
    cookies: Path | None = None
    archive: Path | None = None

    def may_be_private(self, host: str) -> bool:
        """Whether a host may lead to an address inside this network."""
        return "*" in self.private_hosts or host.lower().rstrip(".") in self.private_hosts

    def is_page_host(self, host: str) -> bool:
        """Whether addresses of this host are pages for yt-dlp."""
        name = host.lower().rstrip(".")
        return any(name == known or name.endswith("." + known) for known in self.page_hosts)


class _FromEnvironment(BaseSettings):
    model_config = SettingsConfigDict(env_prefix="AHOY_", env_nested_delimiter="__")

    sources: SourcePolicy = SourcePolicy()


def policy_from_environment() -> SourcePolicy:
    """The policy of this machine: `AHOY_SOURCES__LOCAL=false`, `AHOY_SOURCES__PRIVATE_HOSTS='["nas.example"]'`, ..."""
    return _FromEnvironment().sources
