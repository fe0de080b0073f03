"""The Kubernetes manifests: valid by Kubernetes' own JSON schemas, and true to everything they refer to."""

from __future__ import annotations

import copy
from typing import Any

import kubernetes_validate
import pytest
import yaml

from .facts import (
    KUBERNETES,
    OUR_IMAGES,
    POSTGRES,
    UID,
    check_command,
    compose,
    is_known_variable,
    manifests,
    pod_specs,
)

VERSIONS = ("1.34", "1.37")
ALL = list(manifests())
PODS = list(pod_specs())
SECRETS = {"ahoy-auth": {"auth"}, "ahoy-database": {"url", "password"}, "ahoy-objects": {"access-key", "secret-key"}}


def named(kind: str) -> set[str]:
    return {document["metadata"]["name"] for _, document in ALL if document["kind"] == kind}


def containers(spec: dict[str, Any]) -> list[dict[str, Any]]:
    return [*spec.get("initContainers", []), *spec["containers"]]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("place", range(len(ALL)), ids=[f"{f}-{d['kind']}-{d['metadata']['name']}" for f, d in ALL])
def test_every_manifest_fits_kubernetes_schema(place: int, version: str) -> None:
    kubernetes_validate.validate(ALL[place][1], version, strict=True)


@pytest.mark.parametrize("path", [("replica",), ("template", "spec", "containers", 0, "envs"), ("replicas",)])
def test_the_schema_notices_mistakes(path: tuple[Any, ...]) -> None:
    document = copy.deepcopy(next(d for _, d in ALL if d["kind"] == "Deployment"))
    place = document["spec"]
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = "two"
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(document, VERSIONS[-1], strict=True)


def test_everything_lies_in_the_namespace_and_is_listed_once() -> None:
    listed = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["resources"]
    files = {path.name for path in KUBERNETES.glob("*.yaml")} - {"kustomization.yaml"}
    assert set(listed) | {"launcher.yaml"} == files and len(listed) == len(set(listed))
    for _, document in ALL:
        if document["kind"] != "Namespace":
            assert document["metadata"]["namespace"] in named("Namespace")
    keys = [(d["kind"], d["metadata"]["name"]) for _, d in ALL]
    assert len(keys) == len(set(keys))


@pytest.mark.parametrize(("name", "labels", "spec"), PODS, ids=[name for name, _, _ in PODS])
def test_pods_refer_to_what_there_is(name: str, labels: dict[str, str], spec: dict[str, Any]) -> None:
    volumes = {volume["name"]: volume for volume in spec.get("volumes", [])}
    owner = next(d["spec"] for _, d in ALL if d["metadata"]["name"] == name and "template" in d.get("spec", {}))
    claims = {claim["metadata"]["name"] for claim in owner.get("volumeClaimTemplates", [])}
    for volume in volumes.values():
        if "persistentVolumeClaim" in volume:
            assert volume["persistentVolumeClaim"]["claimName"] in named("PersistentVolumeClaim")
    mounted = {mount["name"] for container in containers(spec) for mount in container.get("volumeMounts", [])}
    assert mounted == set(volumes) | claims
    assert spec.get("serviceAccountName", "ahoy-launcher") in named("ServiceAccount")
    for container in containers(spec):
        assert container["image"] in OUR_IMAGES | {POSTGRES}
        for source in container.get("envFrom", []):
            assert source["configMapRef"]["name"] in named("ConfigMap")
        for variable in container.get("env", []):
            reference = variable.get("valueFrom", {}).get("secretKeyRef")
            if reference:
                assert reference["key"] in SECRETS[reference["name"]]
            if container["image"] in OUR_IMAGES:
                assert is_known_variable(variable["name"]), variable["name"]
        if container["image"] in OUR_IMAGES:
            check_command(container["args"])


def test_no_secret_stands_in_a_manifest_and_every_one_is_documented() -> None:
    assert not named("Secret")
    used = {
        (variable["valueFrom"]["secretKeyRef"]["name"], variable["valueFrom"]["secretKeyRef"]["key"])
        for _, _, spec in PODS
        for container in containers(spec)
        for variable in container.get("env", [])
        if "valueFrom" in variable
    }
    assert used == {(name, key) for name, keys in SECRETS.items() for key in keys}
    page = (KUBERNETES.parents[1] / "docs" / "deploy.md").read_text()
    for name, keys in SECRETS.items():
        assert f"secret generic {name}" in page and all(f"={key}" in page or f"{key}=" in page for key in keys)


def test_the_shared_configuration_is_read_by_somebody() -> None:
    data = next(d for _, d in ALL if d["kind"] == "ConfigMap")["data"]
    assert all(is_known_variable(name) for name in data), data
    worker = compose()["services"]["worker"]["environment"]
    assert data["AHOY_STORE"] == worker["AHOY_STORE"] and data["AHOY_SOURCES__LOCAL"] == worker["AHOY_SOURCES__LOCAL"]


def test_services_find_their_pods_and_ports() -> None:
    for _, document in ALL:
        if document["kind"] != "Service":
            continue
        selector = document["spec"]["selector"]
        found = [spec for _, labels, spec in PODS if selector.items() <= labels.items()]
        assert len(found) == 1
        ports = {p["name"]: p["containerPort"] for c in found[0]["containers"] for p in c["ports"]}
        for port in document["spec"]["ports"]:
            assert ports[port["targetPort"]] == port["port"]
    url = next(d for _, d in ALL if d["kind"] == "ConfigMap")["data"]["PREFECT_API_URL"]
    host, port = url.removeprefix("http://").removesuffix("/api").split(":")
    service = next(d for _, d in ALL if d["kind"] == "Service" and d["metadata"]["name"] == host)
    assert service["spec"]["ports"][0]["port"] == int(port)


def test_network_policies_select_pods_and_close_the_private_networks() -> None:
    import ipaddress

    from tasks.sources.address import refusal

    policies = {d["metadata"]["name"]: d["spec"] for _, d in ALL if d["kind"] == "NetworkPolicy"}
    assert policies["ahoy-nothing-by-default"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    for policy in policies.values():
        wanted = policy["podSelector"].get("matchLabels", {})
        assert any(wanted.items() <= labels.items() for _, labels, _ in PODS)
    blocks = [to["ipBlock"] for rule in policies["ahoy-workers"]["egress"] for to in rule["to"] if "ipBlock" in to]
    assert {block["cidr"] for block in blocks} == {"0.0.0.0/0", "2000::/3"}
    closed = [ipaddress.ip_network(cidr) for block in blocks for cidr in block.get("except", [])]
    for text in ("10.1.2.3", "172.31.0.1", "192.168.0.9", "169.254.169.254", "127.0.0.1", "100.100.0.1", "0.1.2.3"):
        address = ipaddress.ip_address(text)
        assert refusal(address) and any(address in network for network in closed), text
    for text in ("fd00::1", "fe80::1", "::1", "::ffff:10.0.0.1"):
        assert ipaddress.ip_address(text) not in ipaddress.ip_network("2000::/3")


@pytest.mark.parametrize(("name", "labels", "spec"), PODS, ids=[name for name, _, _ in PODS])
def test_pods_run_without_privileges(name: str, labels: dict[str, str], spec: dict[str, Any]) -> None:
    """What the namespace's own label (pod security: restricted) would refuse, and a little more."""
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert not {"hostNetwork", "hostPID", "hostIPC"} & set(spec)
    assert not [volume for volume in spec.get("volumes", []) if "hostPath" in volume]
    assert spec.get("automountServiceAccountToken") is False or "serviceAccountName" in spec
    for container in containers(spec):
        context = container["securityContext"]
        assert context["allowPrivilegeEscalation"] is False and context["capabilities"] == {"drop": ["ALL"]}
        assert container["resources"]["limits"]["memory"]
        if container["image"] in OUR_IMAGES:
            assert context["readOnlyRootFilesystem"] is True and spec["securityContext"]["runAsUser"] == UID


def test_the_gpu_variant_differs_by_the_gpu_alone() -> None:
    plain, gpu = (
        next(spec for name, _, spec in PODS if name == wanted) for wanted in ("ahoy-worker", "ahoy-worker-gpu")
    )
    gpu = copy.deepcopy(gpu)
    del gpu["nodeSelector"], gpu["tolerations"]
    assert gpu["containers"][0]["resources"]["limits"].pop("nvidia.com/gpu") == 1
    for container in containers(gpu):
        assert container["image"].endswith("-cuda")
        container["image"] = container["image"].removesuffix("-cuda")
    assert gpu == plain
