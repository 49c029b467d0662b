"""Access rules of the router for each role, derived from the table of services.

The form is Zenoh's ``access_control``, which denies everything else. The keys of a rule are exact,
so a sender's wildcards never match. Each message is checked twice: when it enters the router
(ingress, the sender's role) and when it leaves (egress, the receiver's role).
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from schemas.topics import ROOT, Topic, echo_key, group_key, rpc_key
from services.table import Role, roles

Rule = dict[str, object]
#: Keys by which a sender announces and serves its kept messages; ``**`` does not match them.
KEPT_KEYS: Final = "@adv/pub/**"
#: The router's own state: its connections and declarations. It is read-only.
ADMINISTRATION: Final = "@/**"
_PASSED_ON: Final[Rule] = {
    "id": "router: all",
    "permission": "allow",
    "flows": ["ingress", "egress"],
    "messages": [
        *("put", "delete", "declare_subscriber", "query", "declare_queryable", "reply"),
        *("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
    ],
    "key_exprs": ["**", "**/@adv/**", "**/@group/**", echo_key("*", "*", "*", "*")],
}


def access_control(robots: Sequence[str], *, linked: bool = False) -> dict[str, object]:
    """Return the router's rules for the robots of a fleet; a certificate identifies the role.

    A linked router passes on everything from its peers and to them: each router checks its own
    clients.
    """
    rules = {role.name: list(_rules(role, robots)) for role in roles().values()}
    if linked:
        rules["router"] = [_PASSED_ON]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for of_role in rules.values() for rule in of_role],
        "subjects": [{"id": name, "cert_common_names": [name]} for name in rules],
        "policies": [
            {"rules": [rule["id"] for rule in of_role], "subjects": [name]}
            for name, of_role in rules.items()
        ],
    }


def _lost(kept: set[str]) -> set[str]:
    """Return the keys that Zenoh queries for lost messages: the sender is known, its kind is not."""
    return {key.replace("@adv/pub/", "@adv/*/") for key in kept}


def _rules(role: Role, robots: Sequence[str]) -> Iterator[Rule]:
    for message, says, hears in _allowed(role, robots):
        for flow, keys in (("ingress", says), ("egress", hears)):
            if keys:
                yield {
                    "id": f"{role.name}: {flow} {message}",
                    "permission": "allow",
                    "flows": [flow],
                    "messages": [message],
                    "key_exprs": sorted(keys),
                }


def _is_recorded(topic: Topic) -> bool:
    return topic.recorded


def _keys(topics: Iterable[Topic], robots: Sequence[str]) -> set[str]:
    return {topic.key(robot) for topic in topics for robot in robots}


def _rpc_keys(names: Iterable[str], robots: Sequence[str]) -> set[str]:
    return {rpc_key(robot, *name.split("/", 1)) for name in names for robot in robots}


def _allowed(role: Role, robots: Sequence[str]) -> Iterator[tuple[str, set[str], set[str]]]:
    """Yield each kind of message with the keys that a role may send it to and receive it from."""
    gives = _keys(role.gives, robots)
    takes = _keys(role.takes, robots)
    fetches = _keys(role.fetches, robots)
    recorded = _keys(filter(_is_recorded, role.gives), robots)
    kept = {f"{key}/{KEPT_KEYS}" for key in recorded}
    replayed = {f"{key}/{KEPT_KEYS}" for key in _keys(filter(_is_recorded, role.fetches), robots)}
    serves = _rpc_keys(role.serves, robots)
    calls = _rpc_keys(role.calls, robots)
    listens = {f"{ROOT}/{robot}/**" for robot in robots} if role.person else set()
    #: Instances of the same service see, query and answer each other.
    seen = {f"{group_key(robots[0], role.name)}/**"} if role.grouped else set()
    echo = {echo_key(role.name, "*", "*", "*")}
    asked = calls | replayed | ({ADMINISTRATION} if role.name == "operator" else set())
    yield "put", gives | kept | echo, takes | replayed | echo
    # Senders must learn of subscribers, and callers of queryables; otherwise Zenoh sends nothing.
    yield "declare_subscriber", takes | replayed | listens | echo, gives | kept | echo
    yield "declare_queryable", serves | kept | seen, asked | seen
    yield "query", asked | _lost(replayed) | seen, serves | kept | _lost(kept) | seen
    # Kept messages are answered on the topic's own key.
    yield "reply", serves | kept | recorded | seen, asked | fetches | seen
    yield "liveliness_token", kept | seen, replayed | seen
    yield "declare_liveliness_subscriber", replayed, kept
    yield "liveliness_query", replayed | seen, kept | seen
