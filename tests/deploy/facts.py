"""What the files of deploy/ may refer to: read off our code, the command line and the pinned set."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
POOLS = DEPLOY / "work-pools"

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = PROJECT["version"]
OUR_IMAGES = {f"ahoy:{VERSION}", f"ahoy:{VERSION}-cuda"}
POSTGRES = "postgres:18.6"
UID = 10001

# Read by libraries, not by us.
_AWS = {"AWS_ENDPOINT_URL", "AWS_DEFAULT_REGION", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"}


def pinned() -> dict[str, str]:
    """Package -> version, of constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(name): version for name, version in pairs}


def extra(name: str) -> list[Requirement]:
    """What an extra of ours installs."""
    return [Requirement(text) for text in PROJECT["optional-dependencies"][name]]


def compose() -> dict[str, Any]:
    """The compose file, merges applied."""
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())


def manifests() -> Iterator[tuple[str, dict[str, Any]]]:
    """File name and document of every Kubernetes manifest."""
    for path in sorted(KUBERNETES.glob("*.yaml")):
        if path.name != "kustomization.yaml":
            for document in yaml.safe_load_all(path.read_text()):
                yield path.name, document


def pod_specs() -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Name, labels and spec of every pod that a manifest makes."""
    for _, document in manifests():
        template = document.get("spec", {}).get("template")
        if template:
            yield document["metadata"]["name"], template["metadata"]["labels"], template["spec"]


def entrypoint_variables() -> set[str]:
    """Variables that the entrypoint takes from files."""
    text = (DEPLOY / "entrypoint.sh").read_text()
    listed = re.search(r"for name in ([A-Z_ ]+); do", text)
    assert listed
    return set(listed.group(1).split())


def is_known_variable(name: str) -> bool:
    """Whether anything reads an environment variable of this name."""
    if name.endswith("_FILE"):
        return name.removesuffix("_FILE") in entrypoint_variables()
    if name.startswith("AHOY_SOURCES__"):
        from tasks.sources import SourcePolicy

        return name.removeprefix("AHOY_SOURCES__").lower() in SourcePolicy.model_fields
    if name.startswith("AHOY_"):
        return any(f'"{name}"' in path.read_text() for package in ("flows", "tasks") for path in _modules(package))
    if name.startswith("PREFECT_INTEGRATIONS_KUBERNETES_WORKER_"):
        from prefect_kubernetes.settings import KubernetesWorkerSettings

        short = name.removeprefix("PREFECT_INTEGRATIONS_KUBERNETES_WORKER_").lower()
        return short in KubernetesWorkerSettings.model_fields
    if name.startswith("PREFECT_"):
        import prefect.settings

        return hasattr(prefect.settings, name)
    return name in _AWS or name in {"OMP_WAIT_POLICY", "NUMBA_CACHE_DIR", "PYTHONUNBUFFERED", "PATH", "HOME"}


def check_command(command: list[str]) -> None:
    """Fail unless `ahoy` or `prefect` takes this command line.

    Raises:
        AssertionError: there is no such command or option.
    """
    program, *words = command
    if program == "ahoy":
        from flows.cli import app

        _walk(typer.main.get_command(app), words, command)
    elif program == "prefect":
        from prefect.cli import app as prefect_app

        words = [word for word in words if not word.startswith("-")]
        assert words[:2] == ["worker", "start"] and prefect_app is not None
    else:
        assert program in ("python",), command


def _walk(command: Any, words: list[str], whole: list[str]) -> None:
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        found = command.commands.get(words[0])
        assert found is not None, f"`{' '.join(whole)}`: no command {words[0]!r} among {sorted(command.commands)}"
        command, words = found, words[1:]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    for word in words:
        if word.startswith("-") and word != "--help":
            assert word.partition("=")[0] in options, f"`{' '.join(whole)}`: no option {word} among {sorted(options)}"


def _modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))
