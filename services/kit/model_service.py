"""What the services that work with a learned model share: its settings, loading it, and the main function."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Protocol, Self, TypeVar, cast

from pydantic import Field

from schemas.base import Message
from schemas.codec import printable
from schemas.episode import GoalName
from schemas.rpc import MAX_TICKS, LoadReply, LoadRequest, Scheme
from schemas.topics import Topic
from services.kit.node import Detail, Node, ServiceError
from services.kit.root import RootSettings, open_below
from smal.files.container import ModelError, NoModelError
from smal.files.stored import Stored
from smal.model import Model
from smal.paper.model import Model as PaperModel
from smal.planning import chosen_goal

_DIGITS: Final = 16  # So many hex digits of a model's checksum tell one model from another.
#: Frames after which a run times out, at least; and how many times those of the longest taught drive.
LEAST_TICKS, PATIENCE = 3000, 3
_log = logging.getLogger("models")
AnyModel = Model | PaperModel  # Of either scheme.
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class ModelSettings(RootSettings):
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


def refused(model: AnyModel, scheme: Scheme | None, stride: int | None, goal: str | None) -> str | None:
    """Say in one line why a model cannot be used by a scheme with a stride to go to a goal, or None."""
    if scheme not in (None, model.scheme):
        return f"it was learned for the scheme {model.scheme!r}, not {scheme!r}: smal learn --scheme {scheme}"
    if isinstance(model, Model):
        if stride not in (None, 1):
            return f"stride {stride}: the filter decides at every frame; only the paper's scheme has a stride"
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
    return cast("AnyModel", Stored.load(path))  # There is no third scheme.


@dataclass(frozen=True)
class LoadedModel:
    """A model that a service may work with."""

    model: AnyModel
    name: str  # Its file: the path in the settings, or the name that a call gave.
    stride: int  # Frames from one decision to the next; 1 but for the paper's scheme.
    goal: str | None  # Where to go; None for the only goal.

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
        return cls(model, name, 1 if isinstance(model, Model) else stride or model.sequence_length, goal)

    @classmethod
    def read(cls, path: Path, scheme: Scheme | None = None, stride: int | None = None, goal: str | None = None) -> Self:
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
                model = cast("AnyModel", Stored.read(file, request.model))
        except (OSError, NoModelError) as error:
            _log.warning("model %r: %s", request.model, error)
            raise ServiceError(f"no model {printable(request.model)!r} below the root of this service") from None
        except ModelError as error:
            raise ServiceError(str(error)) from None
        return cls.of(model, request.model, request.scheme, request.stride, request.goal)

    def reply(self) -> LoadReply:
        """Tell who asked for it what was loaded."""
        return LoadReply(scheme=self.model.scheme, stride=self.stride, **self._size())

    def detail(self) -> Detail:
        """Tell of the model in the service's status."""
        known: Detail = {"model": self.name, "checksum": self.identity, "scheme": self.model.scheme, "goal": self.goal}
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


def serve_loads(node: Node, service: ModelService[M_contra], root: Path) -> None:
    """Load the models that calls name below a root; when one is refused, go on with the one before."""
    node.serve("load", LoadRequest, lambda request: service.load(LoadedModel.named(request, root)))
    node.detail = lambda: {"root": str(root)} | service.detail()


def serve_model(node: Node, settings: ModelSettings, service: ModelService[M_contra], topic: Topic) -> None:
    """Load the model of the settings, if any, and handle the messages of a topic until stopped."""
    if settings.model is not None:
        service.load(LoadedModel.read(settings.model, settings.scheme, settings.stride, settings.goal))
    serve_loads(node, service, settings.root)
    node.subscribe(topic, service.handle)
    node.log.info("model %s", settings.model or f"not loaded yet; waiting for rpc/{node.name}/load")
    node.spin()
