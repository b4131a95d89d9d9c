"""Models of Stable-Baselines3 act here as they do there, and no code of a file is run."""

import os
import pickle
import shutil
import tracemalloc
from collections import deque
from itertools import islice
from pathlib import Path

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.agents.conversion import OriginalPolicy, converted, parts_of
from rejeu.core import checkpoint, spaces
from rejeu.core.algorithm import Clock, Transition
from rejeu.core.errors import CheckpointError
from rejeu.lab.cli import main
from rejeu.sb3 import algorithms, load_zip
from tests.hostile_zips import hostile_zips
from tests.sb3_models import MadeUp, difference_from, loaded
from tests.tiers import exhaustive, only
from tests.torch_files import Tensor, changed, members_of, serialized, torch_file, zipped

pytestmark = pytest.mark.usefixtures("learners_are_shared")

FOLDER = Path(__file__).parents[1] / "data" / "sb3"
"""Files that ``trials/sb3_models.py small`` made with Stable-Baselines3, and what they did there."""
AGENTS = sorted(path.stem for path in FOLDER.glob("*.zip"))
LIMIT = {"a2c-sde": 3e-5}
"""The variance of gSDE has 1e-6 in the environment's unit there, and in the unit of [-1, 1] here."""
PPO = (FOLDER / "ppo-normalized.zip").read_bytes()


def write(tmp_path, content, name="model.zip"):
    path = tmp_path / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "name", only({"ppo-normalized", "recurrent-mlp", "a2c-sde", "sac-her", "dqn-mlp", "qrdqn-mlp"}, AGENTS)
)
def test_actions_values_and_log_probabilities_are_those_of_the_original(name):
    agent = loaded(FOLDER / name)
    found = difference_from(agent, dict(np.load(FOLDER / f"{name}.npz")))
    assert found["actions"] < 1e-5
    assert found["values"] < 1e-5
    assert found.get("log_probs", 0) < LIMIT.get(name, 1e-5)
    assert agent.num_timesteps in (300, 320)
    assert agent.n_updates > 0
    assert agent.notes == []


@pytest.mark.parametrize(("name", "shape"), [("ppo-normalized", (1, -1)), ("a2c-sde", (-1, 1, 1))])
def test_the_shape_of_box_actions_changes_nothing_else(name, shape, tmp_path):
    path = FOLDER / f"{name}.zip"
    flat, obs = load_zip(path, vecnormalize=False), dict(np.load(FOLDER / f"{name}.npz"))["obs"]
    low, high = (bound.reshape(shape) for bound in (flat.action_space.low, flat.action_space.high))
    content = changed(path.read_bytes(), {"action_space": serialized(gym.spaces.Box(low, high, dtype=np.float32))})
    actions = load_zip(write(tmp_path, content)).predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(actions, flat.predict(obs, deterministic=True)[0].reshape(-1, *low.shape))


@pytest.mark.parametrize("name", only(["dqn-mlp"], ["dqn-mlp", "ddpg-mlp"]))
def test_the_next_gradient_step_is_the_one_of_the_original(name):
    """Of weights, target networks and moments of Adam."""
    agent, data = loaded(FOLDER / name), dict(np.load(FOLDER / f"{name}.npz"))
    batch = {key.removeprefix("batch."): value for key, value in data.items() if key.startswith("batch.")}
    action = batch["action"][:, 0] if name == "dqn-mlp" else batch["action"]
    discount = agent.config.gamma * (1 - batch["done"][:, 0])
    transition = Transition(batch["obs"], action, batch["reward"][:, 0], batch["next_obs"], discount)
    clock = Clock(jnp.uint32(agent.num_timesteps), jnp.uint32(0), jnp.float32(1))
    state, _ = jax.jit(agent.learner.algorithm.update)(agent.state, transition, clock)
    before = checkpoint.tree_to_arrays(agent.state)
    after = {key.removeprefix("after."): value for key, value in data.items() if key.startswith("after.")}
    policy = OriginalPolicy(after, agent.obs_leaves, [], agent.action_space, False)
    expected, _ = converted(parts_of(agent.name, policy, 1), policy, {})
    ours = checkpoint.tree_to_arrays(state)
    assert max(np.abs(ours[key] - before[key]).max() for key in expected) > 1e-5
    for key, value in expected.items():
        np.testing.assert_allclose(ours[key], value, atol=2e-6, err_msg=key)


@pytest.mark.parametrize(("name", "file"), [("DQN", "dqn-mlp")])
def test_the_class_of_the_drop_in_loads_a_file_of_the_original(name, file):
    kind, path = getattr(algorithms, name), FOLDER / f"{file}.zip"
    with path.open("rb") as file:
        found = kind.load(file, gamma=0.5)
    agent, expected = kind.load(path), load_zip(path)
    obs = np.stack([agent.observation_space.sample() for _ in range(5)])
    for one in (agent, found):
        np.testing.assert_array_equal(
            one.predict(obs, deterministic=True)[0], expected.predict(obs, deterministic=True)[0]
        )
    assert (type(agent), agent.gamma, found.gamma) == (kind, expected.config.gamma, 0.5)
    with pytest.raises(CheckpointError, match=f"it is a model of {name}, not of PPO; load it with {name}.load"):
        algorithms.PPO.load(path)


@pytest.mark.parametrize("name", only({"sac-her"}, ["dqn-mlp", "sac-her", "ppo-normalized"]))
def test_training_continues(name):
    agent = loaded(FOLDER / name)
    env = MadeUp(agent.observation_space, agent.action_space)
    before = agent.get_parameters()
    agent.set_env(env)
    n_updates = agent.n_updates
    before_them = agent.num_timesteps
    agent.learn(150, reset_num_timesteps=False)
    assert agent.num_timesteps >= before_them + 150
    assert agent.n_updates > n_updates
    after = agent.get_parameters()
    assert all(np.isfinite(value).all() for value in after.values())
    assert any(not np.array_equal(after[key], before[key]) for key in after if "head" in key)


def test_images_are_read_in_the_order_of_channels_of_pytorch(tmp_path):
    """Against a convolution that is written out for channels first, as PyTorch has it; the Dict's keys are not sorted."""
    rng = np.random.default_rng(0)
    space = gym.spaces.Dict(
        {"place": gym.spaces.Box(-1, 1, (3,)), "camera": gym.spaces.Box(0, 255, (2, 36, 40), np.uint8)}
    )
    space.spaces = {key: space.spaces[key] for key in ("place", "camera")}
    shapes = {"cnn.0": (32, 2, 8, 8), "cnn.2": (64, 32, 4, 4), "cnn.4": (64, 64, 3, 3), "linear.0": (5, 64 * 1 * 1)}
    n_flat = (
        64
        * conv_side(conv_side(conv_side(36, 8, 4), 4, 2), 3, 1)
        * conv_side(conv_side(conv_side(40, 8, 4), 4, 2), 3, 1)
    )
    shapes["linear.0"] = (5, n_flat)
    base = "features_extractor.extractors.camera"
    weights = {
        f"{base}.{key}.weight": rng.normal(size=shape) / np.sqrt(np.prod(shape[1:])) for key, shape in shapes.items()
    }
    weights |= {f"{base}.{key}.bias": rng.normal(size=shape[0]) / 5 for key, shape in shapes.items()}
    for key, shape in {"mlp_extractor.policy_net.0": (4, 8), "mlp_extractor.value_net.0": (4, 8)}.items():
        weights |= {f"{key}.weight": rng.normal(size=shape), f"{key}.bias": rng.normal(size=4)}
    for key, n in {"action_net": 3, "value_net": 1}.items():
        weights |= {f"{key}.weight": rng.normal(size=(n, 4)), f"{key}.bias": rng.normal(size=n)}
    data = {
        "observation_space": serialized(space),
        "action_space": serialized(gym.spaces.Discrete(3)),
        "policy_kwargs": {},
    }
    policy = torch_file({key: Tensor(value) for key, value in weights.items()})
    agent = load_zip(write(tmp_path, changed(PPO, data, policy_pth=policy)))

    place, image = rng.uniform(-1, 1, (6, 3)).astype(np.float32), rng.integers(0, 256, (6, 2, 36, 40), np.uint8)
    x = image / 255.0
    for key, stride in (("cnn.0", 4), ("cnn.2", 2), ("cnn.4", 1)):
        x = np.maximum(
            convolved(x, weights[f"{base}.{key}.weight"], stride) + weights[f"{base}.{key}.bias"][:, None, None], 0
        )
    x = np.maximum(x.reshape(6, -1) @ weights[f"{base}.linear.0.weight"].T + weights[f"{base}.linear.0.bias"], 0)
    features = np.concatenate([place, x], axis=1)  # in the order of the file
    hidden = np.tanh(
        features @ weights["mlp_extractor.value_net.0.weight"].T + weights["mlp_extractor.value_net.0.bias"]
    )
    value = hidden @ weights["value_net.weight"][0] + weights["value_net.bias"]
    np.testing.assert_allclose(agent.value({"place": place, "camera": image}), value, atol=1e-5)


def conv_side(side, kernel, stride):
    return (side - kernel) // stride + 1


def convolved(x, weight, stride):
    """Returns the convolution of ``(batch, channels, rows, columns)``."""
    kernel = weight.shape[-1]
    windows = np.lib.stride_tricks.sliding_window_view(x, (kernel, kernel), (2, 3))[:, :, ::stride, ::stride]
    return np.einsum("bcijkl,ockl->boij", windows, weight)


class Evil:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize(
    "where", ["observation_space", "policy_kwargs", "policy.pth", "policy.optimizer.pth", "vecnormalize"]
)
def test_code_in_a_file_is_not_run(where, tmp_path):
    evil = pickle.dumps(Evil(tmp_path / "ran"))
    content, scaler = PPO, None
    if where == "vecnormalize":
        scaler = write(tmp_path, evil, "scaler.pkl")
    elif where.endswith(".pth"):
        inner = members_of(members_of(PPO)[where])
        inner = zipped({name: evil if name.endswith("data.pkl") else value for name, value in inner.items()}, 0)
        content = zipped({**members_of(PPO), where: inner})
    else:
        content = changed(PPO, {where: serialized(evil)})
    with pytest.raises(CheckpointError, match="mkdir, which has no place in such a file") as caught:
        load_zip(write(tmp_path, content), vecnormalize=scaler)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "ran").exists()
    pickle.loads(evil)
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(("changes", "message"), [
    ({"policy_kwargs": {"full_std": False}}, "full_std=False, which is not read"),
    ({"policy_kwargs": {"use_expln": True}}, "use_expln=True"),
    ({"gamma": 2.0}, "gamma=2.0 must be"),
    ({"action_space": serialized(gym.spaces.Discrete(3))}, "head.* is .*, expected"),
    ({"observation_space": {"a": 1}}, "observation_space: it is no space of Gymnasium"),
])  # fmt: skip
def test_what_cannot_be_expressed_is_one_line(changes, message, tmp_path):
    with pytest.raises(CheckpointError, match=message) as caught:
        load_zip(write(tmp_path, changed(PPO, changes)))
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_one_that_is_no_zip_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing"):
        load_zip(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match="not a complete zip file"):
        load_zip(write(tmp_path, b"PK"))
    with pytest.raises(CheckpointError, match="it is a zip file; rejeu import converts those of Stable-Baselines3"):
        rejeu.load(write(tmp_path, PPO))


CLOUDPICKLED = b"\x80\x02ccloudpickle.cloudpickle\n_make_skeleton_class\n."
"""How the pickle of a class that is defined in a script begins."""


@pytest.mark.parametrize(("content", "message"), [
    (zipped({"data": b"{}", "parameter_list": b"[]", "parameters": b""}), "it has data and parameters, as models of Stable B"),
    (pickle.dumps(({}, [np.zeros(2)])), "it is a pickle, .*VecNormalize.* models of Stable Baselines 2 .* train again with"),
    (changed(PPO, {"policy_kwargs": serialized(CLOUDPICKLED)}), "policy_kwargs: it holds a class .*your own, .*with equinox"),
    (changed(PPO, {"policy_class": serialized(b"\x80\x02cmine\nPolicy\n.")}), "it names mine.Policy, .*with equinox"),
], ids=["Stable Baselines 2", "VecNormalize", "own class", "own policy"])  # fmt: skip
def test_what_is_not_read_is_named_with_what_to_do(content, message, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        load_zip(write(tmp_path, content))


def test_a_pickle_in_the_place_of_a_model_file_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="it is a pickle, such as an old model of Stable Baselines 2"):
        algorithms.PPO.load(write(tmp_path, pickle.dumps({}), "model.pkl"))


def test_a_policy_class_of_another_program_is_noted(tmp_path):
    content = changed((FOLDER / "sac-sde.zip").read_bytes(), {"policy_class": serialized(CLOUDPICKLED)})
    (note,) = load_zip(write(tmp_path, content)).notes
    assert note.startswith("its policy class is not of Stable-Baselines3: it is read as SAC, and what that class adds")


def test_environments_of_other_spaces_are_refused():
    with pytest.raises(CheckpointError, match=r"its observation space is .* and the environment's is"):
        load_zip(FOLDER / "ppo-normalized.zip", env="Pendulum-v1")


def test_hyperparameters_are_those_of_the_file_and_can_be_replaced():
    agent = load_zip(FOLDER / "dqn-mlp.zip", gamma=0.5)
    assert (agent.config.gamma, agent.config.buffer_size, agent.config.learning_starts) == (0.5, 500, 50)
    her = load_zip(FOLDER / "sac-her.zip")
    assert her.config.replay_buffer_class == "HerReplayBuffer"
    assert her.config.hindsight.n_sampled_goal == 4


def test_recent_episodes_and_outputs_are_those_of_the_file(tmp_path):
    episodes = [{"r": np.float32(1.5), "l": 3, "t": 0.25}] * 5
    data = {"_stats_window_size": 4, "verbose": 1, "tensorboard_log": "logs"}
    data |= {"ep_info_buffer": serialized(deque(episodes, 4)), "ep_success_buffer": serialized(deque(["no"], 4))}
    path = write(tmp_path, changed(PPO, data))
    agent = algorithms.PPO.load(path)
    assert agent.ep_info_buffer == deque([{"r": 1.5, "l": 3, "t": 0.25}] * 4)
    assert not agent.ep_success_buffer
    assert (agent.stats_window_size, agent.verbose, agent.tensorboard_log) == (4, 1, "logs")
    agent = algorithms.PPO.load(path, verbose=0, tensorboard_log=None, stats_window_size=2)
    assert (agent.ep_info_buffer.maxlen, agent.verbose, agent.tensorboard_log) == (2, 0, None)
    assert load_zip(path).tensorboard_log is None


@exhaustive
def test_images_are_what_convolutions_read():
    leaf = spaces.leaves(gym.spaces.Box(0.0, 1.0, (1, 36, 36), np.float32))[0]
    weights = {"features_extractor.cnn.0.weight": np.zeros(1), "features_extractor.linear.0.bias": np.zeros(16)}
    features = [
        OriginalPolicy(one, (leaf,), [], gym.spaces.Discrete(2), False).n_features(leaf) for one in (weights, {})
    ]
    assert features == [16, 36 * 36]


def test_a_file_of_more_tensors_than_any_algorithm_has_is_refused(tmp_path):
    """Each may be a pickle that takes a tenth of a second."""
    more = {f"{i}.pth": torch_file({}) for i in range(20)}
    with pytest.raises(CheckpointError, match=r"it has \d+ files of tensors, expected at most 16"):
        load_zip(write(tmp_path, zipped({**members_of(PPO), **more})))


@pytest.mark.parametrize("end", only([80], [80, None]))
def test_hostile_files_end_soon_in_little_memory_and_run_nothing(end, tmp_path):
    """A sample of them."""
    ran = tmp_path / "ran"
    for name, content in islice(hostile_zips(PPO, 240, seed=0, ran=ran), 0, end, 7):
        path = write(tmp_path, content)
        tracemalloc.start()
        message = ""
        try:
            load_zip(path)
        except CheckpointError as error:
            message = str(error)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert "\n" not in message, name
        assert peak < 64 * 2**20, name
    assert not ran.exists()


def test_the_command_writes_a_model_file(tmp_path, capsys):
    for end in ("zip", "pkl"):
        shutil.copy(FOLDER / f"ppo-normalized.{end}", tmp_path)
    model = tmp_path / "ppo-normalized.zip"
    assert main(["import", str(model), "--vecnormalize", str(model.with_suffix(".pkl")), "--set", "gamma=0.9"]) == 0
    assert "PPO, 320 steps" in capsys.readouterr().out
    agent = rejeu.load(model.with_suffix(".safetensors"))
    assert agent.config.gamma == 0.9
    found = difference_from(agent, dict(np.load(FOLDER / "ppo-normalized.npz")))
    assert max(found.values()) < 1e-5
    assert main(["import", str(model)]) == 2
    assert "exists; name another file with --out" in capsys.readouterr().err
