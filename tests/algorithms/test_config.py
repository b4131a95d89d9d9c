"""Hyperparameters: what may be written, what is kept, and how mistakes are named."""

import dataclasses
import inspect
import json

import pytest

import rejeu
from rejeu.algorithms import config as configs
from rejeu.algorithms.catalog import CATALOG
from rejeu.algorithms.sac import Config
from rejeu.core import validation
from rejeu.core.errors import MissingObjectError
from rejeu.core.schedules import Linear
from rejeu.replay.hindsight import GoalSelectionStrategy, HindsightConfig


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("lr", "the step size is called learning_rate"),
        ("use_sde", r"is for PPO, A2C, TRPO, SAC and TQC"),
        ("features_extractor_class", r"policy_kwargs=dict\(torso"),
    ],
)
def test_a_setting_of_another_name_elsewhere_is_explained(name, hint):
    with pytest.raises(TypeError, match=f"TD3 has no setting '{name}'; .*{hint}"):
        rejeu.TD3("MlpPolicy", "Pendulum-v1", **{name: 1})


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"learning_rate": "lin_3e-4", "train_freq": (2, "episode"), "gradient_steps": -1},
        {"learning_rate": rejeu.Exponential(1e-3, 1e-4, 0.5), "ent_coef": 0.2, "target_entropy": -3},
        {"replay_buffer_class": rejeu.HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 2}},
        {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [9, 9]}, "activation_fn": "tanh", "layer_norm": True}},
        {"action_noise": rejeu.OrnsteinUhlenbeckActionNoise([0.0, 0.0], [0.1, 0.2], theta=0.3)},
        {"priorities": {"alpha": 0.5, "beta": Linear(0.1, 1.0)}, "n_steps": 3},
    ],
)
def test_a_config_survives_json(settings):
    config = Config(**settings)
    text = json.dumps(configs.to_json(config), allow_nan=False)
    again = validation.build(Config, json.loads(text))
    assert again == config
    assert hash(again) == hash(config)


def test_numbers_that_are_whole_may_be_written_as_floats():
    config = Config(buffer_size=1e6, learning_starts=1e2, train_freq=4.0)
    assert (config.buffer_size, config.learning_starts, config.train_freq) == (1_000_000, 100, 4)
    assert Config(train_freq=(4, "step")).train_freq == 4
    assert all(type(n) is int for n in (config.buffer_size, config.learning_starts, config.train_freq))


@pytest.mark.parametrize("given", [rejeu.HerReplayBuffer, "HerReplayBuffer"])
def test_a_replay_buffer_is_given_by_class_or_name(given):
    assert Config(replay_buffer_class=given).hindsight == HindsightConfig()
    assert Config(replay_buffer_class=given.replace("Her", "") if isinstance(given, str) else None).hindsight is None


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"batch_size": 0}, "batch_size=0 must be a whole number of at least 1"),
        ({"batch_size": 2.5}, "batch_size=2.5 must be a whole number"),
        ({"batch_size": True}, "batch_size=True must be a whole number"),
        ({"batch_size": "64"}, "batch_size='64' must be a whole number"),
        ({"tau": 1.1}, "tau=1.1 must be a finite number, at least 0 and at most 1"),
        ({"train_freq": (1, "epoch")}, r"train_freq=\(1, 'epoch'\) must be .* \(n, 'episode'\)"),
        ({"gradient_steps": -2}, "gradient_steps=-2 must be a whole number of at least -1"),
        (
            {"replay_buffer_class": "HerBuffer"},
            "replay_buffer_class='HerBuffer' must be one of ReplayBuffer",
        ),
        (
            {"replay_buffer_kwargs": {"n_sampled_goal": 4}},
            "does not apply to ReplayBuffer; did you forget replay_buffer_class=HerReplayBuffer",
        ),
    ],
)
def test_an_impossible_value_is_named_with_what_is_possible(settings, words):
    with pytest.raises(ValueError, match=words) as caught:
        Config(**settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"policy_kwargs": {"net_arc": [8]}}, "^policy_kwargs has no setting 'net_arc'; .*net_arch"),
        ({"policy_kwargs": [8]}, "policy_kwargs=.* must be a dict with the keys net_arch"),
        (
            {"replay_buffer_class": "HerReplayBuffer", "replay_buffer_kwargs": {"n_sampled_goals": 4}},
            "no setting 'n_sampled_goals'; did you mean n_sampled_goal",
        ),
        ({"learning_rate": lambda progress: float(progress)}, "learning_rate: the function must use jax.numpy"),
        ({"action_noise": [0.1]}, r"action_noise=\[0.1\] must be None, a standard deviation .* NormalActionNoise"),
    ],
)
def test_a_nested_mistake_is_named_with_its_place(settings, words):
    with pytest.raises(TypeError, match=words):
        Config(**settings)


def test_every_setting_is_documented_and_shown_by_help():
    docs = validation.field_docs(Config)
    assert list(docs) == validation.field_names(Config)
    assert all(text[0].isupper() or text.startswith("``") for text in docs.values())
    for name, text in docs.items():
        assert f"{name}: {text}" in rejeu.SAC.__doc__
    parameters = inspect.signature(rejeu.SAC).parameters
    assert set(docs) < set(parameters)
    assert parameters["gamma"].default == 0.99


def test_a_strategy_of_a_file_that_nobody_registered_is_named_with_the_way_to_give_it():
    saved = {"replay_buffer_class": "HerReplayBuffer", "replay_buffer_kwargs": {"goal_selection_strategy": "mine"}}
    with pytest.raises(MissingObjectError, match=r"goal_selection_strategy is your own, 'mine'.*--import MODULE"):
        configs.rebuild(Config, saved, {})
    for name in ("random", "future"):
        saved["replay_buffer_kwargs"]["goal_selection_strategy"] = name
        assert configs.rebuild(Config, saved, {}).replay_buffer_kwargs.goal_selection_strategy == name
    saved["replay_buffer_kwargs"]["goal_selection_strategy"] = {"future": 1, "mine": 1}
    with pytest.raises(MissingObjectError, match=r"goal_selection_strategy is your own, 'mine'.*--import MODULE"):
        configs.rebuild(Config, saved, {})


def test_a_mix_of_strategies_is_written_by_names_and_read_again():
    her = {"goal_selection_strategy": {"future": 2, GoalSelectionStrategy.DESIRED: 2}}
    config = Config(replay_buffer_class="HerReplayBuffer", replay_buffer_kwargs=her)
    saved = json.loads(json.dumps(configs.to_json(config)))
    assert saved["replay_buffer_kwargs"]["goal_selection_strategy"] == {"future": 2, "desired": 2}
    assert configs.rebuild(Config, saved, {}) == config
    assert hash(config.hindsight) == hash(configs.rebuild(Config, saved, {}).hindsight)


COUNTED = {"gradient_steps", "learning_starts", "policy_delay", "renorm_warmup_steps", "sde_sample_freq"}
COUNTED |= {"target_update_interval", "train_freq"}
"""Settings of which nothing is built."""
IN_MEMORY = {"batch_size", "buffer_size", "n_episodes", "n_steps"}
"""Those that the memory bounds, where it is reserved."""


def test_every_number_of_which_something_is_built_has_an_upper_limit():
    """So that no file asks for a network, a stack of frames or a loop without end."""
    kinds = [entry.load().Config for entry in CATALOG.values()]
    unlimited, limited = set(), set()
    for kind in {*kinds, *(one.policy_kwargs_class for one in kinds), HindsightConfig, configs.RndConfig}:
        for name in (one.name for one in dataclasses.fields(kind) if "int" in str(one.type)):
            try:
                kind(**{name: 10**9})
            except (TypeError, ValueError) as error:
                limited |= {name} if "at most" in str(error) else set()
            else:
                unlimited.add(name)
    assert unlimited == COUNTED | IN_MEMORY | {"n_sampled_goal"}  # which is a share
    assert limited >= validation.MOST.keys()


@pytest.mark.parametrize(
    "settings", [{"net_arch": [8] * 257}, {"qf": [2**21]}, {"state_layers": [8] * 257}, {"n_blocks": 257}]
)
def test_networks_have_limits_that_are_checked_before_they_are_built(settings):
    with pytest.raises(ValueError, match=r"at most|up to 1048576"):
        Config(policy_kwargs=settings)
