"""Where goals are in pictures of environments."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from rejeu.envs.canvas import Scene
from rejeu.envs.functional.drawing import GOAL, Maze
from rejeu.envs.functional.point_maze import PointMaze, State
from rejeu.envs.goal_camera import goal_camera, goal_names, perspective, project
from rejeu.envs.registry import make_env
from rejeu.envs.rendering import rgb_frame


def test_the_goal_of_a_maze_is_where_it_is_drawn():
    pytest.importorskip("pygame")
    goal = np.array([1.3, -0.8])
    drawing = Maze(PointMaze(), "rgb_array")
    picture = drawing.draw(Scene([State(np.array([-1.0, 1.0]), np.zeros(2), goal, np.int32(0))], None, False))
    ((x, y),) = project(drawing.camera, goal[None])
    assert tuple(picture[round(y), round(x)]) == GOAL


def test_the_goal_on_the_lot_is_where_highway_env_draws_it():
    pytest.importorskip("highway_env")
    env = make_env("parking-v0", render_mode="rgb_array")
    obs, _ = env.reset(seed=0)
    picture = rgb_frame(env)
    ((x, y),) = project(goal_camera(env), obs["desired_goal"][None])
    env.close()
    assert tuple(picture[round(y), round(x)]) == (100, 200, 255)  # highway-env's color of a landmark


def test_a_camera_sees_what_is_in_front_of_it():
    """It looks along x with z up; half of 100 pixels are seen at a slope of 1, so that y to the left is x in the picture."""
    camera = perspective(np.array([1, 0, 0]), np.array([1, 0, 0]), np.array([0, 0, 1]), 1.0, (200, 100))
    goals = np.array([[3, 0, 0], [3, 0, 1], [3, -1, 0], [0, 0, 0]])
    np.testing.assert_allclose(project(camera, goals), [[100, 50], [100, 25], [125, 50], [np.nan, np.nan]])
    assert np.isnan(project(camera, goals[:, :2])).all()  # these are places in a plane


class Robot(gym.Env):
    """One that MuJoCo would draw, with goals of ``n`` numbers: two eyes look down from a height of 2."""

    def __init__(self, n):
        eyes = [
            SimpleNamespace(pos=np.array([x, 0, 2.0]), forward=np.array([0, 0, -1.0]), up=np.array([0, 1.0, 0]))
            for x in (-0.1, 0.1)
        ]
        for eye in eyes:
            eye.frustum_top, eye.frustum_near = 0.5, 1.0
        size = SimpleNamespace(width=100, height=100)
        viewer = SimpleNamespace(scn=SimpleNamespace(camera=eyes), viewport=size)
        self.mujoco_renderer = SimpleNamespace(viewer=viewer)
        self.observation_space = gym.spaces.Dict({"desired_goal": gym.spaces.Box(-9, 9, (n,))})


def test_goals_of_a_robot_are_places_in_space_or_on_the_floor():
    for goal in ([0.5, 0.5, 0.0], [0.5, 0.5]):
        camera = goal_camera(Robot(len(goal)))
        np.testing.assert_allclose(
            project(camera, np.array([goal])), [[75, 25]]
        )  # 1 is half of the width at this height
    assert goal_camera(Robot(6)) is None


def test_an_environment_may_say_where_its_goals_are_and_what_they_are_called():
    env = gym.Env()
    assert (goal_camera(env), goal_names(env, 2)) == (None, ["number 1 of the goal", "number 2 of the goal"])
    env.goal_names, env.goal_camera = ["height", "angle", "speed"], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert goal_names(env, 2) == ["height", "angle"]
    assert goal_names(env, 4) == ["height", "angle", "speed", "number 4 of the goal"]
    assert project(goal_camera(env), np.array([[3.0, 4.0]])).tolist() == [[3, 4]]
    env.goal_camera = [1, 0, 0]
    with pytest.raises(ValueError, match=r"goal_camera of .* has the shape \(3,\), expected \(3, k \+ 1\)"):
        goal_camera(env)


def test_a_robots_goal_is_where_mujoco_finds_it_in_its_picture():
    """MuJoCo says which body is at a place of the picture; it needs no display for that."""
    mujoco = pytest.importorskip("mujoco")
    xml = "<mujoco><worldbody><geom type='sphere' size='0.02' pos='{} {} {}'/></worldbody></mujoco>"
    place = (0.3, -0.2, 0.5)
    model = mujoco.MjModel.from_xml_string(xml.format(*place))
    data, options, scene, view = (
        mujoco.MjData(model),
        mujoco.MjvOption(),
        mujoco.MjvScene(model, 10),
        mujoco.MjvCamera(),
    )
    mujoco.mj_forward(model, data)
    view.azimuth, view.elevation, view.distance = 130, -30, 3
    mujoco.mjv_updateScene(model, data, options, None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
    robot = Robot(3)
    robot.mujoco_renderer.viewer = SimpleNamespace(scn=scene, viewport=SimpleNamespace(width=200, height=100))
    ((x, y),) = project(goal_camera(robot), np.array([place]))
    chosen = [np.zeros(3), *(np.full(1, -1, np.int32) for _ in range(3))]
    mujoco.mjv_select(model, data, options, 2.0, x / 200, 1 - y / 100, scene, *chosen)
    assert chosen[1][0] == 0
    np.testing.assert_allclose(chosen[0], place, atol=0.03)
