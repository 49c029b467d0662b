"""The features service with depth: colour and depth of a frame are joined, whichever comes first."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import topics
from schemas.camera import CompressedImage, DepthImage
from schemas.observation import Observation
from services.features.service import FeaturesService
from services.kit.bus import Bus
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.kit.node import Detail
from smal.features import FeatureSettings, extract
from tests.services.chain import image, process
from tests.services.waiting import collected, eventually, introduce, malformed, ready, status_of

WITH_DEPTH = FeatureSettings.of(("color", "depth"))


def depth_pixels(tick: int) -> np.ndarray:
    return np.random.default_rng(1000 + tick).integers(0, 65536, (24, 32), dtype=np.uint16)


def depth_image(tick: int, episode: str = "e") -> DepthImage:
    """Return the depth image of the frame `image`."""
    data = depth_pixels(tick).astype("<u2").tobytes()
    return DepthImage.after(image(tick, episode=episode), width=32, height=24, data=data)


def features(tick: int) -> np.ndarray:
    return extract(decode_jpeg(image(tick).data), WITH_DEPTH, depth_pixels(tick))


def detail(client: Bus) -> Detail:
    status = status_of(client, "features")
    return status.detail


def give(service: FeaturesService, *messages: CompressedImage | DepthImage) -> list[Observation]:
    """Give messages in this order, and return what came of them."""
    answers = [
        service.handle(one) if isinstance(one, CompressedImage) else service.handle_depth(one)
        for one in messages
    ]
    return [answer for answer in answers if answer is not None]


@pytest.mark.parametrize("depth_first", [True, False])
def test_a_frame_is_published_once_both_its_images_are_there(depth_first: bool) -> None:
    service = FeaturesService(WITH_DEPTH)
    first, second = (depth_image(7), image(7)) if depth_first else (image(7), depth_image(7))
    assert give(service, first) == []
    (observation,) = give(service, second)
    np.testing.assert_array_equal(observation.features.to_numpy(), features(7))
    assert observation.fingerprint == WITH_DEPTH.fingerprint
    assert (observation.episode, observation.tick, observation.stamp_ns) == ("e", 7, 7)
    assert service.without_depth == 0


def test_detections_go_with_the_features_of_their_frame() -> None:
    tag = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 5, 120
    )
    pixels = np.full((240, 320, 3), 255, dtype=np.uint8)
    pixels[60:180, 100:220] = tag[..., None]
    shown = image(1).model_copy(update={"data": encode_jpeg(pixels), "width": 320, "height": 240})
    (observation,) = give(FeaturesService(FeatureSettings(("thumbnail", "apriltag"))), shown)
    (found,) = observation.detected
    assert (found.label, found.score) == ("apriltag 5", 1.0)
    assert found.box == pytest.approx((100 / 320, 60 / 240, 220 / 320, 180 / 240), abs=0.01)
    assert observation.modalities == ("thumbnail", "apriltag")


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 3), st.sampled_from("ab")), max_size=20))
def test_observation_is_of_one_frame_in_any_order(
    arrivals: list[tuple[bool, int, str]],
) -> None:
    service = FeaturesService(WITH_DEPTH)
    sent = [
        (depth_image if is_depth else image)(tick, episode=episode)
        for is_depth, tick, episode in arrivals
    ]
    heard = give(service, *sent)
    for observation in heard:
        np.testing.assert_array_equal(observation.features.to_numpy(), features(observation.tick))
    frames = [(one.episode, one.tick) for one in sent if isinstance(one, CompressedImage)]
    assert all((one.episode, one.tick) in frames for one in heard)
    assert len(heard) + service.without_depth <= len(frames)


def test_a_frame_that_is_asked_for_again_is_answered_again() -> None:
    service = FeaturesService(WITH_DEPTH)
    frame = (depth_image(4), image(4))
    first = give(service, *frame)
    assert len(first) == 1
    assert give(service, *frame) == give(service, image(4)) == first


@pytest.mark.zenoh
def test_the_process_joins_colour_and_depth(client: Bus, router_endpoint: str) -> None:
    heard = collected(client, topics.OBSERVATION)
    assert not client.has_listeners(topics.DEPTH)
    with process("features", router_endpoint, "--modalities", "color,depth"):
        ready(client, "features")
        introduce(client, "features", image(0, episode="hello"), depth_image(1, episode="hello"))
        # This is how the simulator knows that it has to make depth images.
        eventually(lambda: client.has_listeners(topics.DEPTH))
        for topic in (topics.DEPTH, topics.JPEG):
            malformed(client, "features", topic)
        # `introduce` may have sent several frames without depth, and none of them is to be heard.
        assert heard == []
        for message in (depth_image(5), image(5)):
            client.publish(message)
        eventually(lambda: len(heard) == 1)
        for message in (image(6), depth_image(6)):
            client.publish(message)
        eventually(lambda: len(heard) == 2)
        before = detail(client)

        def counted() -> bool:
            for tick in (7, 8):
                client.publish(image(tick))
            return detail(client)["without_depth"] > before["without_depth"]

        eventually(counted)
        assert (before["modalities"], before["fingerprint"]) == (
            "color depth",
            WITH_DEPTH.fingerprint,
        )
    assert [one.tick for one in heard] == [5, 6]
    for one in heard:
        np.testing.assert_array_equal(one.features.to_numpy(), features(one.tick))


def test_the_service_needs_no_scipy() -> None:
    program = (
        "import sys\n"
        "sys.modules['scipy'] = None\n"
        "import services.features.__main__\n"
        "import numpy as np\n"
        "from smal.features import MODALITIES, FeatureSettings, extract\n"
        "names = [name for name in MODALITIES if name != 'depth']\n"
        "print(extract(np.zeros((48, 64, 3), dtype=np.uint8), FeatureSettings.of(names)).size)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 8244
