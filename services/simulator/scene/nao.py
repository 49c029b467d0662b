"""The victim indoors as meshes about its own origin, x forward: a humanoid after the NAO."""

from __future__ import annotations

from typing import TYPE_CHECKING

import shapely
from shapely import affinity

from services.simulator.scene.bodies import limb
from services.simulator.scene.shapes import ball, band, tube

if TYPE_CHECKING:
    from services.simulator.scene.meshes import Mesh
    from services.simulator.scene.textures import Material


def nao() -> dict[Material, list[Mesh]]:
    """Return a humanoid robot after the NAO, 0.58 m tall, standing upright, its face towards x."""
    made: dict[Material, list[Mesh]] = {
        "white_plastic": [
            ball((0.0, 0.0, 0.516), (0.06, 0.066, 0.058), 18),
            ball((0.0, 0.0, 0.408), (0.05, 0.07, 0.05), 16),
            ball((0.002, 0.0, 0.362), (0.043, 0.052, 0.06), 14),
            ball((-0.002, 0.0, 0.283), (0.042, 0.072, 0.034), 14),
        ],
        "nao_grey": [
            tube((0.0, 0.0, 0.44), (0.0, 0.0, 0.475), (0.027, 0.027), 14),
            tube((0.0, 0.0, 0.285), (0.0, 0.0, 0.335), (0.04, 0.038), 16),
        ],
        "orange_plastic": [
            ball((0.03, 0.0, 0.412), (0.032, 0.05, 0.036), 16),
            ball((-0.03, 0.0, 0.405), (0.034, 0.05, 0.04), 14),
            ball((-0.012, 0.0, 0.556), (0.03, 0.016, 0.023), 10),
        ],
        "black_plastic": [
            ball((0.052, 0.0, 0.49), (0.01, 0.012, 0.006), 8),
            ball((0.052, 0.0, 0.548), (0.008, 0.009, 0.008), 8),
        ],
        "blue_plastic": [],
    }
    for side in (-1, 1):
        for material, meshes in (*_face(side), *_arm(side), *_leg(side)):
            made[material] += meshes
    return made


def _face(side: int) -> list[tuple[Material, list[Mesh]]]:
    """Return an eye and an ear; `side` is 1 for the left."""
    return [
        ("black_plastic", [ball((0.046, side * 0.027, 0.522), (0.016, 0.017, 0.017), 12)]),
        ("blue_plastic", [ball((0.0535, side * 0.0285, 0.522), (0.0105, 0.0105, 0.0105), 10)]),
        ("nao_grey", [ball((0.0, side * 0.062, 0.516), (0.036, 0.014, 0.036), 14)]),
        ("white_plastic", [ball((0.0, side * 0.068, 0.516), (0.02, 0.012, 0.02), 12)]),
    ]


def _arm(side: int) -> list[tuple[Material, list[Mesh]]]:
    """Return an arm, bent a little, hanging from its shoulder."""
    shoulder, elbow, hand = (0.0, side * 0.1, 0.428), (0.0, side * 0.122, 0.335), (0.07, side * 0.112, 0.268)
    return [
        ("orange_plastic", [ball(shoulder, (0.034, 0.031, 0.036), 14)]),
        ("white_plastic", [
            tube((0.0, side * 0.106, 0.41), (0.0, side * 0.12, 0.346), (0.03, 0.027), 16),
            tube((0.01, side * 0.121, 0.328), (0.062, side * 0.113, 0.277), (0.029, 0.022), 16),
            ball((0.012, side * 0.121, 0.326), (0.029, 0.029, 0.029), 12),
        ]),
        ("nao_grey", [
            ball(elbow, (0.031, 0.027, 0.025), 12),
            ball((hand[0] + 0.006, hand[1], hand[2] - 0.004), (0.026, 0.019, 0.022), 12),
            *limb((0.082, side * 0.096, 0.268), (0.104, side * 0.098, 0.258), 0.007),
        ]),
    ]  # fmt: skip


def _leg(side: int) -> list[tuple[Material, list[Mesh]]]:
    """Return a leg: thigh and shin with coloured shells, a grey knee, a flat-soled foot."""
    y = side * 0.053
    foot = affinity.scale(shapely.Point(0.02, y).buffer(1.0, quad_segs=8), 0.078, 0.044)
    return [
        ("white_plastic", [
            ball((0.0, y, 0.262), (0.043, 0.042, 0.04), 14),
            tube((0.0, y, 0.262), (0.006, y, 0.178), (0.043, 0.035), 18),
            tube((0.008, y, 0.146), (0.0, y, 0.066), (0.034, 0.037), 18),
            band(foot, 0.0, 0.02, 1.0),
            ball((0.02, y, 0.02), (0.078, 0.044, 0.028), 14),
        ]),
        ("nao_grey", [
            ball((0.008, y, 0.162), (0.039, 0.038, 0.03), 14),
            ball((0.0, y, 0.058), (0.033, 0.034, 0.024), 12),
        ]),
        ("orange_plastic", [
            ball((0.022, y, 0.222), (0.028, 0.033, 0.034), 16),
            ball((0.02, y, 0.106), (0.024, 0.029, 0.03), 16),
        ]),
    ]  # fmt: skip
