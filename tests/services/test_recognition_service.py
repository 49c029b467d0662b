"""Recognition by the filter, its handlers alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.array import Float32Array
from schemas.observation import Detected
from schemas.state import State
from services.kit.model_service import LoadedModel
from services.kit.node import ServiceError
from services.recognition.service import RecognitionService
from smal.features import FeatureSettings
from smal.obstacles.ground import Ground
from smal.target.evidence import ScoreEvidence
from smal.target.label import TargetLabel
from tests import corridor
from tests.places import estimate
from tests.services.chain import (
    identity,
    observation,
    save_model,
    seen,
    wheels,
    with_model,
)
from tests.services.recordings.recorded_messages import applied


@pytest.fixture
def service(model: Path) -> RecognitionService:
    return with_model(RecognitionService(), model)


def at(
    service: RecognitionService, tick: int, pose: corridor.Pose | None = None, episode: str = "e"
) -> State:
    """Give a frame and its odometry; return the state."""
    assert service.see(wheels(tick, pose, episode)) is None
    return service.handle(seen(tick, pose, episode))


def test_a_state_is_a_belief_over_places(service: RecognitionService, model: Path) -> None:
    for tick in range(8):
        state = at(service, tick, (0.2 * tick, 0.1, 0.0))
    assert (state.status, state.model, state.state, state.episode, state.tick) == (
        "recognized", identity(model), None, "e", 7,
    )  # fmt: skip
    assert estimate(state) == pytest.approx((1.4, 0.1), abs=0.1)
    assert state.weights.sum() == pytest.approx(1.0)
    assert state.lost < 0.1
    assert state.cosine > 0.4
    assert state.tracked_m == pytest.approx(1.4, abs=0.01)


def test_renewed_map_keeps_the_belief(service: RecognitionService, tmp_path: Path) -> None:
    for tick in range(8):
        at(service, tick)
    renewed = corridor.save_renewed(tmp_path / "renewed.smal")
    service.load(LoadedModel.read(renewed))
    service.see(wheels(8))
    state = service.handle(seen(8))
    assert (state.model, state.tracked_m) == (identity(renewed), pytest.approx(1.6, abs=0.05))
    assert estimate(state) == pytest.approx((1.6, 0.0), abs=0.1)


Box = tuple[float, float, float, float]


@pytest.fixture
def detecting(tmp_path: Path) -> RecognitionService:
    """Give recognition whose target wears a tag."""
    tells = TargetLabel("apriltag 7", 0.04, ScoreEvidence(0.0, 0.1, 1.0, 60))
    replace(corridor.model(), labels={"victim": tells}).save(tmp_path / "way.smal")
    return with_model(RecognitionService(), tmp_path / "way.smal")


def detected(box: Box, label: str = "apriltag 7") -> dict[str, object]:
    """Return the changes of an observation in which a tag is seen."""
    picture = np.random.default_rng(0).integers(0, 256, 14_400, dtype=np.uint8).tobytes()
    return {"picture": picture, "detected": (Detected(label=label, score=1.0, box=box),)}


def test_detected_target_is_seen(detecting: RecognitionService) -> None:
    for label, found in (("apriltag 8", 0.0), ("apriltag 7", 1.0)):
        for tick in range(20):
            detecting.see(wheels(tick, episode=label[-1]))
            update = detected((0.3, 0.4, 0.5, 0.6), label)
            state = detecting.handle(seen(tick, episode=label[-1]).model_copy(update=update))
        assert state.seen == pytest.approx(found, abs=0.05)
    assert (state.near, state.seen_left) == (pytest.approx(1.0), pytest.approx(0.1))


def test_unexpected_ground_is_reported_when_it_is_watched(
    tmp_path: Path,
) -> None:
    black = Ground(np.zeros((len(corridor.model().mapped.keyframes), 9, 3), dtype=np.uint8), 0.1)
    for ground, watches in ((black, True), (black, False), (None, True)):
        replace(corridor.model(), ground=ground).save(tmp_path / "way.smal")
        service = RecognitionService(watches)
        loaded = LoadedModel.read(tmp_path / "way.smal")
        if ground is None:
            with pytest.raises(ServiceError, match="has no ground"):
                service.load(loaded)
            continue
        service.load(loaded)
        for tick in range(6):
            service.see(wheels(tick))
            light = np.full(14_400, 200, dtype=np.uint8).tobytes()
            state = service.handle(
                seen(tick).model_copy(update={"picture": light, "stamp_ns": tick * 100_000_000})
            )
        assert (state.strange_m is not None) == watches


def test_odometry_may_come_before_its_observation_or_after_it(
    service: RecognitionService, model: Path
) -> None:
    other = with_model(RecognitionService(), model)
    for tick in range(5):
        expected = at(service, tick)
        assert other.handle(seen(tick)) is None
        assert other.see(wheels(tick, episode="another")) is None
        assert other.see(wheels(tick + 50)) is None
        assert other.see(wheels(tick)) == expected


def test_a_frame_that_is_sent_again_has_the_same_answer(service: RecognitionService) -> None:
    for tick in range(3):
        first = at(service, tick)
        assert service.handle(seen(tick)) is first
        assert service.see(wheels(tick)) is None
        assert service.handle(seen(tick)) is first
    # A view taken in twice would count as more evidence.
    fresh = at(service, 3)
    assert estimate(fresh)[0] == pytest.approx(0.6, abs=0.1)


def test_recognition_goes_on_without_odometry_on_a_resent_frame(
    service: RecognitionService,
) -> None:
    for tick in range(3):
        at(service, tick)
    assert service.handle(seen(3)) is None
    state = service.handle(seen(3))
    assert (state.tick, state.status) == (3, "recognized")
    # The odometry that follows says how far the robot went in both frames.
    later = at(service, 4)
    assert later.tracked_m == pytest.approx(0.8, rel=0.02)
    assert estimate(later)[0] == pytest.approx(0.8, abs=0.1)


def test_recognition_uses_commands_when_taught_without_odometry(tmp_path: Path) -> None:
    path = tmp_path / "unmeasured.smal"
    corridor.model(odometry=False).save(path)
    service = with_model(RecognitionService(), path)
    for tick in range(9):
        # Two commands in one frame: the last one counts. Odometry is in metres, and does not.
        for sequence, atom in ((1, "forward"), (0, "stop")):
            service.see_applied(applied("e", tick, sequence, atom))
        service.see(wheels(tick, (7.0 * tick, 0.0, 0.0)))
        if tick in (3, 4):
            service.behind = lambda: True
        state = service.handle(seen(tick).model_copy(update={"stamp_ns": tick * 100_000_000}))
        assert (state is None) == (tick in (3, 4))
        service.behind = lambda: False
    # In the unit of such a map, one atom ahead.
    assert state.tracked_m == pytest.approx(8.0, rel=0.05)
    x, _ = estimate(state, corridor.model(odometry=False))
    assert x == pytest.approx(8.0, abs=0.7)


def test_frames_are_left_out_while_newer_ones_wait(service: RecognitionService) -> None:
    at(service, 0)
    service.behind = lambda: True
    for tick in (1, 2, 3):
        service.see(wheels(tick))
        assert service.handle(seen(tick)) is None
    service.behind = lambda: False
    state = at(service, 4)
    assert state.tracked_m == pytest.approx(0.8, abs=0.01)
    assert estimate(state)[0] == pytest.approx(0.8, abs=0.1)


def test_features_of_another_fingerprint_are_refused_in_one_line(
    service: RecognitionService,
) -> None:
    before = at(service, 0)
    for _ in range(2):
        with pytest.raises(
            ServiceError, match=r"^observations have the features .*; learn the model again$"
        ):
            service.handle(observation(1))
    assert service.handle(seen(0)) is before
    assert at(service, 1).status == "recognized"


def test_a_model_of_the_papers_scheme_needs_no_odometry(tmp_path: Path) -> None:
    service = RecognitionService()
    reply = service.load(LoadedModel.read(save_model(tmp_path / "paper.smal")))
    assert (reply.scheme, reply.keyframes) == ("paper", 0)
    assert [service.handle(observation(tick, place=6 + tick)) is None for tick in range(3)] == [
        False
    ] * 3


def test_recognition_answers_when_the_odometry_jumps_far(service: RecognitionService) -> None:
    for tick in range(40):
        far = tick % 2 == 1 and tick < 20
        service.see(wheels(tick, (1e6, 1e6, 3.0) if far else (0.2 * (tick - 20), 0.0, 0.0)))
        state = service.handle(seen(tick, (0.2 * max(tick - 20, 0), 0.0, 0.0)))
        assert np.abs(state.places.to_numpy()[:, 1]).max() <= 1e6
    assert state.status == "recognized"
    assert estimate(state) == pytest.approx((3.8, 0.0), abs=0.2)


@pytest.mark.parametrize(
    "box", [(0.5, 0.5, 0.4, 0.6), (1.4, 0.0, 1.5, 1.0), (-0.5, -0.5, -0.4, 1.5)]
)
def test_recognition_answers_when_a_box_is_impossible(
    detecting: RecognitionService, box: Box
) -> None:
    detecting.see(wheels(0))
    assert detecting.handle(seen(0).model_copy(update=detected(box))) is not None


@pytest.mark.parametrize(
    "features", [np.full(corridor.FEATURES.size, 3e38), np.ones(3)], ids=["huge", "few"]
)
def test_recognition_refuses_features_when_they_are_impossible(
    service: RecognitionService, features: NDArray[np.float64]
) -> None:
    service.see(wheels(0))
    forged = seen(0).model_copy(
        update={"features": Float32Array.from_numpy(features.astype(np.float32))}
    )
    with pytest.raises(ServiceError, match=r"^episode e, frame 0: features "):
        service.handle(forged)
    assert at(service, 1).status in {"recognized", "unknown"}


def test_recognition_warns_when_it_cannot_run_the_network(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FeatureSettings, "computable", False)
    service = RecognitionService()
    lines: list[str] = []
    service.warn = lines.append
    with_model(service, model)
    assert [line for line in lines if "pitch of the camera is not estimated" in line] == lines != []
