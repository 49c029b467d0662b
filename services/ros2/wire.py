"""How ROS 2 speaks over Zenoh: keys, liveliness tokens and attachments, in two dialects. Pure: no session here."""

import re
import struct
from typing import Final, Literal, NamedTuple

import xxhash

from services.ros2.messages import Messages

Kind = Literal["MP", "MS"]
DialectName = Literal["rmw_zenoh", "zenoh-bridge-ros2dds"]
NO_TYPE_HASH: Final = (
    "TypeHashNotSupported"  # What stands in the place of a type's hash in Humble, which has none.
)
_GID_BYTES: Final = 16
# Names that releases before Jazzy 0.2.4 and Humble 0.1.2 write before the values, as strings with their length.
_OLD_NAMES: Final = tuple(
    bytes([len(n)]) + n for n in (b"sequence_number", b"source_timestamp", b"source_gid")
)


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
    latched: bool = False  # Transient local: who comes late wants what was said last.

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
        return struct.pack("<qqB16s", self.sequence, self.stamp_ns, _GID_BYTES, self.gid)


def read_attachment(data: bytes) -> Attachment | None:
    """Return the attachment in some bytes, of today's releases or of older ones; None where there is none."""
    for names in ((b"", b"", b""), _OLD_NAMES):
        form = struct.Struct("<{}sq{}sq{}sB16s".format(*map(len, names)))
        if len(data) == form.size:
            *said, size, gid = form.unpack(data)
            if tuple(said[::2]) == names and size == _GID_BYTES:
                return Attachment(said[1], said[3], gid)
    return None


def gid_of(token: str) -> bytes:
    """Return the id of an endpoint, which is made of its token."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


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


class Bridge:
    """A robot with another middleware: zenoh-bridge-ros2dds speaks for us, with plain keys and nothing attached."""

    tokens = "@/*/@ros2_lv/**"  # Key expression of the tokens by which endpoints tell that they are there.
    attached = False  # Whether a message without an attachment is none.

    def type_hash(self, _type_name: str) -> str:
        """Return the hash of a type as it stands in keys; here none does."""
        return ""

    def key(self, topic: str, _type_name: str) -> str:
        """Return the key of a topic's messages."""
        return topic.strip("/")

    def read_token(self, token: str) -> Endpoint | None:
        """Return the endpoint that a token tells of: the bridge's zid, the kind, the key, the type; else None."""
        match = re.fullmatch(r"@/[^/]+/@ros2_lv/(MP|MS)/([^/]+)/([^/]+)/[^/]*", token)
        if match is None:
            return None
        kind: Kind = "MP" if match[1] == "MP" else "MS"
        return Endpoint(kind, "/" + match[2].replace("§", "/"), match[3].replace("§", "/"), "")

    def node_token(self, _session: str) -> str | None:
        """Return the token by which we are a node, if there is one."""
        return None

    def endpoint_token(
        self, _session: str, _number: int, _endpoint: Endpoint, _qos: Qos
    ) -> str | None:
        """Return the token of an endpoint of ours, if there is one."""
        return None

    def attachment(self, _sequence: int, _stamp_ns: int, _gid: bytes) -> bytes | None:
        """Return what goes with a message, if anything does."""
        return None


class RmwZenoh(Bridge):
    """The middleware of ROS 2 itself, rmw_zenoh_cpp.

    The messages are of the robot's distribution, the domain is its ROS_DOMAIN_ID; we are called by namespace and node.
    Keys hold the hashes of types with ``hashed``; Humble has none.
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
        """Return the hash, or Humble's word for having none."""
        return self._messages.type_hash(type_name) if self._hashed else NO_TYPE_HASH

    def key(self, topic: str, type_name: str) -> str:
        """Return domain, topic, type and hash."""
        return (
            f"{self._domain}/{topic.strip('/')}/{dds_type(type_name)}/{self.type_hash(type_name)}"
        )

    def read_token(self, token: str) -> Endpoint | None:
        """Read what `endpoint_token` writes, and more of it than we say."""
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
        """Return the token by which `ros2 node list` shows us."""
        return f"@ros2_lv/{self._domain}/{session}/0/0/NN/{self._us}"

    def endpoint_token(self, session: str, number: int, endpoint: Endpoint, qos: Qos) -> str:
        """Return the token by which `ros2 topic info` shows us."""
        what = f"{_mangled(endpoint.topic)}/{dds_type(endpoint.type_name)}/{endpoint.type_hash}/{qos.text()}"
        return f"@ros2_lv/{self._domain}/{session}/0/{number}/{endpoint.kind}/{self._us}/{what}"

    def attachment(self, sequence: int, stamp_ns: int, gid: bytes) -> bytes:
        """Return the 33 bytes."""
        return Attachment(sequence, stamp_ns, gid).write()


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"
