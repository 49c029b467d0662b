"""Teach the fake TurtleBot one way, and let it search: ``python -m tests.ros2.day --world yard --folder out``."""

# ruff: noqa: T201 - what it prints is what it is for

import argparse
import json
import signal
from collections import Counter
from pathlib import Path

from tests.command import run_smal
from tests.ros2.field import Robot, day_with


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--world", default="yard")
    parser.add_argument("--dialect", default="rmw_zenoh")
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--rate", type=int, default=15)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument(
        "--until-found", action="store_true", help="one search that finds it is enough"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--model", type=Path, help="of another drive, in place of one of this day")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument(
        "--clock-offset", type=float, default=0.0, help="seconds of the robot's clock ahead of ours"
    )
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    seen = {"size": (width, height), "rate": options.rate, "clock_offset": options.clock_offset}
    robot = Robot(options.folder, options.world, options.dialect, **seen)
    outcomes: Counter[str] = Counter()
    with day_with(robot) as (place, person):
        model = options.model or options.folder / "model.smal"
        if options.model is None:
            drive = person.demonstrate(options.seed, options.folder / "drives")
            print("drive:", drive.outcome, drive.ticks, "frames", flush=True)
            place.children["camera"].send_signal(signal.SIGSTOP)  # learning wants the processor
            learned = run_smal("learn", options.folder / "drives", "--out", model)
            print(learned.stdout[-300:], learned.stderr[-300:], flush=True)
            place.children["camera"].send_signal(signal.SIGCONT)
        person.load(model)
        for k in range(options.runs):
            record = person.run(options.seed + k, max_ticks=3000)
            outcomes[record.outcome] += 1
            told = {
                key: value
                for key, value in person.detail.items()
                if key.startswith(("camera", "refused", "robot"))
            }
            print(k, record.outcome, record.ticks, "frames", json.dumps(told), flush=True)
            if options.until_found and record.outcome == "found":
                break
    print(
        f"{options.world}, {options.dialect}: found {outcomes['found']} of {outcomes.total()}",
        dict(outcomes),
    )


if __name__ == "__main__":
    main()
