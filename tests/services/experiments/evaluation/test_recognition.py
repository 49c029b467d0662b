"""The demonstrated frame that a state and a phase are, counted by hand; and what was done at the nearest one."""

import numpy as np

from services.experiments.evaluation.recognition import NearestImitation, demonstrated_frames
from smal.features import FeatureSettings, extract
from smal.movement import Atom
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import Model
from smal.teaching.demonstration import Demonstration
from tests.services.chain import picture
from tests.smal.worlds import COLOR

LENGTH = 4


def taught(frames: tuple[int, ...] = (22, 17, 26), seed: int = 0) -> Model:
    """Learn drives through random places; the later ones pass places of the first again."""
    rng, features = np.random.default_rng(seed), FeatureSettings()
    places = rng.random((40, features.size), dtype=np.float32)
    drives = []
    for number, count in enumerate(frames):
        views = places[number * 2 : number * 2 + count] + 0.01 * rng.random((count, features.size), dtype=np.float32)
        atoms = np.full(count, Atom.FORWARD, dtype=np.int8)
        drives.append(Demonstration(f"drive-{number}", views, atoms))
    settings = LearningSettings(sequence_length=LENGTH)
    return learn(drives, settings)


def test_a_template_is_where_it_was_demonstrated() -> None:
    model = taught()
    assert model.states < sum(map(len, model.state_streams))
    frame_of, made, start = demonstrated_frames(model), set(), 0
    for atoms, states in zip(model.atoms, model.state_streams, strict=True):
        begin, last = start + len(atoms) % LENGTH, start + len(atoms) - 1
        for number, state in enumerate(states.tolist()):
            if state not in made:
                for phase in range(2 * LENGTH - 1):
                    expected = min(begin + number * LENGTH + phase, last)
                    assert frame_of(state, phase + 0.3) == expected, "and not beyond the demonstration"
            made.add(state)
        start += len(atoms)
    assert made == set(range(model.states))


def test_the_nearest_window_is_imitated() -> None:
    """Of two alike frames the one after which other frames came before."""
    images = [picture(place) for place in (1, 20, 40, 20)]
    features = np.stack([extract(image, COLOR) for image in images])
    atoms = np.array([Atom.FORWARD, Atom.LEFT, Atom.FORWARD, Atom.STOP], dtype=np.int8)
    drives = [Demonstration("d", features[:2], atoms[:2]), Demonstration("e", features[2:], atoms[2:])]
    one, two = NearestImitation(drives, COLOR), NearestImitation(drives, COLOR, 2)
    assert [one.step(image) for image in images] == [Atom.FORWARD, Atom.LEFT, Atom.FORWARD, Atom.LEFT]
    assert [two.step(image) for image in images[2:]] == [Atom.FORWARD, Atom.STOP]
