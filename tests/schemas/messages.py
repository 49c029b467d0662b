"""Messages made up for the tests: one example of each, and strategies that make any.

After a deliberate change of the wire: ``python -m tests.schemas.messages`` writes ``golden.json`` anew.
"""

import json
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from schemas.action import Action
from schemas.array import Float32Array
from schemas.base import Message, Strict
from schemas.camera import Calibration, CameraInfo, CompressedImage, DepthImage, OverheadImage
from schemas.codec import encode, encoding_of
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat, Pulse
from schemas.motion import Imu, ImuSample, Odometry, TrackedPose, TruePose
from schemas.observation import Detected, Observation
from schemas.rpc import LoadRequest
from schemas.snapshot import Snapshot
from schemas.state import MAX_PLACES, NO_PLACES, State
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

_floats32 = st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=20)
_arrays = _floats32.map(lambda values: Float32Array.from_numpy(np.array(values, np.float32)))
#: What is checked by a function of our own, of which no strategy can be derived.
_OWN: dict[str, st.SearchStrategy[object]] = {
    "places": st.lists(
        st.tuples(
            st.integers(0, 1_000_000),
            *[st.floats(-1e6, 1e6, width=32)] * 2,
            st.floats(-3.125, 3.125, width=32),
            st.floats(0.0, 0.0078125, width=32),
        ),
        max_size=MAX_PLACES,
    ).map(lambda rows: places(*rows)),
    "goal": st.from_regex(r"\w[\w .-]{0,63}", fullmatch=True),
    "box": st.none() | st.tuples(*[st.floats(0.0, 0.4)] * 2, *[st.floats(0.5, 1.0)] * 2),
}
_requests = st.builds(
    LoadRequest, model=st.from_regex(r"[a-z]{1,9}(/[a-z]{1,9})?", fullmatch=True), goal=_OWN["goal"]
)


def _any_of(kind: Any, rules: Sequence[Any] = ()) -> st.SearchStrategy[Any]:
    """Make any value of a type within the bounds that are annotated."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin is Annotated:
        fields = [one.metadata if isinstance(one, FieldInfo) else [one] for one in arguments[1:]]
        return _any_of(arguments[0], [*rules, *chain.from_iterable(fields)])
    if origin in (Union, UnionType):
        return st.one_of(*(_any_of(one, rules) for one in arguments))
    if origin is Literal:
        return st.sampled_from(arguments)
    bounds = dict(chain.from_iterable(map(_named, rules)))
    if origin is tuple:
        return _tuples(arguments, bounds)
    return _values(kind, bounds)


def _tuples(arguments: tuple[Any, ...], bounds: dict[str, Any]) -> st.SearchStrategy[Any]:
    if arguments[-1] is not ...:
        return st.tuples(*map(_any_of, arguments))
    least = bounds.get("min_length", 0)
    most = min(bounds.get("max_length", 9), 100)
    return st.lists(_any_of(arguments[0]), min_size=least, max_size=most).map(tuple)


def _values(kind: type, bounds: dict[str, Any]) -> st.SearchStrategy[Any]:
    special = {Float32Array: _arrays, LoadRequest: _requests}
    if kind in special:
        return special[kind]
    if issubclass(kind, Message):
        return messages_of(kind)
    if issubclass(kind, Strict):
        return st.builds(kind, **_fields_of(kind))
    if "pattern" in bounds:
        return st.from_regex(bounds["pattern"].strip("^$"), fullmatch=True)
    size = {"min_size": bounds.get("min_length", 0), "max_size": bounds.get("max_length", 99)}
    least = bounds.get("ge", bounds.get("gt"))
    most = bounds.get("le", bounds.get("lt"))
    return {
        NoneType: st.none(),
        bool: st.booleans(),
        int: st.integers(least, most if most is None else most - ("lt" in bounds)),
        float: st.floats(least, most, exclude_min="gt" in bounds),
        str: st.text(st.characters(codec="utf-8"), **size),
        bytes: st.binary(**size),
    }[kind]


def _named(rule: Any) -> list[tuple[str, Any]]:
    names = ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern")
    return [(name, getattr(rule, name)) for name in names if getattr(rule, name, None) is not None]


def _fields_of(cls: type[Strict]) -> dict[str, st.SearchStrategy[Any]]:
    fields = cls.model_fields.items()
    own = _OWN if issubclass(cls, Message) else {}
    return {
        name: own[name] if name in own else _any_of(field.annotation, field.metadata)
        for name, field in fields
    }


def _depth_image(fields: dict[str, Any], rng: np.random.Generator) -> None:
    fields["width"] = fields["width"] % 8 + 1
    fields["height"] = fields["height"] % 8 + 1
    fields["data"] = rng.bytes(2 * fields["width"] * fields["height"])


def _camera_info(fields: dict[str, Any], rng: np.random.Generator) -> None:
    fields["centre_x_px"] = fields["width"] * rng.random()
    fields["centre_y_px"] = fields["height"] / 2
    fields["focal_px"] = fields["width"] * rng.uniform(1.0, 12.0)


def _taught_map(fields: dict[str, Any], rng: np.random.Generator) -> None:
    count = len(fields["begins"])
    poses = rng.standard_normal((count, 3), dtype=np.float32)
    fields |= {"begins": tuple(range(count)), "keyframes": Float32Array.from_numpy(poses)}


def _imu(fields: dict[str, Any], _rng: np.random.Generator) -> None:
    at_s = {sample.after_s: sample for sample in fields["samples"]}
    fields["samples"] = tuple(at_s[one] for one in sorted(at_s))


def _tracked_pose(fields: dict[str, Any], _rng: np.random.Generator) -> None:
    measured = ("x_m", "y_m", "heading_rad", "error_px")
    fields["visible"] = None not in [fields[name] for name in measured]
    if not fields["visible"]:
        fields |= dict.fromkeys(measured)


def _episode(fields: dict[str, Any], _rng: np.random.Generator) -> None:
    ended = fields["outcome"] is not None
    fields["event"] = "ended" if ended else fields["event"].replace("ended", "started")
    fields["judge"] = fields["judge"] if fields["outcome"] == "found" else None
    fields["right"] = fields["right"] if fields["outcome"] == "not_here" else None
    fields["box"] = fields["box"] if fields["judge"] == "operator" else None


def _state(fields: dict[str, Any], _rng: np.random.Generator) -> None:
    if fields["status"] == "idle":
        fields |= {"model": None, "places": NO_PLACES}
    else:
        fields["model"] = fields["model"] or "0123456789abcdef"
    of_paper = fields["status"] == "recognized" and not fields["places"].shape[0]
    fields["state"] = (fields["state"] or 0) if of_paper else None


#: By class: changes fields, each valid alone, so that they are valid together.
_FITTING: dict[type[Message], Callable[[dict[str, Any], np.random.Generator], None]] = {
    DepthImage: _depth_image,
    CameraInfo: _camera_info,
    TaughtMap: _taught_map,
    Imu: _imu,
    TrackedPose: _tracked_pose,
    Episode: _episode,
    State: _state,
}


def messages_of(cls: type[Message]) -> st.SearchStrategy[Message]:
    """Make any message of a class."""

    def message(fields: dict[str, Any]) -> Message:
        if cls in _FITTING:
            _FITTING[cls](fields, np.random.default_rng(fields["tick"]))
        return cls(**fields)

    return st.fixed_dictionaries(_fields_of(cls)).map(message)


any_message = st.sampled_from(CLASSES).flatmap(messages_of)


def golden_of(cls: type[Message]) -> dict[str, str]:
    """Return what ``golden.json`` says of a class."""
    return {"encoding": encoding_of(cls), "hex": encode(EXAMPLES[cls]).hex()}


if __name__ == "__main__":
    GOLDEN.write_text(
        json.dumps({cls.__name__: golden_of(cls) for cls in CLASSES}, indent=2) + "\n"
    )
