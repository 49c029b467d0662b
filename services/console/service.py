"""Connection of the console to the bus: requests of browsers go to the operator and services."""

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
from schemas.episode import in_words
from schemas.rpc import (
    CarryRequest,
    LoadReply,
    LoadRequest,
    Nothing,
    RecordRequest,
    ResetReply,
    ResetRequest,
    Status,
    TaskRequest,
)
from services.console.browser_messages import (
    LATE,
    Add,
    Ask,
    Carry,
    ChooseTask,
    Delete,
    DriveRequest,
    End,
    LearnRequest,
    Press,
    Rename,
    Run,
)
from services.console.jobs import BackgroundJob, Jobs
from services.console.library import DRIVES, MODELS, LearnedModel, Library
from services.console.live_content import LiveContent
from services.console.newest_content import Board
from services.console.who_drives import LEASE_S, LET_GO_S
from services.kit.bus import PATIENCE_S
from services.kit.model_service import most_ticks
from services.kit.node import Node, ServiceError
from services.kit.root import WORLDS, below
from services.operator.operator import POLL_S, Operator, Report
from services.table import CHAIN

LOAD_S: Final = 60.0  # Timeout of loading a model.
_LINES: Final = 30  # News lines that the page keeps.


class ConsoleService:
    """Connects an operator and a board to a node.

    Requests run on the node's thread: other threads call ``do``. Browsers can name files below
    ``root``, whose path contains no links.
    """

    def __init__(self, node: Node, board: Board, root: Path) -> None:
        self._node = node
        self._board = board
        self._news: deque[dict[str, object]] = deque(maxlen=_LINES)
        self._news_count = 0
        self._operator = Operator(node, self._say, self._show, board.clock, self._bridges)
        self.library = Library(root)
        self.live = LiveContent(node, board, self.library)
        self._jobs = Jobs(lambda job: board.put("job", job))
        self._there_until_s = -math.inf
        self._holds = False  # Whether the driver holds a key.
        self._resuming = False  # Whether the held key has resumed a run.
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._wake = node.soon(self._work)
        node.subscribe(topics.ACTION, self._on_action)
        node.every(POLL_S, self._work)
        node.detail = lambda: {"watchers": board.watchers, "root": str(root)}
        self._show(self._operator.report)
        board.put("robot_id", node.robot)
        board.put("taken", content=False)

    def close(self) -> None:
        """Cancel the running job and release the robot."""
        self._jobs.cancel()
        self._operator.hold(None)
        self.library.close()

    @property
    def attended(self) -> bool:
        """Whether a driver has answered recently."""
        return self._board.clock() < self._there_until_s

    def do(self, what: Callable[..., None], *arguments: object) -> Future[None]:
        """Run a function on the node's thread; errors become news, and the future ends after it."""
        done: Future[None] = Future()

        def work() -> None:
            try:
                what(*arguments)
            except (ServiceError, OSError) as error:
                self._say(str(error))
            finally:
                with suppress(InvalidStateError):  # The caller has gone.
                    done.set_result(None)

        self._asked.put(work)
        self._wake()
        return done

    def _work(self) -> None:
        with suppress(Empty):
            while True:
                self._asked.get_nowait()()
        self._operator.poll()

    def _show(self, report: Report) -> None:
        """Show the robot, with the outcome in words."""
        result = in_words(report.outcome, report.right) if report.outcome else None
        self._board.put("robot", asdict(report) | {"result": result})

    def _say(self, text: str) -> None:
        self._news_count += 1
        self._news.append(
            {
                "number": self._news_count,
                "at": round(self._board.clock(), 3),
                "text": printable(text),
            }
        )
        self._board.put("news", list(self._news))

    def hold(self, held: tuple[float, float] | None, sent_s: float) -> None:
        """Handle a driver's answer with the held velocity, sent at a time of the board's clock."""
        # A link that is too slow to drive is enough to watch.
        self._there_until_s = sent_s + LEASE_S
        if self._board.clock() >= sent_s + LET_GO_S:
            return
        self._operator.beat(sent_s)
        pressed = held is not None and not self._holds
        self._holds = held is not None
        if pressed and self._resumes_by_key():
            self._operator.resume()
            # In a run this press resumes only; the next one corrects the robot.
            self._resuming = self._operator.report.driver == "policy"
        self._resuming = self._resuming and self._holds
        velocity = None if held is None or self._resuming else Velocity(*held)
        self._operator.hold(velocity, sent_s + LET_GO_S)

    def _resumes_by_key(self) -> bool:
        """Whether a new key press resumes: a busy computer misses its operator without any danger."""
        report = self._operator.report
        lost = self.live.health.unattended and report.cause == "operator_lost"
        return lost and not self._operator.asking

    def let_go(self) -> None:
        """Handle the loss of the driver: the robot misses them, and stops."""
        self._there_until_s = -math.inf
        self._holds = False
        self._operator.hold(None)

    def leave(self) -> None:
        """Handle the departure of the driver, whom the robot does not miss."""
        self.let_go()
        self._operator.beat(present=False)

    def stop(self) -> None:
        """Trigger the emergency stop."""
        self._operator.stop_for_emergency()

    def ask(self, ask: Ask, until_s: float) -> None:
        """Execute a request of the driver, valid until a time of the board's clock."""
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
            case Carry():
                pose = CarryRequest(x_m=ask.x_m, y_m=ask.y_m, heading_rad=ask.heading_rad)
                self._operator.place(pose, self.live.peek)
            case ChooseTask():
                self._operator.place(TaskRequest(start=ask.start, goal=ask.goal), self.live.peek)
            case LearnRequest() | Add():
                self._learn(ask)
            case Delete():
                self.library.delete(ask.file)
                self._say(f"{ask.file} deleted")
            case Rename():
                self.library.rename(ask.file, ask.name)
                self._say(f"{ask.file} is called {ask.name} now")

    def make_world(self, name: str, upload: IO[bytes]) -> None:
        """Start the conversion of a map or a scan to a world."""
        if name in str(self.live.health.detail("robot", "worlds")).split(", "):
            # Included worlds and the world of the start take precedence over an equal name.
            raise ServiceError(f"world {name} already exists; rename the file")
        path = f"/proc/self/fd/{upload.fileno()}"
        job = BackgroundJob(
            "world",
            name,
            doing=f"Converting {name} to a world",
            done=f"{name} is a world now: begin a drive in it.",
            arguments=("world", "import", path),
            out=below(self.library.root, f"{WORLDS}/{name}.json"),
            hidden=path,
            called=name,
            reads=upload,
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
            raise ServiceError(
                f"goal {goal} not found in {ask.model}; choose from {', '.join(model.goals)}"
            )
        request = ResetRequest(
            seed=ask.seed,
            purpose="run",
            driver="policy",
            start=ask.start,
            goal=goal or self.library.leads_to(model),
            max_ticks=most_ticks(model.longest),
            victim=ask.victim,
            obstacles=ask.obstacles,
            people=ask.people,
            kidnap_tick=ask.kidnap_tick,
            until_said=bool(model.goals),
        )

        def prepare() -> None:
            self._load(model, goal)
            self._record()  # A person can correct the run by hand, which teaches.

        self._begin(ask, request, prepare)

    def _begin(
        self, ask: DriveRequest | Run, request: ResetRequest, prepare: Callable[[], None]
    ) -> None:
        """Begin an episode after its preparation, if the driver is still present."""

        def show_goal(begun: ResetReply) -> None:  # Only simulators have the victim's position.
            goal = None if begun.victim is None else [round(metres, 2) for metres in begun.victim]
            boxes = {"boxes": begun.things}
            self._board.put("goal", {"episode": begun.episode, "at": goal} | boxes)

        if not self._jobs.running:
            self._board.put("job", None)  # An old failure must not stand over the next outcome.
        place = {"world": ask.world, "variation": ask.variation, "mode": "realtime"}
        self._operator.begin(
            request.model_copy(update=place), prepare, lambda: self.attended, show_goal
        )

    def _record(self) -> None:
        """Start the recorder unless it records; blocks."""
        bus = self._node.bus
        status = bus.call("recorder", "status", Nothing(), Status, patience_s=PATIENCE_S)
        if status.detail.get("folder") is None:
            bus.call("recorder", "start", RecordRequest(folder=DRIVES), Nothing)

    def _load(self, model: LearnedModel, goal: str | None) -> None:
        """Load a model into recognition and policy; blocks."""
        bus = self._node.bus
        features = bus.call("features", "status", Nothing(), Status).detail
        if features.get("fingerprint") != model.fingerprint:
            raise ServiceError(
                f"{model.name}: learned on other features than the stack's "
                f"({features.get('modalities')}); learn it again, or change the stack's features "
                "(smal up --modalities)"
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
            raise ServiceError("a selected recording is gone or cannot teach; choose again")
        if isinstance(ask, Add):
            model = self.library.model(ask.model)
            name = Path(model.name).stem
            out = self.library.path(model.name)
            command: tuple[str, ...] = ("learn", "--add")
            doing = f"Learning more for {name}"
            done = f"{name} has learned from these runs."
        else:
            name = ask.name
            out = below(self.library.root, f"{MODELS}/{ask.name}.smal")
            doing = f"Learning {name}"
            done = f"{name} is learned: run it."
            # A selected run of the robot's own is intended for learning.
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
        """Whether the console answers for a slow browser, since the robot can move unattended."""
        # An attended robot needs the operator's own answers, with their own times.
        return self.attended and self.live.health.unattended

    def _on_action(self, action: Action) -> None:
        self.live.on_action(action)
        operator = self._operator
        began = operator.request is not None and operator.request.driver == "policy"
        if action.says and began and action.episode == operator.mine and not operator.asking:
            operator.end_mine(action.says)
