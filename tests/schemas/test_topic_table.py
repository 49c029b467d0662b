"""The one table of topics."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import SOURCES
from schemas.command import Command
from schemas.topics import TOPICS, Topic, check_robot_id, rpc_key, topic_of
from tests.schemas.messages import CLASSES, EXAMPLES

robots = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda topic: topic.name)
def test_rows_are_complete(topic: Topic) -> None:
    assert TOPICS[topic.name] is topic
    assert re.fullmatch(r"[a-z_]+(/[a-z_]+)*", topic.name), "a Zenoh key without wild cards"
    assert not topic.name.startswith("rpc/"), "rpc is for queryables"
    assert topic.meaning.endswith(".")
    assert topic.queue >= 1
    assert topic.rate_hz is None or topic.rate_hz > 0


def test_commands_and_signs_of_life_go_before_everything_else() -> None:
    lanes = {topic.name: topic.lane for topic in TOPICS.values() if topic.lane != "ordinary"}
    urgent = [*(f"command/{source}" for source in SOURCES), "command/applied", "heartbeat", "pulse"]
    assert lanes == dict.fromkeys(urgent, "urgent") | {"command/emergency_stop": "stop"}


def test_episode_events_are_never_dropped() -> None:
    assert [topic.name for topic in TOPICS.values() if topic.reliable] == ["episode"]


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_each_message_knows_its_topic(cls: type) -> None:
    assert TOPICS[EXAMPLES[cls].topic_name].message is cls


@pytest.mark.parametrize("source", SOURCES)
def test_each_source_has_a_topic(source: str) -> None:
    command = Command.after(EXAMPLES[Command], source=source, atom="stop")
    assert TOPICS[command.topic_name].message is Command


@given(robots, st.sampled_from(list(TOPICS.values())))
def test_topic_of_is_the_inverse_of_key(robot: str, topic: Topic) -> None:
    assert topic_of(topic.key(robot)) is topic


@given(st.text() | robots.map("smal/{}/state/x".format) | robots.map("other/{}/state".format))
def test_foreign_keys_are_no_topics(key: str) -> None:
    assert topic_of(key) is None


@pytest.mark.parametrize("key", ["smal/Bad/state", "smal//state", "state", "smal/a/state/", "smal/*/state", "smal/a/"])
def test_malformed_keys_are_no_topics(key: str) -> None:
    assert topic_of(key) is None


@given(robots, st.sampled_from(["simulator", "recorder"]), st.sampled_from(["status", "reset"]))
def test_calls_are_no_topics(robot: str, service: str, verb: str) -> None:
    assert topic_of(rpc_key(robot, service, verb)) is None


@given(robots)
def test_good_robot_ids(robot: str) -> None:
    assert check_robot_id(robot) == robot


@pytest.mark.parametrize("robot", ["", "A", "a b", "a\n", "-a", "*", "a" * 33])
def test_bad_robot_ids(robot: str) -> None:
    with pytest.raises(ValueError, match="robot id"):
        check_robot_id(robot)
