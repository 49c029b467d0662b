"""ROS 2 over Zenoh: recordings of a real node, and a second implementation that reads our bytes."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pamoja import ros2 as other

from services.ros2 import messages
from services.ros2.messages import Messages
from services.ros2.wire import (
    Attachment,
    Bridge,
    Endpoint,
    Qos,
    RmwZenoh,
    dds_type,
    gid_of,
    qualified,
    read_attachment,
    ros_type,
)

# Captured from a ROS 2 Humble node, rmw_zenoh_cpp 0.1.8, `ros2 topic pub /chatter`: the token of
# its publisher, and what was
# attached to its 216th message. Captured by dora-rs/dora (Apache-2.0).
SAID = (
    "@ros2_lv/0/9ca0f8facf84ffb1e6bfa4f2500889f0/0/3/MP/%/%/_ros2cli_712/%chatter/"
    "std_msgs::msg::dds_::String_/TypeHashNotSupported/:1:,1:,:,:,,"
)
ATTACHED = bytes.fromhex("d80000000000000034dae10162f8c41810f07168d3856ce9f689254cbed6252151")
STRING = "std_msgs/msg/String"
JAZZY = Messages("jazzy")
DIALECT = RmwZenoh(JAZZY, 0, "")


def test_wire_reads_attachment_and_token_of_a_real_node() -> None:
    attached = read_attachment(ATTACHED)
    assert attached == Attachment(
        216, 1784824452167621172, bytes.fromhex("f07168d3856ce9f689254cbed6252151")
    )
    assert attached.write() == ATTACHED
    assert DIALECT.read_token(SAID) == Endpoint("MP", "/chatter", STRING, "TypeHashNotSupported")
    assert gid_of(SAID) == attached.gid


def test_writes_the_key_and_the_token_of_that_node() -> None:
    humble = RmwZenoh(Messages("humble"), 0, "", node="_ros2cli_712", hashed=False)
    assert (
        humble.key("/chatter", STRING)
        == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    )
    endpoint = Endpoint("MP", "/chatter", STRING, humble.type_hash(STRING))
    token = humble.endpoint_token(
        "9ca0f8facf84ffb1e6bfa4f2500889f0", 3, endpoint, Qos(reliable=True, depth=1, latched=True)
    )
    assert token == SAID


def test_wire_reads_attachments_of_older_releases() -> None:
    gid = bytes(range(16))
    old = (
        b"\x0fsequence_number" + struct.pack("<q", 7) + b"\x10source_timestamp" + struct.pack("<q", 11)
        + b"\x0asource_gid\x10" + gid
    )  # fmt: skip
    assert read_attachment(old) == Attachment(7, 11, gid)


@given(st.binary(max_size=80))
def test_attachment_is_read_or_refused_when_it_is_any_bytes(data: bytes) -> None:
    attached = read_attachment(data)
    assert attached is None or data in {attached.write()} or b"sequence_number" in data


@given(st.text(max_size=80))
def test_token_is_read_or_refused_when_it_is_any_text(text: str) -> None:
    for dialect in (DIALECT, Bridge()):
        for token in (
            text,
            f"@ros2_lv/0/a/0/1/MS/%/%/n/{text}/t/h/q",
            f"@/a/@ros2_lv/MS/{text}/{text}/q",
        ):
            dialect.read_token(token)


def test_hashes_of_types_are_those_of_ros() -> None:
    # From its documentation and from the keys of running robots.
    assert (
        JAZZY.type_hash(STRING)
        == "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    )
    for name, digits in {
        messages.TWIST: "9c45bf16",
        messages.TWIST_STAMPED: "5f0fcd4f",
        messages.IMAGE: "d31d41a9",
        messages.COMPRESSED_IMAGE: "15640771",
        messages.ODOMETRY: "3cc97dc7",
    }.items():
        assert JAZZY.type_hash(name).startswith(f"RIHS01_{digits}")
        assert Messages("kilted").type_hash(name) == JAZZY.type_hash(name)


@pytest.mark.parametrize("type_name", [messages.TWIST, messages.COMPRESSED_IMAGE, messages.HAZARDS])
@pytest.mark.parametrize("topic", ["/cmd_vel", "/robot1/oakd/rgb/preview/image_raw"])
def test_another_implementation_makes_the_same_keys(type_name: str, topic: str) -> None:
    type_hash = DIALECT.type_hash(type_name)
    assert other.entity_key(0, topic, type_name, type_hash) == DIALECT.key(topic, type_name)
    assert other.dds_type_name(type_name) == dds_type(type_name)
    assert ros_type(dds_type(type_name)) == type_name
    token = DIALECT.endpoint_token(
        "ab", 1, Endpoint("MS", topic, type_name, type_hash), Qos(reliable=False, depth=5)
    )
    assert token.split("/")[9] == other.percent_mangle(topic)
    assert DIALECT.read_token(token) == Endpoint("MS", topic, type_name, type_hash)
    assert bytes(other.type_hash_digest(type_hash) or ()).hex() == type_hash.removeprefix("RIHS01_")


@given(st.floats(-5, 5), st.floats(-5, 5))
def test_velocities_agree_with_another_implementation(ahead: float, turn: float) -> None:
    written = JAZZY.velocity(ahead, turn, None)
    assert other.twist_from_cdr(written) == ((ahead, 0.0, 0.0), (0.0, 0.0, turn))
    read = JAZZY.read(
        messages.TWIST, bytes(other.twist_to_cdr((ahead, 0.0, 0.0), (0.0, 0.0, turn)))
    )
    assert (read.linear.x, read.angular.z) == (ahead, turn)


def test_velocity_begins_with_its_stamp_when_it_is_stamped() -> None:
    written = JAZZY.velocity(0.25, -0.5, 1_700_000_000_123_456_789)
    assert written[:4] == bytes((0, 1, 0, 0))
    assert struct.unpack_from("<iI", written, 4) == (1_700_000_000, 123_456_789)
    assert written.endswith(JAZZY.velocity(0.25, -0.5, None)[4:])


@pytest.mark.parametrize(("stamp_ns", "seconds"), [(-1, 0), (2**31 * 10**9, 2**31 - 1)])
def test_velocity_is_sent_when_the_robot_clock_is_invalid(stamp_ns: int, seconds: int) -> None:
    assert struct.unpack_from("<iI", JAZZY.velocity(0.0, 0.0, stamp_ns), 4) == (seconds, 0)


def test_bridge_has_plain_keys_and_reads_velocity_types() -> None:
    bridge = Bridge()
    assert bridge.key("/robot1/cmd_vel", messages.TWIST) == "robot1/cmd_vel"
    said = "@/9ca0f8fa/@ros2_lv/MS/robot1§cmd_vel/geometry_msgs§msg§TwistStamped/:::"
    assert bridge.read_token(said) == Endpoint("MS", "/robot1/cmd_vel", messages.TWIST_STAMPED, "")
    assert bridge.attachment(1, 2, bytes(16)) is None


def test_topic_is_in_the_namespace_unless_it_is_absolute() -> None:
    assert qualified("cmd_vel", "/robot1") == "/robot1/cmd_vel"
    assert qualified("/cmd_vel", "/robot1") == "/cmd_vel"
    assert qualified("cmd_vel", "") == "/cmd_vel"
