"""What the router lets through: rules for each role, derived from the table of services; all else is refused.

The form is that of Zenoh's ``access_control``. A rule's keys are exact, so that no wildcard of a sender matches them. A
message is looked at where it comes into the router (ingress, what a role may say) and where it goes out (egress, what a
role may hear); both must allow it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from schemas.topics import ROOT, Topic, rpc_key
from services.table import Role, roles

Rule = dict[str, object]
#: Where a sender keeps what is recorded, and says that it is there; ``**`` does not match it.
KEPT_KEYS: Final = "@adv/pub/**"
#: Of the router itself: who is connected, and what is declared. It can be read, never written.
ADMINISTRATION: Final = "@/**"


def access_control(robot: str) -> dict[str, object]:
    """Return the router's rules for one robot: who may do what is told by the certificate."""
    known = roles().values()
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for role in known for rule in _rules(role, robot)],
        "subjects": [{"id": role.name, "cert_common_names": [role.name]} for role in known],
        "policies": [
            {
                "rules": [rule["id"] for rule in _rules(role, robot)],
                "subjects": [role.name],
            }
            for role in known
        ],
    }


def _rules(role: Role, robot: str) -> Iterator[Rule]:
    says, hears = _says(role, robot), _hears(role, robot)
    for flow, allowed in (("ingress", says), ("egress", hears)):
        for message, keys in allowed.items():
            if keys:
                yield {
                    "id": f"{role.name}: {flow} {message}",
                    "permission": "allow",
                    "flows": [flow],
                    "messages": [message],
                    "key_exprs": sorted(keys),
                }


def _says(role: Role, robot: str) -> dict[str, set[str]]:
    """Return what a role may send to the router, by kind of message."""
    gives, takes = _keys(role.gives, robot), _keys(role.takes, robot)
    kept, replayed = _kept_keys(role.gives, robot), _kept_keys(role.fetches, robot)
    serves, calls = _services(role, robot)
    listens = {f"{ROOT}/{robot}/**"} if role.person else set()
    administers = {ADMINISTRATION} if role.name == "operator" else set()
    return {
        "put": gives | kept,
        "declare_subscriber": takes | replayed | listens,
        "declare_queryable": serves | kept,
        "query": calls | replayed | administers,
        # What a sender kept is answered on the topic's own key.
        "reply": serves | kept | {topic.key(robot) for topic in role.gives if topic.recorded},
        "liveliness_token": kept,
        "declare_liveliness_subscriber": replayed,
        "liveliness_query": replayed,
    }


def _hears(role: Role, robot: str) -> dict[str, set[str]]:
    """Return what a role may be sent by the router, by kind of message."""
    gives, takes = _keys(role.gives, robot), _keys(role.takes, robot)
    kept, replayed = _kept_keys(role.gives, robot), _kept_keys(role.fetches, robot)
    serves, calls = _services(role, robot)
    administers = {ADMINISTRATION} if role.name == "operator" else set()
    return {
        "put": takes | replayed,
        # A sender is told who listens, and a caller who serves: without that neither sends.
        "declare_subscriber": gives | kept,
        "declare_queryable": calls | replayed | administers,
        "query": serves | kept,
        "reply": calls | replayed | administers | _keys(role.fetches, robot),
        "liveliness_token": replayed,
        "declare_liveliness_subscriber": kept,
        "liveliness_query": kept,
    }


def _keys(some: tuple[Topic, ...], robot: str) -> set[str]:
    return {topic.key(robot) for topic in some}


def _kept_keys(some: tuple[Topic, ...], robot: str) -> set[str]:
    return {f"{topic.key(robot)}/{KEPT_KEYS}" for topic in some if topic.recorded}


def _services(role: Role, robot: str) -> tuple[set[str], set[str]]:
    def keys(names: tuple[str, ...]) -> set[str]:
        return {rpc_key(robot, *name.split("/", 1)) for name in names}

    return keys(role.serves), keys(role.calls)
