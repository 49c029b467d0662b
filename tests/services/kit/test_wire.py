"""The checksum beside a message."""

from contextlib import closing
from queue import SimpleQueue

from schemas import topics
from schemas.codec import encode
from schemas.motion import TruePose
from services.kit.bus import Bus
from services.kit.wire import checksum
from tests.schemas.messages import EXAMPLES
from tests.services.waiting import eventually


def test_a_message_that_was_changed_on_its_way_is_refused(
    client: Bus, router_endpoint: str
) -> None:
    pose = EXAMPLES[TruePose]
    heard = SimpleQueue[bytes]()
    refused = SimpleQueue[str]()
    payload = encode(pose)
    changed = payload.replace(b"x_m", b"y_m")
    assert changed != payload
    with closing(Bus("rescuebot", router_endpoint)) as other:
        other.subscribe(topics.POSE, lambda payload, *_: heard.put(payload), refused.put)
        sender = client.declare_publisher(topics.POSE)

        def told() -> bool:
            sender.put(changed, attachment=checksum(payload))
            return not refused.empty()

        eventually(told)
        assert "changed" in refused.get()
        sender.put(payload)  # of a sender that says nothing of it
        client.publish(pose)
        assert [heard.get(timeout=100.0) for _ in range(2)] == [payload] * 2
