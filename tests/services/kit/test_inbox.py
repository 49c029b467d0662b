"""The queues of a node."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.kit.inbox import Inbox

NAMES = ("a", "b", "c")


def taken(inbox: Inbox, timeout_s: float = 0.0) -> tuple[str, object] | None:
    item = inbox.take(timeout_s)
    return None if item is None else (item.name, item.content)


Step = tuple[str, int] | None


@given(
    st.lists(st.none() | st.tuples(st.sampled_from(NAMES), st.integers(0, 12)), max_size=60),
    st.tuples(*[st.integers(1, 5) for _ in NAMES]),
    st.integers(0, 30),
)
def test_inbox_gives_the_oldest_and_counts_drops(
    steps: list[Step], depths: tuple[int, ...], most_bytes: int
) -> None:
    """Compare with one list in order of arrival. A step of None takes; a name and a size puts."""
    inbox = Inbox(most_bytes=most_bytes)
    depth = dict(zip(NAMES, depths, strict=True))
    for name in NAMES:
        inbox.open(name, depth[name])
    model: list[tuple[str, int, int]] = []
    dropped = dict.fromkeys(NAMES, 0)

    def held(name: str) -> int:
        return sum(size for n, _, size in model if n == name)

    def give_up(name: str) -> None:
        model.remove(next(entry for entry in model if entry[0] == name))
        dropped[name] += 1

    for number, step in enumerate(steps):
        if step is None:
            assert taken(inbox) == (model.pop(0)[:2] if model else None)
            continue
        name, size = step
        inbox.put(name, number, size)
        model.append((name, number, size))
        if sum(n == name for n, _, _ in model) > depth[name]:
            give_up(name)
        while sum(map(held, NAMES)) > most_bytes:
            give_up(max(NAMES, key=held))
        assert inbox.waiting() == {n: sum(entry[0] == n for entry in model) for n in NAMES}
    while model:
        assert taken(inbox) == model.pop(0)[:2]
    assert taken(inbox) is None
    assert {name: inbox.dropped[name] for name in NAMES} == dropped


def test_inbox_tells_how_long_items_wait() -> None:
    now_s = 0.0
    inbox = Inbox(lambda: now_s)
    inbox.open("a", 2)
    inbox.open("b", 1)
    assert inbox.oldest_s() == 0.0
    inbox.put("b", 0, 1)
    now_s = 1.0
    inbox.put("a", 1, 1)
    now_s = 3.5
    assert inbox.oldest_s() == 3.5
    first = inbox.take(0.0)
    second = inbox.take(0.0)
    assert (first.waited_s, second.waited_s) == (pytest.approx(3.5), pytest.approx(2.5))
    assert inbox.oldest_s() == 0.0
