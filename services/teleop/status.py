"""The status line: who drives, what the robot does, and how the episode goes."""

from typing import Final

from schemas.base import Atom
from schemas.command import StopCause
from services.operator.operator import SILENCE_S
from services.operator.report import Report

_CAUSES: Final[dict[StopCause | None, str]] = {
    None: "armed",
    "not_armed": "not armed",
    "emergency_stop": "emergency stop",
    "operator_lost": "it had lost you; r resumes",
    "fault": "its body has failed",
}


def status_line(robot: Report, held: Atom | None, now_s: float) -> str:
    """Return what a person at a terminal is told of the robot, with the key that they hold."""
    if robot.waiting:
        episode = "waiting for the robot; a simulator's first picture takes a while"
    elif robot.episode is None:
        episode = f"ended: {robot.outcome}; n: next episode" if robot.outcome else "no episode; n: begin one"
    else:
        episode = "a person drives" if robot.driver == "teleop" else f"{robot.driver or 'somebody'} drives"
    parts = ["EMERGENCY STOP"] if robot.emergency else []
    return "  |  ".join([*parts, *_robot(robot, now_s), f"you: {held or '-'}", episode])


def _robot(robot: Report, now_s: float) -> list[str]:
    if robot.episode is None:
        return [f"robot: {_CAUSES[robot.cause] if robot.answers else '-'}"]
    if now_s - robot.at > SILENCE_S:
        return [f"NO SIGN OF THE ROBOT for {now_s - robot.at:.0f} s"]
    reasons = {
        "command": "by hand" if robot.source == "teleop" else f"by {robot.source}",
        "obstacle": "something is in the way, or not known to be free",
        "silence": "nobody drives",
        "taken_over": "you have taken over; r resumes",
        "emergency_stop": _CAUSES[robot.cause],
    }
    doing = f"{robot.atom or '-'} ({reasons.get(robot.reason or '', '-')})"
    return [f"frame {robot.tick}", f"robot: {doing}", f"refused {robot.refused}"]
