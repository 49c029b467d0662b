"""Work in a child process that misbehaves as libraries do with hostile files."""

import os
import time
from typing import Any

from smal.files.confined import ConfinedError, Work


def loop(_request: object, _work: Work) -> None:
    """Compute for ever."""
    while True:
        pass


def loop_in_a_step(request: Any, work: Work) -> None:
    """Compute for ever in a step of its own."""
    work.step("an image", request)
    loop(request, work)


def go_on(request: Any, work: Work) -> float:
    """Take some processor time, and report progress at each twentieth of a second; return all time."""
    while time.process_time() < request:
        until_s = time.process_time() + 0.05
        while time.process_time() < until_s:
            pass
        work.tell(time.process_time())
    return time.process_time()


def fill(_request: object, _work: Work) -> None:
    """Take all memory."""
    kept = []
    while True:
        kept.append(bytearray(2**24))


def crash(_request: object, _work: Work) -> None:
    """End as a library does that writes where it must not."""
    os.kill(os.getpid(), 11)


def refuse(request: Any, _work: Work) -> None:
    """Refuse."""
    raise ConfinedError(f"{request}: is of no use")


def sleep(_request: object, work: Work) -> None:
    """Report this process, and wait for ever."""
    work.tell(os.getpid())
    time.sleep(3600)


def echo(request: Any, _work: Work) -> Any:
    """Return the request; the output of a library is no reply."""
    os.write(1, b"a library prints\n")
    return request
