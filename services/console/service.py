"""The console on the bus: what a browser says goes to the operator, or to whom it is for."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final

from schemas import topics
from schemas.action import Action
from schemas.base import Atom
from schemas.rpc import MAX_TICKS, LoadReply, LoadRequest, Nothing, RecordRequest, ResetReply, ResetRequest, Status
from services.console.browser_messages import LATE, Ask, Cancel, Delete, Drive, End, Learn, Resume, Run, Withdraw
from services.console.folder import Folder
from services.console.jobs import Job, Jobs
from services.console.learned import Learned
from services.console.library import DRIVES, MODELS, LearnedModel, Library
from services.console.newest_content import Board
from services.console.page_content import Feed
from services.console.reports import BoardReports
from services.console.who_drives import LEASE_S, LET_GO_S
from services.kit.node import Detail, Node, ServiceError
from services.kit.root import WORLDS, below
from services.operator.hold import KeyHold
from services.operator.operator import POLL_S, Operator

#: Reading a model takes as long.
LOAD_S: Final = 60.0
#: Frames after which a run times out: three times those of the longest taught drive, at least these; as `smal run`.
_PATIENCE, _MAX_TICKS = 3, 3000
#: The services that work with the model.
_CHAIN: Final = ("recognition", "policy")


class ConsoleService:
    """Wires an operator and a board to a node.

    ``hold``, ``let_go``, ``leave``, ``stop`` and ``ask`` may be called on any thread; it is done on the node's, which
    ends the future that they return.

    Parameters
    ----------
    node
        Where to listen and publish.
    board
        Where everything is shown.
    root
        Folder of the files that browsers may name, without links in its path.
    """

    def __init__(self, node: Node, board: Board, root: Path) -> None:
        self._node = node
        self._board = board
        self._reports = BoardReports(board)
        keys = KeyHold(board.clock, LET_GO_S, LET_GO_S)
        self._operator = Operator(node, keys, self._reports, board.clock, self._bridges)
        self.library = Library(root)
        self.feed = Feed(node, board, self.library)
        self._jobs = Jobs(lambda job: board.put("job", job))
        self._there_until_s = -math.inf
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._wake = node.soon(self._work)
        node.subscribe(topics.ACTION, self._on_action)
        node.every(POLL_S, self._work)
        node.detail = self._detail
        board.put("robot_id", node.robot)
        board.put("taken", content=False)

    def close(self) -> None:
        """End what is being made, and let go of the robot in good order."""
        self._jobs.cancel()
        self._operator.release()
        self.feed.close()

    @property
    def learned(self) -> Learned | None:
        """The model that the robot goes by."""
        return self.feed.learned

    @property
    def attended(self) -> bool:
        """Whether somebody drives, and has answered a moment ago."""
        return self._board.clock() < self._there_until_s

    # -- what browsers say ----------------------------------------------------------------------------------------

    def hold(self, atom: Atom | None, sent_s: float) -> Future[None]:
        """Take a sign of life of whoever drives, and what they hold, as of a time of the board's clock.

        They count as there for longer than what they hold does: by a slow link one cannot drive, and can watch.
        """
        until_s = sent_s + LET_GO_S

        def take() -> None:
            self._there_until_s = sent_s + LEASE_S
            if self._board.clock() >= until_s:
                return
            self._operator.beat(sent_s)
            if atom is None:
                self._operator.release()
            else:
                self._operator.press(atom, until_s)

        return self._do(take)

    def let_go(self) -> Future[None]:
        """Take note that whoever drives is gone: the robot misses them, and stands."""

        def take() -> None:
            self._there_until_s = -math.inf
            self._operator.release()

        return self._do(take)

    def leave(self) -> Future[None]:
        """Take note that whoever drives stands up, and is not to be missed."""

        def take() -> None:
            self._there_until_s = -math.inf
            self._operator.release()
            self._operator.beat(present=False)

        return self._do(take)

    def stop(self) -> Future[None]:
        """Stop for an emergency."""

        def take() -> None:
            if not self._operator.commands.emergency:
                self._reports.say("EMERGENCY STOP, until the robot is armed")
            self._operator.stop_for_emergency()

        return self._do(take)

    def ask(self, ask: Ask, until_s: float) -> Future[None]:
        """Do what whoever drives asks for, until a time of the board's clock; what comes of it is told in the news."""

        def take() -> None:
            try:
                if self._board.clock() >= until_s:
                    raise ServiceError(LATE)
                self._answer(ask)
            except (ServiceError, OSError) as error:
                self._reports.say(str(error))

        return self._do(take)

    def make_world(self, name: str, osm_map: Path, folder: Folder) -> Future[None]:
        """Make a world of a map; its folder is closed when the map has been read."""

        def take() -> None:
            robot = self.feed.health.statuses.get("robot")
            known = "" if robot is None else str(robot.detail.get("worlds", ""))
            try:
                with ExitStack() as read:
                    read.enter_context(closing(folder))
                    if name in known.split(", "):
                        # Of two worlds of one name the robot opens the project's, or the one that it was started in.
                        raise ServiceError(f"there is a world {name} already; give the file another name")
                    job = Job(
                        "world",
                        name,
                        doing=f"Making a world of {name}",
                        done=f"{name} is a world now: begin a drive in it.",
                        arguments=("world", "import", str(osm_map)),
                        out=below(self.library.root, f"{WORLDS}/{name}.json"),
                        hidden=f"{osm_map.parent}/",
                        needs=folder,
                    )
                    read.pop_all()
                self._jobs.begin(job)
            except (ServiceError, OSError) as error:
                self._reports.say(str(error))

        return self._do(take)

    def _bridges(self) -> bool:
        """Whether the robot, which would move alone, is not to miss a browser that stutters; what it held is let go.

        A robot that moves only while its operator is there hears of none but their own answers, as of their own time.
        """
        robot = self.feed.health.statuses.get("robot")
        return self.attended and robot is not None and robot.detail.get("attended") is False

    def _do(self, what: Callable[[], None]) -> Future[None]:
        done: Future[None] = Future()

        def work() -> None:
            try:
                what()
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
        self._reports.emergency(pressed=self._operator.commands.emergency)

    def _answer(self, ask: Ask) -> None:
        match ask:
            case Resume():
                self._operator.resume()
            case End(found=found):
                self._operator.end(found=found)
            case Drive():
                request = ResetRequest(
                    name=ask.name,
                    world=ask.world,
                    variation=ask.variation,
                    seed=secrets.randbelow(2**31),
                    purpose="drive",
                    goal=ask.goal,
                    driver="teleop",
                    mode="realtime",
                    max_ticks=None,
                )
                self._begin(request, self._record)
            case Run():
                self._run(ask)
            case Withdraw():
                self._operator.withdraw()
            case Learn():
                self._learn(ask)
            case Cancel():
                self._jobs.cancel()
            case Delete(recording=name):
                self._delete(name)

    # -- what is asked for ----------------------------------------------------------------------------------------

    def _begin(self, request: ResetRequest, prepare: Callable[[], None]) -> None:
        """Begin an episode when that is prepared, which may take seconds, and nobody has left meanwhile."""
        self._operator.begin(request, prepare, lambda: self.attended, self._show_goal)

    def _show_goal(self, begun: ResetReply) -> None:
        """Show where the way leads, which only a simulator knows."""
        goal = [round(metres, 2) for metres in begun.route[-1]] if begun.route else None
        self._board.put("goal", {"episode": begun.episode, "at": goal})

    def _record(self) -> None:
        """Have the recorder record, unless it does."""
        bus = self._node.bus
        if bus.call("recorder", "status", Nothing(), Status).detail.get("folder") is None:
            bus.call("recorder", "start", RecordRequest(folder=DRIVES), Nothing)

    def _run(self, ask: Run) -> None:
        model = self.library.model(ask.model)
        if model is None or model.useless:
            raise ServiceError(f"{ask.model}: {'no such model' if model is None else model.useless}")
        goal = ask.goal if model.goals else None
        if goal is not None and goal not in model.goals:
            raise ServiceError(f"{ask.model} has no goal {goal}; it has {', '.join(model.goals)}")
        load = LoadRequest(model=model.name, goal=goal)
        request = ResetRequest(
            world=ask.world,
            variation=ask.variation,
            seed=ask.seed,
            purpose="run",
            driver="policy",
            mode="realtime",
            start=ask.start,
            goal=goal or self.library.leads_to(model),
            max_ticks=min(max(_MAX_TICKS, _PATIENCE * model.longest), MAX_TICKS),
        )

        def prepare() -> None:
            self._load(model, load)
            self._record()  # a person may correct it by hand, which teaches

        self._begin(request, prepare)

    def _load(self, model: LearnedModel, load: LoadRequest) -> None:
        """Have recognition and policy work with a model; on a thread that asks."""
        bus = self._node.bus
        made = bus.call("features", "status", Nothing(), Status).detail
        if made.get("fingerprint") != model.fingerprint:
            raise ServiceError(
                f"{model.name} was learned on other features than the stack makes ({made.get('modalities')}); "
                "learn it again, or start the stack with others (smal up --modalities)"
            )
        for service in _CHAIN:
            bus.call(service, "load", load, LoadReply, LOAD_S)

    def _learn(self, ask: Learn) -> None:
        name, names = ask.name, ask.recordings
        chosen = [self.library.recording(one) for one in names]
        recordings = [one for one in chosen if one is not None and not one.useless]
        if len(recordings) != len(names):
            raise ServiceError("a recording that was chosen is gone, or teaches nothing; choose again")
        out = below(self.library.root, f"{MODELS}/{name}.smal")
        # Who chooses a run of the robot's own wants it to teach.
        runs = any(one.purpose == "run" for one in recordings)
        paths = (str(self.library.path(one.name)) for one in recordings)
        flags = ("--scheme", ask.scheme, "--progress", *(["--include-runs"] if runs else []))
        job = Job(
            "model",
            name,
            doing=f"Learning {name}",
            done=f"{name} is learned: run it.",
            arguments=("learn", *paths, *flags),
            out=out,
            hidden=f"{self.library.root}/",
        )
        self._jobs.begin(job)

    def _delete(self, name: str) -> None:
        recording = self.library.recording(name)
        if recording is None:
            raise ServiceError("no such recording")
        self.library.delete(recording.name)
        self._reports.say(f"{recording.name} is deleted")

    # -- what is heard --------------------------------------------------------------------------------------------

    def _on_action(self, action: Action) -> None:
        self.feed.on_action(action)
        operator = self._operator
        began = operator.request is not None and operator.request.driver == "policy"
        if action.arrived and began and action.episode == operator.mine and not operator.asking:
            operator.end_mine()

    def _detail(self) -> Detail:
        return {"watchers": self._board.watchers, "root": str(self.library.root)}
