"""The table of topics."""

from hypothesis import given
from hypothesis import strategies as st

from schemas.command import Command, CommandApplied
from schemas.heartbeat import Heartbeat, Pulse
from schemas.topics import TOPICS, Topic, topic_of

robots = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)


def test_commands_and_heartbeats_never_queue_behind_images() -> None:
    for topic in TOPICS.values():
        drives = topic.message in (Command, CommandApplied, Heartbeat, Pulse)
        assert (topic.lane != "ordinary") == drives, topic.name
        assert not drives or topic.message.max_bytes <= 65_536, topic.name
    assert [one.name for one in TOPICS.values() if one.lane == "stop"] == ["command/emergency_stop"]


@given(robots, st.sampled_from(list(TOPICS.values())))
def test_topic_of_is_the_inverse_of_key(robot: str, topic: Topic) -> None:
    assert topic_of(topic.key(robot)) is topic


@given(
    st.text()
    | robots.map("smal/{}/state/x".format)
    | robots.map("other/{}/state".format)
    | st.sampled_from(
        ["smal/Bad/state", "smal//state", "state", "smal/a/state/", "smal/*/state", "smal/a/"]
    )
)
def test_key_has_no_topic_when_it_is_foreign_or_malformed(key: str) -> None:
    assert topic_of(key) is None
