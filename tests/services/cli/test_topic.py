"""``smal topic`` as an operator runs it, and the pure pieces below it."""

import json
from collections.abc import Iterator

import pytest

from schemas import topics
from schemas.camera import CompressedImage
from schemas.codec import encode, encoding_of
from schemas.command import Command
from schemas.topics import TOPICS
from services.cli import listening
from services.cli.listening import Sample, figures
from services.kit.bus import Bus
from tests.schemas.messages import EXAMPLES
from tests.services.cli.conftest import Listen, Mistake, Smal
from tests.services.waiting import eventually


def sample(message: topics.Message, **changes: object) -> Sample:
    key = TOPICS[message.topic_name].key(message.robot)
    return Sample(
        **(
            {"key": key, "payload": encode(message), "encoding": encoding_of(type(message))}
            | changes
        )
    )


@pytest.mark.parametrize("name", ["state", "smal/other/state"])
def test_info_describes_a_topic_with_its_schema(smal: Smal, name: str) -> None:
    row = json.loads(smal("topic", "info", name, "--json", "--robot", "robo-2")[1])
    assert row["key"] == "smal/robo-2/state"
    assert row["encoding"] == "application/vnd.msgpack;smal.State/1"
    assert row["schema"]["additionalProperties"] is False
    assert row["schema"]["properties"]["status"]["description"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"payload": b"\xc1"}, "not msgpack"),
        ({"key": "smal/stranger/command/teleop"}, "contains a message of rescuebot/command/teleop"),
        (
            {"key": "smal/rescuebot/command/policy"},
            "contains a message of rescuebot/command/teleop",
        ),
        ({"key": "smal/rescuebot/\x1b[2J\n"}, "not a topic of SMAL"),
    ],
)
def test_topic_reports_payload_when_decoding_fails(changes: dict[str, object], reason: str) -> None:
    strange = sample(EXAMPLES[Command], **changes)
    assert "not decodable (" in strange.line()
    assert reason in strange.line()
    assert strange.line().isprintable()
    assert reason in str(strange.record()["error"])


@pytest.mark.zenoh
def test_echo_prints_messages_and_ends_cleanly_on_ctrl_c(listen: Listen) -> None:
    listening = listen("echo")
    lines = listening.lines_until(4, EXAMPLES[Command], EXAMPLES[CompressedImage])
    assert any(
        line.startswith("smal/rescuebot/command/teleop  episode=drive-7-18c0-1 tick=300 ")
        for line in lines
    )
    assert any(line.endswith("data=<4 bytes>\n") for line in lines)
    status, _, error = listening.end()
    assert (status, error) == (0, "")


@pytest.mark.zenoh
def test_echo_into_a_pipe_that_is_closed(listen: Listen) -> None:
    listening = listen("echo")
    listening.lines_until(1, EXAMPLES[Command])
    listening.process.stdout.close()

    def ended() -> bool:
        listening._client.publish(EXAMPLES[Command])
        return listening.process.poll() is not None

    eventually(ended)
    assert listening.process.returncode == 0
    assert listening.process.stderr.read() == ""
    listening.process.stdout = None


def test_a_bad_key_expression_is_one_line(mistake: Mistake, client: Bus) -> None:
    assert "smal//x" in mistake(1, "topic", "echo", "smal//x", "--router", client.endpoint)


KEY = "smal/rescuebot/command/teleop"


def test_topic_hz_measures_received_messages() -> None:
    assert figures([(1.0, 10), (2.0, 20), (4.0, 60)], 3.0) == {
        "messages": 3, "rate_hz": pytest.approx(2 / 3), "min_s": 1.0, "max_s": 2.0, "std_s": 0.5,
        "bytes_per_s": 30.0, "mean_bytes": 30.0, "max_bytes": 60,
    }  # fmt: skip
    of_one = figures([(1.0, 10)], 3.0)
    assert {of_one[name] for name in ("rate_hz", "min_s", "max_s", "std_s")} == {None}


@pytest.fixture
def talking(client: Bus, router_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the time of listening be over when several messages must have been heard."""
    witness = Bus("rescuebot", router_endpoint)

    def wait(_what: str, _seconds: float) -> None:
        heard: list[str] = []
        witness.listen("smal/**", lambda key, *_: heard.append(key))

        def enough() -> bool:
            client.publish(EXAMPLES[Command])
            client.publish(EXAMPLES[CompressedImage])
            return len(heard) >= 20

        eventually(enough)

    monkeypatch.setattr(listening, "wait", wait)
    yield
    witness.close()


@pytest.mark.usefixtures("talking")
def test_hz_measures_each_key(smal: Smal, router_endpoint: str) -> None:
    status, out, _ = smal("topic", "hz", "--json", "--router", router_endpoint)
    found = json.loads(out)
    assert status == 0
    assert set(found) == {KEY, "smal/rescuebot/camera/jpeg"}
    assert found[KEY]["rate_hz"] > 0.0
    assert found[KEY]["mean_bytes"] == found[KEY]["max_bytes"]


def test_list_fits_a_terminal_of_80_columns(smal: Smal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = smal("topic", "list")[1].splitlines()
    assert [line.split()[0] for line in lines] == ["topic", *TOPICS]
    assert max(map(len, lines)) == 80
