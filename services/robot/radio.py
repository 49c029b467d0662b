"""Radio mode: keeps latency low on a narrow, slow link that loses packets.

TCP answers a lost packet by slowing down. Images that exceed the remaining bandwidth then queue for
seconds (measured by the benchmark ``link``), and every answer is too late. Therefore radio mode
sends small images, limits the images in flight to those that the driver can answer in time, and
allows older commands.
"""

import math
from typing import Final

from schemas.camera import DepthImage
from services.robot.clock import SILENCE_S

# Maximum age of a command by radio: 50 ms and 20 ms of jitter each way, and a loss.
AGE_S: Final = 0.5
# JPEG quality: 6 kB for 320x240, a quarter of quality 95; the features of both have a cosine of
# 0.997.
QUALITY: Final = 30
#: Maximum columns of a depth image: 40x30 are 2 kB, where a camera's 320x240 are 150 kB. They are
#: two degrees apart, 8 cm at 2.5 m. The gate, which avoids obstacles, uses the camera's full image.
DEPTH_COLUMNS: Final = 40
UNANSWERED: Final = 3  # Images in flight: a driver that answers within 0.3 s sustains 10 Hz.


def coarse(depth: DepthImage) -> DepthImage:
    """Subsample a depth image by the middle pixel of each block."""
    every = math.ceil(depth.width / DEPTH_COLUMNS)
    pixels = depth.to_numpy()[every // 2 :: every, every // 2 :: every]
    height, width = pixels.shape
    return depth.model_copy(update={"width": width, "height": height, "data": pixels.tobytes()})


class RadioWindow:
    """Frames with an image, of which at most `UNANSWERED` are in flight; of one episode."""

    def __init__(self) -> None:
        self._sent: list[int] = []
        self._last_s = 0.0

    def answered(self, tick: int) -> None:
        """Store that the driver has answered a frame, and with it all earlier frames; thread-safe."""
        self._sent = [sent for sent in self._sent if sent > tick]

    def takes(self, tick: int, now_s: float) -> bool:
        """Return whether to send the image of a frame; lost images time out."""
        if len(self._sent) >= UNANSWERED and now_s - self._last_s < 2 * SILENCE_S:
            return False
        self._sent = [*self._sent, tick][-UNANSWERED:]
        self._last_s = now_s
        return True
