"""Scans: unit, axis, floor and colours of the laboratory as a phone would export it."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh

from services.simulator.opening import BaseKind, open_simulation
from services.simulator.scanning import reading
from services.simulator.scanning.importing import ImportedScan, ScanWishes, import_scan
from services.simulator.scanning.mesh_file import read_parts, write_parts
from services.simulator.scene.rendering import NOTHING, SKY, SceneCamera
from services.simulator.sensors.camera import CameraSettings
from services.simulator.sensors.readings import LEVEL
from services.simulator.variation import VARIATIONS
from services.simulator.world import Pose, WorldError, load_world
from services.simulator.world.loading import RoleWishes
from services.simulator.world.route import obstacles_of, plan_route, route_length_m
from services.simulator.world.scan import ScannedPlace, scan_text
from services.simulator.world.varying import vary
from tests.services.simulator.scans import (
    SIZE_M,
    hilly,
    laboratory,
    slope_deg,
    two_storeys,
    without_floor,
)
from tests.services.simulator.simulator_driving import drive_to
from tests.sharing import made_once

INDOOR = load_world("indoor")
START = Pose(INDOOR.start.x, INDOOR.start.y, INDOOR.start.heading)
TASK = RoleWishes(INDOOR.start, INDOOR.victim)


def summary(imported: ImportedScan, name: str) -> str:
    return dict(imported.summary)[name]


def share(imported: ImportedScan, name: str) -> float:
    return float(summary(imported, name).rstrip("%"))


def written(imported: ImportedScan, path: Path) -> Path:
    path.write_text(scan_text(imported.world, "scan.glb"))
    with path.with_suffix(".npz").open("wb") as file:
        write_parts(file, imported.parts)
    return path


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of the laboratory."""

    def make(folder: Path) -> None:
        laboratory().export(folder / "lab.glb")

    return made_once(tmp_path_factory, "laboratory", make) / "lab.glb"


@pytest.fixture(scope="session")
def scanned(lab: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Import the laboratory with the task of the original, and return its world file."""

    def make(folder: Path) -> None:
        written(import_scan(lab, ScanWishes(TASK)), folder / "lab.json")

    return made_once(tmp_path_factory, "scan", make) / "lab.json"


def same_floor(place: ScannedPlace) -> float:
    """Return the share of the laboratory's free floor that a scan of it found, and no more."""
    room = shapely.box(0, 0, *SIZE_M)
    solids = [one.shape for one in INDOOR.place.solids if one.low_m < INDOOR.robot.top_m]
    free = room.difference(shapely.union_all([s for s in solids if s.geom_type == "Polygon"]))
    found = place.floor.footprint
    # A scan counts from the corner of its floor, which is a cell from the walls.
    found = shapely.affinity.translate(found, *(np.array(SIZE_M) - found.bounds[2:]) / 2)
    return float(found.intersection(free).area / found.union(free).area)


def test_scan_has_floor_and_route_of_the_room(scanned: Path) -> None:
    world = load_world(scanned)
    assert isinstance(world.place, ScannedPlace)
    assert same_floor(world.place) > 0.9
    assert not world.place.sky
    length_m = route_length_m(plan_route(world, (world.start.x, world.start.y)))
    usual_m = route_length_m(plan_route(INDOOR, (START.x, START.y)))
    assert length_m == pytest.approx(usual_m, rel=0.1)


@pytest.mark.parametrize(("unit", "unit_m"), [("cm", 0.01), ("in", 0.0254), ("mm", 0.001)])
def test_scan_in_another_unit_becomes_metres(tmp_path: Path, unit: str, unit_m: float) -> None:
    laboratory(unit_m=unit_m).export(tmp_path / f"{unit}.glb")
    imported = import_scan(tmp_path / f"{unit}.glb", ScanWishes(TASK))
    assert summary(imported, "unit").startswith(f"{unit_m:g} m")
    assert summary(imported, "up axis").startswith("y ")
    place = imported.world.place
    assert isinstance(place, ScannedPlace)
    assert same_floor(place) > 0.9
    given = f"--scale 1: too large, .* x .* m, a storey of .*; give --scale {unit_m:g} \\({unit}\\)"
    with pytest.raises(WorldError, match=given):
        import_scan(tmp_path / f"{unit}.glb", ScanWishes(TASK, scale=1.0))


def test_scan_without_a_ceiling_in_millimetres_is_detected(tmp_path: Path) -> None:
    scene = laboratory(unit_m=0.001)
    for name, mesh in list(scene.geometry.items()):
        if mesh.bounds[0, 2] > 2.7:
            scene.delete_geometry(name)
    scene.export(tmp_path / "open.glb")
    given = r"too large, 8\d\d\d x 6\d\d\d m \(maximum 300 m\); give --scale 0.001 \(mm\)"
    with pytest.raises(WorldError, match=given):
        import_scan(tmp_path / "open.glb", ScanWishes(TASK, scale=1.0))
    imported = import_scan(tmp_path / "open.glb", ScanWishes(TASK))
    assert summary(imported, "unit").startswith("0.001 m")
    assert summary(imported, "place").startswith("outdoors")
    assert summary(imported, "robot").startswith("turtlebot")


def test_scan_as_obj_with_z_up_is_detected(tmp_path: Path) -> None:
    laboratory(y_up=False).export(tmp_path / "lab.obj")
    imported = import_scan(tmp_path / "lab.obj", ScanWishes(TASK))
    assert summary(imported, "up axis").startswith("z ")
    assert share(imported, "untextured") == 0.0
    assert "warning" not in dict(imported.summary)
    wrong = import_scan(tmp_path / "lab.obj", ScanWishes(up="y"))
    assert summary(wrong, "warning").endswith("along z; if the floor is wrong, give --up z")
    place = imported.world.place
    assert isinstance(place, ScannedPlace)
    assert same_floor(place) > 0.9


def test_scan_with_draco_equals_the_plain_one(tmp_path: Path, scanned: Path) -> None:
    data = trimesh.exchange.gltf.export_glb(laboratory(), extension_draco=True)
    (tmp_path / "draco.glb").write_bytes(data)
    imported = import_scan(tmp_path / "draco.glb", ScanWishes(TASK))
    plain = load_world(scanned).place
    place = imported.world.place
    assert isinstance(place, ScannedPlace)
    assert isinstance(plain, ScannedPlace)
    difference = place.floor.footprint.symmetric_difference(plain.floor.footprint)
    assert difference.area < 0.02 * plain.floor.footprint.area


def test_scan_reports_holes_and_drives_around_them(tmp_path: Path, lab: Path) -> None:
    place = (1.5, 3.0)
    without_floor(laboratory(), *place, 0.5).export(tmp_path / "hole.glb")
    imported = import_scan(tmp_path / "hole.glb", ScanWishes(TASK))
    assert share(imported, "edge without a wall") > 1.0
    # The scan counts from the corner of its floor.
    assert not obstacles_of(imported.world.place).is_free(*place, 0.0)
    whole = import_scan(lab, ScanWishes(TASK))
    assert share(whole, "edge without a wall") == 0.0
    assert obstacles_of(whole.world.place).is_free(*place)


def test_scan_of_two_storeys_has_the_floor_asked_for(tmp_path: Path) -> None:
    house = two_storeys(tmp_path)
    told: list[tuple[str, int, int]] = []
    low = import_scan(house, ScanWishes(up="z"), lambda *stage: told.append(stage))
    robots = [f"finding the floor of the {name}" for name in ("rescuebot", "turtlebot")]
    assert list(dict.fromkeys(name for name, _, _ in told)) == ["reading the scan", *robots]
    for robot in robots:
        counts = [(done, total) for name, done, total in told if name == robot]
        assert counts == sorted(counts)
        assert counts[-1][0] == counts[-1][1] > 0
    high = import_scan(house, ScanWishes(up="z", floor_m=3.0))
    assert summary(low, "floor").endswith("height 0.01 m")
    assert summary(high, "floor").endswith("height 3.01 m")
    areas = [one.world.place.floor.footprint.area for one in (low, high)]  # type: ignore[attr-defined]
    assert areas == pytest.approx([25.0, 36.0], rel=0.1)
    assert share(low, "untextured") == 100.0


def test_scan_rejects_a_floor_or_place_that_it_lacks(tmp_path: Path) -> None:
    house = two_storeys(tmp_path)
    with pytest.raises(
        WorldError, match=r": --floor 9: no floor within 1 m .* choose from 0\.\d+, "
    ):
        import_scan(house, ScanWishes(up="z", floor_m=9.0))
    far = RoleWishes(Pose(1.0, 1.0, 0.0), Pose(90.0, 90.0, 0.0))
    with pytest.raises(WorldError, match=r"ply: .*; choose --from and --to on the floor"):
        import_scan(house, ScanWishes(up="z", task=far))


def test_scan_of_a_slope_is_laid_level(tmp_path: Path) -> None:
    imported = import_scan(hilly(tmp_path), ScanWishes(scale=1.0, up="z"))
    place = imported.world.place
    assert isinstance(place, ScannedPlace)
    assert place.sky
    assert summary(imported, "robot").startswith("rescuebot")
    assert place.floor.footprint.area == pytest.approx(400.0 - 16 * 0.3, rel=0.05)
    (part,) = imported.parts
    ground = part.vertices[part.vertices[:, 2] < 0.3]
    assert slope_deg(ground) < 0.5
    # The wall separates its sides.
    sight = np.array([[(5.0, 8.0), (15.0, 8.0)]])
    assert not obstacles_of(place).in_sight(sight)[0]


def test_far_specks_do_not_change_a_scan(tmp_path: Path, scanned: Path) -> None:
    scene = laboratory()
    speck = trimesh.creation.box((0.05, 0.05, 0.05))
    speck.apply_translation((30_000.0, 2.0, 8_000.0))
    scene.add_geometry(speck)
    scene.export(tmp_path / "specks.glb")
    place = import_scan(tmp_path / "specks.glb", ScanWishes(TASK)).world.place
    plain = load_world(scanned).place
    assert isinstance(place, ScannedPlace)
    assert isinstance(plain, ScannedPlace)
    difference = place.floor.footprint.symmetric_difference(plain.floor.footprint)
    assert difference.area < 0.02 * plain.floor.footprint.area


def test_scan_without_a_task_gets_a_long_hidden_one(lab: Path) -> None:
    world = import_scan(lab, ScanWishes()).world
    assert route_length_m(plan_route(world, (world.start.x, world.start.y))) > 7.0
    sight = np.array([[(world.start.x, world.start.y), (world.victim.x, world.victim.y)]])
    assert not obstacles_of(world.place).in_sight(sight)[0]


@pytest.mark.rendering
def test_scan_looks_like_the_room(scanned: Path) -> None:
    world = load_world(scanned)
    size = CameraSettings(160, 120)
    ours = SceneCamera(INDOOR, size)
    theirs = SceneCamera(world, size)
    shift = (np.array(SIZE_M) - world.place.floor.footprint.bounds[2:]) / 2  # type: ignore[attr-defined]
    for turn in np.arange(0.0, 6.0, 0.8):
        pose = Pose(START.x, START.y, turn)
        usual = ours.render(pose).astype(float)
        there = Pose(START.x - shift[0], START.y - shift[1], turn)
        image = theirs.render(there).astype(float)
        assert not np.isin(theirs._labels(there, LEVEL), (NOTHING, SKY)).any()
        alike = np.corrcoef(usual.ravel(), image.ravel())[0, 1]
        mirrored = np.corrcoef(usual.ravel(), image[:, ::-1].ravel())[0, 1]
        assert alike > max(0.75, mirrored + 0.1), f"turned by {turn}"


@pytest.mark.rendering
def test_far_parts_of_a_scan_look_the_same(scanned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = load_world(scanned)
    near = SceneCamera(world, CameraSettings(160, 120)).render(world.start)
    monkeypatch.setattr("services.simulator.scene.scan._NEAR", 0.0)
    camera = SceneCamera(world, CameraSettings(160, 120))
    far = camera.render(world.start)
    assert np.corrcoef(near.ravel(), far.ravel())[0, 1] > 0.95
    assert not (camera._labels(world.start, LEVEL) == NOTHING).any()


@pytest.mark.rendering
def test_scan_of_vertex_colours_has_their_colours(tmp_path: Path) -> None:
    room = trimesh.creation.box((6.0, 5.0, 2.6))
    room.apply_translation((0.0, 0.0, 1.3))
    room.invert()
    room = room.subdivide().subdivide()
    east = room.vertices[:, 0] > 0
    room.visual.vertex_colors = np.where(east[:, None], (200, 40, 30, 255), (30, 60, 200, 255))
    room.export(tmp_path / "room.ply")
    imported = import_scan(tmp_path / "room.ply", ScanWishes(up="z"))
    world = load_world(written(imported, tmp_path / "room.json"))
    camera = SceneCamera(world, CameraSettings(64, 48))
    red = camera.render(Pose(4.5, 2.5, 0.0))[10:14, 20:40].mean(axis=(0, 1))
    blue = camera.render(Pose(1.5, 2.5, np.pi))[10:14, 20:40].mean(axis=(0, 1))
    assert red == pytest.approx((200, 40, 30), abs=12)
    assert blue == pytest.approx((30, 60, 200), abs=12)


@pytest.mark.rendering
def test_scan_is_darker_in_the_evening(scanned: Path) -> None:
    world = load_world(scanned)
    day, evening = (
        SceneCamera(world, CameraSettings(64, 48, VARIATIONS[name].light)).render(world.start)
        for name in ("day", "evening")
    )
    red, _, blue = (evening.mean(axis=(0, 1)) / day.mean(axis=(0, 1))).tolist()
    assert blue < red < 1.0


def test_scan_rejects_variations_of_furniture(scanned: Path) -> None:
    with pytest.raises(WorldError, match="cannot change"):
        vary(load_world(scanned), clutter_seed=1)


@pytest.mark.rendering
@pytest.mark.parametrize("base", ["kinematic", "physics"])
def test_robot_reaches_the_goal_in_a_scan(scanned: Path, base: BaseKind) -> None:
    simulation = open_simulation(str(scanned), CameraSettings(64, 48), base=base)
    for x, y in simulation.route()[1:]:
        drive_to(simulation, x, y, lambda: simulation.look().victim_found)
    assert simulation.look().victim_found
    assert not simulation.collided


def test_textures_beyond_the_limit_are_reduced(
    tmp_path: Path, lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "MOST_TEXTURE", 1 << 20)
    imported = import_scan(lab, ScanWishes(TASK))
    assert "reduced to 1/" in summary(imported, "warning")
    path = written(imported, tmp_path / "lab.json")
    pictures = {id(picture): picture for _, picture in read_parts(path.with_suffix(".npz"))}
    assert sum(4 * 4 / 3 * one.size / 3 for one in pictures.values()) <= 1 << 20


NAMES = ("cut.glb", "empty.ply", "text.obj", "cloud.ply", "picture.glb")


def broken(folder: Path, whole: bytes) -> dict[str, Path]:
    files = {name: folder / name for name in NAMES}
    files["cut.glb"].write_bytes(whole[: len(whole) // 2])
    files["empty.ply"].write_bytes(b"")
    picture = whole.index(b"\x89PNG")
    files["picture.glb"].write_bytes(whole[: picture + 700] + bytes(5000) + whole[picture + 5700 :])
    files["text.obj"].write_text("nothing here\n")
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3))).export(files["cloud.ply"])
    return files


@pytest.mark.parametrize("name", NAMES)
def test_broken_scan_gives_one_line(tmp_path: Path, lab: Path, name: str) -> None:
    path = broken(tmp_path, lab.read_bytes())[name]
    with pytest.raises(WorldError) as error:
        import_scan(path, ScanWishes())
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_scan_with_ktx2_textures_names_the_converter(tmp_path: Path) -> None:
    content = {"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_texture_basisu"]}
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.raises(WorldError, match=r"KTX2 .* gltf-transform ktxdecompress"):
        import_scan(tmp_path / "a.gltf", ScanWishes())


def test_scan_without_its_mesh_file_is_rejected(scanned: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.json").write_bytes(scanned.read_bytes())
    with pytest.raises(WorldError, match=r"lab\.npz not found"):
        load_world(tmp_path / "lab.json")


def test_damaged_mesh_file_gives_one_line(scanned: Path, tmp_path: Path) -> None:
    data = scanned.with_suffix(".npz").read_bytes()
    (tmp_path / "lab.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(WorldError, match=r"lab\.npz: damaged"):
        read_parts(tmp_path / "lab.npz")
