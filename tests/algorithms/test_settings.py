"""Settings of every algorithm: their defaults, and what is refused. What all share is tested in ``test_config.py``."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.agents import AGENTS

OBSERVATIONS = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
OFF_POLICY = {
    "buffer_size": 1_000_000,
    "learning_starts": 100,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "action_noise": None,
    "n_steps": 1,
}
ON_POLICY = {"gamma": 0.99, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5}
SAC = {"learning_rate": 3e-4, "ent_coef": "auto", "target_update_interval": 1, "target_entropy": "auto"}
THEIRS = {
    "SAC": OFF_POLICY | SAC,
    "TQC": OFF_POLICY | SAC | {"n_quantiles": 25, "top_quantiles_to_drop_per_net": 2, "n_critics": 2},
    "CrossQ": {key: value for key, value in OFF_POLICY.items() if key != "tau"}
    | {"learning_rate": 1e-3, "policy_delay": 3, "renorm_warmup_steps": 100_000, "n_critics": 2, "ent_coef": "auto"},
    "DDPG": OFF_POLICY | {"learning_rate": 1e-3},
    "TD3": OFF_POLICY
    | {"learning_rate": 1e-3, "policy_delay": 2, "target_policy_noise": 0.2, "target_noise_clip": 0.5},
    "PPO": ON_POLICY
    | {"learning_rate": 3e-4, "n_steps": 2048, "batch_size": 64, "n_epochs": 10, "gae_lambda": 0.95, "clip_range": 0.2}
    | {"clip_range_vf": None, "normalize_advantage": True, "target_kl": None},
    "A2C": ON_POLICY
    | {"learning_rate": 7e-4, "n_steps": 5, "gae_lambda": 1.0, "use_rms_prop": True, "rms_prop_eps": 1e-5}
    | {"normalize_advantage": False},
}
"""The signatures of Stable-Baselines3 2.9.2 and its contributions, where rejeu has the parameter."""


@pytest.mark.parametrize("name", THEIRS)
def test_the_defaults_are_those_of_stable_baselines3(name):
    config = AGENTS[name].algorithm.Config()
    assert {key: getattr(config, key) for key in THEIRS[name]} == THEIRS[name]


SHARED = {"share_layers": True}
OWN_RATE = {"critic_learning_rate": 1e-3, "policy_kwargs": SHARED}
OWN_RATE_MESSAGE = "critic_learning_rate is a learning rate of its own for the value, which share_layers=True forbids"
REFUSED = [
    *(
        ("SAC", {"ent_coef": v}, "ent_coef")
        for v in ("automatic", "auto_x", "auto_-1", "auto_nan", 0, -0.1, True, None)
    ),
    ("CrossQ", {"policy_kwargs": {"layer_norm": True}}, "take net_arch and activation_fn, not layer_norm"),
    ("TQC", {"n_quantiles": 2, "top_quantiles_to_drop_per_net": 2}, "would leave nothing of n_quantiles=2"),
    ("DQN", {"exploration_schedule": "exponential", "exploration_final_eps": 0}, "not possible with an exponential"),
    ("DQN", {"action_noise": rejeu.NormalActionNoise([0.0], [0.1])}, "does not apply to Discrete actions"),
    ("PQN", {"policy_kwargs": {"architecture": "simba", "layer_norm": True}}, "conflicts with layer_norm"),
    ("A2C", OWN_RATE, OWN_RATE_MESSAGE),
    ("PPO", {"learning_rate": rejeu.Linear(1e-3, -1e-3)}, r"learning_rate=Linear\(.* must not fall below 0"),
    ("PPO", {"policy_kwargs": {"ortho": True}}, "ortho.*ortho_init"),
    ("PPO", {"policy_kwargs": {"net_arch": {"pi": [8], "v": [8]}}}, r"unknown keys \['v'\]; expected 'pi' and "),
    ("PPO", {"policy_kwargs": {"state_dependent_std": True, "learn_std": False}}, "conflicts with learn_std=False"),
    ("PPO", {"policy_kwargs": SHARED | {"share_features_extractor": False}}, "share_layers=True conflicts with share"),
    ("PPO", {"policy_kwargs": SHARED | {"net_arch": {"pi": [32], "vf": [64, 64]}}}, r"conflicts with vf=\[64, 64\]"),
    ("PPO", {"policy_kwargs": SHARED | {"vf": [32]}}, r"the policy's widths \[64, 64\], and conflicts with vf=\[32\]"),
    ("PPO", {"policy_kwargs": SHARED | {"actor_layers": [8], "critic_layers": [4]}}, r"with critic_layers=\[4\]"),
    ("RecurrentPPO", {"use_sde": True}, "state-dependent noise is not available for policies with memory"),
    ("RecurrentPPO", {"n_episodes": 1}, "give n_steps and leave it out"),
    ("RecurrentPPO", {"critic_learning_rate": 1e-3}, "leave it out"),
    ("RecurrentPPO", {"policy_kwargs": {"cell": "rnn"}}, "must be one of lstm, gru"),
    ("RecurrentPPO", {"policy_kwargs": SHARED}, "needs shared_lstm=True"),
    ("RecurrentPPO", {"policy_kwargs": {"shared_lstm": True, "share_features_extractor": False}}, "leave out one"),
    ("RecurrentPPO", {"policy_kwargs": {"lstm_size": 4}}, "lstm_hidden_size"),
]


@pytest.mark.parametrize(("name", "settings", "message"), REFUSED)
def test_an_impossible_setting_is_refused_in_one_line(name, settings, message):
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        AGENTS[name].algorithm.Config(**settings)
    assert "\n" not in str(caught.value)


WRONG = object(), float("nan"), -1e30
NEGATIVE = (
    "target_entropy",
    "log_std_init",
    "sde_log_std_init",
    "munchausen_clip",
    "v_min",
    "v_max",
    "alive_bonus_offset",
)
"""Settings that take any finite number, which may be below 0."""
ALIASES = {"rnd": "(rnd|coefficient)", "action_noise": "(action_noise|sigma)", "vf": "(vf|qf)"}
"""What errors may name instead: a nested setting, or the critic's widths."""


@pytest.mark.parametrize("name", AGENTS)
def test_every_setting_refuses_by_its_name_in_one_line_what_is_none_of_its_values(name):
    config = AGENTS[name].algorithm.Config
    shape = type(config().policy_kwargs)
    makers = {field.name: lambda **given: config(policy_kwargs=given) for field in dataclasses.fields(shape)}
    makers |= dict.fromkeys((field.name for field in dataclasses.fields(config)), config)
    for key, make in makers.items():
        for value in WRONG[: 2 if key in NEGATIVE else 3]:
            with pytest.raises((ValueError, TypeError), match=rf"^[^\n]*{ALIASES.get(key, key)}[^\n]*$"):
                make(**{key: value})


BOX, DISCRETE = gym.spaces.Box(-1.0, 1.0, (2,), np.float32), gym.spaces.Discrete(3)
WITHOUT_BOUNDS = gym.spaces.Box(-np.inf, np.inf, (2,))
UNFIT = [
    ("TD3", DISCRETE, "TD3 needs a Box action space, got Discrete.*use DQN"),
    ("TD3", gym.spaces.MultiBinary(3), "TD3 needs a Box action space, got MultiBinary.*ActionWrapper"),
    ("TD3", gym.spaces.Box(0.0, np.inf, (2,)), "TD3 needs finite action bounds, got .*RescaleAction"),
    ("DDPG", gym.spaces.MultiDiscrete([2, 2]), "DDPG needs a Box action space, got MultiDiscrete.*ActionWrapper"),
    ("DDPG", WITHOUT_BOUNDS, "DDPG needs finite action bounds, got .*RescaleAction"),
    ("DDPG", gym.spaces.Box(-np.inf, np.inf, (2, 2)), "DDPG needs finite action bounds, got .*RescaleAction"),
    ("DDPG", gym.spaces.Box(1.0, 1.0, (2,)), "every action bound must satisfy low < high"),
    ("CrossQ", DISCRETE, "CrossQ needs a Box action space"),
    ("TQC", DISCRETE, "TQC needs a Box action space"),
    ("DQN", BOX, "DQN needs a Discrete action space, got .*SAC or TD3"),
    ("DQN", gym.spaces.MultiDiscrete([2, 2]), "DQN needs a Discrete action space, got .*ActionWrapper"),
    ("QRDQN", BOX, "QRDQN needs a Discrete action space, got Box.*; for this environment use SAC"),
    ("PQN", BOX, "PQN needs a Discrete action space, got Box.*; for this environment use SAC"),
    ("PPO", gym.spaces.Box(0, 3, (2,), np.int32), "PPO needs Box actions of floats, got .* use MultiDiscrete"),
    ("PPO", gym.spaces.Box(1.0, 1.0, (2,), np.float32), r"must satisfy low < high, got low=\[1.0, 1.0\]"),
    ("PPO", gym.spaces.Dict({"a": gym.spaces.Text(2)}), "PPO needs a Box, .* got Text.*ActionWrapper"),
    ("PPO", gym.spaces.Tuple([gym.spaces.Text(2)]), "PPO needs a Box, .* got Text.*ActionWrapper"),
    ("A2C", gym.spaces.Text(2), "A2C needs a Box, .* got Text.*ActionWrapper"),
]


@pytest.mark.parametrize(("name", "space", "message"), UNFIT)
def test_an_action_space_that_does_not_fit_is_refused_in_one_line(name, space, message):
    algorithm = AGENTS[name].algorithm
    with pytest.raises(ValueError, match=message) as caught:
        algorithm.make(algorithm.Config(), OBSERVATIONS, space)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "setting", "message"),
    [
        ("DDPG", "policy_delay", "DDPG has no setting 'policy_delay'"),
        ("DDPG", "learning_rte", "DDPG has no setting 'learning_rte'; did you mean learning_rate"),
        ("PPO", "n_epoch", "n_epoch.*n_epochs"),
        ("CrossQ", "tau", "CrossQ has no setting 'tau'"),
        *(("PQN", key, f"PQN has no setting '{key}'") for key in ("gae_lambda", "ent_coef", "use_sde", "tau")),
    ],
)
def test_a_setting_that_an_algorithm_does_not_have_is_named(name, setting, message):
    with pytest.raises(TypeError, match=message):
        AGENTS[name]("MlpPolicy", "CartPole-v1", **{setting: 0.5})
