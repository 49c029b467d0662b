"""``smal topic hz`` and ``bw``: the figures, and the commands as an operator runs them."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.command import Command
from schemas.image import Image
from services.cli.listening import commands as listening_commands
from services.cli.listening.bandwidth import Sizes, bandwidth_lines, human, total
from services.cli.listening.rates import Rate, rate_lines
from services.kit.bus import Bus
from services.kit.tables import table
from tests.schemas.messages import EXAMPLES
from tests.services.cli.conftest import Listen, Smal
from tests.services.waiting import eventually

KEY = "smal/rescuebot/command/teleop"


@given(st.lists(st.floats(0.001, 10), min_size=1, max_size=30), st.integers(0, 10_000))
def test_rates(intervals_s: list[float], size: int) -> None:
    times_s = [100.0]
    for interval_s in intervals_s:
        times_s.append(times_s[-1] + interval_s)
    rate = Rate()
    for time_s in times_s:
        rate.add(size, time_s)
    gaps = [later - earlier for earlier, later in pairwise(times_s)]
    assert rate.mean_s == pytest.approx(sum(gaps) / len(gaps))
    assert rate.rate_hz == pytest.approx(len(gaps) / sum(gaps))
    assert rate.bytes_per_s == pytest.approx(size * len(gaps) / sum(gaps))
    assert (rate.min_s, rate.max_s) == (min(gaps), max(gaps))
    assert rate.std_s == pytest.approx(statistics.pstdev(gaps), abs=1e-9)


def test_rates_of_too_few_samples_are_unknown_not_zero() -> None:
    rate = Rate()
    rate.add(10, 1.0)
    assert rate.record() == {
        "messages": 1, "rate_hz": None, "bytes_per_s": None,
        "mean_s": None, "min_s": None, "max_s": None, "std_s": None,
    }  # fmt: skip
    rate.add(10, 1.0)
    assert rate.rate_hz is None, "two at the same instant"
    assert list(rate_lines({"key": rate}))[1].split() == ["key", "2", "-", "0.00", "0.00", "0.00", "0.00"]


@given(st.dictionaries(st.sampled_from("abc"), st.lists(st.integers(0, 10**7), max_size=20)), st.floats(0.1, 100))
def test_sizes(payloads: dict[str, list[int]], elapsed_s: float) -> None:
    keyed: dict[str, Sizes] = {}
    for key, sizes in payloads.items():
        keyed[key] = Sizes()
        for size in sizes:
            keyed[key].add(size)
    every = [size for sizes in payloads.values() for size in sizes]
    assert total(keyed).record(elapsed_s) == {
        "messages": len(every),
        "bytes": sum(every),
        "bytes_per_s": sum(every) / elapsed_s,
        "mean_bytes": sum(every) / len(every) if every else None,
        "min_bytes": min(every, default=None),
        "max_bytes": max(every, default=None),
    }
    parts = [one.record(elapsed_s)["bytes_per_s"] for one in keyed.values()]
    assert sum(parts) == pytest.approx(sum(every) / elapsed_s), "the keys add up to the total"
    assert len(list(bandwidth_lines(keyed, elapsed_s))) == len(keyed) + 2


def test_the_table_of_bandwidths() -> None:
    image, stranger = Sizes(), Sizes()
    image.add(2_359_296)
    image.add(2_359_296)
    stranger.add(7)
    assert [line.split("  ") for line in table_of({"smal/r/camera/rgb": image, "a\x1b[2J": stranger}, 2.0)] == [
        ["key", "messages", "bandwidth", "mean", "min", "max"],
        ["a?[2J", "1", "3.5 B/s", "7 B", "7 B", "7 B"],
        ["smal/r/camera/rgb", "2", "2.4 MB/s", "2.4 MB", "2.4 MB", "2.4 MB"],
        ["total", "3", "2.4 MB/s", "1.6 MB", "7 B", "2.4 MB"],
    ]


def table_of(sizes: dict[str, Sizes], elapsed_s: float) -> list[str]:
    """Return the table with two spaces between its cells."""
    lines = bandwidth_lines(sizes, elapsed_s)
    return ["  ".join(cell.strip() for cell in line.split("  ") if cell.strip()) for line in lines]


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (None, "-"), (0, "0 B"), (3.456, "3.5 B"), (812, "812 B"), (999.6, "1.0 kB"), (33_123, "33.1 kB"),
        (123_456, "123 kB"), (24_100_000, "24.1 MB"), (1e9, "1.0 GB"), (5e12, "5000.0 GB"),
    ],
)  # fmt: skip
def test_sizes_for_people(size: float | None, text: str) -> None:
    assert human(size) == text


def test_a_table_is_aligned() -> None:
    rows = [["key", "of", "n"], ["a", "b", "100"]]
    assert list(table(rows)) == ["key  of    n", "a     b  100"]
    assert list(table(rows, left=3)) == ["key  of  n", "a    b   100"]


@pytest.mark.zenoh
def test_hz_measures_each_key_until_ctrl_c(listen: Listen) -> None:
    listening = listen("hz", "--json", "--seconds", "60")
    assert listening.process.stderr is not None
    assert listening.process.stderr.readline() == "listening to smal/rescuebot/** for 60 s\n"
    # The subscription was there before that line was printed, but the router passes it on in the background: it knows
    # the later listener's only after this one's.
    listen("echo", "--count", "20").lines_until(20, EXAMPLES[Command], EXAMPLES[Image])
    status, out, err = listening.end()
    rates = json.loads(out)
    assert (status, err) == (0, "")
    assert rates[KEY]["messages"] >= 2
    assert rates[KEY]["rate_hz"] > 0
    assert rates[KEY]["std_s"] >= 0


@pytest.fixture
def talking(client: Bus, router_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the time of listening be over when several messages must have been heard."""
    witness = Bus("rescuebot", router_endpoint)

    def wait(_what: str, _seconds: float) -> None:
        heard: list[str] = []
        witness.listen("smal/**", lambda key, *_: heard.append(key))

        def enough() -> bool:
            client.publish(EXAMPLES[Command])
            client.publish(EXAMPLES[Image])
            return len(heard) >= 20

        eventually(enough)

    monkeypatch.setattr(listening_commands, "wait", wait)
    yield
    witness.close()


@pytest.mark.usefixtures("talking")
def test_bw_measures_each_key_and_the_total(smal: Smal, router_endpoint: str) -> None:
    status, out, _ = smal("topic", "bw", "--json", "--router", router_endpoint)
    found = json.loads(out)
    assert status == 0
    assert set(found["keys"]) == {KEY, "smal/rescuebot/camera/rgb"}
    assert found["keys"][KEY]["mean_bytes"] == found["keys"][KEY]["min_bytes"] == found["keys"][KEY]["max_bytes"]
    assert found["total"]["bytes"] == sum(one["bytes"] for one in found["keys"].values())
    assert found["total"]["bytes_per_s"] == found["total"]["bytes"] / found["seconds"]


@pytest.mark.usefixtures("talking")
@pytest.mark.parametrize(("command", "last"), [("bw", ["total"]), ("hz", [])])
def test_tables(smal: Smal, router_endpoint: str, command: str, last: list[str]) -> None:
    status, out, _ = smal("topic", command, "--router", router_endpoint)
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()] == ["key", "smal/rescuebot/camera/rgb", KEY, *last]


@pytest.mark.parametrize("command", ["hz", "bw"])
def test_silence(smal: Smal, router_endpoint: str, command: str) -> None:
    code, out, err = smal("topic", command, "pose/truth", "--seconds", "0.1", "--router", router_endpoint)
    assert (code, out) == (0, "")
    assert err.endswith("smal: nothing was published on smal/rescuebot/pose/truth\n")


def test_silence_as_json(smal: Smal, router_endpoint: str) -> None:
    options = ("--seconds", "0.1", "--json", "--router", router_endpoint)
    assert json.loads(smal("topic", "hz", *options)[1]) == {}
    found = json.loads(smal("topic", "bw", *options)[1])
    assert (found["keys"], found["total"]["bytes_per_s"], found["total"]["mean_bytes"]) == ({}, 0.0, None)
