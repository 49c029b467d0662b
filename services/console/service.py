"""The console on the bus: what is heard goes to the board, what a browser says to the operator."""

from __future__ import annotations

import math
import secrets
import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final

from schemas import topics
from schemas.action import Action
from schemas.base import Atom
from schemas.compressed_image import CompressedImage
from schemas.pose import Pose
from schemas.rpc import LoadReply, LoadRequest, Nothing, RecordRequest, ResetRequest, Status
from schemas.state import State
from schemas.tracked_pose import TrackedPose
from services.console.asks import LATE, Ask, Cancel, Delete, Drive, End, Learn, Resume, Run
from services.console.board import Board
from services.console.health import ASK_S, Health
from services.console.jobs import Job, Jobs
from services.console.learned import Learned, learned_of
from services.console.library import DRIVES, MODELS, WORLDS, LearnedModel, Library
from services.console.reports import BoardReports
from services.console.seat import LEASE_S, LET_GO_S
from services.kit.jpeg import is_jpeg
from services.kit.node import Detail, Node, ServiceError
from services.kit.root import below, name_below
from services.operator.hold import KeyHold
from services.operator.operator import BEAT_S, POLL_S, Operator
from services.table import stack_services
from smal.model import Model, ModelError

#: Reading a model takes as long.
LOAD_S: Final = 60.0
#: Frames after which a run times out: three times those of the longest taught drive, at least these; as `smal run`.
_PATIENCE, _MAX_TICKS = 3, 3000
#: Points of today's way; when there are more every second one is left out.
_POINTS: Final = 400
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
        self._operator = Operator(node, KeyHold(board.clock, LET_GO_S, LET_GO_S), self._reports)
        self.library = Library(root)
        self._health = Health(node.bus, tuple(name for name in stack_services() if name != node.name))
        self._jobs = Jobs(lambda job: board.put("job", job))
        #: The model that the robot goes by.
        self.learned: Learned | None = None
        self._followed: tuple[object, object] = (None, None)
        self._there_until_s = -math.inf
        self._way: list[tuple[float, float]] = []
        self._way_of = ""
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._wake = node.soon(self._work)
        self._closed = threading.Event()
        node.subscribe(topics.JPEG, self._on_image, depth=1)
        node.subscribe(topics.STATE, self._on_state)
        node.subscribe(topics.ACTION, self._on_action)
        node.subscribe(topics.POSE, self._on_pose)
        node.subscribe(topics.TRACKED, self._on_tracked)
        node.every(POLL_S, self._work)
        node.every(BEAT_S, self._bridge)
        node.detail = self._detail
        board.put("robot_id", node.robot)
        board.put("taken", content=False)
        self._rounds = [
            threading.Thread(target=self._repeat, args=(round_,), name=round_.__name__, daemon=True)
            for round_ in (self._look_at_services, self._look_at_files)
        ]

    def start(self) -> None:
        """Begin to look at services and files, now and then."""
        for thread in self._rounds:
            thread.start()

    def close(self) -> None:
        """Stop looking, and let go of the robot in good order."""
        self._closed.set()
        self._jobs.cancel()
        self._operator.release()
        for thread in self._rounds:
            if thread.is_alive():
                thread.join(2 * ASK_S)

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
            self._operator.beat()
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

    def make_world(self, name: str, osm_map: Path, needs: AbstractContextManager[object]) -> Future[None]:
        """Make a world of a map; ``needs`` is exited when the map has been read."""

        def take() -> None:
            robot = self._health.statuses.get("robot")
            known = "" if robot is None else str(robot.detail.get("worlds", ""))
            try:
                with ExitStack() as read:
                    read.enter_context(needs)
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
                        needs=read.pop_all(),
                    )
                self._jobs.begin(job)
            except (ServiceError, OSError) as error:
                self._reports.say(str(error))

        return self._do(take)

    def _bridge(self) -> None:
        """Have a robot that would move alone not miss a browser that stutters: what it held is let go all the same.

        A robot that moves only while its operator is there hears of none but their own answers.
        """
        robot = self._health.statuses.get("robot")
        if self.attended and robot is not None and robot.detail.get("attended") is False:
            self._operator.beat()

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
                )
                self._begin(request, self._record)
            case Run():
                self._run(ask)
            case Learn(name=name, recordings=names):
                self._learn(name, names)
            case Cancel():
                self._jobs.cancel()
            case Delete(recording=name):
                self._delete(name)

    # -- what is asked for ----------------------------------------------------------------------------------------

    def _begin(self, request: ResetRequest, prepare: Callable[[], None]) -> None:
        """Begin an episode when that is prepared, which may take seconds, and nobody has left meanwhile."""
        self._operator.begin(request, prepare, lambda: self.attended)

    def _record(self) -> None:
        """Have the recorder record, unless it does."""
        bus = self._node.bus
        if bus.call("recorder", "status", Nothing(), Status).detail.get("folder") is None:
            bus.call("recorder", "start", RecordRequest(folder=DRIVES), Nothing)

    def _run(self, ask: Run) -> None:
        model = self.library.model(ask.model)
        if model is None or model.useless:
            raise ServiceError(f"{ask.model}: {'no such model' if model is None else model.useless}")
        goal = ask.goal if ask.scheme == "filter" else None
        if ask.scheme == "filter" and not model.goals:
            raise ServiceError(f"{ask.model} has no map of views; choose the paper's scheme")
        if goal is not None and goal not in model.goals:
            raise ServiceError(f"{ask.model} has no goal {goal}; it has {', '.join(model.goals)}")
        load = LoadRequest(model=model.name, scheme=ask.scheme, goal=goal)
        request = ResetRequest(
            world=ask.world,
            variation=ask.variation,
            seed=ask.seed,
            purpose="run",
            driver="policy",
            mode="realtime",
            start=ask.start,
            goal=goal or model.nearest,
            max_ticks=max(_MAX_TICKS, _PATIENCE * model.longest),
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

    def _learn(self, name: str, names: tuple[str, ...]) -> None:
        chosen = [self.library.recording(one) for one in names]
        recordings = [one for one in chosen if one is not None and not one.useless]
        if len(recordings) != len(names):
            raise ServiceError("a recording that was chosen is gone, or teaches nothing; choose again")
        out = below(self.library.root, f"{MODELS}/{name}.smal")
        # Who chooses a run of the robot's own wants it to teach.
        runs = any(one.purpose == "run" for one in recordings)
        paths = (str(self.library.path(one.name)) for one in recordings)
        flags = ("--progress", *(["--include-runs"] if runs else []))
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

    def _on_image(self, image: CompressedImage) -> None:
        if is_jpeg(image.data):
            self._board.show(image.data)
            self._put("camera", tick=image.tick, width=image.width, height=image.height)

    def _on_state(self, state: State) -> None:
        learned = self.learned
        belief = {} if learned is None else learned.belief(state)
        self._put(
            "belief",
            tick=state.tick,
            status=state.status,
            lost=round(state.lost, 3),
            cosine=round(state.cosine, 3),
            gap=state.duality_gap,
            state=state.state,
            places=[[place.keyframe, round(place.weight, 3)] for place in state.places] if belief else [],
            **belief,
        )

    def _on_action(self, action: Action) -> None:
        self._put("plan", tick=action.tick, kind=action.kind, atoms=action.atoms[:20], arrived=action.arrived)
        operator = self._operator
        began = operator.request is not None and operator.request.driver == "policy"
        if action.arrived and began and action.episode == operator.mine and not operator.asking:
            operator.end_mine()

    def _on_pose(self, pose: Pose) -> None:
        self._go(pose.episode, "truth", (pose.x_m, pose.y_m, pose.heading_rad))

    def _on_tracked(self, pose: TrackedPose) -> None:
        if pose.x_m is not None and pose.y_m is not None and pose.heading_rad is not None:
            self._put("tracked", pose=_rounded((pose.x_m, pose.y_m, pose.heading_rad)))

    def _go(self, episode: str, by: str, pose: tuple[float, float, float]) -> None:
        """Take note of where the robot is, and of the way that it has come in this episode."""
        if episode != self._way_of:
            self._way, self._way_of = [], episode
        here = (round(pose[0], 2), round(pose[1], 2))
        if not self._way or math.dist(here, self._way[-1]) >= 0.1:
            self._way.append(here)
            if len(self._way) > _POINTS:
                del self._way[1:-1:2]
            # Every tenth point, since the page draws the rest itself from where the robot is.
            if len(self._way) % 10 == 1:
                self._board.put("way", {"episode": episode, "points": self._way})
        self._put("pose", episode=episode, by=by, pose=_rounded(pose))

    def _put(self, channel: str, **content: object) -> None:
        self._board.put(channel, content | {"at": round(self._board.clock(), 3)})

    # -- now and then, on threads of their own --------------------------------------------------------------------

    def _repeat(self, look: Callable[[], None]) -> None:
        while not self._closed.is_set():
            try:
                look()
            except Exception:
                self._node.log.warning("%s", look.__name__.strip("_").replace("_", " "), exc_info=True)
            self._closed.wait(ASK_S)

    def _look_at_services(self) -> None:
        self._put("health", services=self._health.ask())
        recorder = self._health.statuses.get("recorder")
        folder = recorder.detail.get("folder") if recorder is not None else None
        if folder is not None:
            self.library.record_in(Path(str(folder)))

    def _look_at_files(self) -> None:
        self._board.put("library", self.library.look())
        recognition = self._health.statuses.get("recognition")
        if recognition is not None:
            told = recognition.detail
            self._follow_model(told.get("model"), told.get("checksum"), told.get("goal"))

    def _follow_model(self, file: object, identity: object, goal: object) -> None:
        """Look at the model that recognition works with, where that is another one now."""
        if file is None or self._followed == (identity, goal):
            return
        self._followed = (identity, goal)
        name = name_below(self.library.root, self.library.root / str(file))
        try:
            if name is None:
                raise ServiceError(f"{file} lies outside of the console's root, and is not drawn")
            recordings = {one.episode: self.library.path(one.name) for one in self.library.recordings() if one.episode}
            model = Model.load(below(self.library.root, name))
            self.learned = learned = learned_of(model, None if goal is None else str(goal), recordings)
            self._board.put("model", {"name": name} | learned.shown())
        except (ModelError, ServiceError, ValueError, OSError) as error:
            self._board.put("model", {"name": str(file), "trouble": str(error)})

    def _detail(self) -> Detail:
        return {"watchers": self._board.watchers, "root": str(self.library.root)}


def _rounded(pose: tuple[float, float, float]) -> list[float]:
    return [round(value, 3) for value in pose]
