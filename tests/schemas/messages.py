"""Messages made up for the tests: one example of each, and changed examples.

After a deliberate change of the wire: ``python -m tests.schemas.messages`` writes ``golden.json`` anew.
"""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.action import Action
from schemas.array import Float32Array
from schemas.base import Message
from schemas.camera import Calibration, CameraInfo, CompressedImage, DepthImage, OverheadImage
from schemas.codec import encode, encoding_of
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat, Pulse
from schemas.motion import Imu, ImuSample, Odometry, TrackedPose, TruePose
from schemas.observation import Detected, Observation
from schemas.rpc import LoadRequest
from schemas.snapshot import Snapshot
from schemas.state import State
from schemas.taught_map import TaughtMap
from schemas.topics import TOPICS
from tests.places import places

HEADER = {
    "robot": "rescuebot",
    "episode": "drive-7-18c0-1",
    "tick": 300,
    "stamp_ns": 1_700_000_000_000_000_000,
}

#: One of each class; ``golden.json`` holds their bytes.
EXAMPLES: dict[type[Message], Message] = {
    CompressedImage: CompressedImage(**HEADER, width=2, height=1, data=b"\xff\xd8\xff\xd9"),
    CameraInfo: CameraInfo(
        **HEADER, width=640, height=480, focal_px=500.5, centre_x_px=320.0, centre_y_px=239.5
    ),
    DepthImage: DepthImage(**HEADER, width=2, height=1, data=bytes(range(4))),
    OverheadImage: OverheadImage(
        **HEADER,
        width=2,
        height=1,
        data=b"\xff\xd8\xff\xd9",
        calibration=Calibration(
            focal_px=900.0,
            centre_x_px=1.0,
            centre_y_px=0.5,
            x_m=4.0,
            y_m=3.0,
            height_m=4.5,
            up_rad=1.5,
        ),
    ),
    Odometry: Odometry(
        **HEADER, x_m=2.5, y_m=-0.25, heading_rad=0.125, speed_m_s=0.4, turn_rate_rad_s=-0.5
    ),
    Imu: Imu(
        **HEADER,
        samples=(
            ImuSample(
                after_s=29.98,
                angular_velocity_rad_s=(0.0, 0.125, -0.5),
                acceleration_m_s2=(0.25, 0.0, 9.8125),
            ),
        ),
    ),
    TrackedPose: TrackedPose(
        **HEADER, visible=True, x_m=12.5, y_m=-3.25, heading_rad=1.5, error_px=0.25
    ),
    TruePose: TruePose(**HEADER, x_m=12.5, y_m=-3.25, heading_rad=1.5),
    Observation: Observation(
        **HEADER,
        fingerprint="0123456789abcdef",
        modalities=("color", "hog"),
        features=Float32Array.from_numpy(np.array([0.5, -0.25, 1.0], np.float32)),
        detected=(Detected(label="apriltag 7", score=1.0, box=(0.25, 0.5, 0.375, 0.75)),),
    ),
    TaughtMap: TaughtMap(
        **HEADER,
        model="0123456789abcdef",
        keyframes=Float32Array.from_numpy(
            np.array([[0.0, 0.0, 0.0], [1.5, -0.25, 0.5], [0, 0, 3]], np.float32)
        ),
        begins=(0, 2),
    ),
    State: State(
        **HEADER,
        status="recognized",
        model="0123456789abcdef",
        places=places((7, 0.25, -0.125, 0.5, 0.75), (3, -0.5, 0.0, -0.25, 0.25)),
        lost=0.125,
        cosine=0.625,
        tracked_m=12.5,
    ),
    Action: Action(**HEADER, kind="follow", state=7, atoms=("forward",)),
    Pulse: Pulse(**HEADER, session="fedcba987654", number=41, latched_stop=3, stop_cause="fault"),
    Heartbeat: Heartbeat(
        **HEADER, session="0123456789abcdef", name="teleop", sequence=7, answers=41
    ),
    Command: Command(
        **HEADER, source="teleop", session="0123456789abcdef", sequence=2, atom="forward", speed=0.5
    ),
    CommandApplied: CommandApplied(
        **HEADER,
        sequence=1,
        atom="forward",
        linear=0.75,
        angular=0.0,
        source="teleop",
        reason="command",
        answered_tick=299,
        latency_ns=12_000_000,
        delay_ns=45_000_000,
        refused=3,
    ),
    Episode: Episode(
        **HEADER,
        event="ended",
        purpose="drive",
        driver="teleop",
        world="campus",
        seed=7,
        outcome="found",
        judge="task",
    ),
}
EXAMPLES[Snapshot] = Snapshot(
    **HEADER,
    service="recognition",
    checksum="0123456789abcdef",
    model=LoadRequest(model="ways/campus.smal", goal="victim"),
    state=EXAMPLES[State],
    wheels=(2.5, -0.25, 0.125),
)
CLASSES = list(EXAMPLES)
assert set(CLASSES) == {topic.message for topic in TOPICS.values()}, "every message has an example"

GOLDEN = Path(__file__).parent / "golden.json"

#: Any values of a type, by the type of an example.
_VALUES: dict[type, st.SearchStrategy[object]] = {
    bool: st.booleans(),
    int: st.integers(0, 10**6),
    float: st.floats(-100.0, 100.0) | st.floats(0.0, 1.0),
    str: st.text(st.characters(codec="utf-8"), max_size=40),
    bytes: st.binary(min_size=1, max_size=99),
    Float32Array: st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False)).map(
        lambda values: Float32Array.from_numpy(np.array(values, np.float32))
    ),
}


@st.composite
def any_message(draw: st.DrawFn) -> Message:
    """Change fields of an example, and keep each change that is valid beside the others."""
    cls = draw(st.sampled_from(CLASSES))
    message = EXAMPLES[cls]
    fields = message.model_dump()
    for name in draw(st.lists(st.sampled_from(sorted(fields)), max_size=8, unique=True)):
        value = draw(_VALUES.get(type(getattr(message, name)), st.none()))
        with suppress(ValidationError):
            message = cls.model_validate(message.model_dump() | {name: value})
    return message


def golden_of(cls: type[Message]) -> dict[str, str]:
    """Return what ``golden.json`` says of a class."""
    return {"encoding": encoding_of(cls), "hex": encode(EXAMPLES[cls]).hex()}


if __name__ == "__main__":
    GOLDEN.write_text(
        json.dumps({cls.__name__: golden_of(cls) for cls in CLASSES}, indent=2) + "\n"
    )
