"""Messages made up for the tests: one example of each, and strategies that make any.

After a deliberate change of the wire: ``python -m tests.schemas.messages`` writes ``golden.json`` anew.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from schemas.action import Action
from schemas.array import Float32Array
from schemas.base import ATOMS, MAX_TICK, SOURCES, Message
from schemas.camera_info import CameraInfo
from schemas.codec import encode, encoding_of
from schemas.command import Command, CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.depth_image import DepthImage
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.image import Image
from schemas.imu import Imu, ImuSample
from schemas.observation import Observation
from schemas.odometry import Odometry
from schemas.overhead_image import Calibration, OverheadImage
from schemas.pose import Pose
from schemas.pulse import Pulse
from schemas.state import MAX_PLACES, Place, State
from schemas.taught_map import TaughtMap
from schemas.topics import TOPICS
from schemas.tracked_pose import TrackedPose

HEADER = {"robot": "rescuebot", "episode": "drive-7-18c0-1", "tick": 300, "stamp_ns": 1_700_000_000_000_000_000}

#: One of each class; ``golden.json`` holds their bytes.
EXAMPLES: dict[type[Message], Message] = {
    Image: Image(**HEADER, width=2, height=1, data=bytes(range(6))),
    CompressedImage: CompressedImage(**HEADER, width=2, height=1, data=b"\xff\xd8\xff\xd9"),
    CameraInfo: CameraInfo(**HEADER, width=640, height=480, focal_px=500.5, centre_x_px=320.0, centre_y_px=239.5),
    DepthImage: DepthImage(**HEADER, width=2, height=1, data=bytes(range(4))),
    OverheadImage: OverheadImage(
        **HEADER,
        width=2,
        height=1,
        data=bytes(range(6)),
        calibration=Calibration(
            focal_px=900.0, centre_x_px=1.0, centre_y_px=0.5, x_m=4.0, y_m=3.0, height_m=4.5, up_rad=1.5
        ),
    ),
    Odometry: Odometry(**HEADER, x_m=2.5, y_m=-0.25, heading_rad=0.125, speed_m_s=0.4, turn_rate_rad_s=-0.5),
    Imu: Imu(
        **HEADER,
        samples=(
            ImuSample(after_s=29.98, angular_velocity_rad_s=(0.0, 0.125, -0.5), acceleration_m_s2=(0.25, 0.0, 9.8125)),
        ),
    ),
    TrackedPose: TrackedPose(**HEADER, visible=True, x_m=12.5, y_m=-3.25, heading_rad=1.5, error_px=0.25),
    Pose: Pose(**HEADER, x_m=12.5, y_m=-3.25, heading_rad=1.5),
    Observation: Observation(
        **HEADER,
        fingerprint="0123456789abcdef",
        modalities=("color", "hog"),
        features=Float32Array.from_numpy(np.array([0.5, -0.25, 1.0], np.float32)),
    ),
    TaughtMap: TaughtMap(
        **HEADER,
        model="0123456789abcdef",
        keyframes=Float32Array.from_numpy(np.array([[0.0, 0.0, 0.0], [1.5, -0.25, 0.5], [0, 0, 3]], np.float32)),
        begins=(0, 2),
    ),
    State: State(
        **HEADER,
        status="recognized",
        model="0123456789abcdef",
        places=(
            Place(keyframe=7, ahead_m=0.25, left_m=-0.125, turned_rad=0.5, weight=0.75),
            Place(keyframe=3, ahead_m=-0.5, left_m=0.0, turned_rad=-0.25, weight=0.25),
        ),
        lost=0.125,
        cosine=0.625,
        tracked_m=12.5,
    ),
    Action: Action(**HEADER, kind="follow", state=7, atoms=("forward",)),
    Pulse: Pulse(**HEADER, session="fedcba987654", number=41, emergency_stop=3, stop_cause="fault"),
    Heartbeat: Heartbeat(**HEADER, session="0123456789abcdef", name="teleop", sequence=7, answers=41),
    Command: Command(**HEADER, source="teleop", session="0123456789abcdef", sequence=2, atom="forward", speed=0.5),
    CommandApplied: CommandApplied(
        **HEADER,
        sequence=1,
        atom="forward",
        speed=0.5,
        ahead=0.25,
        source="teleop",
        reason="command",
        answered_tick=299,
        latency_ns=12_000_000,
        delay_ns=45_000_000,
        refused=3,
    ),
    Episode: Episode(
        **HEADER, event="ended", purpose="drive", driver="teleop", world="campus", seed=7, outcome="found", judge="task"
    ),
}
CLASSES = list(EXAMPLES)
assert set(CLASSES) == {topic.message for topic in TOPICS.values()}, "every message has an example"

GOLDEN = Path(__file__).parent / "golden.json"

_large = st.floats(0, 1e9)
_header = {
    "robot": st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True),
    "episode": st.from_regex(r"[a-z0-9][a-z0-9_-]{0,63}", fullmatch=True),
    "tick": st.integers(0, MAX_TICK),
    "stamp_ns": st.integers(0, 2**63 - 1),
}
_floats32 = st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=20)
_arrays = _floats32.map(lambda values: Float32Array.from_numpy(np.array(values, np.float32)))
_sizes = st.tuples(st.integers(1, 8), st.integers(1, 8))
_images = _sizes.flatmap(
    lambda size: st.fixed_dictionaries(
        {
            **_header,
            "width": st.just(size[0]),
            "height": st.just(size[1]),
            "data": st.binary(min_size=3 * size[0] * size[1], max_size=3 * size[0] * size[1]),
        }
    )
)
_sessions = st.from_regex(r"[0-9a-z_-]{0,32}", fullmatch=True)
_lengths = st.floats(-1e6, 1e6)
_beside = st.builds(
    Place,
    keyframe=st.integers(0, 1_000_000),
    ahead_m=_lengths,
    left_m=_lengths,
    turned_rad=st.floats(-3.2, 3.2),
    weight=st.floats(0, 1),
)
_state = st.fixed_dictionaries(
    {
        **_header,
        "lost": st.floats(0, 1),
        "cosine": st.floats(-1, 1),
        "tracked_m": _large,
        "score": _large,
        "total_weight": _large,
        "residual": st.floats(0, 1),
        "agreement": st.floats(-1, 1),
        "duality_gap": _large,
    }
)
_checksums = st.from_regex(r"[0-9a-f]{8,64}", fullmatch=True)
_status = st.one_of(
    st.fixed_dictionaries(
        {
            "status": st.just("recognized"),
            "model": _checksums,
            "state": st.integers(0, 1_000_000),
        }
    ),
    st.fixed_dictionaries(
        {
            "status": st.sampled_from(["recognized", "unknown"]),
            "model": _checksums,
            "places": st.lists(_beside, min_size=1, max_size=MAX_PLACES).map(tuple),
        }
    ),
    st.fixed_dictionaries({"status": st.sampled_from(["collecting", "unknown"]), "model": _checksums}),
    st.just({"status": "idle"}),
)
_event = st.one_of(
    st.fixed_dictionaries(
        {"event": st.just("ended"), "outcome": st.sampled_from(["found", "collision", "timeout", "aborted"])}
    ),
    st.fixed_dictionaries({"event": st.sampled_from(["started", "victim_found", "collision", "timed_out"])}),
)
_atoms = st.sampled_from(ATOMS)
_sources = st.sampled_from(SOURCES)
_counts = st.integers(0, 1_000_000)

_places = {"x_m": st.floats(-1e5, 1e5), "y_m": st.floats(-1e5, 1e5)}
_calibrations = st.builds(
    Calibration,
    focal_px=st.floats(1, 1e5),
    centre_x_px=st.floats(0, 4096),
    centre_y_px=st.floats(0, 3072),
    height_m=st.floats(0.1, 1e3),
    up_rad=st.floats(-3.2, 3.2),
    **_places,
)
_rates, _accelerations = st.floats(-100, 100), st.floats(-1000, 1000)
_samples = st.lists(st.floats(0, 1e6), max_size=4, unique=True).flatmap(
    lambda times: st.tuples(
        *(
            st.builds(
                ImuSample,
                after_s=st.just(time),
                angular_velocity_rad_s=st.tuples(_rates, _rates, _rates),
                acceleration_m_s2=st.tuples(_accelerations, _accelerations, _accelerations),
            )
            for time in sorted(times)
        )
    )
)
_tracked = st.one_of(
    st.just({"visible": False}),
    st.fixed_dictionaries(
        {"visible": st.just(True), **_places, "heading_rad": st.floats(-3.2, 3.2), "error_px": st.floats(0, 1e4)}
    ),
)

_fields: dict[type[Message], st.SearchStrategy[dict[str, object]]] = {
    Image: _images,
    CameraInfo: st.fixed_dictionaries(
        {
            **_header,
            "width": st.integers(1, 4096),
            "height": st.integers(1, 3072),
            "focal_px": st.floats(1.0, 1e5),
            "centre_x_px": st.floats(0.0, 4096.0),
            "centre_y_px": st.floats(0.0, 3072.0),
        }
    ),
    CompressedImage: st.fixed_dictionaries(
        {**_header, "width": st.integers(1, 4096), "height": st.integers(1, 3072), "data": st.binary(min_size=4)}
    ),
    DepthImage: _sizes.flatmap(
        lambda size: st.fixed_dictionaries(
            {
                **_header,
                "width": st.just(size[0]),
                "height": st.just(size[1]),
                "data": st.binary(min_size=2 * size[0] * size[1], max_size=2 * size[0] * size[1]),
            }
        )
    ),
    OverheadImage: st.builds(lambda image, c: image | {"calibration": c}, _images, _calibrations),
    Odometry: st.fixed_dictionaries(
        {
            **_header,
            **_places,
            "heading_rad": st.floats(-3.2, 3.2),
            "speed_m_s": _rates,
            "turn_rate_rad_s": _rates,
        }
    ),
    Imu: st.fixed_dictionaries({**_header, "samples": _samples}),
    TrackedPose: st.builds(lambda a, b: a | b, st.fixed_dictionaries(_header), _tracked),
    Pose: st.fixed_dictionaries(
        {
            **_header,
            "x_m": st.floats(-1e5, 1e5),
            "y_m": st.floats(-1e5, 1e5),
            "heading_rad": st.floats(-3.2, 3.2),
        }
    ),
    Observation: st.fixed_dictionaries(
        {
            **_header,
            "fingerprint": _checksums,
            "modalities": st.lists(st.from_regex(r"[a-z][a-z0-9_]{0,31}", fullmatch=True), max_size=16).map(tuple),
            "features": _arrays,
        }
    ),
    TaughtMap: st.integers(1, 9).flatmap(
        lambda count: st.fixed_dictionaries(
            {
                **_header,
                "model": _checksums,
                "keyframes": st.lists(st.floats(-1e6, 1e6, width=32), min_size=3 * count, max_size=3 * count).map(
                    lambda values: Float32Array.from_numpy(np.array(values, np.float32).reshape(-1, 3))
                ),
                "begins": st.sets(st.integers(1, count - 1) if count > 1 else st.nothing()).map(
                    lambda more: (0, *sorted(more))
                ),
            }
        )
    ),
    State: st.builds(lambda a, b: a | b, _state, _status),
    Action: st.fixed_dictionaries(
        {
            **_header,
            "kind": st.sampled_from(["follow", "action", "goal", "dead_end", "look_around", "guess", "stop"]),
            "state": st.none() | st.integers(0, 1_000_000),
            "atoms": st.lists(_atoms, max_size=30).map(tuple),
        }
    ),
    Command: st.fixed_dictionaries(
        {
            **_header,
            "source": _sources,
            "session": _sessions,
            "sequence": _counts,
            "atom": _atoms,
            "speed": st.floats(0, 1),
        }
    ),
    Heartbeat: st.fixed_dictionaries(
        {
            **_header,
            "session": _sessions,
            "name": st.from_regex(r"[a-z0-9_-]{1,32}", fullmatch=True),
            "sequence": st.integers(0, 2**63 - 1),
            "answers": st.none() | st.integers(1, 2**63 - 1),
            "present": st.booleans(),
        }
    ),
    Pulse: st.fixed_dictionaries(
        {
            **_header,
            "session": _sessions,
            "number": st.integers(1, 2**63 - 1),
            "emergency_stop": st.integers(0, 2**63 - 1),
            "stop_cause": st.sampled_from([None, "not_armed", "emergency_stop", "operator_lost", "fault"]),
        }
    ),
    CommandApplied: st.fixed_dictionaries(
        {
            **_header,
            "sequence": _counts,
            "atom": _atoms,
            "speed": st.floats(0, 1),
            "ahead": st.floats(-1, 1),
            "source": st.none() | _sources,
            "reason": st.sampled_from(["command", "silence", "taken_over", "emergency_stop"]),
            "emergency_stop": st.integers(0, 2**63 - 1),
            "stop_cause": st.sampled_from([None, "not_armed", "emergency_stop", "operator_lost", "fault"]),
            "answered_tick": st.none() | st.integers(0, MAX_TICK),
            "latency_ns": st.none() | st.integers(0, 2**63 - 1),
            "delay_ns": st.none() | st.integers(0, 2**63 - 1),
            "refused": st.integers(0, 2**63 - 1),
        }
    ),
    Episode: st.builds(
        lambda a, b: a | b,
        st.fixed_dictionaries(
            {
                **_header,
                "purpose": st.sampled_from(["drive", "recovery", "run"]),
                "driver": _sources,
                "world": st.text(st.characters(codec="utf-8"), min_size=1, max_size=255),
                "seed": st.integers(0, 2**63 - 1),
            }
        ),
        _event,
    ),
}


def messages_of(cls: type[Message]) -> st.SearchStrategy[Message]:
    """Make any message of a class."""
    return _fields[cls].map(lambda fields: cls(**fields))


any_message = st.sampled_from(CLASSES).flatmap(messages_of)


def golden_of(cls: type[Message]) -> dict[str, str]:
    """Return what ``golden.json`` says of a class."""
    return {"encoding": encoding_of(cls), "hex": encode(EXAMPLES[cls]).hex()}


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({cls.__name__: golden_of(cls) for cls in CLASSES}, indent=2) + "\n")
