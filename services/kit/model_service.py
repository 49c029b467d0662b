"""What the services that work with a learned model share: its settings, loading it, and the main function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Protocol, Self, TypeVar

from pydantic import Field

from schemas.base import Message
from schemas.episode import GoalName
from schemas.rpc import LoadReply, LoadRequest, Scheme
from schemas.topics import Topic
from services.kit.node import Detail, Node, ServiceError, configure_logging, read_settings
from services.kit.settings import ServiceSettings
from smal.model import Model, ModelError
from smal.planning import chosen_goal

#: So many hex digits of a model's checksum tell one model from another.
_DIGITS: Final = 16
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class ModelSettings(ServiceSettings):
    """The model to start with; another is loaded by the queryable ``load``."""

    model: Path | None = None
    """Model file, made by `smal learn`."""
    scheme: Scheme = "filter"
    """`filter`, or `paper` for the paper's own recognition and execution."""
    stride: Annotated[int | None, Field(ge=1, le=1000)] = None
    """Frames from one decision to the next in the paper's scheme; the model's sequence length if not given."""
    goal: GoalName | None = None
    """Where to go, in a model with several goals."""


def identity_of(model: Model) -> str:
    """Return the name by which messages and health tell of a model: the beginning of its checksum."""
    return model.checksum[:_DIGITS]


def refused(model: Model, scheme: Scheme, stride: int | None, goal: str | None) -> str | None:
    """Say in one line why a model cannot be used by a scheme with a stride to go to a goal, or None."""
    if scheme == "filter":
        if stride not in (None, 1):
            return f"stride {stride}: the filter decides at every frame; only the paper's scheme has a stride"
        if model.visual_map is None:
            return (
                "the model has no map of views: no drive to the goal that it was learned from has images; "
                "learn it again, or use the scheme 'paper'"
            )
        try:
            chosen_goal(model.visual_map.goals, goal)
        except ValueError as error:
            return str(error)
    elif goal is not None:
        return f"goal {goal!r}: the paper's scheme goes to the nearest goal, whatever its name"
    elif stride is not None and stride > model.sequence_length:
        return f"stride must be 1 to the sequence length {model.sequence_length}, got {stride}"
    return None


@dataclass(frozen=True)
class LoadedModel:
    """A model that a service may work with.

    Attributes
    ----------
    model
        The model.
    identity
        See ``identity_of``.
    path
        Its file.
    scheme
        How to work with it.
    stride
        Frames from one decision to the next; 1 but for the paper's scheme.
    goal
        Where to go; None for the only goal.
    """

    model: Model
    identity: str
    path: str
    scheme: Scheme
    stride: int
    goal: str | None

    @classmethod
    def read(cls, request: LoadRequest) -> Self:
        """Read a model.

        Raises
        ------
        ServiceError
            When the file is no model, or cannot be used so.
        """
        try:
            model = Model.load(Path(request.path))
        except ModelError as error:
            raise ServiceError(str(error)) from None
        refusal = refused(model, request.scheme, request.stride, request.goal)
        if refusal is not None:
            raise ServiceError(refusal)
        stride = 1 if request.scheme == "filter" else request.stride or model.sequence_length
        return cls(model, identity_of(model), request.path, request.scheme, stride, request.goal)

    def reply(self) -> LoadReply:
        """Tell who asked for it what was loaded."""
        return LoadReply(
            states=self.model.states,
            templates=self.model.templates.shape[1],
            sequence_length=self.model.sequence_length,
            keyframes=0 if self.model.visual_map is None else len(self.model.visual_map.keyframes),
            scheme=self.scheme,
            stride=self.stride,
        )

    def detail(self) -> Detail:
        """Tell of the model in the service's status."""
        return {
            "model": self.path,
            "checksum": self.identity,
            "states": self.model.states,
            "scheme": self.scheme,
            "goal": self.goal,
        }


class ModelService(Protocol[M_contra]):
    """What ``serve_model`` needs of a service."""

    def load(self, request: LoadRequest) -> LoadReply:
        """Load a model; when it is refused, go on with the one before."""

    def handle(self, message: M_contra, /) -> Message | list[Message] | None:
        """Answer a message."""

    def detail(self) -> Detail:
        """Tell how the service is."""


def serve_model(
    name: str, service: ModelService[M_contra], topic: Topic, wire: Callable[[Node], None] = lambda _: None
) -> None:
    """Load the model of the settings, if any, and handle the messages of a topic until stopped.

    `wire` is called with the node before the first message.
    """
    settings = read_settings(ModelSettings, name)
    configure_logging(settings.log_level)
    if settings.model is not None:
        service.load(
            LoadRequest(path=str(settings.model), scheme=settings.scheme, stride=settings.stride, goal=settings.goal)
        )
    with Node(name, settings) as node:
        node.stop_on_signals()
        node.detail = service.detail
        node.serve("load", LoadRequest, service.load)
        wire(node)
        node.subscribe(topic, service.handle)
        node.log.info("model %s", settings.model or f"not loaded yet; waiting for rpc/{name}/load")
        node.spin()
