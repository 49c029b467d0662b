"""The queues of a node."""

from __future__ import annotations

import threading
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.kit.inbox import Inbox

NAMES = ("a", "b", "c")


def taken(inbox: Inbox, timeout_s: float = 0.0) -> tuple[str, object] | None:
    item = inbox.take(timeout_s)
    return None if item is None else (item.name, item.content)


@given(st.lists(st.sampled_from([*NAMES, None]), max_size=60), st.tuples(*[st.integers(1, 5) for _ in NAMES]))
def test_inbox_gives_the_oldest_and_counts_what_gave_way(steps: list[str | None], depths: tuple[int, ...]) -> None:
    """Compare with one list that holds everything in order of arrival; None takes, a name puts."""
    inbox = Inbox()
    depth = dict(zip(NAMES, depths, strict=True))
    for name in NAMES:
        inbox.open(name, depth[name])
    model: deque[tuple[str, int]] = deque()
    dropped = dict.fromkeys(NAMES, 0)
    for number, name in enumerate(steps):
        if name is None:
            assert taken(inbox) == (model.popleft() if model else None)
            continue
        inbox.put(name, number)
        model.append((name, number))
        mine = [entry for entry in model if entry[0] == name]
        if len(mine) > depth[name]:
            model.remove(mine[0])
            dropped[name] += 1
        assert inbox.waiting() == {n: sum(entry[0] == n for entry in model) for n in NAMES}
    while model:
        assert taken(inbox) == model.popleft()
    assert taken(inbox) is None
    assert {name: inbox.dropped[name] for name in NAMES} == dropped


def test_inbox_wakes_a_reader_from_another_thread() -> None:
    inbox = Inbox()
    inbox.open("queue", 1)
    writer = threading.Timer(0.02, inbox.put, ("queue", "item"))
    writer.start()
    assert taken(inbox, timeout_s=5.0) == ("queue", "item")
    writer.join()


def test_inbox_tells_how_long_items_wait() -> None:
    now_s = 0.0
    inbox = Inbox(lambda: now_s)
    inbox.open("a", 2)
    inbox.open("b", 1)
    assert inbox.oldest_s() == 0.0
    inbox.put("b", 0)
    now_s = 1.0
    inbox.put("a", 1)
    now_s = 3.5
    assert inbox.oldest_s() == 3.5
    first, second = inbox.take(0.0), inbox.take(0.0)
    assert first is not None
    assert second is not None
    assert (first.waited_s, second.waited_s) == (pytest.approx(3.5), pytest.approx(2.5))
    assert inbox.oldest_s() == 0.0
