"""Table of services, the source of ``smal up``, ``smal doctor``, ``smal topic`` and the graph.

A new service needs a folder and a row. `tests/system` checks the rows while all services run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import Final, Literal

from schemas import topics
from schemas.topics import COMMANDS, SNAPSHOTS, TOPICS, Topic


@dataclass(frozen=True)
class Service:
    """A service: its topics, its calls and how it is started."""

    # Part of the keys of its queryables.
    name: str
    meaning: str  # Purpose in a few words.
    takes: tuple[Topic, ...] = ()  # Topics that it may subscribe to.
    gives: tuple[Topic, ...] = ()  # Topics that it may publish.
    fetches: tuple[Topic, ...] = ()  # Topics whose missed messages it may fetch.
    serves: tuple[str, ...] = ()  # Verbs that it answers besides ``status``.
    calls: tuple[str, ...] = ()  # Calls that it may make, as ``<service>/<verb>``.
    #: Target of the Dockerfile that it runs in; None for a program outside of the stack.
    image: Literal["services", "recognition", "simulator"] | None = "services"
    module: str = ""  # Module for ``python -m``; ``services.<name>`` by default.
    # Whether several instances can share the robots of a fleet (`services.kit.group`).
    grouped: bool = False
    role: str = ""  # Role of its certificate; its own name by default.

    @property
    def command(self) -> tuple[str, str]:
        """Arguments of Python that run the service."""
        return "-m", self.module or f"services.{self.name}"


#: The services by name. ``smal up`` starts those with an image, in this order.
SERVICES: Final = {
    service.name: service
    for service in (
        Service("router", "passes messages on"),
        Service(
            "robot",
            "the gate, the loop, and the body behind it: a simulated or a real one",
            takes=(*COMMANDS.values(), topics.HEARTBEAT, topics.PULSE),
            gives=(
                *(topics.JPEG, topics.CAMERA_INFO, topics.DEPTH, topics.OVERHEAD),
                *(
                    topics.ODOMETRY,
                    topics.IMU,
                    topics.POSE,
                    topics.APPLIED,
                    topics.PULSE,
                    topics.EPISODE,
                ),
            ),
            serves=("arm", "reset", "cancel", "resume", "end", "look"),
            # To detect another robot with the same id. The robot takes PULSE for the same reason.
            calls=("robot/status",),
            image="simulator",
            module="services.simulator",
        ),
        Service(
            "features",
            "describes images",
            (topics.JPEG,),
            (topics.OBSERVATION,),
            grouped=True,
        ),
        Service(
            "recognition",
            "knows where the robot is",
            (topics.OBSERVATION, topics.ODOMETRY, topics.APPLIED, SNAPSHOTS["recognition"]),
            (topics.STATE, topics.MAP, SNAPSHOTS["recognition"]),
            serves=("load",),
            image="recognition",
            grouped=True,
        ),
        Service(
            "policy",
            "decides",
            (topics.STATE, topics.APPLIED, topics.ODOMETRY, topics.DEPTH, SNAPSHOTS["policy"]),
            (topics.ACTION, COMMANDS["policy"], SNAPSHOTS["policy"]),
            serves=("load",),
            image="recognition",
            grouped=True,
        ),
        Service(
            "recorder",
            "writes recordings",
            tuple(topic for topic in TOPICS.values() if topic.recorded),
            fetches=tuple(topic for topic in TOPICS.values() if topic.recorded),
            serves=("start", "flush", "stop"),
        ),
        Service(
            "tracker",
            "measures the robot's pose from above",
            (topics.OVERHEAD,),
            (topics.TRACKED,),
            grouped=True,
        ),
        Service(
            "console",
            "the page in a browser: drive, teach, watch",
            (
                *(
                    topics.JPEG,
                    topics.DEPTH,
                    topics.ODOMETRY,
                    topics.STATE,
                    topics.ACTION,
                    topics.POSE,
                ),
                *(topics.TRACKED, topics.APPLIED, topics.PULSE, topics.EPISODE),
            ),
            (COMMANDS["teleop"], COMMANDS["emergency_stop"], topics.HEARTBEAT),
            # The console also learns, as the smal command does.
            image="simulator",
        ),
        Service(
            "teleop",
            "a person at the keyboard",
            (topics.APPLIED, topics.PULSE, topics.EPISODE),
            (COMMANDS["teleop"], COMMANDS["emergency_stop"], topics.HEARTBEAT),
            image=None,
            role="operator",
        ),
        Service(
            "expert",
            "drives by the map, to demonstrate",
            (topics.POSE,),
            (COMMANDS["expert"],),
            image=None,
            role="operator",
        ),
    )
}


#: Services that work with a model, in the order of loading: policy must be ready for the first state
#: of recognition.
CHAIN: Final = ("policy", "recognition")


def stack_services() -> tuple[str, ...]:
    """Return the names of the stack's services in their starting order, the router first."""
    return tuple(service.name for service in SERVICES.values() if service.image is not None)


def givers(topic: Topic) -> tuple[str, ...]:
    """Return the names of the services that publish a topic."""
    return tuple(service.name for service in SERVICES.values() if topic in service.gives)


def takers(topic: Topic) -> tuple[str, ...]:
    """Return the names of the services that subscribe to a topic."""
    return tuple(service.name for service in SERVICES.values() if topic in service.takes)


def graph(
    there: Mapping[str, Sequence[str]] = MappingProxyType(dict.fromkeys(SERVICES, ())),
) -> str:
    """Draw services and topics as a Mermaid flowchart, with dotted arrows to the recorder.

    Parameters
    ----------
    there
        Names of the drawn services, each with further lines of its label.
    """
    drawn = [one for one in SERVICES.values() if one.name in there and (one.takes or one.gives)]
    texts = {
        one.name: "<br>".join([f"<b>{one.name}</b>", one.meaning, *there[one.name]])
        for one in drawn
    }
    lines = ["flowchart LR", *(f'    {name}["{text}"]' for name, text in texts.items())]
    for giver, taker in product(drawn, repeat=2):
        shared = "<br>".join(topic.name for topic in giver.gives if topic in taker.takes)
        if shared:
            arrow = "-.->" if taker.name == "recorder" else f'-- "{shared}" -->'
            lines.append(f"    {giver.name} {arrow} {taker.name}")
    return "\n".join(lines)


@dataclass(frozen=True)
class Role:
    """Permissions of a certificate's holder on a bus; the router refuses everything else."""

    # Common name of the certificate.
    name: str
    takes: tuple[Topic, ...]
    gives: tuple[Topic, ...]
    fetches: tuple[Topic, ...]
    serves: tuple[str, ...]  # Queryables that the role may declare, as ``<service>/<verb>``.
    calls: tuple[str, ...]
    #: Whether a person holds it, who also subscribes to key expressions. Services subscribe to
    #: topics.
    person: bool = False
    grouped: bool = False  # Whether holders of the same role see each other.


def role_of(name: str) -> str:
    """Return the role of a service; "operator" for a person's command."""
    service = SERVICES.get(name)
    return "operator" if service is None else service.role or name


def _role(one: Service) -> Role:
    serves = tuple(f"{one.name}/{verb}" for verb in ("status", *one.serves))
    return Role(one.name, one.takes, one.gives, one.fetches, serves, one.calls, grouped=one.grouped)


def roles() -> dict[str, Role]:
    """Return the roles by name: one for each service of a stack, and the roles of people.

    An operator drives and may call every service. The console has the same rights, on behalf of its
    users. A watcher subscribes, and calls ``status``.
    """
    named = {one.name: _role(one) for one in SERVICES.values() if one.image is not None}
    everything = tuple(TOPICS.values())
    own = [service for service in SERVICES.values() if service.role == "operator"]
    served = tuple(key for role in named.values() for key in role.serves)
    given = tuple(topic for topic in everything if any(topic in service.gives for service in own))
    statuses = tuple(f"{service.name}/status" for service in own)
    # A person's command must not miss the end of its episodes.
    named["operator"] = Role(
        "operator", everything, given, (topics.EPISODE,), statuses, served, person=True
    )
    named["console"] = Role(
        "console", everything, given, (), named["console"].serves, served, person=True
    )
    asks = tuple(key for key in (*served, *statuses) if key.endswith("/status"))
    named["watcher"] = Role("watcher", everything, (), (), (), asks, person=True)
    return named
