"""Recognition and policy load models by name, keep the old one when a load is refused, and never mix two."""

from pathlib import Path

import pytest

from schemas.action import Action
from schemas.base import Message
from schemas.command import Command
from schemas.rpc import LoadReply, LoadRequest
from services.kit.model_service import LoadedModel
from services.kit.node import ServiceError
from services.policy.service import PolicyService
from services.recognition.service import RecognitionService
from smal.model import Model
from tests import corridor
from tests.services.chain import LENGTH, identity, observation, save_model, state, with_model

Service = PolicyService | RecognitionService
SERVICES = (PolicyService, RecognitionService)
REFUSALS = {
    "missing": "^model 'none.smal' not found below the root of this service$",
    "truncated": "truncated.smal: truncated or altered",
    "stride": f"^longer.smal: stride must be 1 to the sequence length {LENGTH}, got {LENGTH + 1}$",
    "stride of the filter": "^mapped.smal: stride 2: the filter decides at every frame; for a stride use `smal paper",
    "goal of the paper": "^longer.smal: goal 'there': the paper's scheme always goes to the nearest goal$",
    "for the paper": "^longer.smal: scheme 'paper' of the model is not 'filter'; learn again with `smal learn`",
    "for the filter": "^mapped.smal: scheme 'filter' of the model is not 'paper'; learn again with `smal paper",
}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_model(tmp_path_factory.mktemp("model") / "corridor.smal")


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_model(tmp_path_factory.mktemp("other") / "longer.smal", frames=21)


@pytest.fixture(params=REFUSALS)
def refused(
    request: pytest.FixtureRequest, tmp_path: Path, other: Path
) -> tuple[Path, LoadRequest, str]:
    """Give a root, a request that must be refused, and the reason."""
    name = request.param
    file, asked = {
        "missing": ("none.smal", {"scheme": "paper"}),
        "truncated": ("truncated.smal", {}),
        "stride": (other.name, {"scheme": "paper", "stride": LENGTH + 1}),
        "stride of the filter": ("mapped.smal", {"stride": 2}),
        "goal of the paper": (other.name, {"goal": "there"}),
        "for the paper": (other.name, {"scheme": "filter"}),
        "for the filter": ("mapped.smal", {"scheme": "paper"}),
    }[name]
    if file == "truncated.smal":
        (tmp_path / file).write_bytes(other.read_bytes()[:-7])
    if file == "mapped.smal":
        corridor.save_model(tmp_path / file)
    return (
        other.parent if file == other.name else tmp_path,
        LoadRequest(model=file, **asked),
        REFUSALS[name],
    )


def load_by_name(service: Service, root: Path, request: LoadRequest) -> None:
    service.load(LoadedModel.named(request, root))


@pytest.fixture
def policy(model: Path) -> PolicyService:
    return with_model(PolicyService(), model)


@pytest.fixture
def recognition(model: Path) -> RecognitionService:
    return with_model(RecognitionService(), model)


def atom(answer: list[Message]) -> str:
    (command,) = [message for message in answer if isinstance(message, Command)]
    return command.atom


def decisions(answer: list[Message]) -> list[Message]:
    return [message for message in answer if isinstance(message, Action)]


@pytest.mark.parametrize("cls", SERVICES)
@pytest.mark.parametrize(("stride", "got"), [(None, LENGTH), (1, 1), (2, 2), (LENGTH, LENGTH)])
def test_the_loaded_model_is_told(
    cls: type[Service], stride: int | None, got: int, model: Path
) -> None:
    service = cls()
    assert service.detail() == {"model": None}
    reply = service.load(LoadedModel.read(model, "paper", stride))
    assert reply == LoadReply(scheme="paper", states=6, stride=got)
    detail = service.detail()
    facts = [detail[name] for name in ("model", "checksum", "scheme")]
    assert facts == [str(model), identity(model), "paper"]


@pytest.mark.parametrize("cls", SERVICES)
@pytest.mark.parametrize("stride", [None, 1])
def test_a_model_with_a_map_is_for_the_filter(
    cls: type[Service], stride: int | None, tmp_path: Path
) -> None:
    mapped = corridor.save_model(tmp_path / "mapped.smal")
    service = cls()
    reply = service.load(LoadedModel.read(mapped, stride=stride))
    keyframes = len(Model.load(mapped).mapped.keyframes)
    assert keyframes > 10
    assert reply == LoadReply(scheme="filter", keyframes=keyframes, stride=1)
    assert service.detail()["scheme"] == "filter"


def test_policy_goes_on_with_its_plan_after_a_refused_load(
    policy: PolicyService, refused: tuple[Path, LoadRequest, str], model: Path
) -> None:
    known = state(0, model, status="recognized", state=2)
    first = policy.handle(known)
    before = policy.detail()
    with pytest.raises(ServiceError, match=refused[2]):
        load_by_name(policy, *refused[:2])
    assert policy.detail() == before
    assert policy.handle(known) == first
    assert atom(policy.handle(state(1, model, status="collecting"))) == "left"


def test_recognition_keeps_its_window_after_a_refused_load(
    recognition: RecognitionService, refused: tuple[Path, LoadRequest, str]
) -> None:
    for tick in range(LENGTH - 1):
        recognition.handle(observation(tick, place=6 + tick))
    before = recognition.detail()
    with pytest.raises(ServiceError, match=refused[2]):
        load_by_name(recognition, *refused[:2])
    assert recognition.detail() == before
    answer = recognition.handle(observation(LENGTH - 1, place=5 + LENGTH))
    assert (answer.status, answer.state) == ("recognized", 2)


def test_states_name_the_model_that_they_are_of(
    recognition: RecognitionService, model: Path, other: Path
) -> None:
    assert RecognitionService().handle(observation(0)).model is None
    assert recognition.handle(observation(0)).model == identity(model)
    recognition.load(LoadedModel.read(other))
    assert recognition.handle(observation(1)).model == identity(other)
    assert identity(model) != identity(other)


@pytest.mark.parametrize(
    "fields", [{"status": "recognized", "state": 2}, {"status": "unknown"}], ids=str
)
def test_policy_stops_when_a_state_is_of_another_model(
    policy: PolicyService, fields: dict[str, object], model: Path, other: Path
) -> None:
    known = state(0, model, status="recognized", state=2)
    assert decisions(policy.handle(known))
    for tick in (0, 1, 1):
        answer = policy.handle(state(tick, other, **fields))
        assert (atom(answer), decisions(answer)) == ("stop", [])
    assert policy.detail()["states_of_another_model"] == 3
    # Without the state of the other model the robot would turn left here.
    assert atom(policy.handle(state(2, model, status="collecting"))) == "stop"
    assert atom(policy.handle(state(3, model, status="recognized", state=2))) == "forward"
    assert policy.detail()["states_of_another_model"] == 3
