"""Publish the state of services and files on the board, for watchers."""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from schemas import topics
from schemas.action import Action
from schemas.camera import CompressedImage
from schemas.motion import Odometry, TrackedPose, TruePose
from schemas.rpc import LookReply, Nothing, PlanReply, Status
from schemas.state import State
from services.console.driven_route import DrivenRoute
from services.console.learned import Learned, learned_of
from services.console.library import Library
from services.console.newest_content import Board
from services.kit.bus import Bus, RpcError
from services.kit.health import ailment
from services.kit.jpeg import is_jpeg
from services.kit.node import Node, ServiceError
from services.kit.obstacle_memory import ObstacleMemory
from services.kit.root import below, name_below
from services.table import stack_services
from smal.files.container import ModelError
from smal.files.stored import Stored
from smal.model import Model

_LOOK_S: Final = 1.0  # Polling interval of services and files.
_ANSWER_S: Final = 1.0  # Timeout of a service's answer.
#: Details of services that the page uses.
_DETAILS: Final = (
    "world",
    "worlds",
    "variation",
    "variations",
    "speed_m_s",
    "turn_rate_rad_s",
    "frames_hz",
    "disk",
)
# Interval of images between episodes, when the robot publishes no frames.
_PEEK_S: Final = 1.0
_THINGS: Final = 200  # Maximum number of obstacle points on the map.


class Health:
    """Polls the status of services."""

    def __init__(self, bus: Bus, services: tuple[str, ...]) -> None:
        self.bus = bus
        self._services = services
        self._asked_s = time.monotonic()
        # The last answers; None after a timeout.
        self.statuses: dict[str, Status | None] = {}

    def ask(self) -> list[dict[str, object]]:
        """Poll all services at once; return a row for each service."""
        before = self.statuses
        # Short-lived threads: a service that hangs delays only its own thread, up to the timeout.
        with ThreadPoolExecutor(len(self._services), "health") as pool:
            self.statuses = dict(
                zip(self._services, pool.map(self._status, self._services), strict=True)
            )
        now = time.monotonic()
        elapsed_s = max(now - self._asked_s, 1e-3)
        self._asked_s = now
        return [
            _row(name, before.get(name), status, elapsed_s)
            for name, status in self.statuses.items()
        ]

    def detail(self, service: str, key: str) -> object:
        """Return a detail of a service's status; None if unknown."""
        status = self.statuses.get(service)
        return None if status is None else status.detail.get(key)

    @property
    def unattended(self) -> bool:
        """Whether the robot moves without an operator, as in simulation."""
        return self.detail("robot", "attended") is False

    def _status(self, service: str) -> Status | None:
        try:
            return self.bus.call(service, "status", Nothing(), Status, _ANSWER_S, patience_s=0.0)
        except RpcError:
            return None


class LiveContent:
    """Publishes messages (except ``action``), health, recordings and models on the board."""

    def __init__(self, node: Node, board: Board, library: Library) -> None:
        self._board = board
        self._library = library
        self.health = Health(
            node.bus, tuple(name for name in stack_services() if name != node.name)
        )
        self.learned: Learned | None = None  # The loaded model.
        self._followed: tuple[object, object] = (None, None)
        self._way = DrivenRoute()
        self._way_of = ""
        self._driven = DrivenRoute()  # By odometry, which every robot has.
        self._driven_of = ""
        # World, variation and task of the shown ground plan: a variation moves furniture.
        self._planned: tuple[object, ...] = ()
        self._obstacles = ObstacleMemory()
        self._seen_s = -math.inf  # Time of the last frame.
        node.subscribe(topics.JPEG, self._on_image, depth=1)
        node.subscribe(topics.DEPTH, self._obstacles.store_depth)
        node.subscribe(topics.ODOMETRY, self._on_odometry)
        node.subscribe(topics.STATE, self._on_state)
        node.subscribe(topics.POSE, self._on_pose)
        node.subscribe(topics.TRACKED, self._on_tracked)
        node.apart(_LOOK_S, self._look_at_services)
        node.apart(_LOOK_S, self._look_at_files)
        node.apart(_PEEK_S, self.peek)

    def _on_image(self, image: CompressedImage) -> None:
        if is_jpeg(image.data):
            self._seen_s = self._board.clock()
            # Before the image, since the page draws it over the image.
            self._look_around(image.episode)
            self._show(image.data)

    def _show(self, jpeg: bytes) -> None:
        self._board.show(jpeg)
        self._put("camera")

    def peek(self) -> None:
        """Show camera image and place of the robot between episodes, if there are watchers; blocks."""
        last_s = self._seen_s
        if not self._board.watchers or self._board.clock() - last_s < _PEEK_S:
            return
        with suppress(RpcError):
            seen = self.health.bus.call("robot", "look", Nothing(), LookReply)
            if last_s != self._seen_s:
                return
            if seen.pose is not None:
                self._put("stands", pose=_rounded(*seen.pose))
            if seen.picture is not None and is_jpeg(seen.picture):
                self._show(seen.picture)

    def _look_around(self, episode: str) -> None:
        """Show obstacles from the depth camera, if there are watchers."""
        around = self._obstacles.around(episode) if self._board.watchers else None
        if around is None or self._obstacles.mount is None or (seen := around.seen) is None:
            return
        columns = np.stack([seen.across, seen.hit_m, seen.top_m], axis=1)[
            seen.hit_m < around.reach_m
        ]
        self._put(
            "around",
            mounting=self._obstacles.mount._asdict(),
            # In the image: metres to the left at 1 m ahead, distance, height; and the spacing of
            # columns.
            columns=columns.round(3).tolist(),
            apart=round(float(seen.across[0] - seen.across[1]), 5),
            things=around.things(_THINGS)
            .round(2)
            .tolist(),  # Metres ahead of the robot and to its left.
        )

    def _on_state(self, state: State) -> None:
        belief = {} if self.learned is None else self.learned.belief(state)
        self._put(
            "belief",
            tick=state.tick,
            status=state.status,
            lost=round(state.lost, 3),
            cosine=round(state.cosine, 3),
            camera=state.camera,
            pitch=state.pitch_deg,
            seen=None if state.seen is None else round(state.seen, 3),
            left=state.seen_left,
            gap=state.duality_gap,
            state=state.state,
            places=[
                [key, round(weight, 3)]
                for key, weight in zip(
                    state.keyframes.tolist(), state.weights.tolist(), strict=True
                )
                if belief
            ],
            **belief,
        )

    def on_action(self, action: Action) -> None:
        """Show the robot's plan."""
        self._put("plan", tick=action.tick, kind=action.kind, atoms=action.atoms[:20])

    def _on_odometry(self, odometry: Odometry) -> None:
        self._obstacles.store_odometry(odometry)
        if odometry.episode != self._driven_of:
            self._driven = DrivenRoute()
            self._driven_of = odometry.episode
        if self._driven.add(odometry.x_m, odometry.y_m):
            metres = round(self._driven.metres, 1)
            self._board.put("driven", {"episode": odometry.episode, "metres": metres})

    def _on_pose(self, pose: TruePose) -> None:
        if pose.episode != self._way_of:
            self._way = DrivenRoute()
            self._way_of = pose.episode
        # Every tenth point: the page draws the rest from the robot's pose.
        if self._way.add(pose.x_m, pose.y_m) and len(self._way.points) % 10 == 1:
            self._board.put("way", {"episode": pose.episode, "points": self._way.points})
        self._put("pose", episode=pose.episode, pose=_rounded(*pose.pose))

    def _on_tracked(self, pose: TrackedPose) -> None:
        if pose.x_m is not None and pose.y_m is not None and pose.heading_rad is not None:
            self._put("tracked", pose=_rounded(pose.x_m, pose.y_m, pose.heading_rad))

    def _put(self, channel: str, **content: object) -> None:
        self._board.put(channel, content | {"at": round(self._board.clock(), 3)})

    def _look_at_services(self) -> None:
        services = self.health.ask()
        self._put("health", services=services, unattended=self.health.unattended)
        folder = self.health.detail("recorder", "folder")
        if folder is not None:
            self._library.folder = name_below(self._library.root, Path(str(folder)))
        self._look_at_world()

    def _look_at_world(self) -> None:
        """Show the ground plan of a simulated robot's world."""
        world = self.health.detail("robot", "world")
        here = (world, *(self.health.detail("robot", key) for key in ("variation", "task")))
        if here == self._planned or self.health.detail("robot", "worlds") is None:
            return
        with suppress(RpcError):
            plan = self.health.bus.call("robot", "plan", Nothing(), PlanReply)
            self._board.put("ground", plan.model_dump())
            self._planned = here

    def _look_at_files(self) -> None:
        self._board.put(
            "library", self._library.look(lambda shown: self._board.put("library", shown))
        )
        followed = {
            key: self.health.detail("recognition", key) for key in ("model", "checksum", "goal")
        }
        if followed["model"] is not None and self._followed != (
            followed["checksum"],
            followed["goal"],
        ):
            self._followed = (followed["checksum"], followed["goal"])
            self._follow_model(
                str(followed["model"]), None if followed["goal"] is None else str(followed["goal"])
            )

    def _follow_model(self, file: str, goal: str | None) -> None:
        name = name_below(self._library.root, self._library.root / file)
        try:
            if name is None:
                raise ServiceError(f"{file}: permission denied, outside the console's folder")
            recordings = {
                one.episode: self._library.path(one.name) for one in self._library.recordings()
            }
            model = Stored.load(below(self._library.root, name))
            if not isinstance(model, Model):
                raise ServiceError(
                    f"{name}: unsupported on the map (the paper's scheme has no poses)"
                )
            self.learned = learned = learned_of(model, goal, recordings)
            self._board.put("model", {"name": name} | learned.shown())
        except (ModelError, ServiceError, ValueError, OSError) as error:
            self._board.put("model", {"name": file, "trouble": str(error)})


def _rounded(*pose: float) -> list[float]:
    return [round(value, 3) for value in pose]


def _row(
    name: str, before: Status | None, status: Status | None, elapsed_s: float
) -> dict[str, object]:
    if status is None:
        return {"name": name, "ailment": "does not answer"}
    earlier = before.published if before is not None and before.pid == status.pid else {}
    rates = {
        topic: (count - earlier.get(topic, count)) / elapsed_s
        for topic, count in status.published.items()
    }
    return {
        "name": name,
        "ailment": ailment(status),
        "idle": round(status.idle_s, 1),
        "rates": {topic: round(rate, 1) for topic, rate in rates.items() if rate > 0},
        "dropped": sum(status.dropped.values()),
        "bad": sum(status.bad.values()),
        "failed": status.failed,
        "told": {
            key: status.detail[key]
            for key in _DETAILS
            if status.detail.get(key) not in (None, "", False)
        },
    }
