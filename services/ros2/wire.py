"""Encoding of ROS 2 over Zenoh in two dialects: keys, liveliness tokens and attachments."""

import re
import struct
from typing import Final, Literal, NamedTuple

import xxhash

from services.ros2.messages import Messages

Kind = Literal["MP", "MS"]
DialectName = Literal["rmw_zenoh", "zenoh-bridge-ros2dds"]
# Replaces the type hash in Humble, which has none.
NO_TYPE_HASH: Final = "TypeHashNotSupported"
_GID_BYTES: Final = 16
# Names that releases before Jazzy 0.2.4 and Humble 0.1.2 write before the values, as strings with
# their length.
_OLD_NAMES: Final = tuple(
    bytes([len(n)]) + n for n in (b"sequence_number", b"source_timestamp", b"source_gid")
)


class Endpoint(NamedTuple):
    """Publisher (MP) or subscription (MS) of a robot, as in its liveliness token."""

    kind: Kind
    topic: str
    type_name: str
    type_hash: str


class Qos(NamedTuple):
    """Quality of service of an endpoint, otherwise the default (keep last)."""

    reliable: bool
    depth: int
    latched: bool = False  # Transient local: late subscribers receive the last message.

    def text(self) -> str:
        """Return its text in a liveliness token; empty parts are the default."""
        return f"{'' if self.reliable else 2}:{1 if self.latched else ''}:,{self.depth}:,:,:,,"


class Attachment(NamedTuple):
    """Attachment of every rmw_zenoh message; receivers drop a message without it."""

    sequence: int
    stamp_ns: int
    gid: bytes

    def write(self) -> bytes:
        """Return its 33 bytes."""
        return struct.pack("<qqB16s", self.sequence, self.stamp_ns, _GID_BYTES, self.gid)


def read_attachment(data: bytes) -> Attachment | None:
    """Parse an attachment of current or older releases; None for other bytes."""
    for names in ((b"", b"", b""), _OLD_NAMES):
        form = struct.Struct("<{}sq{}sq{}sB16s".format(*map(len, names)))
        if len(data) == form.size:
            *said, size, gid = form.unpack(data)
            if tuple(said[::2]) == names and size == _GID_BYTES:
                return Attachment(said[1], said[3], gid)
    return None


def gid_of(token: str) -> bytes:
    """Return the id of an endpoint, a digest of its token."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def dds_type(type_name: str) -> str:
    """Return the name of a type in keys: std_msgs::msg::dds_::String_ for std_msgs/msg/String."""
    package, folder, name = type_name.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_type(name: str) -> str | None:
    """Return the type of a name in keys, or None if invalid."""
    match = re.fullmatch(r"(\w+)::(\w+)::dds_::(\w+)_", name)
    return match and "/".join(match.groups())


def qualified(topic: str, namespace: str) -> str:
    """Return a topic's full name; absolute names are unchanged."""
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


class Bridge:
    """Dialect of zenoh-bridge-ros2dds for other middleware: plain keys, no attachments."""

    # Key expression of the endpoints' tokens.
    tokens = "@/*/@ros2_lv/**"
    attached = False  # Whether messages need an attachment.

    def type_hash(self, _type_name: str) -> str:
        """Return the hash of a type in keys; empty in this dialect."""
        return ""

    def key(self, topic: str, _type_name: str) -> str:
        """Return the key of a topic's messages."""
        return topic.strip("/")

    def read_token(self, token: str) -> Endpoint | None:
        """Parse a token of the bridge (its zid, the kind, the key, the type), or return None."""
        match = re.fullmatch(r"@/[^/]+/@ros2_lv/(MP|MS)/([^/]+)/([^/]+)/[^/]*", token)
        if match is None:
            return None
        kind: Kind = "MP" if match[1] == "MP" else "MS"
        return Endpoint(kind, "/" + match[2].replace("§", "/"), match[3].replace("§", "/"), "")

    def node_token(self, _session: str) -> str | None:
        """Return the token of our node; None in this dialect."""
        return None

    def endpoint_token(
        self, _session: str, _number: int, _endpoint: Endpoint, _qos: Qos
    ) -> str | None:
        """Return the token of an endpoint of ours; None in this dialect."""
        return None

    def attachment(self, _sequence: int, _stamp_ns: int, _gid: bytes) -> bytes | None:
        """Return the attachment of a message; None in this dialect."""
        return None


class RmwZenoh(Bridge):
    """Dialect of rmw_zenoh_cpp, the middleware of ROS 2 itself.

    The messages are of the robot's distribution, and the domain is its ROS_DOMAIN_ID. Our name
    consists of namespace and node. Keys contain the hashes of types with ``hashed``; Humble has
    none.
    """

    attached = True

    def __init__(
        self,
        messages: Messages,
        domain: int,
        namespace: str,
        node: str = "smal",
        *,
        hashed: bool = True,
    ) -> None:
        self._messages = messages
        self._domain = domain
        self._hashed = hashed
        self._us = f"%/{_mangled(namespace)}/{node}"
        self.tokens = f"@ros2_lv/{domain}/**"  # A wildcard never matches the first part.

    def type_hash(self, type_name: str) -> str:
        """Return the hash of a type, or Humble's placeholder."""
        return self._messages.type_hash(type_name) if self._hashed else NO_TYPE_HASH

    def key(self, topic: str, type_name: str) -> str:
        """Return the key: domain, topic, type and hash."""
        return (
            f"{self._domain}/{topic.strip('/')}/{dds_type(type_name)}/{self.type_hash(type_name)}"
        )

    def read_token(self, token: str) -> Endpoint | None:
        """Parse a token of `endpoint_token`, also with quality settings that we do not use."""
        parts = token.split("/")
        if len(parts) != 13 or parts[0] != "@ros2_lv" or parts[5] not in {"MP", "MS"}:
            return None
        type_name = ros_type(parts[10])
        kind: Kind = "MP" if parts[5] == "MP" else "MS"
        return (
            None
            if type_name is None
            else Endpoint(kind, parts[9].replace("%", "/"), type_name, parts[11])
        )

    def node_token(self, session: str) -> str:
        """Return the token by which `ros2 node list` shows our node."""
        return f"@ros2_lv/{self._domain}/{session}/0/0/NN/{self._us}"

    def endpoint_token(self, session: str, number: int, endpoint: Endpoint, qos: Qos) -> str:
        """Return the token by which `ros2 topic info` shows our endpoint."""
        what = f"{_mangled(endpoint.topic)}/{dds_type(endpoint.type_name)}/{endpoint.type_hash}/{qos.text()}"
        return f"@ros2_lv/{self._domain}/{session}/0/{number}/{endpoint.kind}/{self._us}/{what}"

    def attachment(self, sequence: int, stamp_ns: int, gid: bytes) -> bytes:
        """Return the 33 bytes."""
        return Attachment(sequence, stamp_ns, gid).write()


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"
