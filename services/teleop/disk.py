"""What the recorder says of the room on its disk, for whoever drives."""

from __future__ import annotations

import threading
from typing import Final

from schemas.rpc import Nothing, Status
from services.kit.node import Node
from services.operator.operator import ANSWER_S

#: How often the recorder is asked.
ASK_S: Final = 5.0


class DiskNews:
    """Asks the recorder, in a thread of its own: what moves the robot must not wait for its answer.

    Parameters
    ----------
    node
        To ask on.

    Attributes
    ----------
    text
        What it said last; None where there is room enough, or no recorder.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._asking = threading.Lock()
        self.text: str | None = None

    def ask(self) -> None:
        """Ask, unless the last answer is still waited for."""
        if self._asking.acquire(blocking=False):
            threading.Thread(target=self._ask, name="disk", daemon=True).start()

    def _ask(self) -> None:
        text: object = None
        try:
            text = self._node.bus.call("recorder", "status", Nothing(), Status, ANSWER_S).detail.get("disk")
        except Exception:  # noqa: BLE001 - whatever it is, the recorder does not tell
            text = None
        finally:
            self.text = None if text is None else str(text)
            self._asking.release()
