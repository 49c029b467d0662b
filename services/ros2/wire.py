"""How ROS 2 speaks over Zenoh: keys, liveliness tokens and attachments, in two dialects. Pure: no session here."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, Protocol

import xxhash

from services.ros2.messages import Messages

Kind = Literal["MP", "MS"]
DialectName = Literal["rmw_zenoh", "zenoh-bridge-ros2dds"]
#: What stands in the place of a type's hash in Humble, which has none.
NO_TYPE_HASH: Final = "TypeHashNotSupported"
_GID_BYTES: Final = 16
# Names that releases before Jazzy 0.2.4 and Humble 0.1.2 write before the values, as strings with their length.
_OLD_NAMES: Final = tuple(bytes([len(n)]) + n for n in (b"sequence_number", b"source_timestamp", b"source_gid"))
_INT64_BYTES: Final = 8


class Endpoint(NamedTuple):
    """One publisher (MP) or subscription (MS) of a robot, as its liveliness token tells it."""

    kind: Kind
    topic: str
    type_name: str
    type_hash: str


class Qos(NamedTuple):
    """What is said of an endpoint's quality of service; all else is the default (keep last)."""

    reliable: bool
    depth: int
    #: Transient local: who comes late wants what was said last.
    latched: bool = False

    def text(self) -> str:
        """Return it as it stands in a liveliness token; empty is the default."""
        return f"{'' if self.reliable else 2}:{1 if self.latched else ''}:,{self.depth}:,:,:,,"


class Attachment(NamedTuple):
    """What comes with every message of rmw_zenoh; receivers drop a message without it."""

    sequence: int
    stamp_ns: int
    gid: bytes

    def write(self) -> bytes:
        """Return its 33 bytes."""
        numbers = b"".join(n.to_bytes(_INT64_BYTES, "little", signed=True) for n in (self.sequence, self.stamp_ns))
        return numbers + bytes([len(self.gid)]) + self.gid


def read_attachment(data: bytes) -> Attachment | None:
    """Return the attachment in some bytes, of today's releases or of older ones; None where there is none."""
    for names in ((b"", b"", b""), _OLD_NAMES):
        at, values = 0, []
        for name, size in zip(names, (_INT64_BYTES, _INT64_BYTES, 1 + _GID_BYTES), strict=True):
            if data[at : at + len(name)] != name:
                break
            at += len(name) + size
            values.append(data[at - size : at])
        if len(values) == 3 and at == len(data) and values[2][0] == _GID_BYTES:
            sequence, stamp_ns = (int.from_bytes(value, "little", signed=True) for value in values[:2])
            return Attachment(sequence, stamp_ns, values[2][1:])
    return None


def gid_of(token: str) -> bytes:
    """Return the id of an endpoint, which is made of its token."""
    digest = xxhash.xxh3_128_intdigest(token.encode())
    low, high = digest & (2**64 - 1), digest >> 64
    return low.to_bytes(8, "little") + high.to_bytes(8, "little")


def dds_type(type_name: str) -> str:
    """Return the name of a type in keys: of std_msgs/msg/String, std_msgs::msg::dds_::String_."""
    package, folder, name = type_name.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_type(name: str) -> str | None:
    """Return the name of a type by its name in keys; None where that is none."""
    match = re.fullmatch(r"(\w+)::(\w+)::dds_::(\w+)_", name)
    return match and "/".join(match.groups())


def qualified(topic: str, namespace: str) -> str:
    """Return a topic's full name: an absolute one is that already."""
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


class Dialect(Protocol):
    """What differs between the two ways that ROS 2 speaks over Zenoh."""

    @property
    def tokens(self) -> str:
        """Key expression of the tokens by which endpoints tell that they are there."""

    def key(self, topic: str, type_name: str) -> str:
        """Return the key of a topic's messages."""

    def read_token(self, token: str) -> Endpoint | None:
        """Return the endpoint that a token tells of; None for anything else."""

    def node_token(self, session: str) -> str | None:
        """Return the token by which we are a node; None where no such thing is declared."""

    def endpoint_token(self, session: str, number: int, endpoint: Endpoint, qos: Qos) -> str | None:
        """Return the token of an endpoint of ours."""

    def attachment(self, sequence: int, stamp_ns: int, gid: bytes) -> bytes | None:
        """Return what goes with a message."""

    def type_hash(self, type_name: str) -> str:
        """Return the hash of a type as it stands in keys; empty where none does."""

    @property
    def attached(self) -> bool:
        """Whether a message without an attachment is none."""


@dataclass(frozen=True)
class RmwZenoh:
    """The middleware of ROS 2 itself, rmw_zenoh_cpp.

    Attributes
    ----------
    messages
        Of the robot's distribution.
    domain
        ROS_DOMAIN_ID of the robot.
    namespace, node
        What we are called.
    hashed
        Whether keys hold the hashes of types; Humble has none.
    """

    messages: Messages
    domain: int
    namespace: str
    node: str = "smal"
    hashed: bool = True
    attached: bool = True

    @property
    def tokens(self) -> str:
        """All of the domain; a wildcard never matches the first part."""
        return f"@ros2_lv/{self.domain}/**"

    def type_hash(self, type_name: str) -> str:
        """Return the hash, or Humble's word for having none."""
        return self.messages.type_hash(type_name) if self.hashed else NO_TYPE_HASH

    def key(self, topic: str, type_name: str) -> str:
        """Return domain, topic, type and hash."""
        return f"{self.domain}/{topic.strip('/')}/{dds_type(type_name)}/{self.type_hash(type_name)}"

    def read_token(self, token: str) -> Endpoint | None:
        """Read what `endpoint_token` writes, and more of it than we say."""
        parts = token.split("/")
        if len(parts) != 13 or parts[0] != "@ros2_lv" or parts[5] not in {"MP", "MS"}:
            return None
        type_name = ros_type(parts[10])
        kind: Kind = "MP" if parts[5] == "MP" else "MS"
        return None if type_name is None else Endpoint(kind, parts[9].replace("%", "/"), type_name, parts[11])

    def _us(self) -> str:
        return f"%/{_mangled(self.namespace)}/{self.node}"

    def node_token(self, session: str) -> str:
        """Return the token by which `ros2 node list` shows us."""
        return f"@ros2_lv/{self.domain}/{session}/0/0/NN/{self._us()}"

    def endpoint_token(self, session: str, number: int, endpoint: Endpoint, qos: Qos) -> str:
        """Return the token by which `ros2 topic info` shows us."""
        what = f"{_mangled(endpoint.topic)}/{dds_type(endpoint.type_name)}/{endpoint.type_hash}/{qos.text()}"
        return f"@ros2_lv/{self.domain}/{session}/0/{number}/{endpoint.kind}/{self._us()}/{what}"

    def attachment(self, sequence: int, stamp_ns: int, gid: bytes) -> bytes:
        """Return the 33 bytes."""
        return Attachment(sequence, stamp_ns, gid).write()


@dataclass(frozen=True)
class Bridge:
    """A robot with another middleware, and zenoh-bridge-ros2dds beside it: plain keys, nothing attached."""

    tokens: str = "@/*/@ros2_lv/**"
    attached: bool = False

    def type_hash(self, _type_name: str) -> str:
        """Return nothing: no key holds a hash."""
        return ""

    def key(self, topic: str, _type_name: str) -> str:
        """Return the topic, which holds the namespace."""
        return topic.strip("/")

    def read_token(self, token: str) -> Endpoint | None:
        """Read what the bridge tells of its robot's endpoints: its zid, the kind, the key, the type."""
        match = re.fullmatch(r"@/[^/]+/@ros2_lv/(MP|MS)/([^/]+)/([^/]+)/[^/]*", token)
        if match is None:
            return None
        kind: Kind = "MP" if match[1] == "MP" else "MS"
        return Endpoint(kind, "/" + match[2].replace("§", "/"), match[3].replace("§", "/"), "")

    def node_token(self, _session: str) -> None:
        """Return nothing: the robot's own bridge speaks for us."""

    def endpoint_token(self, _session: str, _number: int, _endpoint: Endpoint, _qos: Qos) -> None:
        """Return nothing, as `node_token`."""

    def attachment(self, _sequence: int, _stamp_ns: int, _gid: bytes) -> None:
        """Return nothing."""


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def velocity_type(endpoints: Sequence[Endpoint], topic: str, known: Sequence[str]) -> str | None:
    """Return which of the known types a robot subscribes to on a topic; None where it does not."""
    types = {one.type_name for one in endpoints if one.kind == "MS" and one.topic == topic}
    return next((name for name in known if name in types), None)
