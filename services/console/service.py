"""The console on the bus: what a browser says goes to the operator, or to whom it is for."""

import math
import secrets
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Final

from schemas import topics
from schemas.action import Action
from schemas.base import Velocity
from schemas.codec import printable
from schemas.rpc import (
    LoadReply,
    LoadRequest,
    Nothing,
    RecordRequest,
    ResetReply,
    ResetRequest,
    Status,
)
from services.console.browser_messages import (
    LATE,
    Add,
    Ask,
    Delete,
    DriveRequest,
    End,
    LearnRequest,
    Press,
    Run,
)
from services.console.jobs import BackgroundJob, Jobs
from services.console.library import DRIVES, MODELS, LearnedModel, Library
from services.console.live_content import LiveContent
from services.console.newest_content import Board
from services.console.who_drives import LEASE_S, LET_GO_S
from services.kit.model_service import most_ticks
from services.kit.node import Node, ServiceError
from services.kit.root import WORLDS, below
from services.operator.operator import POLL_S, Operator
from services.table import CHAIN

LOAD_S: Final = 60.0  # Reading a model takes as long.
_LINES: Final = 30  # Lines of news that the page keeps.


class ConsoleService:
    """Wires an operator and a board to a node.

    All that a person does is done on the node's thread: other threads call it by ``do``. Browsers may name files below
    ``root``, which has no links in its path.
    """

    def __init__(self, node: Node, board: Board, root: Path) -> None:
        self._node = node
        self._board = board
        self._news: deque[dict[str, object]] = deque(maxlen=_LINES)
        self._said = 0
        show = lambda report: board.put("robot", asdict(report))  # noqa: E731
        self._operator = Operator(node, self._say, show, board.clock, self._bridges)
        self.library = Library(root)
        self.live = LiveContent(node, board, self.library)
        self._jobs = Jobs(lambda job: board.put("job", job))
        self._there_until_s = -math.inf
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._wake = node.soon(self._work)
        node.subscribe(topics.ACTION, self._on_action)
        node.every(POLL_S, self._work)
        node.detail = lambda: {"watchers": board.watchers, "root": str(root)}
        board.put("robot", asdict(self._operator.report))
        board.put("robot_id", node.robot)
        board.put("taken", content=False)

    def close(self) -> None:
        """End what is being made, and let go of the robot in good order."""
        self._jobs.cancel()
        self._operator.hold(None)
        self.library.close()

    @property
    def attended(self) -> bool:
        """Whether somebody drives, and has answered a moment ago."""
        return self._board.clock() < self._there_until_s

    def do(self, what: Callable[..., None], *arguments: object) -> Future[None]:
        """Have something done on the node's thread; the future ends when it is. What is wrong with it is told."""
        done: Future[None] = Future()

        def work() -> None:
            try:
                what(*arguments)
            except (ServiceError, OSError) as error:
                self._say(str(error))
            finally:
                with suppress(InvalidStateError):  # nobody waits for it any more
                    done.set_result(None)

        self._asked.put(work)
        self._wake()
        return done

    def _work(self) -> None:
        with suppress(Empty):
            while True:
                self._asked.get_nowait()()
        self._operator.poll()

    def _say(self, text: str) -> None:
        self._said += 1
        self._news.append(
            {"number": self._said, "at": round(self._board.clock(), 3), "text": printable(text)}
        )
        self._board.put("news", list(self._news))

    def hold(self, held: tuple[float, float] | None, sent_s: float) -> None:
        """Take a sign of life of whoever drives, and what they hold, as of a time of the board's clock."""
        self._there_until_s = sent_s + LEASE_S  # One may watch by a link that is too slow to drive.
        if self._board.clock() >= sent_s + LET_GO_S:
            return
        self._operator.beat(sent_s)
        self._operator.hold(None if held is None else Velocity(*held), sent_s + LET_GO_S)

    def let_go(self) -> None:
        """Take note that whoever drives is gone: the robot misses them, and stands."""
        self._there_until_s = -math.inf
        self._operator.hold(None)

    def leave(self) -> None:
        """Take note that whoever drives stands up, and is not to be missed."""
        self.let_go()
        self._operator.beat(present=False)

    def stop(self) -> None:
        """Stop for an emergency."""
        self._operator.stop_for_emergency()

    def ask(self, ask: Ask, until_s: float) -> None:
        """Do what whoever drives asks for, until a time of the board's clock."""
        if self._board.clock() >= until_s:
            raise ServiceError(LATE)
        match ask:
            case Press(do="resume"):
                self._operator.resume()
            case Press(do="withdraw"):
                self._operator.withdraw()
            case Press(do="cancel"):
                self._jobs.cancel()
            case End():
                self._operator.end(found=ask.found, box=ask.box)
            case DriveRequest():
                self._drive(ask)
            case Run():
                self._run(ask)
            case LearnRequest() | Add():
                self._learn(ask)
            case Delete():
                self.library.delete(ask.recording)
                self._say(f"{ask.recording} is deleted")

    def make_world(self, name: str, osm_map: IO[bytes]) -> None:
        """Make a world of a map."""
        if name in str(self.live.health.detail("robot", "worlds")).split(", "):
            # Of two worlds of one name the robot opens the project's, or the one that it was started in.
            raise ServiceError(f"there is a world {name} already; give the file another name")
        path = f"/proc/self/fd/{osm_map.fileno()}"
        job = BackgroundJob(
            "world",
            name,
            doing=f"Making a world of {name}",
            done=f"{name} is a world now: begin a drive in it.",
            arguments=("world", "import", path),
            out=below(self.library.root, f"{WORLDS}/{name}.json"),
            hidden=path,
            called=f"{name}.osm",
            reads=osm_map,
        )
        self._jobs.begin(job)

    def _drive(self, ask: DriveRequest) -> None:
        seed = secrets.randbelow(2**31)
        goal = ask.goal
        request = ResetRequest(
            name=ask.name, seed=seed, purpose="drive", goal=goal, driver="teleop", max_ticks=None
        )
        self._begin(ask, request, self._record)

    def _run(self, ask: Run) -> None:
        model = self.library.model(ask.model)
        goal = ask.goal if model.goals else None
        if goal is not None and goal not in model.goals:
            raise ServiceError(f"{ask.model} has no goal {goal}; it has {', '.join(model.goals)}")
        request = ResetRequest(
            seed=ask.seed,
            purpose="run",
            driver="policy",
            start=ask.start,
            goal=goal or self.library.leads_to(model),
            max_ticks=most_ticks(model.longest),
            victim=ask.victim,
            until_said=bool(model.goals),
        )

        def prepare() -> None:
            self._load(model, goal)
            self._record()  # a person may correct it by hand, which teaches

        self._begin(ask, request, prepare)

    def _begin(
        self, ask: DriveRequest | Run, request: ResetRequest, prepare: Callable[[], None]
    ) -> None:
        """Begin an episode when that is prepared, which may take seconds, and nobody has left meanwhile."""

        def show_goal(begun: ResetReply) -> None:  # Where the victim lies only a simulator knows.
            goal = None if begun.victim is None else [round(metres, 2) for metres in begun.victim]
            self._board.put("goal", {"episode": begun.episode, "at": goal})

        there = {"world": ask.world, "variation": ask.variation, "mode": "realtime"}
        self._operator.begin(
            request.model_copy(update=there), prepare, lambda: self.attended, show_goal
        )

    def _record(self) -> None:
        """Have the recorder record, unless it does; on a thread that asks."""
        bus = self._node.bus
        if bus.call("recorder", "status", Nothing(), Status).detail.get("folder") is None:
            bus.call("recorder", "start", RecordRequest(folder=DRIVES), Nothing)

    def _load(self, model: LearnedModel, goal: str | None) -> None:
        """Have recognition and policy work with a model; on a thread that asks."""
        bus = self._node.bus
        made = bus.call("features", "status", Nothing(), Status).detail
        if made.get("fingerprint") != model.fingerprint:
            raise ServiceError(
                f"{model.name} was learned on other features than the stack makes ({made.get('modalities')}); "
                "learn it again, or start the stack with others (smal up --modalities)"
            )
        for service in CHAIN:
            bus.call(service, "load", LoadRequest(model=model.name, goal=goal), LoadReply, LOAD_S)

    def _learn(self, ask: LearnRequest | Add) -> None:
        recordings = [
            one
            for name in ask.recordings
            if (one := self.library.recording(name)) and not one.useless
        ]
        if len(recordings) != len(ask.recordings):
            raise ServiceError(
                "a recording that was chosen is gone, or teaches nothing; choose again"
            )
        if isinstance(ask, Add):
            model = self.library.model(ask.model)
            name = Path(model.name).stem
            out = self.library.path(model.name)
            command: tuple[str, ...] = ("learn", "--add")
            doing = f"Learning more for {name}"
            done = f"{name} has looked at these runs."
        else:
            name = ask.name
            out = below(self.library.root, f"{MODELS}/{ask.name}.smal")
            doing = f"Learning {name}"
            done = f"{name} is learned: run it."
            # Whoever chooses a run of the robot's own wants it to teach.
            runs = ("--include-runs",) if any(one.purpose == "run" for one in recordings) else ()
            command = ("paper", "learn", *runs) if ask.scheme == "paper" else ("learn", *runs)
        paths = (str(self.library.path(one.name)) for one in recordings)
        job = BackgroundJob(
            "model",
            name,
            doing=doing,
            done=done,
            arguments=(*command, *paths, "--progress"),
            out=out,
            hidden=f"{self.library.root}/",
            renews=isinstance(ask, Add),
        )
        self._jobs.begin(job)

    def _bridges(self) -> bool:
        """Whether the robot, which would move alone, is not to miss a browser that stutters; what it held is let go."""
        # One that moves only while its operator is there hears of none but their own answers, as of their own time.
        return self.attended and self.live.health.detail("robot", "attended") is False

    def _on_action(self, action: Action) -> None:
        self.live.on_action(action)
        operator = self._operator
        began = operator.request is not None and operator.request.driver == "policy"
        if action.says and began and action.episode == operator.mine and not operator.asking:
            operator.end_mine(action.says)
