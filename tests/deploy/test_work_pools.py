"""Base job templates: Prefect's own formats, checked and filled in by Prefect's own code."""

from __future__ import annotations

import asyncio
import json
import uuid
from typing import Any

import kubernetes_validate
import pytest
from prefect.client.orchestration import PrefectClient
from prefect.client.schemas.objects import FlowRun
from prefect.server.schemas.actions import WorkPoolCreate
from prefect.workers.base import BaseWorker
from prefect.workers.process import ProcessWorker
from prefect_docker.worker import DockerWorker
from prefect_kubernetes.worker import KubernetesWorker

from .facts import OUR_IMAGES, POOLS, UID, compose, extra, is_known_variable, manifests, pinned

WORKERS: dict[str, type[BaseWorker[Any, Any, Any]]] = {
    "process": ProcessWorker,
    "docker": DockerWorker,
    "kubernetes": KubernetesWorker,
}


def template(kind: str) -> dict[str, Any]:
    return json.loads((POOLS / f"{kind}.json").read_text())


def filled(kind: str, **values: object) -> Any:
    """The job configuration that a worker of this kind makes of the template, ready for a run."""
    offline = PrefectClient("http://127.0.0.1:1/api")  # only a template that names blocks would ask it
    make = WORKERS[kind].job_configuration.from_template_and_values
    job = asyncio.run(make(template(kind), values, client=offline))
    job.prepare_for_flow_run(FlowRun(id=uuid.uuid4(), flow_id=uuid.uuid4(), name="brave-walk"))
    return job


@pytest.mark.parametrize("kind", WORKERS)
def test_prefect_takes_the_template(kind: str) -> None:
    WorkPoolCreate(name="ahoy", type=kind, base_job_template=template(kind))
    assert filled(kind).env["PREFECT_FLOWS_HEARTBEAT_FREQUENCY"] == "30"


@pytest.mark.parametrize("kind", WORKERS)
def test_prefect_notices_a_variable_that_is_not_declared(kind: str) -> None:
    broken = template(kind)
    del broken["variables"]["properties"]["env"]
    with pytest.raises(ValueError, match="env"):
        WorkPoolCreate(name="ahoy", type=kind, base_job_template=broken)


@pytest.mark.parametrize("kind", WORKERS)
def test_the_template_is_this_prefects_own_with_our_defaults(kind: str) -> None:
    """Whatever a newer worker adds must be taken over: regenerate from `get_default_base_job_template`."""
    ours, theirs = template(kind), WORKERS[kind].get_default_base_job_template()
    added = set(ours["variables"]["properties"]) - set(theirs["variables"]["properties"])
    assert added == ({"gpus"} if kind == "kubernetes" else set())
    for name, schema in theirs["variables"]["properties"].items():
        mine = ours["variables"]["properties"][name]
        assert {k: v for k, v in mine.items() if k != "default"} == {k: v for k, v in schema.items() if k != "default"}
    assert set(ours["job_configuration"]) == set(theirs["job_configuration"])
    if kind != "kubernetes":
        assert ours["job_configuration"] == theirs["job_configuration"]


@pytest.mark.parametrize("kind", WORKERS)
def test_defaults_refer_to_what_there_is(kind: str) -> None:
    properties = template(kind)["variables"]["properties"]
    assert all(is_known_variable(name) for name in properties["env"]["default"])
    if "image" in properties:
        assert properties["image"]["default"] in OUR_IMAGES


def test_docker_jobs_join_the_networks_and_volumes_of_the_compose_file() -> None:
    job, project = filled("docker"), compose()
    assert {name.removeprefix("ahoy_") for name in job.networks} <= set(project["networks"])
    named = [volume.split(":")[0] for volume in job.volumes if not volume.startswith("/")]
    assert {name.removeprefix("ahoy_") for name in named} <= set(project["volumes"])
    assert not job.privileged and job.container_create_kwargs["cap_drop"] == ["ALL"]
    assert job.container_create_kwargs["read_only"] is True


def test_the_counts_of_a_job_stand_where_kubernetes_reads_them() -> None:
    """Prefect's own template has them in the pod, where a strict cluster refuses them."""
    spec = filled("kubernetes").job_manifest["spec"]
    assert (spec["completions"], spec["parallelism"]) == (1, 1)
    assert not {"completions", "parallelism"} & set(spec["template"]["spec"])


def test_a_kubernetes_job_fits_kubernetes_schema_and_runs_without_privileges() -> None:
    manifest = filled("kubernetes").job_manifest
    kubernetes_validate.validate(manifest, "1.37", strict=True)
    pod = manifest["spec"]["template"]["spec"]
    container = pod["containers"][0]
    assert pod["securityContext"]["runAsUser"] == UID and pod["automountServiceAccountToken"] is False
    assert container["securityContext"]["readOnlyRootFilesystem"] is True
    assert container["resources"]["limits"]["memory"] == "12Gi"
    named = {(d["kind"], d["metadata"]["name"]) for _, d in manifests()}
    assert ("ConfigMap", container["envFrom"][0]["configMapRef"]["name"]) in named
    for volume in pod["volumes"]:
        if "persistentVolumeClaim" in volume:
            assert ("PersistentVolumeClaim", volume["persistentVolumeClaim"]["claimName"]) in named
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    labels = manifest["spec"]["template"]["metadata"]["labels"]
    assert labels["ahoy-network"] == "workers", "the network policy holds for jobs, too"


def test_a_kubernetes_job_gets_its_credentials_by_reference() -> None:
    container = filled("kubernetes").job_manifest["spec"]["template"]["spec"]["containers"][0]
    references = {v["name"]: v["valueFrom"]["secretKeyRef"]["name"] for v in container["env"] if "valueFrom" in v}
    assert references == {"AWS_ACCESS_KEY_ID": "ahoy-objects", "AWS_SECRET_ACCESS_KEY": "ahoy-objects"}


def test_a_kubernetes_job_asks_for_the_gpus_that_it_is_given() -> None:
    job = filled("kubernetes", gpus=2)
    assert job.job_manifest["spec"]["template"]["spec"]["containers"][0]["resources"]["limits"]["nvidia.com/gpu"] == 2


@pytest.mark.parametrize("name", ["docker", "kubernetes", "s3", "youtube"])
def test_the_extras_are_pinned(name: str) -> None:
    for requirement in extra(name):
        assert requirement.specifier.contains(pinned()[requirement.name]), requirement
