"""What degraded images show, and which demonstrated frame a state, a phase and the nearest frame are."""

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import DEGRADATIONS, Degrader
from services.experiments.evaluation.recognition import demonstrated_frames
from smal.evaluation.nearest import NearestImitation
from smal.features import FeatureSettings, extract
from smal.movement import MOTIONS, STANDS, Atom
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import PaperModel
from smal.teaching.demonstration import Demonstration
from tests.services.chain import picture
from tests.smal.worlds import COLOR


def texture(seed: int = 0, height: int = 60, width: int = 80) -> NDArray[np.uint8]:
    """Return an image in which no two neighbouring pixels are alike."""
    image = np.random.default_rng(seed).integers(0, 128, (height, width, 3), dtype=np.uint8)
    image[::2, ::2] += 128
    return image


def test_the_same_seed_damages_the_same_frames_in_the_same_way() -> None:
    image = texture()

    def frames(seed: int, name: str = "poor") -> NDArray[np.uint8]:
        degrader = Degrader(DEGRADATIONS[name], seed)
        return np.stack([degrader.apply(tick, image) for tick in range(60)])

    np.testing.assert_array_equal(frames(5), frames(5))
    assert (frames(5) != frames(6)).any(axis=(1, 2, 3)).all()
    occluded = (frames(5, "occluded") != image).any(axis=(1, 2, 3))
    assert 0.2 < occluded.mean() < 0.5
    assert (frames(5, "clean") == image).all()


LENGTH = 4


def taught(frames: tuple[int, ...] = (22, 17, 26), seed: int = 0) -> PaperModel:
    """Learn drives through random places; the later ones pass places of the first again."""
    rng = np.random.default_rng(seed)
    features = FeatureSettings()
    places = rng.random((40, features.size), dtype=np.float32)
    drives = []
    for number, count in enumerate(frames):
        views = places[number * 2 : number * 2 + count] + 0.01 * rng.random(
            (count, features.size), dtype=np.float32
        )
        atoms = np.full(count, Atom.FORWARD, dtype=np.int8)
        drives.append(Demonstration(f"drive-{number}", views, atoms))
    settings = LearningSettings(sequence_length=LENGTH)
    return learn(drives, settings)


def test_a_template_is_where_it_was_demonstrated() -> None:
    model = taught()
    assert model.states < sum(map(len, model.state_streams))
    frame_of = demonstrated_frames(model)
    made = set()
    start = 0
    for atoms, states in zip(model.atoms, model.state_streams, strict=True):
        begin = start + len(atoms) % LENGTH
        last = start + len(atoms) - 1
        for number, state in enumerate(states.tolist()):
            if state not in made:
                for phase in range(2 * LENGTH - 1):
                    expected = min(begin + number * LENGTH + phase, last)
                    assert frame_of(state, phase + 0.3) == expected, (
                        "and not beyond the demonstration"
                    )
            made.add(state)
        start += len(atoms)
    assert made == set(range(model.states))


def test_the_nearest_window_is_imitated() -> None:
    images = [picture(place) for place in (1, 20, 60, 40, 20)]
    features = np.stack([extract(image, COLOR) for image in images])
    atoms = np.array([Atom.FORWARD, Atom.LEFT, Atom.STOP, Atom.FORWARD, Atom.STOP], dtype=np.int8)
    drives = [
        Demonstration("d", features[:3], atoms[:3]),
        Demonstration("e", features[3:], atoms[3:]),
    ]
    one = NearestImitation(drives, COLOR)
    two = NearestImitation(drives, COLOR, 2)
    seen = [images[k] for k in (0, 1, 3, 4)]
    taught = (Atom.FORWARD, Atom.LEFT, Atom.FORWARD, Atom.LEFT)
    assert [one.step(image) for image in seen] == [MOTIONS[atom] for atom in taught]
    assert one.said is None
    assert [two.step(image) for image in seen[2:]] == [MOTIONS[Atom.FORWARD], STANDS]
    assert two.said == "found"
