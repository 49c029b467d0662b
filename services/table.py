"""The one table of services: ``smal up``, ``smal doctor``, ``smal topic`` and the drawn graph are derived from it.

A new service is a folder and a row here. What the rows say is checked where all services run (`tests/system`).
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
    """One row of the table."""

    name: str  # Part of the keys of its queryables.
    meaning: str  # What it does, in a few words.
    takes: tuple[Topic, ...] = ()  # Topics that it may subscribe to.
    gives: tuple[Topic, ...] = ()  # Topics that it may publish.
    fetches: tuple[Topic, ...] = ()  # Topics of which it may have sent what it has missed.
    serves: tuple[str, ...] = ()  # Verbs that it answers beside ``status``.
    calls: tuple[str, ...] = ()  # What it may call of others, ``<service>/<verb>``.
    #: Target of the Dockerfile that it runs in; None for what is no process of its own in a stack.
    image: Literal["services", "recognition", "simulator"] | None = "services"
    module: str = ""  # What ``python -m`` runs; ``services.<name>`` if not given.
    grouped: bool = False  # Whether it may run any number of times, for any number of robots (`services.kit.group`).
    role: str = ""  # Whose certificate it shows to the router; its own if not given.

    @property
    def command(self) -> tuple[str, str]:
        """Arguments of Python that run it."""
        return "-m", self.module or f"services.{self.name}"


#: The services by name; those with an image are started by ``smal up``, in this order.
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
            # Whether there is another robot of its id; so does the pulse tell that it takes.
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
            # It learns as well, as the smal command does.
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


#: The services that work with a model, in the order in which one is loaded: what policy has prepared it takes with the
#: first state that recognition finds by it.
CHAIN: Final = ("policy", "recognition")


def stack_services() -> tuple[str, ...]:
    """Return the names of the services of a stack, in the order in which they start, the router first."""
    return tuple(service.name for service in SERVICES.values() if service.image is not None)


def givers(topic: Topic) -> tuple[str, ...]:
    """Return who publishes a topic."""
    return tuple(service.name for service in SERVICES.values() if topic in service.gives)


def takers(topic: Topic) -> tuple[str, ...]:
    """Return who subscribes to a topic."""
    return tuple(service.name for service in SERVICES.values() if topic in service.takes)


def graph(
    there: Mapping[str, Sequence[str]] = MappingProxyType(dict.fromkeys(SERVICES, ())),
) -> str:
    """Return services and topics as a Mermaid flowchart; dotted is the way to the recorder, which takes all.

    Those that are ``there`` are drawn, each with further lines.
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
    """What the holder of a certificate may do on a robot's bus, as of a service; all else is refused by the router."""

    name: str  # Common name of the certificate.
    takes: tuple[Topic, ...]
    gives: tuple[Topic, ...]
    fetches: tuple[Topic, ...]
    serves: tuple[str, ...]  # Queryables that it may be, ``<service>/<verb>``.
    calls: tuple[str, ...]
    #: Whether somebody holds it who also listens to key expressions, and not a service, which subscribes to topics.
    person: bool = False
    grouped: bool = False  # Whether it is seen by, and sees, who holds the same.


def role_of(name: str) -> str:
    """Return the role of a service, or of what is none: a person's command."""
    service = SERVICES.get(name)
    return "operator" if service is None else service.role or name


def _role(one: Service) -> Role:
    serves = tuple(f"{one.name}/{verb}" for verb in ("status", *one.serves))
    return Role(one.name, one.takes, one.gives, one.fetches, serves, one.calls, grouped=one.grouped)


def roles() -> dict[str, Role]:
    """Return the roles by name: one for each service of a stack, and those of people.

    An operator drives, and calls whatever is served; so does the console, for whoever is at its page. A watcher looks.
    """
    named = {one.name: _role(one) for one in SERVICES.values() if one.image is not None}
    everything = tuple(TOPICS.values())
    own = [service for service in SERVICES.values() if service.role == "operator"]
    served = tuple(key for role in named.values() for key in role.serves)
    given = tuple(topic for topic in everything if any(topic in service.gives for service in own))
    statuses = tuple(f"{service.name}/status" for service in own)
    # Of the episodes that it has run, a person's command must not miss the end.
    named["operator"] = Role(
        "operator", everything, given, (topics.EPISODE,), statuses, served, person=True
    )
    named["console"] = Role(
        "console", everything, given, (), named["console"].serves, served, person=True
    )
    asks = tuple(key for key in (*served, *statuses) if key.endswith("/status"))
    named["watcher"] = Role("watcher", everything, (), (), (), asks, person=True)
    return named
