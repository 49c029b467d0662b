"""The method in four lines: images in, atoms and the position out."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smal import Atom, Model, Robot
from smal.features import extract
from smal.features.percept import perceive
from smal.files.container import ModelError
from smal.movement import Motion
from smal.paper.robot import PaperRobot
from smal.planning import Planner
from smal.robot import Localizer
from smal.teaching.demonstration import Demonstration
from smal.teaching.mapping import learn
from tests.corridor import (
    FEATURES,
    FRAMES,
    LENGTH,
    STEP_M,
    Pose,
    model,
    moved,
    paper_model,
    pose,
    view,
)
from tests.smal.synthetic_world import drive as room_drive
from tests.smal.test_camera_change import ROOM, USUAL, usual_map


def _drive(
    robot: Robot, start: Pose, odometry: bool, frames: int = 80
) -> tuple[Pose, list[Motion]]:
    """Let the robot drive through the corridor, until it says that it is done."""
    here = start
    made = []
    while len(made) < frames and not (made and robot.done):
        made.append(robot.step(view(*here), here if odometry else None))
        here = moved(here, made[-1])
    return here, made


@pytest.mark.parametrize("odometry", [True, False])
def test_robot_reports_the_end_of_the_taught_way(odometry: bool) -> None:
    robot = Robot(model(odometry))
    (x, y, _), _ = _drive(robot, (0.1, 0.3, 0.1), odometry)
    assert robot.done
    assert math.hypot(x - pose(FRAMES - 1)[0], y) < 0.6


def test_robot_repeats_an_episode_when_reset_with_its_seed() -> None:
    start = (0.1, 0.3, 0.1)
    fresh = Robot(model(), seed=3)
    _, made = _drive(fresh, start, odometry=True)
    robot = Robot(model())
    _drive(robot, start, odometry=True)
    robot.reset(3)
    _, again = _drive(robot, start, odometry=True)
    assert again == made
    np.testing.assert_array_equal(robot.belief.offsets, fresh.belief.offsets)


def test_robot_reports_its_position() -> None:
    robot = Robot(model())
    for frame in range(8):
        robot.step(view(*pose(frame)), pose(frame))
    assert not robot.lost
    assert robot.where.drive == 0
    assert abs(robot.where.frame * STEP_M + robot.where.ahead - pose(7)[0]) < 0.4
    assert abs(robot.where.left) < 0.4


def test_paper_robot_reaches_the_end_too() -> None:
    robot = PaperRobot(paper_model(), stride=1)
    made = [robot.step(view(*pose(frame)), pose(frame)) for frame in range(FRAMES)]
    assert made[LENGTH - 1 : -LENGTH] == [Atom.FORWARD] * (FRAMES - 2 * LENGTH + 1)
    assert robot.done


def test_model_is_refused_when_it_is_of_the_other_scheme(tmp_path: Path) -> None:
    paper_model().save(tmp_path / "paper.smal")
    with pytest.raises(ModelError, match="learned for the scheme 'paper', not 'filter'") as refused:
        Model.load(tmp_path / "paper.smal")
    assert "\n" not in str(refused.value)


def test_map_names_its_drives(tmp_path: Path) -> None:
    images = [view(*pose(frame)) for frame in range(FRAMES)]
    atoms = np.array([Atom.FORWARD] * (FRAMES - 1) + [Atom.STOP], dtype=np.int8)
    unseen = Demonstration(
        "unseen", np.stack([extract(image, FEATURES) for image in images]), atoms
    )
    taught = learn([unseen, replace(unseen, name="seen", images=images)], FEATURES)
    taught.save(tmp_path / "taught.smal")
    assert Model.load(tmp_path / "taught.smal").mapped.names == (("seen",),)


def test_robot_does_not_move_when_a_frame_is_refused() -> None:
    known = model()
    one = Localizer(known)
    other = Localizer(known)
    raw = extract(view(0.0), FEATURES)
    one.observe(raw, (0.0, 0.0, 0.0))
    other.observe(raw, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="finite"):
        one.observe(raw, (math.nan, 0.0, 0.0))
    later = extract(view(0.2), FEATURES)
    both = [each.observe(later, (0.2, 0.0, 0.0)).tracked for each in (one, other)]
    assert both[0] == both[1] == pytest.approx(0.2, rel=0.05)


def test_atoms_fill_gaps_in_the_odometry() -> None:
    localizer = Localizer(model())
    for frame in range(9):
        place = pose(frame)
        raw = extract(view(*place), FEATURES)
        belief = localizer.observe(raw, place if frame % 2 == 0 else None, [Atom.FORWARD])
    assert belief.tracked == pytest.approx(8 * STEP_M, rel=0.1)


def test_following_features_needs_no_opencv(tmp_path: Path) -> None:
    model().save(tmp_path / "way.smal")
    np.save(tmp_path / "seen.npy", extract(view(*pose(0)), FEATURES))
    code = (
        "import sys; sys.modules['cv2'] = None\n"
        "import numpy as np\n"
        "from smal import Model\n"
        "from smal.planning import Planner\n"
        "from smal.robot import Localizer\n"
        "model = Model.load('way.smal')\n"
        "belief = Localizer(model).observe(np.load('seen.npy'), (0.0, 0.0, 0.0))\n"
        "print(Planner(model.mapped).decide(belief.summary()).motion)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    belief = Localizer(model()).observe(np.load(tmp_path / "seen.npy"), (0.0, 0.0, 0.0))
    expected = Planner(model().mapped).decide(belief.summary()).motion
    assert done.stdout == f"{expected}\n", done.stderr


@pytest.mark.parametrize(
    ("executed", "moved"),
    [
        ([(1.0, 0.2)], True),
        ([Atom.FORWARD], True),
        ([(1.0, 0.0), (0.0, 0.0)], False),
        ([(0.1, 0.0)], False),
        ([], False),
    ],
)
def test_way_is_compared_only_when_the_robot_drives_ahead(
    executed: list[Atom | Motion], moved: bool
) -> None:
    mapped, centering = usual_map()
    localizer = Localizer(Model(centering, mapped))
    poses = room_drive().poses
    localizer.locate(perceive(ROOM.look(poses[0]), USUAL), poses[0].tolist())
    there = perceive(ROOM.look(poses[1]), USUAL)
    belief = localizer.locate(there, poses[1].tolist(), executed).belief
    assert (belief.moved is not None) == moved
