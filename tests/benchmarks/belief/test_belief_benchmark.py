"""The benchmark of beliefs, on a way that is made up."""

import numpy as np
import pytest

from smal.camera import STRAIGHT
from smal.files.packed import unpacked
from tests.benchmarks.belief import benchmark as belief
from tests.benchmarks.route import FRAME_M, SPACING_M, map_of

METRES = 60.0
#: Runs that are carried away from where the wheels lead; the fourth into another world.
NUMBERS = {"as it is": (1, 4, 5), "without scouts": (1, 5)}


@pytest.fixture(scope="module")
def asked() -> tuple[belief.Judge, belief.Asked, belief.Asked]:
    """Who judges, a drive along the taught way, and one in another world."""
    model = map_of(METRES, 128)
    rng = np.random.default_rng(3)
    mapped = model.mapped
    poses = np.column_stack(
        [np.arange(0.0, METRES, FRAME_M), *np.zeros((2, round(METRES / FRAME_M)))]
    )
    atoms = np.ones(len(poses), np.int8)

    def drive(views: np.ndarray) -> belief.Asked:
        noise = 0.01 * rng.standard_normal((len(views), len(mapped.basis)))
        return belief.Asked(
            (views @ mapped.basis.T + noise).astype(np.float32), poses, poses, atoms
        )

    near = np.minimum(np.rint(poses[:, 0] / SPACING_M).astype(int), len(mapped.keyframes) - 1)
    strange = rng.standard_normal((len(poses), mapped.basis.shape[1]))
    judge = belief.Judge(model, mapped.poses, 3.0, 0.5)
    return judge, drive(unpacked(mapped.views[near, 1, STRAIGHT])), drive(strange)


@pytest.mark.long
def test_what_is_left_out_is_missed(
    asked: tuple[belief.Judge, belief.Asked, belief.Asked], monkeypatch: pytest.MonkeyPatch
) -> None:
    judge, there, away = asked
    monkeypatch.setattr(belief, "PIECE", 50)
    found = {
        name: [
            belief.run(judge, belief.VARIANTS[name], [there, there], away, number)
            for number in numbers
        ]
        for name, numbers in NUMBERS.items()
    }
    carried = {
        name: sum(belief.soon(one, belief.PIECE) for one in runs) for name, runs in found.items()
    }
    assert carried["as it is"] >= 2
    assert carried["without scouts"] == 0
    lost = {
        name: np.concatenate([one.lost[~one.known] for one in runs]) for name, runs in found.items()
    }
    assert lost["as it is"].max() > 0.9
