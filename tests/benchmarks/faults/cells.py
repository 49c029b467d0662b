"""The matrix: every fault, what it may cost, and the stack that it needs."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

from schemas.topics import KEPT_S
from services.table import stack_services
from tests.benchmarks.faults import harm
from tests.benchmarks.faults.floods import flooded
from tests.benchmarks.faults.judge import Window
from tests.benchmarks.faults.rig import Rig

#: plain: everything talks to the router; linked: some services by links that can go down; clock: with libfaketime;
#: rolling: linked, and the robot's base is a process of its own that moves on in real time; flooded: the robot notes
#: when it stood for a stop; guarded: as well, behind certificates.
Bench = Literal["plain", "linked", "clock", "rolling", "flooded", "guarded"]
LINKED: Final = ("robot", "policy", "recorder")
#: From the death of a service to the next frame that the loop answers.
_RESTARTED_S: Final = 15.0
#: From the return of the router, of a frozen process or of a link to the next frame that the loop answers.
_RECOVERED_S: Final = 1.0
_FREEZES_S: Final = (1.0, 3.0, 14.0)
_OUTAGE_S: Final = 20.0
_FULL_S: Final = 5.0
_SLOW_S: Final = 15.0
_HOUR_S: Final = 3600
_CONTROL_S: Final = 5.0
#: Without a new command, of what must not disturb the robot: it stands after half a second.
_UNDISTURBED_S: Final = 1.0


@dataclass(frozen=True)
class Limits:
    """What a cell may cost at most; None is not judged.

    Parameters
    ----------
    still_s : float
        The robot moves so long after the last valid command, and after a fault that has to make it stand.
    recovery_s : float, optional
        Until the loop works again.
    lost_ticks : int, optional
        Frames of which a message is not recorded.
    pause_s : float, optional
        Without a new command: for what must not disturb the robot at all.
    rate_hz : float, optional
        At least, of camera, pose, observation, state and commands at the observer, during the fault.
    """

    still_s: float = 0.5
    recovery_s: float | None = _RECOVERED_S
    lost_ticks: int | None = 0
    pause_s: float | None = None
    rate_hz: float | None = None


@dataclass(frozen=True)
class Cell:
    """One fault.

    Parameters
    ----------
    name : str
    harm : callable
        Does it to a rig whose robot drives, and returns when it lasted.
    limits : Limits
    bench : str
    watched : str, optional
        A service that must be another process, and ready, after the fault.
    drives_on : bool
        Whether episodes go on meanwhile.
    stands : bool
        Whether the robot has to stand in the meantime, since whoever commands or moves it is gone for longer.
    abandoned : bool
        Whether the robot has to stand in the meantime, and may stand already when the fault begins.
    next_episode : bool
        Whether the next episode's recording is judged, in place of this one's, of which only what is there must be
        readable.
    """

    name: str
    harm: Callable[[Rig], Window]
    limits: Limits = field(default_factory=Limits)
    bench: Bench = "plain"
    watched: str | None = None
    drives_on: bool = False
    stands: bool = False
    abandoned: bool = False
    next_episode: bool = False


def _controls() -> list[Cell]:
    """Return what the rest is compared with: on a machine that is busy with other things these are not met either."""
    harmless = partial(harm.nothing, seconds=_CONTROL_S)
    limits = Limits(pause_s=_UNDISTURBED_S)
    return [
        Cell("no fault", harmless, limits, drives_on=True),
        Cell("no fault, libfaketime", harmless, limits, bench="clock", drives_on=True),
    ]


def _harmed() -> list[str]:
    """Return whom single faults harm and a run needs; the console is none of them."""
    return [service for service in stack_services() if service != "console"]


def _kills() -> list[Cell]:
    # What a killed process had not handed over is gone with it: of its own messages those of one frame, and as much of
    # the recorder's.
    limits = Limits(recovery_s=_RESTARTED_S, lost_ticks=1)
    return [
        Cell(f"kill -9 {service}", partial(harm.kill, service=service), limits, watched=service)
        for service in _harmed()
        if service != "router"
    ]


def _freezes() -> list[Cell]:
    return [_freeze(service, seconds) for service in _harmed() for seconds in _FREEZES_S]


def _freeze(service: str, seconds: float) -> Cell:
    return Cell(f"freeze {service} {seconds:.0f} s", partial(harm.freeze, service=service, seconds=seconds))


def _outages() -> list[Cell]:
    kill = partial(harm.restart_router, number=signal.SIGKILL)
    return [
        Cell("kill -9 router", kill, watched="router"),
        Cell("restart router", partial(harm.restart_router, number=signal.SIGTERM), watched="router"),
        Cell("router down 20 s", partial(kill, seconds=_OUTAGE_S), watched="router"),
    ]


def _links() -> list[Cell]:
    cells = [
        Cell(
            f"link of {service} down 20 s", partial(harm.link_down, service=service, seconds=_OUTAGE_S), bench="linked"
        )
        for service in LINKED
    ]
    # Longer than anything is kept: what is lost must stand in the recording.
    longer_s = KEPT_S + 15.0
    longer = partial(harm.link_down, service="recorder", seconds=longer_s)
    name = f"link of recorder down {longer_s:.0f} s"
    return [*cells, Cell(name, longer, Limits(lost_ticks=None), bench="linked")]


def _rolling() -> list[Cell]:
    """Return the faults of whatever is between the camera and the wheels, for a base that moves on by itself."""
    chain = ("router", "robot", "features", "recognition", "policy")
    # Features are there again before the robot has to stand.
    gone = ("robot", "recognition", "policy")
    kills = [replace(cell, stands=cell.watched in gone) for cell in (*_kills(), _outages()[0])]
    freezes = [replace(_freeze(service, s), stands=True) for service in chain for s in _FREEZES_S]
    links = [replace(cell, stands=True) for cell in _links() if cell.name.split()[2] in ("robot", "policy")]
    operators = [
        Cell(name, partial(harm.abandon, slow=slow), drives_on=True, abandoned=True)
        for name, slow in (("kill -9 operator", False), ("kill -9 operator, link grown slow", True))
    ]
    cells = (*kills, *freezes, *links, *operators)
    return [replace(cell, name=f"{cell.name}, moving base", bench="rolling") for cell in cells]


def _others() -> list[Cell]:
    undisturbed = Limits(pause_s=_UNDISTURBED_S)
    # Between two episodes there is no command for a moment.
    slow = replace(undisturbed, pause_s=2 * _UNDISTURBED_S, rate_hz=9.0)
    kill, freeze = partial(harm.kill, service="console"), partial(harm.freeze, service="console", seconds=3.0)
    return [
        Cell("kill -9 console", kill, undisturbed, watched="console", drives_on=True),
        Cell("freeze console 3 s", freeze, undisturbed, drives_on=True),
        Cell("full disk", partial(harm.fill_disk, seconds=_FULL_S), undisturbed, next_episode=True),
        Cell("slow consumer", partial(harm.consume_slowly, seconds=_SLOW_S), slow, drives_on=True),
        Cell("clock +1 h", partial(harm.jump, offset_s=_HOUR_S), undisturbed, bench="clock", drives_on=True),
        Cell("clock -1 h", partial(harm.jump, offset_s=-_HOUR_S), undisturbed, bench="clock", drives_on=True),
    ]


def _floods() -> list[Cell]:
    return [
        Cell("floods", flooded, bench="flooded"),
        Cell("floods with certificates", flooded, bench="guarded"),
    ]


MATRIX: Final = (*_controls(), *_kills(), *_freezes(), *_outages(), *_links(), *_rolling(), *_others(), *_floods())
#: The short version: what tells most in a minute.
QUICK: Final = (
    "no fault",
    "kill -9 policy",
    "kill -9 recorder",
    "freeze recognition 3 s",
    "restart router",
    "full disk",
)
