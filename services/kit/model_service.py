"""What the services that work with a learned model share: its settings, loading it, and the main function."""

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
from smal.planning import chosen_goal

_DIGITS: Final = 16  # So many hex digits of a model's checksum tell one model from another.
Wheels = tuple[float, float, float]  # A pose by odometry: metres, metres and radians.
#: Frames after which a run times out, at least; and how many times those of the longest taught drive.
LEAST_TICKS = 3000
PATIENCE = 3
_log = logging.getLogger("models")
AnyModel = Model | PaperModel  # Of either scheme.
_MODELS: Final[WeakValueDictionary[tuple[int, ...], AnyModel]] = WeakValueDictionary()
_READING: Final = threading.Lock()
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class ModelSettings(RootSettings, FleetSettings):
    """The model to start with, wherever it lies; another, below the root, is loaded by the queryable ``load``."""

    model: Path | None = None
    """Model file, made by `smal learn`."""
    scheme: Scheme | None = None
    """For which scheme the model must have been learned, `filter` or `paper`; any if not given."""
    stride: Annotated[int | None, Field(ge=1, le=1000)] = None
    """Frames from one decision to the next in the paper's scheme; the model's sequence length if not given."""
    goal: GoalName | None = None
    """Where to go, in a model with several goals."""


def most_ticks(longest: int) -> int:
    """Return the frames after which a run times out, by those of the longest taught drive."""
    return min(max(LEAST_TICKS, PATIENCE * longest), MAX_TICKS)


def identity_of(model: AnyModel) -> str:
    """Return the name by which messages and health tell of a model: the beginning of its checksum."""
    return model.checksum[:_DIGITS]


def refused(
    model: AnyModel, scheme: Scheme | None, stride: int | None, goal: str | None
) -> str | None:
    """Say in one line why a model cannot be used by a scheme with a stride to go to a goal, or None."""
    if scheme not in (None, model.scheme):
        command = "smal paper learn" if scheme == "paper" else "smal learn"
        return f"it was learned for the scheme {model.scheme!r}, not {scheme!r}; learn again with `{command}`"
    if isinstance(model, Model):
        if stride not in (None, 1):
            return f"stride {stride}: the filter decides at every frame; for a stride use `smal paper learn`"
        try:
            chosen_goal(model.mapped.goals, goal)
        except ValueError as error:
            return str(error)
    elif goal is not None:
        return f"goal {goal!r}: the paper's scheme goes to the nearest goal, whatever its name"
    elif stride is not None and stride > model.sequence_length:
        return f"stride must be 1 to the sequence length {model.sequence_length}, got {stride}"
    return None


def load_model(path: Path) -> AnyModel:
    """Read the model at a path; ModelError as of `Stored.read`."""
    try:
        descriptor = open_regular(path)
    except OSError as error:
        raise NoModelError(f"{path}: cannot be read: {error.strerror}") from error
    with os.fdopen(descriptor, "rb") as file:
        return _read(file, str(path))


def _read(file: IO[bytes], name: str) -> AnyModel:
    """Read an open file, or return the model that was made of it: the robots of a process share one map.

    A file that has the same size and times is the same. Of a file that is rewritten, the loaded model keeps the old
    content (`smal.files.held`).
    """
    with _READING:
        told = os.fstat(file.fileno())
        identity = told.st_dev, told.st_ino, told.st_size, told.st_mtime_ns, told.st_ctime_ns
        if (model := _MODELS.get(identity)) is None:
            model = _MODELS[identity] = cast(
                "AnyModel", Stored.read(file, name)
            )  # There is no third scheme.
        return model


@dataclass(frozen=True)
class LoadedModel:
    """A model that a service may work with."""

    model: AnyModel
    name: str  # Its file: the path in the settings, or the name that a call gave.
    stride: int  # Frames from one decision to the next; 1 but for the paper's scheme.
    goal: str | None  # Where to go; None for the only goal.
    asked: LoadRequest | None = (
        None  # By which call it was loaded; None for the model of the settings.
    )

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
        """Work with a model. Raises ServiceError when it cannot be used so."""
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
        """Read the model that whoever started the service named. Raises ServiceError when it cannot be used so."""
        try:
            return cls.of(load_model(path), str(path), scheme, stride, goal)
        except ModelError as error:
            raise ServiceError(str(error)) from None

    @classmethod
    def named(cls, request: LoadRequest, root: Path) -> Self:
        """Read the model that a call names; ServiceError when it is of no use, which says nothing of other files."""
        try:
            with open_below(root, request.model) as file:
                model = _read(file, request.model)
        except (OSError, NoModelError) as error:
            _log.warning("model %r: %s", request.model, error)
            raise ServiceError(
                f"no model {printable(request.model)!r} below the root of this service"
            ) from None
        except ModelError as error:
            raise ServiceError(str(error)) from None
        return replace(
            cls.of(model, request.model, request.scheme, request.stride, request.goal),
            asked=request,
        )

    def reply(self) -> LoadReply:
        """Tell who asked for it what was loaded."""
        return LoadReply(scheme=self.model.scheme, stride=self.stride, **self._size())

    def detail(self) -> Detail:
        """Tell of the model in the service's status."""
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
    """What ``serve_model`` needs of a service."""

    def load(self, loaded: LoadedModel) -> LoadReply:
        """Work with another model from now on."""

    def handle(self, message: M_contra, /) -> Message | list[Message] | None:
        """Answer a message."""

    def detail(self) -> Detail:
        """Tell how the service is."""

    def hands_on(self) -> tuple[State, Wheels | None] | None:
        """Return the last state and the odometry of its frame, for who goes on from there; None where there is none."""

    def resume(self, state: State, wheels: Wheels | None) -> None:
        """Go on from what another instance, with the same model, has handed on."""

    @property
    def loaded(self) -> LoadedModel | None:
        """The model that it works with."""


def serve_loads(
    node: Node, service: ModelService[M_contra], root: Path, then: Callable[[], None] = lambda: None
) -> None:
    """Load the models that calls name below a root; when one is refused, go on with the one before."""

    def load(request: LoadRequest) -> LoadReply:
        reply = service.load(LoadedModel.named(request, root))
        then()
        return reply

    node.serve("load", LoadRequest, load)
    node.detail = lambda: {"root": str(root)} | service.detail()


def serve_model(
    node: Node, settings: ModelSettings, service: ModelService[M_contra], topic: Topic
) -> None:
    """Load the model of the settings, or that of who served the robot before, and handle a topic until stopped."""
    handed = node.inherited
    if handed is not None and handed.model is not None:
        try:
            service.load(LoadedModel.named(handed.model, settings.root))
        except ServiceError as error:
            node.log.error("the model that %s went by is not at hand here: %s", node.robot, error)  # noqa: TRY400 - one line
    elif settings.model is not None:
        service.load(
            LoadedModel.read(settings.model, settings.scheme, settings.stride, settings.goal)
        )
    if handed is not None and handed.state is not None and service.loaded is not None:
        if handed.checksum == handed.state.model == service.loaded.identity:
            service.resume(handed.state, handed.wheels)
        else:
            node.log.warning("the snapshot of %s belongs to model %s", node.robot, handed.checksum)

    def hand_on() -> None:
        node.publish(_snapshot(node, service))

    serve_loads(
        node, service, settings.root, hand_on
    )  # At once: a model that was said to be loaded is not forgotten.
    node.subscribe(topic, service.handle)
    node.every(SNAPSHOT_S, hand_on)
    name = None if service.loaded is None else service.loaded.name
    node.log.info("model %s", name or f"not loaded yet; waiting for rpc/{node.name}/load")
    node.spin()
    hand_on()


def _snapshot(node: Node, service: ModelService[M_contra]) -> Snapshot | None:
    """Return what whoever serves the robot next goes on from; None without a model."""
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
    told = {
        "service": node.name,
        "checksum": checksum,
        "model": model,
        "state": state,
        "wheels": wheels,
    }
    return Snapshot.model_validate(header | told)
