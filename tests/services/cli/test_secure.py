"""``smal secure`` as a user has it: make, check, renew and replace certificates, and a stack that uses them."""

import os
import shutil
import signal
import threading
from contextlib import closing
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from schemas import topics
from schemas.rpc import Nothing, Status
from schemas.state import State
from services.cli import certificates
from services.cli.stack import Stack, StackPlan, instances
from services.kit.bus import BusError, Router
from services.kit.credentials import credentials_in
from services.kit.errors import UsageError
from services.kit.node import Node
from services.kit.process import read_settings
from services.kit.settings import ServiceSettings
from services.router.__main__ import RouterSettings
from services.table import roles
from tests.schemas.messages import EXAMPLES
from tests.services.cli.conftest import Mistake, Smal
from tests.services.secured import ROBOT, make_keys
from tests.services.waiting import eventually


@pytest.fixture
def keys(tmp_path: Path, smal: Smal) -> Path:
    """Make certificates as a user does."""
    assert smal("secure", "init", tmp_path / "keys")[0] == 0
    return tmp_path / "keys"


@pytest.fixture
def tls_endpoint(free_endpoint: str) -> str:
    """Give an address for encrypted connections."""
    return free_endpoint.replace("tcp/", "tls/")


def test_secure_check_accepts_certificates_of_init(keys: Path, smal: Smal) -> None:
    status, out, err = smal("secure", "check", keys)
    assert (status, err) == (0, "")
    assert all(f"{role}.pem" in out for role in roles())
    assert "problem" not in out
    assert all(path.stat().st_mode & 0o077 == 0 for path in keys.glob("*.key"))


def _replace(keys: Path, role: str, **how: object) -> None:
    """Have the authority sign something odd."""
    authority = certificates.read_authority(keys)
    key = ec.generate_private_key(ec.SECP256R1())
    odd = certificates.certificate_of(authority, str(how.get("name", role)), key.public_key(),
                                      how.get("hosts", ()), how.get("days", 1.0))  # type: ignore[arg-type]  # fmt: skip
    (keys / f"{role}.pem").write_bytes(odd.public_bytes(certificates.serialization.Encoding.PEM))
    (keys / f"{role}.key").write_bytes(certificates._pem_of(key))
    (keys / f"{role}.key").chmod(0o600)


def test_secure_check_reports_each_fault(keys: Path, smal: Smal, tmp_path: Path) -> None:
    _replace(keys, "features", days=-1 / 1440)
    _replace(keys, "policy", name="operator")
    _replace(keys, "robot", hosts=("localhost",))
    _replace(keys, "router")
    foreign = make_keys(tmp_path / "foreign")
    for end in ("pem", "key"):
        shutil.copy(foreign / f"tracker.{end}", keys)
    shutil.copy(keys / "watcher.key", keys / "recorder.key")
    (keys / "console.key").chmod(0o644)
    (keys / "recognition.pem").write_text("nothing")
    status, out, _err = smal("secure", "check", keys)
    assert status == 1
    said = {line.split()[1].partition(".")[0]: line for line in out.splitlines()}
    for role, words in {
        "features": "expired on", "policy": "issued for operator, not for policy", "robot": "act as a router",
        "router": "does not let its holder act as a router", "tracker": "not signed by an authority in ca.pem",
        "recorder": "key belongs to another certificate", "console": "readable by other users",
        "recognition": "cannot be read",
    }.items():  # fmt: skip
        assert said[role].startswith("problem"), said[role]
        assert words in said[role]
    assert said["operator"].startswith("ok")


def test_renewed_the_router_is_still_known_by_all_its_hosts(tmp_path: Path, smal: Smal) -> None:
    """Renewal without the host names locks out other machines."""
    keys = tmp_path / "keys"
    hosts = ("--host", "robot.example", "--host", "192.0.2.7")
    assert smal("secure", "init", keys, *hosts)[0] == 0
    before = _hosts_of(keys)
    assert {"robot.example", "192.0.2.7", "localhost"} < before
    for verb in ("renew", "rotate", "renew", "retire"):
        assert smal("secure", verb, keys)[0] == 0
    assert _hosts_of(keys) == before
    assert smal("secure", "renew", keys, "--host", "new.example")[0] == 0
    assert _hosts_of(keys) == before | {"new.example"}


def _hosts_of(keys: Path) -> set[str]:
    certificate = certificates.x509.load_pem_x509_certificate((keys / "router.pem").read_bytes())
    names = certificate.extensions.get_extension_for_class(
        certificates.x509.SubjectAlternativeName
    ).value
    return {str(name.value) for name in names}


@pytest.mark.parametrize("written", [0, 1])
def test_a_rotation_that_was_interrupted_is_gone_on_with(
    keys: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """The rotation is interrupted after each file that it writes."""
    write = certificates._write
    names = []

    def interrupted(path: Path, content: bytes, mode: int = 0o600) -> None:
        if len(names) == written:
            raise OSError("no space left")
        names.append(path.name)
        write(path, content, mode)

    monkeypatch.setattr(certificates, "_write", interrupted)
    assert smal("secure", "rotate", keys)[0] != 0
    monkeypatch.undo()
    assert len(names) == written
    assert "problem" not in smal("secure", "check", keys)[1]
    for verb in ("renew", "rotate", "renew", "retire"):
        assert smal("secure", verb, keys)[0] == 0, verb
        assert "problem" not in smal("secure", "check", keys)[1]
    assert smal("secure", "check", keys)[1].count("ca.pem") == 1


def test_up_names_a_certificate_of_no_use_before_anything_starts(
    keys: Path, tls_endpoint: str, mistake: Mistake
) -> None:
    _replace(keys, "operator", days=-1 / 1440)  # Not shown by a stack.
    _replace(keys, "policy", days=-1 / 1440)
    up = ("up", "--world", "yard", "--secure", keys, "--router", tls_endpoint)
    assert mistake(2, *up).startswith(f"smal: {keys / 'policy.pem'}: expired on ")
    (keys / "watcher.pem").unlink()
    assert mistake(1, *up).startswith(f"smal: certificate {keys / 'watcher.pem'} not found; ")


def test_up_tells_the_router_that_it_may_let_everybody_in(
    free_endpoint: str, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[StackPlan] = []

    def take(plan: StackPlan) -> None:
        plans.append(plan)
        raise UsageError("enough")

    monkeypatch.setattr("services.cli.up.Stack", take)
    everywhere = free_endpoint.replace("127.0.0.1", "0.0.0.0")  # noqa: S104 - what is tried
    assert "give --secure DIR" in smal("up", "--world", "yard", "--router", everywhere)[2]
    assert (
        smal("up", "--world", "yard", "--router", everywhere, "--insecure")[2] == "smal: enough\n"
    )
    monkeypatch.setattr("sys.argv", ["router", *plans[0].flags["router"]])
    assert read_settings(RouterSettings, "router").insecure


def test_authority_is_replaced_while_operator_drives(
    tls_endpoint: str, tmp_path: Path, smal: Smal
) -> None:
    """The router restarts after each step and accepts old and new keys."""
    keys = make_keys(tmp_path / "keys")
    settings = ServiceSettings(robot=ROBOT, router=tls_endpoint, secure=keys)

    def router() -> Router:
        return Router(tls_endpoint, credentials_in(keys, "router"), ROBOT)

    running = router()
    heard = threading.Event()
    with Node("recognition", settings) as speaker, Node("policy", settings) as listener:
        listener.at_once(topics.STATE, lambda _state: heard.set())

        def speaks() -> bool:
            heard.clear()
            speaker.publish(EXAMPLES[State])
            return heard.wait(0.1)

        eventually(speaks)
        for verb in ("rotate", "renew", "retire"):
            assert smal("secure", verb, keys)[0] == 0
            running.close()
            running = router()
            eventually(speaks)
        assert smal("secure", "check", keys)[1].count("ca.pem") == 1
    running.close()


@pytest.mark.system
def test_secure_stack_rejects_client_without_certificate(
    tls_endpoint: str, keys: Path, tmp_path: Path, smal: Smal
) -> None:
    services = ("router", "features")
    many = {"robots": 8, "scale": {"features": 2}}
    plan = StackPlan(services, ROBOT, tls_endpoint, secure=keys, logs=tmp_path / "logs", **many)
    with Stack(plan) as stack:
        status, out, err = smal("doctor", "--router", tls_endpoint, "--secure", keys)
        assert "for holders of a certificate, encrypted: router, features" in out
        with closing(stack.settings.open_bus("watcher")) as bus:
            eventually(lambda: len(instances(bus)["features"]) == 2)  # They see each other.
            os.kill(bus.call("features", "status", Nothing(), Status).pid, signal.SIGKILL)
            eventually(
                lambda: (
                    [len(robots) for robots in instances(bus).get("features", {}).values()] == [8]
                )
            )
        status, out, err = smal("topic", "hz", "--seconds", "0.1", "--router", tls_endpoint)
        assert status != 0
        assert "needs a certificate" in err
        stranger = tls_endpoint.replace("tls/", "tcp/")
        with pytest.raises(BusError, match="requires a certificate"):
            ServiceSettings(robot=ROBOT, router=stranger).open_bus("operator", patience_s=0.0)
