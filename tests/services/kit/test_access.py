"""Try every role on every key and verb, by real sessions and a real router.

The tables tell which attempts may succeed. Without rules every attempt succeeds, so each attempt proves something.
"""

import json
import os
import shutil
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Final

import pytest
import zenoh

from schemas.topics import COMMANDS, TOPICS, echo_key, rpc_key
from services.cli import certificates
from services.kit.bus import Bus, BusError, Router, host_and_port
from services.kit.credentials import Credentials, credentials_in, secret, why_refused
from services.kit.zenoh_session import MAX_SESSIONS, router_settings
from services.table import Role, roles
from tests.services.secured import ROBOT, make_keys, open_session, secured_router
from tests.services.waiting import eventually

VERBS: Final = ("put", "delete", "subscribe", "query", "serve", "token")
TOPIC_KEYS: Final = {topic.key(ROBOT): topic for topic in TOPICS.values()}
SERVED: Final = {
    rpc_key(ROBOT, *name.split("/")): name for role in roles().values() for name in role.serves
}
#: Signs of life of a process, by role.
ECHOES: Final = {echo_key(name, "1", "urgent", "stop"): name for name in roles()}
KEPT: Final = {
    f"{topic.key(ROBOT)}/@adv/pub/1/2/_": topic for topic in TOPICS.values() if topic.recorded
}
#: What nobody may name: other robots, the administration of the router, and keys that stand for many.
ADMINISTRATION: Final = "@/1/router/config/adminspace"
FOREIGN: Final = (
    *(ADMINISTRATION, "elsewhere", "smal/other/command/teleop", "smal/other/rpc/robot/arm"),
    f"smal/{ROBOT}/rpc/robot/nothing",
)
WILD: Final = (
    "**",
    f"smal/{ROBOT}/**",
    f"smal/{ROBOT}/command/*",
    f"smal/{ROBOT}/rpc/**",
    "smal/*/heartbeat",
)
KEYS: Final = (*TOPIC_KEYS, *SERVED, *KEPT, *ECHOES, *FOREIGN, *WILD)
Cell = tuple[str, str]
#: Zenoh settings of a client on a busy machine.
PATIENT: Final[dict[str, object]] = {"connect/timeout_ms": 10_000}


def allowed(role: Role, verb: str, key: str) -> bool:
    """Whether the tables allow a role to do this."""
    if key in KEPT:
        topic = KEPT[key]
        if verb in {"put", "serve", "token"}:
            return topic in role.gives
        return verb in {"subscribe", "query"} and topic in role.fetches
    if key in ECHOES:
        return verb in {"put", "subscribe"} and ECHOES[key] == role.name
    if verb == "put":
        return key in TOPIC_KEYS and TOPIC_KEYS[key] in role.gives
    if verb == "subscribe":
        # People also listen to key expressions of their robot, and hear the topics among them.
        wild = role.person and key in (f"smal/{ROBOT}/**", f"smal/{ROBOT}/command/*")
        return wild or (key in TOPIC_KEYS and TOPIC_KEYS[key] in role.takes)
    if verb == "query":
        return SERVED.get(key) in role.calls or (key == ADMINISTRATION and role.name == "operator")
    return verb == "serve" and SERVED.get(key) in role.serves


class Trial:
    """One session tries everything; the router's own session observes the effects."""

    def __init__(self, session: zenoh.Session, within: zenoh.Session) -> None:
        self._session = session
        self._within = within
        self._lock = threading.Lock()
        self.done: set[Cell] = set()

    def note(self, verb: str, key: str) -> None:
        with self._lock:
            self.done.add((verb, key))

    def settle(self, session: zenoh.Session) -> None:
        """Wait until router and session have handled all that was sent."""
        list(session.get(f"smal/{ROBOT}/rpc/nobody/nothing", timeout=100.0))

    def say(self) -> None:
        """Publish, delete, ask and declare tokens."""

        def on_sample(sample: zenoh.Sample) -> None:
            self.note(
                "put" if sample.kind == zenoh.SampleKind.PUT else "delete", str(sample.attachment)
            )

        def on_query(query: zenoh.Query) -> None:
            with query:
                self.note("query", str(query.attachment))

        def on_token(sample: zenoh.Sample) -> None:
            self.note("token", str(sample.key_expr))

        direct = zenoh.handlers.Callback
        # `**` stands for no key with @ in it: what senders keep is named.
        everything = ("**", *KEPT, *ECHOES, ADMINISTRATION)
        made = [
            self._within.declare_subscriber(key, direct(on_sample, indirect=False))
            for key in everything
        ]
        made += [
            self._within.declare_queryable(key, direct(on_query, indirect=False))
            for key in everything
        ]
        liveliness = self._within.liveliness()
        made += [
            liveliness.declare_subscriber(key, direct(on_token, indirect=False))
            for key in everything
        ]
        tokens = []
        for key in KEYS:
            self._session.put(key, b"x", attachment=key)
            self._session.delete(key, attachment=key)
            list(self._session.get(key, attachment=key, timeout=100.0))
            if key not in WILD:
                tokens.append(self._session.liveliness().declare_token(key))
        self.settle(self._session)
        for one in (*made, *tokens):
            one.undeclare()

    def hear(self) -> None:
        """Subscribe to each key alone: a session with two subscribers receives the keys of both."""
        for key in KEYS:
            heard = threading.Event()
            told = zenoh.handlers.Callback(lambda _sample, heard=heard: heard.set(), indirect=False)
            subscriber = self._session.declare_subscriber(key, told)
            self.settle(self._session)
            for one in (*TOPIC_KEYS, *KEPT, *FOREIGN) if key in WILD else (key,):
                self._within.put(one, b"x")
            self.settle(self._session)
            if heard.is_set():
                self.note("subscribe", key)
            subscriber.undeclare()

    def serve(self) -> None:
        """Answer queries."""
        for key in KEYS:

            def answer(query: zenoh.Query) -> None:
                with query:
                    query.reply(query.key_expr, b"forged")

            served = self._session.declare_queryable(
                key, zenoh.handlers.Callback(answer, indirect=False)
            )
            self.settle(self._session)
            for one in (*SERVED, *TOPIC_KEYS, *KEPT, *FOREIGN) if key in WILD else (key,):
                if any(reply.ok for reply in self._within.get(one, timeout=100.0)):
                    self.note("serve", key)
            served.undeclare()


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a folder of certificates."""
    return make_keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture
def endpoint(free_endpoint: str) -> str:
    """Give an address where certificates are asked for."""
    return free_endpoint.replace("tcp/", "tls/")


@pytest.fixture
def within(endpoint: str, keys: Path) -> Iterator[zenoh.Session]:
    """Run a router with certificates."""
    with secured_router(endpoint, keys) as session:
        yield session


def tried(session: zenoh.Session, within: zenoh.Session) -> set[Cell]:
    trial = Trial(session, within)
    trial.say()
    trial.hear()
    trial.serve()
    return trial.done


def permitted(role: Role) -> set[Cell]:
    return {(verb, key) for verb in VERBS for key in KEYS if allowed(role, verb, key)}


@pytest.mark.parametrize("role", roles().values(), ids=lambda role: role.name)
def test_role_can_do_exactly_its_table(
    role: Role, endpoint: str, keys: Path, within: zenoh.Session
) -> None:
    with closing(open_session(endpoint, credentials_in(keys, role.name))) as session:
        done = tried(session, within)
    assert done - permitted(role) == set()
    assert permitted(role) - done == set()


def test_without_rules_every_attempt_goes_through(free_endpoint: str) -> None:
    with (
        closing(Router(free_endpoint)) as router,
        closing(open_session(free_endpoint, None)) as session,
    ):
        done = tried(session, router._session)
    could = {(verb, key) for verb in VERBS for key in KEYS if verb != "token" or key not in WILD}
    assert could - done == set()


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_stolen_watcher_certificate_gives_no_more_to_a_router(
    mode: str, endpoint: str, keys: Path, within: zenoh.Session
) -> None:
    more = {"listen/endpoints": []}
    with closing(open_session(endpoint, credentials_in(keys, "watcher"), more, mode)) as session:
        eventually(lambda: bool(session.info.routers_zid()))
        done = tried(session, within)
    assert done - permitted(roles()["watcher"]) == set()


def _router_configuration(endpoint: str, credentials: Credentials) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in router_settings(endpoint, [ROBOT], credentials).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _refused(endpoint: str, credentials: Credentials) -> bool:
    try:
        open_session(endpoint, credentials).close()
    except zenoh.ZError:
        return True
    return False


def test_certificate_is_refused_in_one_line_when_it_is_invalid(
    free_endpoint: str, keys: Path, tmp_path: Path
) -> None:
    """Zenoh gives no reason."""
    endpoint = free_endpoint.replace("tcp/", "tls/")
    foreign = make_keys(tmp_path / "foreign")
    for name in ("old", "mixed", "broken"):
        shutil.copytree(keys, tmp_path / name)
    certificates.issue(tmp_path / "old", certificates.HOSTS, days=-1 / 1440)
    for end in ("pem", "key"):
        shutil.copy(foreign / f"operator.{end}", tmp_path / "mixed")
    (tmp_path / "broken" / "operator.pem").write_text("nothing")
    other = endpoint.replace("127.0.0.1", "127.0.0.2")
    everywhere = endpoint.replace("127.0.0.1", "0.0.0.0")  # noqa: S104 - the case under test
    operator = credentials_in(keys, "operator")
    with closing(Router(everywhere, credentials_in(keys, "router"), ROBOT)):
        for address, folder, why in [
            (other, keys, rf"{other} shows is refused: IP address mismatch.*--host 127\.0\.0\.2"),
            (endpoint, foreign, f"{endpoint} shows is refused: unable to get local issuer"),
            (endpoint, tmp_path / "mixed", f"refuses {tmp_path}/mixed/operator.pem: unknown ca"),
            (endpoint, tmp_path / "old", "old/operator.pem: certificate expired"),
            (
                endpoint,
                tmp_path / "broken",
                "operator.pem with its key and .*/ca.pem; for the reason run `smal sec",
            ),
        ]:
            with pytest.raises(BusError, match=why) as error:
                Bus(ROBOT, address, 0.0, credentials_in(folder, "operator"))
            assert "\n" not in str(error.value)
        assert why_refused(operator, *host_and_port(endpoint)) is None
        assert not _refused(endpoint, operator)
        # Without a certificate, without encryption, and with the key of another role.
        assert _refused(endpoint, None)
        assert _refused(free_endpoint, None)
        assert _refused(endpoint, operator._replace(key=credentials_in(keys, "watcher").key))
    # A client refuses a foreign router, and a router with the certificate of another role.
    with secured_router(endpoint, foreign):
        assert _refused(endpoint, operator)
    with closing(zenoh.open(_router_configuration(endpoint, operator))):
        assert _refused(endpoint, operator)
    plain = pytest.raises(BusError, match="is not an encrypted router")
    with closing(Router(free_endpoint)), plain:
        Bus(ROBOT, endpoint, 0.0, operator)


def test_a_connection_ends_with_its_certificate(
    free_endpoint: str, keys: Path, tmp_path: Path
) -> None:
    endpoint = free_endpoint.replace("tcp/", "tls/")
    brief = tmp_path / "brief"
    shutil.copytree(keys, brief)

    def open_briefly() -> zenoh.Session | None:
        certificates.issue(brief, certificates.HOSTS, days=3 / 86400)
        with suppress(zenoh.ZError):  # a busy machine takes longer than that to get in
            return open_session(endpoint, credentials_in(brief, "operator"))
        return None

    with secured_router(endpoint, keys), closing(eventually(open_briefly)) as session:
        eventually(lambda: not session.info.routers_zid())
        # And it stays out.
        assert _refused(endpoint, credentials_in(brief, "operator"))


def _driving(endpoint: str, keys: Path, stack: ExitStack) -> Callable[[], None]:
    """Return a function that sends a command of the policy and waits until the robot has it."""
    robot, policy = (stack.enter_context(closing(open_session(endpoint, credentials_in(keys, role))))
                     for role in ("robot", "policy"))  # fmt: skip
    key = COMMANDS["policy"].key(ROBOT)
    heard = threading.Event()
    robot.declare_subscriber(
        key, zenoh.handlers.Callback(lambda _sample: heard.set(), indirect=False)
    )
    publisher = policy.declare_publisher(key)

    def drive() -> None:
        heard.clear()
        publisher.put(b"command")
        assert heard.wait(100.0)

    eventually(lambda: publisher.matching_status.matching)
    return drive


def test_full_router_refuses_newcomers_and_serves_the_others(
    endpoint: str, keys: Path, within: zenoh.Session
) -> None:
    watcher = credentials_in(keys, "watcher")
    with ExitStack() as stack:
        drive = _driving(endpoint, keys, stack)
        with ExitStack() as crowd:
            for _ in range(MAX_SESSIONS - 2):
                crowd.enter_context(closing(open_session(endpoint, watcher, PATIENT)))
            with pytest.raises(
                BusError, match=rf"or is full \(it takes {MAX_SESSIONS} sessions"
            ) as error:
                Bus(ROBOT, endpoint, patience_s=0.0, credentials=credentials_in(keys, "operator"))
            assert "\n" not in str(error.value)
            assert len(within.info.transports()) == MAX_SESSIONS
            drive()
        Bus(ROBOT, endpoint, credentials=credentials_in(keys, "operator")).close()
        drive()


@pytest.mark.parametrize("knock", ["silent", "leaves"])
def test_strangers_do_not_disturb_connected_sessions(
    endpoint: str, keys: Path, within: zenoh.Session, knock: str
) -> None:
    with ExitStack() as stack:
        drive = _driving(endpoint, keys, stack)
        with ExitStack() as at_door:
            for _ in range(150):
                one = at_door.enter_context(socket.create_connection(host_and_port(endpoint)))
                if knock == "leaves":
                    one.close()
            drive()
            assert len(within.info.transports()) == 2
            if knock == "silent":  # More wait than the router admits at once: it sends them away.
                Bus(ROBOT, endpoint, credentials=credentials_in(keys, "operator")).close()
        drive()


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "192.0.2.1"])  # noqa: S104 - refused
def test_public_router_is_refused_unless_it_is_insecure(host: str) -> None:
    with pytest.raises(BusError, match="can be reached from other machines"):
        Router(f"tcp/{host}:7447")


def test_router_refuses_certificates_when_it_is_insecure(keys: Path, free_endpoint: str) -> None:
    address = free_endpoint.replace("tcp/", "tls/")
    with pytest.raises(BusError, match="--insecure contradicts certificates"):
        Router(address, credentials_in(keys, "router"), insecure=True)


def test_a_router_that_others_reach_runs_when_it_is_told_to(free_endpoint: str) -> None:
    everywhere = free_endpoint.replace("127.0.0.1", "0.0.0.0")  # noqa: S104 - what is tried
    with closing(Router(everywhere, insecure=True)), closing(Bus(ROBOT, everywhere)) as bus:
        assert bus.connected()


@pytest.mark.parametrize(
    ("owner", "group", "mode", "user", "taken"),
    [
        (0, os.getegid(), 0o440, 1000, True),  # as Kubernetes gives a secret to a pod
        (0, os.getegid(), 0o444, 1000, False),
        (0, os.getegid(), 0o460, 1000, False),
        (0, 4321, 0o440, 1000, False),
        (1000, os.getegid(), 0o440, 1000, False),
        (0, os.getegid(), 0o440, 0, False),
    ],
)
def test_secret_of_root_is_read_when_our_group_may(
    owner: int,
    group: int,
    mode: int,
    user: int,
    taken: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (path := tmp_path / "key").write_text("secret\n")
    told = SimpleNamespace(st_uid=owner, st_gid=group, st_mode=stat.S_IFREG | mode)
    monkeypatch.setattr(Path, "stat", lambda _path: told)
    monkeypatch.setattr(os, "geteuid", lambda: user)
    with nullcontext() if taken else pytest.raises(BusError, match="can be read by others"):
        assert secret(path) == "secret"


def test_an_encrypted_address_without_a_certificate_is_one_line(
    free_endpoint: str, keys: Path
) -> None:
    endpoint = free_endpoint.replace("tcp/", "tls/")
    with pytest.raises(BusError, match="needs a certificate"):
        Bus(ROBOT, endpoint)
    with pytest.raises(BusError, match="is not encrypted"):
        Bus(ROBOT, free_endpoint, credentials=credentials_in(keys, "operator"))
    with (
        secured_router(endpoint, keys),
        pytest.raises(BusError, match="requires a certificate") as error,
    ):
        Bus(ROBOT, free_endpoint, patience_s=0.0)
    assert "\n" not in str(error.value)
