"""Commands and heartbeats for a gate, valid or not."""

from schemas.base import KEYS, Atom, Source
from schemas.command import Command
from schemas.heartbeat import Heartbeat


def command(
    tick: int,
    *,
    sequence: int = 0,
    source: Source = "policy",
    atom: Atom = "forward",
    episode: str = "e",
    linear: float | None = None,
    session: str = "",
) -> Command:
    header = {"robot": "r", "episode": episode, "tick": tick, "stamp_ns": 0}
    whole = Command(**header, source=source, session=session, sequence=sequence, atom=atom)
    # The schema would refuse what the gate has to refuse by itself.
    return whole.model_copy(update={"linear": KEYS[atom].linear if linear is None else linear})


def beat(session: str, sequence: int, answers: int | None, *, present: bool = True) -> Heartbeat:
    header = {"robot": "r", "episode": "e", "tick": 0, "stamp_ns": 0}
    return Heartbeat(
        **header, session=session, name="desk", sequence=sequence, answers=answers, present=present
    )
