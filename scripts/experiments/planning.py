"""Motion planning for rigid bodies: OMPL's planners on the meshes of OMPL.app, collisions by FCL.

Sans-I/O, but for reading a problem's three files; a planner draws its own random numbers. Source: the problem files of
OMPL.app (``*.cfg``, ``*_robot.dae``, ``*_env.dae``). As there, the robot's mesh is moved so that the mean of its
vertices is the origin of its poses. COLLADA's up axis is rotated from y to z.
"""

from __future__ import annotations

import configparser
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray
from ompl import base, geometric, util

# The last one is this project's own: a bar and a wall with a slit.
PROBLEMS: Final = {"Home": "Home", "Cubicles": "cubicles", "Twistycool": "Twistycool", "Easy": "Easy", "Slit": "Slit"}
_AXES: Final = "xyz"

Mesh: TypeAlias = "tuple[NDArray[np.float64], NDArray[np.int64]]"
Place: TypeAlias = "tuple[float, ...]"
Way: TypeAlias = "list[Place]"


@dataclass(frozen=True, slots=True)
class Problem:
    """Robot, world, start and goal, in the units of the meshes. Start and goal are not rotated."""

    robot: Mesh
    world: Mesh
    start: Place
    goal: Place
    low: Place
    high: Place

    @classmethod
    def load(cls, folder: Path, name: str) -> Problem:
        """Read a problem by its name in ``PROBLEMS``.

        Raises ``OSError``: a file is missing. Raises ``KeyError``: no such problem, or a file without what it needs.
        """
        stem = PROBLEMS[name]
        robot, world = ((folder / f"{stem}_{what}.dae").read_bytes() for what in ("robot", "env"))
        return cls.of(robot, world, *limits(folder, name))

    @classmethod
    def of(cls, robot: bytes, world: bytes, start: Place, goal: Place, low: Place, high: Place) -> Problem:
        """Make a problem of two COLLADA files, the positions of start and goal, and the bounds of positions."""
        vertices, faces = _mesh(robot)
        return cls((vertices - vertices.mean(axis=0), faces), _mesh(world), start, goal, low, high)

    def solve(self, planner: str, patience_s: float, is_over: Callable[[], bool]) -> Way:
        """Return a path: poses, each with a position and a quaternion (w last); empty: none was found in time.

        Args:
            planner: its class in ``ompl.geometric``, such as ``RRTConnect``.
            patience_s: limit of the search, in seconds.
            is_over: polled during the search; whether the path is no longer wanted.
        """
        space = base.SE3StateSpace()
        bounds = base.RealVectorBounds(3)
        for axis in range(3):
            bounds.setLow(axis, self.low[axis])
            bounds.setHigh(axis, self.high[axis])
        space.setBounds(bounds)
        setup = geometric.SimpleSetup(space)
        setup.setStateValidityChecker(self._checker())
        ends = []
        for place in (self.start, self.goal):
            state = space.allocState()
            state.setXYZ(*place)
            state.rotation().setIdentity()
            ends.append(state)
        setup.setStartAndGoalStates(*ends)
        setup.setPlanner(getattr(geometric, planner)(setup.getSpaceInformation()))
        timed = base.timedPlannerTerminationCondition(patience_s)
        stopped = base.PlannerTerminationCondition(is_over)
        setup.solve(base.plannerOrTerminationCondition(timed, stopped))
        if not setup.haveExactSolutionPath():
            return []
        states = setup.getSolutionPath().getStates()
        return [(each.getX(), each.getY(), each.getZ(), *_turn(each.rotation())) for each in states]

    def _checker(self) -> Callable[[base.State], bool]:
        robot, world = (fcl.CollisionObject(_volume(mesh), fcl.Transform()) for mesh in (self.robot, self.world))
        request, low, high = fcl.CollisionRequest(), self.low, self.high

        def is_free(state: base.State) -> bool:
            at, turn = (state.getX(), state.getY(), state.getZ()), state.rotation()
            if not all(a <= x <= b for a, x, b in zip(low, at, high, strict=True)):
                return False
            robot.setTransform(fcl.Transform(np.array([turn.w, turn.x, turn.y, turn.z]), np.array(at)))
            return not fcl.collide(robot, world, request, fcl.CollisionResult())

        return is_free


def limits(folder: Path, name: str) -> tuple[Place, Place, Place, Place]:
    """Return positions of start and goal, and the lowest and highest position, of a problem in ``PROBLEMS``.

    Raises ``OSError``: the file is missing. Raises ``KeyError``: no such problem, or a file without what it needs.
    """
    parser = configparser.ConfigParser(strict=False, allow_no_value=True)
    with (folder / f"{PROBLEMS[name]}.cfg").open(encoding="utf-8") as file:
        parser.read_file(file)
    problem = parser["problem"]
    start, goal, low, high = (
        tuple(float(problem[f"{what}.{axis}"]) for axis in _AXES)
        for what in ("start", "goal", "volume.min", "volume.max")
    )
    return start, goal, low, high


def be_quiet() -> None:
    """Switch off the log of OMPL."""
    util.setLogLevel(util.LogLevel.LOG_NONE)


def _turn(rotation: base.SO3StateSpace) -> Place:
    return rotation.x, rotation.y, rotation.z, rotation.w


def _volume(mesh: Mesh) -> fcl.BVHModel:
    vertices, faces = mesh
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    return model


def _mesh(collada: bytes) -> Mesh:
    mesh: trimesh.Trimesh = trimesh.load_scene(io.BytesIO(collada), file_type="dae").to_mesh()
    x, y, z = np.asarray(mesh.vertices, dtype=np.float64).T
    return np.stack([x, z, -y], axis=1), np.asarray(mesh.faces, dtype=np.int64)
