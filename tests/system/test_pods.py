"""The pods of `deploy/kubernetes` as processes of this machine: commands, settings and probes are the manifests'.

No cluster is to be had where the tests run. Addresses and folders are put for those of this machine; the rest holds.
"""

import json
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from services.cli.stack import free_endpoint
from services.table import stack_services
from tests.command import run_smal
from tests.kustomize import built, containers
from tests.services.cli.conftest import ROOT
from tests.services.secured import make_keys
from tests.services.waiting import eventually

pytestmark = [pytest.mark.rendering, pytest.mark.system]


@dataclass
class Pod:
    """A container of a pod, and the process that stands for it."""

    container: dict[str, Any]
    process: subprocess.Popen[bytes]
    http: str
    log: Path

    def passes(self, probe: str) -> bool:
        """Whether it passes one of its probes, as the kubelet asks."""
        asked = self.container[probe]["httpGet"]
        assert asked["port"] in [
            port["name"] for port in self.container["ports"] if port["containerPort"] == 9100
        ]
        assert self.process.poll() is None, self.log.read_text()
        try:
            with urllib.request.urlopen(
                f"http://{self.http}{asked['path']}", timeout=100.0
            ) as answer:
                return bool(answer.status == 200)
        except (urllib.error.URLError, OSError):
            return False


@contextmanager
def running(
    objects: list[dict[str, Any]],
    routers: dict[str, str],
    keys: Path,
    own: dict[str, str],
    folder: Path,
) -> Iterator[dict[str, Pod]]:
    """Run the pods: ``routers`` says where each is here, and ``own`` overrides settings."""
    (settings,) = (one["data"] for one in objects if one["kind"] == "ConfigMap")
    clean = {name: value for name, value in os.environ.items() if not name.startswith("SMAL_")}
    pods: dict[str, Pod] = {}
    try:
        for one in (one for one in objects if one["kind"] in {"Deployment", "StatefulSet"}):
            (container,) = containers(one)
            role = one["metadata"]["name"]
            for pod in (f"{role}-{number}" for number in range(one["spec"]["replicas"])):
                http = free_endpoint().removeprefix("tcp/")
                here = {
                    **routers,
                    "0.0.0.0:7447": routers.get(f"{pod}.router:7447", ""),
                    "0.0.0.0:9100": http,
                    "127.0.0.1:8080": "127.0.0.1:0",
                    "/run/secrets/smal/ca.pem": f"{keys}/ca.pem",
                    "/run/secrets/smal/cert.pem": f"{keys}/{role}.pem",
                    "/run/secrets/smal/key.pem": f"{keys}/{role}.key",
                }
                environment = (
                    settings
                    | {entry["name"]: entry["value"] for entry in container.get("env", [])}
                    | own
                )
                for what, stands in here.items():
                    environment = {
                        name: value.replace(what, stands) for name, value in environment.items()
                    }
                log = folder / f"{pod}.log"
                command = [sys.executable, *container["command"][1:]]
                with log.open("wb") as file:
                    process = subprocess.Popen(
                        command, env=clean | environment, stderr=file, cwd=folder
                    )
                pods[pod] = Pod(container, process, http, log)
        yield pods
    finally:
        for one in pods.values():
            one.process.kill()
            one.process.wait()


@pytest.mark.long
def test_pods_find_the_victim_without_the_first_router(
    near: Path, taught: Path, tmp_path: Path
) -> None:
    objects = built(ROOT / "deploy" / "kubernetes" / "overlays" / "one-node")
    keys = make_keys(tmp_path / "keys")
    routers = {
        f"router-{k}.router:7447": free_endpoint().replace("tcp/127.0.0.1", "localhost")
        for k in range(2)
    }
    both = ",".join(f"tls/{address}" for address in routers.values())
    own = {
        "SMAL_ROOT": str(taught), "SMAL_MODEL": str(taught / "model.smal"), "SMAL_WORLD": str(near),
        "SMAL_CAMERA_WIDTH": "160", "SMAL_CAMERA_HEIGHT": "120",
    }  # fmt: skip
    with running(objects, routers, keys, own, tmp_path) as pods:
        assert {name.rpartition("-")[0] for name in pods} == set(stack_services())
        for pod in pods.values():
            for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
                eventually(lambda pod=pod, probe=probe: pod.passes(probe), 300.0)
        gone = pods.pop("router-0").process
        gone.kill()
        gone.wait()
        # By now each of them has lost it, or it goes to the other one at its next word.
        for pod in pods.values():
            eventually(lambda pod=pod: pod.passes("readinessProbe"), 300.0)
        report = tmp_path / "run.json"
        run = ("run", "--model", taught / "model.smal", "--world", near, "--json", report)
        short = ("--episodes", 1, "--max-ticks", 400)
        found = run_smal(*run, *short, "--connect", both, "--secure", keys)
        assert found.returncode == 0, found.stderr
        (episode,) = json.loads(report.read_text())["episodes"]
        assert episode["outcome"] == "found"
        for name, pod in pods.items():
            assert eventually(lambda pod=pod: pod.passes("readinessProbe")), name
        # As Kubernetes ends them: all at once.
        for pod in pods.values():
            pod.process.send_signal(signal.SIGTERM)
        for name, pod in pods.items():
            assert pod.process.wait(100.0) == 0, f"{name}: {pod.log.read_text()}"
