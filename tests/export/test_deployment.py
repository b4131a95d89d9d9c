"""The services of ``examples/`` act with stand-ins for ROS 2 and FastAPI, and what cannot be exported is one line."""

import os
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.export import FORMATS, Format
from rejeu.lab.cli import main
from rejeu.networks import Linear
from tests.export.policies import agent_of, made, observations
from tests.full_disk import FullDisk
from tests.tiers import exhaustive, only

EXAMPLES = Path(__file__).parents[2] / "examples"
WIDTH = 8


class Node:
    """A node of ROS 2 whose clock the test turns."""

    made = None
    parameters = {}

    def __init__(self, name):
        self.time, self.published, self.errors = 0.0, [], []
        Node.made = self

    def declare_parameter(self, name, default):
        Node.parameters.setdefault(name, default)

    def get_parameter(self, name):
        return SimpleNamespace(value=Node.parameters[name])

    def create_publisher(self, kind, topic, depth):
        assert (kind, topic) == (Message, "action")
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind, topic, callback, depth):
        assert (kind, topic) == (Message, "observation")
        self.receives = callback

    def create_timer(self, seconds, callback):
        self.seconds, self.acts = seconds, callback

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=int(self.time * 1e9)))

    def get_logger(self):
        return SimpleNamespace(error=self.errors.append)


class Message:
    """A message of ROS 2 with an array."""

    def __init__(self, data):
        self.data = data


class Refused(Exception):
    """FastAPI's error of a request."""


class Service:
    """A web service whose functions are kept by path."""

    def __init__(self, title):
        self.paths = {}

    def get(self, path):
        return lambda function: self.paths.setdefault(path, function)

    post = get


def stand_in(monkeypatch, name, **contents):
    module = ModuleType(name)
    vars(module).update(contents)
    monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def agent(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = agent_of("SAC", "Box")
    agent.save("model")
    return agent


def test_the_ros_node_acts_as_predict_and_stops_without_observations(agent, monkeypatch):
    started = []
    stand_in(monkeypatch, "rclpy", init=lambda: started.append("init"), spin=started.append)
    stand_in(monkeypatch, "rclpy.node", Node=Node)
    stand_in(monkeypatch, "std_msgs")
    stand_in(monkeypatch, "std_msgs.msg", Float32MultiArray=Message)
    monkeypatch.setattr(Node, "parameters", {"model": "model.safetensors", "seconds_per_step": 0.1})
    runpy.run_path(str(EXAMPLES / "ros2_node.py"), run_name="__main__")
    node = Node.made
    assert (started, node.seconds) == (["init", node], 0.1)
    node.acts()
    assert node.published[0].data == [0.0, 0.0]
    for i, one in enumerate(observations(agent, 5, seed=1), 1):
        node.time = 0.1 * i
        node.receives(Message(one.tolist()))
        node.acts()
        expected = agent.predict(one, deterministic=True)[0]
        np.testing.assert_allclose(node.published[i].data, expected, atol=1e-5)
        assert np.abs(expected).min() > 1e-3
    node.time += 0.3
    node.acts()
    node.receives(Message([1.0, 2.0]))
    node.acts()
    node.receives(Message([1.0, np.nan, 0.0, 0.0]))
    node.acts()
    assert [message.data for message in node.published[6:]] == [[0.0, 0.0]] * 3
    assert len(node.errors) == 2


def test_the_web_service_acts_as_predict(agent, monkeypatch):
    def refused(code, detail):
        return Refused(f"{code}: {detail}")

    stand_in(monkeypatch, "fastapi", FastAPI=Service, HTTPException=refused)
    monkeypatch.setenv("MODEL", "model.safetensors")
    app = runpy.run_path(str(EXAMPLES / "fastapi_service.py"))["app"]
    for one in observations(agent, 5, seed=1):
        expected = agent.predict(one, deterministic=True)[0]
        np.testing.assert_allclose(app.paths["/action"](one.tolist()), expected, atol=1e-5)
    for wrong in ([1.0], [1.0, float("nan"), 0.0, 0.0]):
        with pytest.raises(Refused, match=r"422: expected finite numbers of Box\(-3.0, 3.0, \(4,\)"):
            app.paths["/action"](wrong)
    assert app.paths["/spaces"]()["action"].startswith("Box(")


class Sorting(eqx.Module):
    """Hidden layers that sort, which only StableHLO can express."""

    first: Linear
    n_outputs: int = eqx.field(static=True, default=WIDTH)

    def __init__(self, key, n_inputs):
        self.first = Linear(key, n_inputs, WIDTH)

    def __call__(self, x):
        return jnp.sort(self.first(x), axis=-1)


class Calling(Sorting):
    """Hidden layers that call NumPy, which no file can."""

    def __call__(self, x):
        shape = jax.ShapeDtypeStruct((*x.shape[:-1], WIDTH), x.dtype)
        return jax.pure_callback(np.tanh, shape, self.first(x), vmap_method="sequential")


class Convolving(eqx.Module):
    """An encoder of images with Equinox's convolutions, which the formats have as products of patches."""

    layer: eqx.nn.Conv2d
    n_outputs: int = eqx.field(static=True, default=75)

    def __init__(self, key, leaves):
        self.layer = eqx.nn.Conv2d(2, 3, 4, stride=3, padding=1, dilation=(1, 2), key=key)

    def __call__(self, obs):
        x = jax.vmap(self.layer)(obs.reshape(-1, 2, 16, 16).astype(jnp.float32) / 255)
        return x.reshape(*obs.shape[:-3], -1)


@pytest.mark.parametrize("target", only(["onnx"], ["onnx", "c"]))
def test_convolutions_of_own_encoders_are_exported(target, tmp_path):
    agent = agent_of("PPO", "Box", "CNN", policy_kwargs={"encoder": Convolving, "net_arch": [8]})
    assert agent.export(tmp_path / "policy", target).check.difference <= 1e-5


@pytest.mark.parametrize(
    ("torso", "target", "message"),
    [
        (Sorting, "onnx", r"to ONNX: .*'sort' \(test_deployment.py, line \d+, in Sorting.__call__\) .* to stablehlo"),
        (Sorting, "c", r"to C: .*'sort' \(test_deployment.py, line \d+, in Sorting.__call__\) .* to stablehlo"),
        pytest.param(Calling, "onnx", r"to ONNX: .* line \d+, in Calling.__call__\)", marks=exhaustive),
        (Calling, "stablehlo", r"to stablehlo \(.*callback\); write the part that calls Python"),
    ],
)
def test_own_modules_that_a_format_cannot_express_are_one_line(torso, target, message, tmp_path):
    agent = agent_of("PPO", "Box", policy_kwargs={"torso": torso})
    with pytest.raises(ValueError, match=message) as error:
        agent.export(tmp_path / "policy", target)
    assert "\n" not in str(error.value)
    assert not [*tmp_path.iterdir()]


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, capsys):
    made("PPO", "MlpPolicy", "CartPole-v1").save(tmp_path / "model")
    (tmp_path / "file").write_text("kept")
    folders = [tmp_path / "file"]
    if os.name == "posix" and os.geteuid() != 0:  # root may write everywhere
        folders.append(tmp_path / "read-only")
        folders[-1].mkdir(mode=0o500)
    for folder in folders:
        out = str(folder / "policy.c")
        assert main(["export", str(tmp_path / "model.safetensors"), "--out", out]) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert out in error
    assert sorted(path.name for path in tmp_path.rglob("*"))[:2] == ["file", "model.safetensors"]
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("target", only(["c"], ["c", "onnx", "stablehlo"]))
def test_a_full_disk_leaves_nothing_new(target, tmp_path, monkeypatch):
    agent, disk = agent_of("PPO", "Box"), FullDisk(monkeypatch)
    path = tmp_path / f"policy{FORMATS[target].suffix}"
    path.write_bytes(b"older")
    files = Format.files
    monkeypatch.setattr(Format, "files", lambda *args: (files(*args)[0], setattr(disk, "full", True)))
    with pytest.raises(OSError, match="free some space") as error:
        agent.export(path)
    assert "\n" not in str(error.value)
    assert disk.failures == 1
    assert ([*tmp_path.iterdir()], path.read_bytes()) == ([path], b"older")


def test_no_c_file_is_kept_without_its_header(tmp_path):
    (tmp_path / "policy.h").mkdir()
    with pytest.raises(OSError, match=r"policy.h.*give a path that is not a folder"):
        agent_of("PPO", "Box").export(tmp_path / "policy.c")
    assert [*tmp_path.iterdir()] == [tmp_path / "policy.h"]
