"""The fixtures of the sources' tests: a clip, a server on the loopback interface, a policy that lets it be asked."""

from __future__ import annotations

from tests.sources.conftest import cache, clip, policy, server

__all__ = ["cache", "clip", "policy", "server"]
