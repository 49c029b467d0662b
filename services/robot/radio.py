"""By radio: what keeps a narrow, slow link that loses packets from making every command too old.

TCP answers a lost packet by slowing down. Pictures that exceed the remaining bandwidth then queue for seconds (measured
by the benchmark ``link``), and every answer comes too late to be obeyed. So by radio pictures are small, the number of
pictures under way is limited to those that the driver can answer in time, and a command may be older.
"""

import math
from typing import Final

from schemas.camera import DepthImage
from services.robot.gate import SILENCE_S

AGE_S: Final = (
    0.5  # Age of a command that is obeyed by radio: 50 ms and 20 ms of jitter each way, and a loss.
)
QUALITY: Final = 30  # Of JPEG: 6 kB for 320x240, a quarter of 95; its features have a cosine of 0.997 with those.
#: Columns of a depth image, at most: 40x30 are 2 kB, where a camera's 320x240 are 150 kB. They are two degrees apart,
#: 8 cm at 2.5 m; the gate, which keeps the robot from running into things, sees what the camera does.
DEPTH_COLUMNS: Final = 40
UNANSWERED: Final = 3  # Pictures under way: what a driver answers within 0.3 s flows at 10 Hz.


def coarse(depth: DepthImage) -> DepthImage:
    """Return a depth image with fewer pixels: of each block the middle one, so that it sees where its block does."""
    every = math.ceil(depth.width / DEPTH_COLUMNS)
    pixels = depth.to_numpy()[every // 2 :: every, every // 2 :: every]
    height, width = pixels.shape
    return depth.model_copy(update={"width": width, "height": height, "data": pixels.tobytes()})


class RadioWindow:
    """Which frames have a picture, so that no more than `UNANSWERED` are under way; those of one episode."""

    def __init__(self) -> None:
        self._sent: list[int] = []
        self._last_s = 0.0

    def answered(self, tick: int) -> None:
        """Note that the driver has answered a frame, in time or not; on any thread. It answers none before it later."""
        self._sent = [sent for sent in self._sent if sent > tick]

    def takes(self, tick: int, now_s: float) -> bool:
        """Whether the picture of a frame is to be sent, which is then under way; what is lost is not waited for."""
        if len(self._sent) >= UNANSWERED and now_s - self._last_s < 2 * SILENCE_S:
            return False
        self._sent = [*self._sent, tick][-UNANSWERED:]
        self._last_s = now_s
        return True
