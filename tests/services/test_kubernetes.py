"""The manifests for Kubernetes fit its API and the table of services."""

import re
import runpy
from itertools import product
from typing import Any

import kubernetes_validate
import pytest

from services.kit.version import program_version
from services.kit.zenoh_session import addresses
from services.table import SERVICES, roles, stack_services
from tests.kustomize import Object, built, containers, pods_of
from tests.services.cli.conftest import ROOT

KUBERNETES = ROOT / "deploy" / "kubernetes"
OVERLAYS = {name: built(KUBERNETES / "overlays" / name) for name in ("one-node", "cluster")}
BUS = 7447
PAGE = 8080
HTTP = 9100
ENGINE = 8786
overlays = pytest.mark.parametrize("objects", OVERLAYS.values(), ids=OVERLAYS)


def of_kind(objects: list[Object], *kinds: str) -> dict[str, Object]:
    return {one["metadata"]["name"]: one for one in objects if one["kind"] in kinds}


@overlays
def test_the_api_takes_them(objects: list[Object]) -> None:
    for one in objects:
        if (
            one["kind"] == "DaskCluster"
        ):  # Whose schema its operator brings; of its pods the API's own.
            for pod in pods_of(one):
                as_pod = {
                    "apiVersion": "v1",
                    "kind": "Pod",
                    "metadata": {"name": "pod"},
                    "spec": pod,
                }
                kubernetes_validate.validate(
                    as_pod, kubernetes_validate.latest_version(), strict=True
                )
        else:
            kubernetes_validate.validate(one, kubernetes_validate.latest_version(), strict=True)


@overlays
def test_each_service_has_its_workload_image_and_certificate(
    objects: list[Object],
) -> None:
    workloads = of_kind(objects, "Deployment", "StatefulSet")
    assert workloads.keys() == set(stack_services())
    for name, one in workloads.items():
        row = SERVICES[name]
        template = one["spec"]["template"]
        (container,) = containers(one)
        assert (
            one["spec"]["selector"]["matchLabels"]
            == template["metadata"]["labels"]
            == {"role": name}
        )
        assert container["command"] == ["python", *row.command]
        assert re.search(rf"\bsmal-{row.image}:{re.escape(program_version())}$", container["image"])
        secrets = [
            volume["secret"]["secretName"]
            for volume in template["spec"]["volumes"]
            if "secret" in volume
        ]
        assert secrets == [name]
    assert {name for name in workloads if workloads[name]["kind"] == "StatefulSet"} == {
        "router",
        "robot",
    }
    assert workloads["robot"]["spec"]["replicas"] == 1
    scaled = [
        one["spec"]["scaleTargetRef"]["name"]
        for one in objects
        if one["kind"] == "HorizontalPodAutoscaler"
    ]
    assert all(SERVICES[name].grouped for name in scaled)


@overlays
def test_manifests_refer_to_secrets_by_path_only(objects: list[Object]) -> None:
    assert not of_kind(objects, "Secret")
    settings = dict(of_kind(objects, "ConfigMap")["smal"]["data"])
    for container in (container for one in objects for container in containers(one)):
        settings |= {entry["name"]: entry["value"] for entry in container.get("env", [])}
    secret = {name for name in settings if re.search(r"CERT|KEY|TOKEN|CA$|CA_FILE$", name)}
    assert secret >= {"SMAL_TLS_CA", "SMAL_TLS_CERT", "SMAL_TLS_KEY"}
    assert all(settings[name].startswith("/run/secrets/") for name in secret)


@overlays
def test_containers_are_restricted(objects: list[Object]) -> None:
    for pod in (pod for one in objects for pod in pods_of(one)):
        assert pod["automountServiceAccountToken"] is False
        assert pod["securityContext"]["runAsNonRoot"]
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        for container in pod["containers"]:
            assert container["securityContext"] == {
                "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
            }  # fmt: skip
            assert container["resources"]["requests"].keys() == {"cpu", "memory"}
            assert container["resources"]["limits"].keys() == {
                "memory"
            }  # a processor that is held back drives late
        assert not {"hostNetwork", "hostPID", "hostIPC"} & pod.keys()
        assert not any("hostPath" in volume for volume in pod["volumes"])


@overlays
def test_busy_pods_live_and_single_services_are_recreated(
    objects: list[Object],
) -> None:
    for name, one in of_kind(objects, "Deployment", "StatefulSet").items():
        (container,) = containers(one)
        # Health says 503 of who is busy, or without a router; metrics are told by whatever lives.
        alive = container["livenessProbe"]
        assert alive["httpGet"]["path"] == "/metrics"
        assert alive["periodSeconds"] * alive["failureThreshold"] >= 60
        assert container["readinessProbe"]["httpGet"]["path"] == "/healthz"
        # What cannot run twice is a StatefulSet, or ends before it starts; what can hands its robots on.
        twice = SERVICES[name].grouped or one["kind"] == "StatefulSet"
        assert one["spec"].get("strategy") == (None if twice else {"type": "Recreate"}), name


@overlays
def test_the_routers_know_each_other_and_all_know_both(objects: list[Object]) -> None:
    settings = of_kind(objects, "ConfigMap")["smal"]["data"]
    routers = of_kind(objects, "StatefulSet")["router"]
    replicas = routers["spec"]["replicas"]
    service = of_kind(objects, "Service")["router"]
    both = [f"tls/router-{k}.{service['metadata']['name']}:{BUS}" for k in range(replicas)]
    own = {one["name"]: one["value"] for one in containers(routers)[0]["env"]}
    assert addresses(settings["SMAL_ROUTER"]) == both
    assert addresses(own["SMAL_PEERS"]) == both[:1]
    assert len(both) == 2
    # A name has to hold before its router is ready, which it is when it is its own client.
    assert service["spec"]["publishNotReadyAddresses"]
    assert service["spec"]["selector"] == routers["spec"]["selector"]["matchLabels"]


def test_the_policies_are_made_of_the_table() -> None:
    made = runpy.run_path(str(KUBERNETES / "policies.py"))["as_yaml"]()
    assert (KUBERNETES / "base" / "network.yaml").read_text() == made, (
        "run deploy/kubernetes/policies.py"
    )


def selects(selector: dict[str, Any], labels: dict[str, str]) -> bool:
    terms = selector.get("matchExpressions", [])
    assert {term["operator"] for term in terms} <= {"In", "Exists"}
    return all(
        labels.get(key) == value for key, value in selector.get("matchLabels", {}).items()
    ) and all(
        term["key"] in labels and labels[term["key"]] in term.get("values", [labels[term["key"]]])
        for term in terms
    )


def reaches(objects: list[Object], giver: dict[str, str], taker: dict[str, str], port: int) -> bool:
    """Whether one pod of the namespace may connect to another: its way out and the other's way in must allow it."""

    def allowed(kind: str, pod: dict[str, str], other: dict[str, str], side: str) -> bool:
        of_pod = [
            policy["spec"]
            for policy in of_kind(objects, "NetworkPolicy").values()
            if kind in policy["spec"]["policyTypes"] and selects(policy["spec"]["podSelector"], pod)
        ]
        assert of_pod, "the default of Kubernetes, everybody, holds for nobody"
        return any(
            any(
                "namespaceSelector" not in peer and selects(peer["podSelector"], other)
                for peer in rule[side]
            )
            and port in [one["port"] for one in rule.get("ports", [{"port": port}])]
            for spec in of_pod
            for rule in spec[kind.lower()]
        )

    return allowed("Egress", giver, taker, "to") and allowed("Ingress", taker, giver, "from")


@overlays
def test_only_services_reach_the_routers(
    objects: list[Object],
) -> None:
    dask = {"dask.org/cluster-name": "dask"}
    on_the_bus = [{"role": name} for name in roles()]
    pods = [*on_the_bus, dask, {"role": "elsewhere"}, {"app": "elsewhere"}, {}]
    for giver, taker, port in product(pods, pods, (BUS, PAGE, HTTP, ENGINE, 22, 53)):
        by_bus = giver in on_the_bus and taker == {"role": "router"} and port == BUS
        by_engine = "dask" in str(objects) and giver == taker == dask
        assert reaches(objects, giver, taker, port) == (by_bus or by_engine), (giver, taker, port)


@overlays
def test_only_prometheus_reads_metrics_from_outside(
    objects: list[Object],
) -> None:
    outside = [
        (policy["metadata"]["name"], peer, rule.get("ports"))
        for policy in of_kind(objects, "NetworkPolicy").values()
        for rule in policy["spec"].get("ingress", [])
        for peer in rule["from"]
        if "podSelector" not in peer
    ]
    prometheus = {
        "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}
    }
    assert outside == [("monitoring", prometheus, [{"port": HTTP}])] * (
        objects is OVERLAYS["cluster"]
    )
    assert not of_kind(objects, "Ingress")
    assert all(
        one["spec"].get("clusterIP") == "None" for one in of_kind(objects, "Service").values()
    )
