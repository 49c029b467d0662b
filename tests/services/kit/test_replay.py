"""Kept and live samples of a sender arrive in order, each once."""

import random
import threading

from hypothesis import given
from hypothesis import strategies as st

from services.kit.replay import Budget, Replay


class Bench:
    """A replay, the samples that it passed on, and the senders that it asked or gave up."""

    def __init__(self, most_bytes: int = 1000) -> None:
        self.passed: list[tuple[str, int]] = []
        self.asked: list[str] = []
        self.overdue: list[str] = []
        self.budget = Budget(most_bytes)
        self.replay: Replay[tuple[str, int]] = Replay(
            self.passed.append, self.asked.append, self.budget, self.overdue.append
        )

    def live(self, name: str, number: int, size: int = 1) -> None:
        self.replay.live(name, number, (name, number), size)

    def replayed(self, name: str, number: int) -> None:
        self.replay.replayed(name, number, (name, number))

    def ended_all(self, *names: str) -> None:
        for name in names:
            self.replay.ended(name)


@given(
    sent=st.lists(st.integers(1, 30), min_size=1, max_size=3),
    joined=st.integers(0, 30),
    rng=st.randoms(use_true_random=False),
)
def test_all_samples_come_in_order_and_once(
    sent: list[int], joined: int, rng: random.Random
) -> None:
    bench = Bench()
    for name, count in zip("abc", sent, strict=False):
        kept = [(bench.replayed, number) for number in range(count)] + [None]
        live = [(bench.live, number) for number in range(min(joined, count), count)]
        bench.replay.met(name)
        while streams := [stream for stream in (kept, live) if stream]:
            step = rng.choice(streams).pop(0)
            if step is None:
                bench.replay.ended(name)
            else:
                step[0](name, step[1])
    assert bench.passed == [
        (name, number) for name, count in zip("abc", sent, strict=False) for number in range(count)
    ]
    assert bench.asked == list("abc")[: len(sent)]


def test_silent_sender_delays_no_other() -> None:
    bench = Bench()
    bench.live("dead", 0)
    bench.live("a", 0)
    bench.replay.ended("a")
    assert bench.passed == [("a", 0)]
    bench.replay.ended("dead")
    assert bench.passed[-1] == ("dead", 0)


def test_waiting_samples_are_bounded_and_kept() -> None:
    bench = Bench(most_bytes=10)
    bench.live("a", 5, size=4)
    bench.live("b", 7, size=4)
    bench.live("a", 6, size=2)
    assert (bench.passed, bench.overdue) == ([], [])
    bench.live("b", 8, size=1)
    assert (bench.passed, bench.overdue) == ([("b", 7), ("b", 8)], ["b"])
    bench.replayed("b", 3)
    bench.ended_all("a", "b")
    assert bench.passed == [("b", 7), ("b", 8), ("a", 5), ("a", 6)], (
        "what was waited for is left out: order is kept"
    )
    assert bench.budget.take(10), "all room is given back"


def test_forgotten_sender_frees_its_room() -> None:
    bench = Bench(most_bytes=1000)
    for number in range(200):
        bench.live(f"sender-{number}", 0, size=1)
    assert len(bench.passed) == 200 - 64
    bench.ended_all(*(f"sender-{number}" for number in range(200)))
    assert len(bench.passed) == 200
    assert bench.budget.take(1000)


def test_samples_are_taken_by_one_thread_at_a_time() -> None:
    entered = threading.Event()
    proceed = threading.Event()
    done = []

    def take(number: int) -> None:
        if number == 0:
            entered.set()
            assert proceed.wait(100.0)
        done.append(number)

    def ask(name: str) -> None:
        replay.ended(name)

    replay: Replay[int] = Replay(take, ask, Budget(1000), print)
    threads = [
        threading.Thread(target=replay.live, args=("a", number, number, 1)) for number in (0, 1)
    ]
    threads[0].start()
    assert entered.wait(100.0)
    threads[1].start()
    threads[1].join(0.2)
    assert threads[1].is_alive(), "the second waits"
    assert done == []
    proceed.set()
    for thread in threads:
        thread.join()
    assert done == [0, 1]
