"""Shared parts of the services with a learned model: settings, loading and the main function."""

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Annotated, Final, Protocol, Self, TypeVar, cast
from weakref import WeakValueDictionary

from pydantic import Field

from schemas.base import NO_EPISODE, Message
from schemas.codec import printable
from schemas.episode import GoalName
from schemas.rpc import MAX_TICKS, LoadReply, LoadRequest, Scheme
from schemas.snapshot import Snapshot
from schemas.state import State
from schemas.topics import Topic
from services.kit.node import SNAPSHOT_S, Detail, Node, ServiceError
from services.kit.root import RootSettings, open_below
from services.kit.settings import FleetSettings
from smal.files.container import ModelError, NoModelError, open_regular
from smal.files.stored import Stored
from smal.model import Model
from smal.paper.model import PaperModel

# Hex digits of a checksum that identify a model.
_DIGITS: Final = 16
Wheels = tuple[float, float, float]  # A pose by odometry: metres, metres and radians.
#: Timeout of a run in frames: a minimum, and a multiple of the longest taught drive.
LEAST_TICKS = 3000
PATIENCE = 3
_log = logging.getLogger("models")
AnyModel = Model | PaperModel
_MODELS: Final[WeakValueDictionary[tuple[int, ...], AnyModel]] = WeakValueDictionary()
_READING: Final = threading.Lock()
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class ModelSettings(RootSettings, FleetSettings):
    """The model at the start, at any path; the queryable ``load`` loads another one below the root."""

    model: Path | None = None
    """Model file, made by `smal learn`."""
    scheme: Scheme | None = None
    """Scheme that the model must have been learned for, `filter` or `paper`; any by default."""
    stride: Annotated[int | None, Field(ge=1, le=1000)] = None
    """Frames between two decisions in the paper's scheme; the model's sequence length by default.
    """
    goal: GoalName | None = None
    """Goal of the run, in a model with several goals."""


def most_ticks(longest: int) -> int:
    """Return the timeout of a run in frames, for the length of the longest taught drive."""
    return min(max(LEAST_TICKS, PATIENCE * longest), MAX_TICKS)


def identity_of(model: AnyModel) -> str:
    """Return the name of a model in messages and health: the beginning of its checksum."""
    return model.checksum[:_DIGITS]


def refused(
    model: AnyModel, scheme: Scheme | None, stride: int | None, goal: str | None
) -> str | None:
    """Return in one line why a model does not support scheme, stride or goal, or None."""
    if scheme not in (None, model.scheme):
        command = "smal paper learn" if scheme == "paper" else "smal learn"
        return (
            f"scheme {model.scheme!r} of the model is not {scheme!r}; learn again with `{command}`"
        )
    if isinstance(model, Model):
        if stride not in (None, 1):
            return (
                f"stride {stride}: the filter decides at every frame; "
                "for a stride use `smal paper learn`"
            )
        try:
            model.mapped.chosen_goal(goal)
        except ValueError as error:
            return str(error)
    elif goal is not None:
        return f"goal {goal!r}: the paper's scheme always goes to the nearest goal"
    elif stride is not None and stride > model.sequence_length:
        return f"stride must be 1 to the sequence length {model.sequence_length}, got {stride}"
    return None


def load_model(path: Path) -> AnyModel:
    """Read the model at a path; ModelError as in `Stored.read`."""
    try:
        descriptor = open_regular(path)
    except OSError as error:
        raise NoModelError(f"{path}: cannot be read: {error.strerror}") from error
    with os.fdopen(descriptor, "rb") as file:
        return _read(file, str(path))


def _read(file: IO[bytes], name: str) -> AnyModel:
    """Read an open file once: all robots of a process share one model.

    A file with the same size and times counts as the same. If a file is rewritten, the loaded model
    keeps the old content (`smal.files.held`).
    """
    with _READING:
        stat = os.fstat(file.fileno())
        identity = stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns
        if (model := _MODELS.get(identity)) is None:
            # The two schemes are the only ones.
            model = _MODELS[identity] = cast("AnyModel", Stored.read(file, name))
        return model


@dataclass(frozen=True)
class LoadedModel:
    """Model that a service works with."""

    model: AnyModel
    name: str  # Its file: the path in the settings, or the name in a call.
    stride: int  # Frames between two decisions; 1 except in the paper's scheme.
    goal: str | None  # Goal of the run; None for the only goal.
    # Call that loaded it; None for the model of the settings.
    asked: LoadRequest | None = None

    @property
    def identity(self) -> str:
        """See ``identity_of``."""
        return identity_of(self.model)

    @classmethod
    def of(
        cls,
        model: AnyModel,
        name: str,
        scheme: Scheme | None = None,
        stride: int | None = None,
        goal: str | None = None,
    ) -> Self:
        """Check a model for its use; ServiceError if it is unsuitable."""
        if (refusal := refused(model, scheme, stride, goal)) is not None:
            raise ServiceError(f"{name}: {refusal}")
        return cls(
            model, name, 1 if isinstance(model, Model) else stride or model.sequence_length, goal
        )

    @classmethod
    def read(
        cls,
        path: Path,
        scheme: Scheme | None = None,
        stride: int | None = None,
        goal: str | None = None,
    ) -> Self:
        """Read the model of the settings; ServiceError if it is unsuitable."""
        try:
            return cls.of(load_model(path), str(path), scheme, stride, goal)
        except ModelError as error:
            raise ServiceError(str(error)) from None

    @classmethod
    def named(cls, request: LoadRequest, root: Path) -> Self:
        """Read the model that a call names; ServiceError, without other files, if unsuitable."""
        try:
            with open_below(root, request.model) as file:
                model = _read(file, request.model)
        except (OSError, NoModelError) as error:
            _log.warning("model %r: %s", request.model, error)
            raise ServiceError(
                f"model {printable(request.model)!r} not found below the root of this service"
            ) from None
        except ModelError as error:
            raise ServiceError(str(error)) from None
        return replace(
            cls.of(model, request.model, request.scheme, request.stride, request.goal),
            asked=request,
        )

    def reply(self) -> LoadReply:
        """Return the reply to the call that loaded it."""
        return LoadReply(scheme=self.model.scheme, stride=self.stride, **self._size())

    def detail(self) -> Detail:
        """Return the model's part of the service's status."""
        known: Detail = {
            "model": self.name,
            "checksum": self.identity,
            "scheme": self.model.scheme,
            "goal": self.goal,
        }
        return {**known, **self._size()}

    def _size(self) -> dict[str, int]:
        if isinstance(self.model, Model):
            return {"keyframes": len(self.model.mapped.keyframes)}
        return {"states": self.model.states}


class ModelService(Protocol[M_contra]):
    """Service that ``serve_model`` runs."""

    def load(self, loaded: LoadedModel) -> LoadReply:
        """Work with another model from now on."""

    def handle(self, message: M_contra, /) -> Message | list[Message] | None:
        """Answer a message."""

    def detail(self) -> Detail:
        """Return the service's part of the status."""

    def hands_on(self) -> tuple[State, Wheels | None] | None:
        """Return the last state and the odometry of its frame, for the next instance, or None."""

    def resume(self, state: State, wheels: Wheels | None) -> None:
        """Continue from the state of another instance with the same model."""

    @property
    def loaded(self) -> LoadedModel | None:
        """The model in use."""


def serve_loads(
    node: Node, service: ModelService[M_contra], root: Path, then: Callable[[], None] = lambda: None
) -> None:
    """Load models below a root by calls; a refused model leaves the current model in use."""

    def load(request: LoadRequest) -> LoadReply:
        reply = service.load(LoadedModel.named(request, root))
        then()
        return reply

    node.serve("load", LoadRequest, load)
    node.detail = lambda: {"root": str(root)} | service.detail()


def serve_model(
    node: Node, settings: ModelSettings, service: ModelService[M_contra], topic: Topic
) -> None:
    """Load the model of the settings or the previous instance, and handle a topic."""
    inherited = node.inherited
    if inherited is not None and inherited.model is not None:
        try:
            service.load(LoadedModel.named(inherited.model, settings.root))
        except ServiceError as error:
            node.log.error("cannot load the previous model of %s: %s", node.robot, error)  # noqa: TRY400 - one line
    elif settings.model is not None:
        service.load(
            LoadedModel.read(settings.model, settings.scheme, settings.stride, settings.goal)
        )
    if inherited is not None and inherited.state is not None and service.loaded is not None:
        if inherited.checksum == inherited.state.model == service.loaded.identity:
            service.resume(inherited.state, inherited.wheels)
        else:
            node.log.warning(
                "the snapshot of %s belongs to model %s", node.robot, inherited.checksum
            )

    def publish_snapshot() -> None:
        node.publish(_snapshot(node, service))

    # At once, so that the next instance uses a model that was confirmed as loaded.
    serve_loads(node, service, settings.root, publish_snapshot)
    node.subscribe(topic, service.handle)
    node.every(SNAPSHOT_S, publish_snapshot)
    name = None if service.loaded is None else service.loaded.name
    node.log.info("model %s", name or f"not loaded yet; waiting for rpc/{node.name}/load")
    node.spin()
    publish_snapshot()


def _snapshot(node: Node, service: ModelService[M_contra]) -> Snapshot | None:
    """Return the snapshot for the next instance; None without a model."""
    if service.loaded is None:
        return None
    state, wheels = service.hands_on() or (None, None)
    header: dict[str, object] = {
        "robot": node.robot,
        "episode": NO_EPISODE,
        "tick": 0,
        "stamp_ns": time.time_ns(),
    }
    if state is not None:
        header = {name: getattr(state, name) for name in header}
    checksum = service.loaded.identity
    model = service.loaded.asked
    fields = {
        "service": node.name,
        "checksum": checksum,
        "model": model,
        "state": state,
        "wheels": wheels,
    }
    return Snapshot.model_validate(header | fields)
