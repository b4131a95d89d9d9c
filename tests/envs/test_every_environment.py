"""What ``check`` approves of trains, is saved and goes on, in this process and in workers."""

import contextlib
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces, wrappers

import rejeu
from rejeu.envs.checker import findings
from rejeu.envs.make import make_vector
from tests import bad_environments, jax_environments
from tests.bit_flipping import BitFlipping
from tests.environments import Counter, Reach, Sampled
from tests.tiers import only
from tests.worker_environments import DrawsGlobally, Paced

pytestmark = [
    pytest.mark.usefixtures("learners_are_shared"),
    pytest.mark.filterwarnings("ignore::UserWarning"),  # of check, and of Gymnasium's wrappers
]
Box = spaces.Box
SEEN = {
    "int8": Box(-5, 5, (3,), np.int8),
    "uint8": Box(0, 255, (3,), np.uint8),
    "float16": Box(-1, 1, (3,), np.float16),
    "bool": Box(0, 1, (3,), np.bool_),
    "uint64": Box(0, 9, (3,), np.uint64),
    "number": Box(-1, 1, (), np.float32),
    "image": Box(0, 255, (12, 12, 3), np.uint8),
    "images": Box(0, 255, (2, 12, 12, 1), np.uint8),
    "bits": spaces.MultiBinary([2, 3]),
    "choice": spaces.Discrete(4, start=5),
    "choices": spaces.MultiDiscrete([[2, 3], [4, 5]]),
    "tuple": spaces.Tuple([spaces.Discrete(3), Box(-1, 1, (2,), np.float32)]),
    "dict": spaces.Dict({"a b": spaces.Discrete(3), "a.b": Box(-1, 1, (2,), np.float32)}),
    "part that holds nothing": spaces.Dict({"a": Box(-1, 1, (0,), np.float32), "b": spaces.Discrete(2)}),
}
DONE = {
    "one": spaces.Discrete(1),
    "matrix": Box(-1, 1, (2, 2), np.float32),
    "number": Box(-1, 1, (), np.float32),
    "float64": Box(-2, 3, (2,), np.float64),
    "half": Box(-1, 1, (2,), np.float16),
    "one-sided": Box(0, np.inf, (1,), np.float32),
    "tuple": spaces.Tuple([spaces.Discrete(2), Box(-1, 1, (1,), np.float32)]),
    "nested": spaces.Dict({"a": spaces.Tuple([spaces.MultiBinary(2)])}),
}
NO_AGENT = {
    "nothing to see": Sampled(Box(-1, 1, (0,), np.float32)),
    "text": Sampled(spaces.Text(3)),
    "sequence": Sampled(spaces.Sequence(spaces.Discrete(2))),
    "graph": Sampled(spaces.Graph(Box(-1, 1, (2,)), None)),
    "one of": Sampled(spaces.OneOf([spaces.Discrete(2), spaces.Discrete(3)])),
    "equal bounds": Sampled(SEEN["number"], Box(np.float32([-1, 0]), np.float32([1, 0]))),
    "nothing to choose": Sampled(SEEN["number"], Box(-1, 1, (0,), np.float32)),
    "whole numbers in a dict": Sampled(SEEN["number"], spaces.Dict({"a": Box(0, 3, (2,), np.int32)})),
    "text to choose": Sampled(SEEN["number"], spaces.Text(3)),
}
SMALL = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}, "seed": 0}


def wrapped(wrapper, **settings):
    return wrapper(gym.make("CartPole-v1"), **settings)


MAKES = {
    **{f"sees {name}": partial(Sampled, space) for name, space in SEEN.items()},
    **{f"does {name}": partial(Sampled, SEEN["choice"], space) for name, space in DONE.items()},
    **{name: fault.make for name, fault in bad_environments.EVERY.items() if fault.trained is None},
    **{one.__name__: one for one in (Counter, Reach, BitFlipping, Paced, DrawsGlobally, bad_environments.Good)},
    "statistics": partial(wrapped, wrappers.RecordEpisodeStatistics),
    "sticky": partial(wrapped, wrappers.StickyAction, repeat_action_probability=0.3),
    "time": partial(wrapped, wrappers.TimeAwareObservation, flatten=False),
    "delay": partial(wrapped, wrappers.DelayObservation, delay=2),
    "scaled": partial(wrapped, wrappers.NormalizeReward),
    "stacked": partial(wrapped, wrappers.FrameStackObservation, stack_size=3),
}
DEFAULT = {"sees tuple"}


def train_save_and_go_on(vector, tmp_path, kind=rejeu.PPO):
    """Trains an agent, saves it, and trains the loaded one in the same environments."""
    is_nested = isinstance(vector.observation_space, spaces.Dict | spaces.Tuple)
    agent = kind("MultiInputPolicy" if is_nested else "MlpPolicy", vector, **SMALL).learn(16)
    loaded = kind.load(agent.save(tmp_path / "agent"))
    loaded.set_env(vector)
    assert loaded.learn(16, reset_num_timesteps=False).num_timesteps == 32
    assert all(np.isfinite(value).all() for value in loaded.get_parameters().values())


@pytest.mark.parametrize("name", only(DEFAULT, MAKES))
def test_what_is_approved_of_trains_is_saved_and_goes_on(name, tmp_path):
    make, fault = MAKES[name], bad_environments.EVERY.get(name)
    is_approved = not [one for one in findings(make()) if one.level == "error"]
    assert is_approved == (fault is None or fault.level == "warning")
    for backend in ("gymnasium", "gymnasium-async"):
        with contextlib.closing(make_vector(make, 2, backend)) as vector:
            train_save_and_go_on(vector, tmp_path)


@pytest.mark.parametrize("env", [pytest.param(env, id=name) for name, env in NO_AGENT.items()])
def test_what_no_agent_trains_in_is_an_error_of_the_check(env):
    assert [one for one in findings(env) if one.level == "error"]
    with pytest.raises((TypeError, ValueError), match=r"expected|needs|holds nothing|low < high|to choose|describe"):
        rejeu.PPO("MlpPolicy", env, **SMALL)


@pytest.mark.parametrize("env", only((), [jax_environments.Reach(), jax_environments.Reach(stops=True)]))
def test_environments_in_jax_train_are_saved_and_go_on(env, tmp_path):
    train_save_and_go_on(make_vector(env, 2), tmp_path)
