"""Trains small agents with Stable-Baselines3 and its Contrib package, and compares their outputs after rejeu has read them.

The two parts run in the environments of the two libraries::

    python trials/sb3_models.py make FOLDER            # with stable-baselines3 and sb3-contrib
    python trials/sb3_models.py compare FOLDER         # with rejeu

``small FOLDER NAME ...`` makes the files in ``tests/data/sb3``.

``make`` writes for each agent its zip file, the ``VecNormalize`` if it has one, and an npz file of 1,000 observations with the
deterministic actions, the values, and the log-probabilities of sampled actions. ``compare`` adds what it found to
``trials/results/sb3_models.json``.
"""

from __future__ import annotations

import sys
import time
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

N = 1000
STEPS = 300
RESULTS = Path(__file__).parent / "results" / "sb3_models.json"
"""What ``compare`` found: the largest differences of each algorithm, and of each version of Stable-Baselines3 and agent."""


def make_env(space_names: str) -> Any:
    """Returns an environment with random observations; the names of its spaces are ``observation/action``."""
    if sys.modules.get("stable_baselines3") and sys.modules["stable_baselines3"].__version__ < "2":
        import gym
    else:
        import gymnasium as gym
    spaces = gym.spaces
    floats = spaces.Box(-2.0, 2.0, (4,), np.float32)
    image = spaces.Box(0, 255, (36, 36, 2), np.uint8)
    observation = {
        "mlp": floats,
        "cnn": image,
        "dict": spaces.Dict({"b_image": image, "a_vector": floats, "c_choice": spaces.Discrete(3)}),
        "plain_dict": spaces.Dict(
            {"place": floats, "bits": spaces.MultiBinary(3), "kind": spaces.MultiDiscrete([2, 3])}
        ),
        "choice": spaces.Discrete(7),
        "goal": spaces.Dict(
            {key: spaces.Box(-2.0, 2.0, (2,), np.float32) for key in ("achieved_goal", "desired_goal", "observation")}
        ),
    }
    action = {
        "box": spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 5.0], np.float32)),
        "unit": spaces.Box(-1.0, 1.0, (2,), np.float32),
        "discrete": spaces.Discrete(4),
        "multi": spaces.MultiDiscrete([3, 2]),
        "bits": spaces.MultiBinary(3),
    }

    class Random(gym.Env):
        """Random observations; the reward is that of small actions."""

        def __init__(self) -> None:
            name, _, act = space_names.partition("/")
            self.observation_space, self.action_space = observation[name], action[act]
            self.t = 0

        def reset(self, seed: int | None = None, options: Any = None) -> Any:
            self.t = 0
            if gym.__name__ == "gym":
                return self.observation_space.sample()
            super().reset(seed=seed)
            return self.observation_space.sample(), {}

        def step(self, action: Any) -> Any:
            self.t += 1
            reward = -float(np.sum(np.square(action))) / 10
            if gym.__name__ == "gym":
                return self.observation_space.sample(), reward, self.t == 20, {}
            return self.observation_space.sample(), reward, False, self.t == 20, {}

        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return -np.linalg.norm(np.asarray(achieved) - np.asarray(desired), axis=-1)

        def action_masks(self) -> np.ndarray:
            n = {"discrete": 4, "multi": 5}.get(space_names.partition("/")[2], 3)
            mask = np.random.default_rng(self.t).random(n) < 0.6
            mask[[0, 3] if n == 5 else [0]] = True
            return mask

    return Random()


SMALL = {"net_arch": [16, 12]}
IMAGE = {**SMALL, "features_extractor_kwargs": {"features_dim": 16}}
DICT = {**SMALL, "features_extractor_kwargs": {"cnn_output_dim": 12}}
ROLLOUT = {"n_steps": 64}
REPLAY = {"learning_starts": 50, "buffer_size": 500, "batch_size": 32}
LSTM = {**SMALL, "lstm_hidden_size": 8}
AGENTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "dqn-mlp": ("DQN", "mlp/discrete", {**REPLAY, "policy_kwargs": SMALL}),
    "dqn-cnn": ("DQN", "cnn/discrete", {**REPLAY, "policy_kwargs": IMAGE}),
    "dqn-dict": ("DQN", "dict/discrete", {**REPLAY, "policy_kwargs": DICT}),
    "qrdqn-mlp": ("QRDQN", "mlp/discrete", {**REPLAY, "policy_kwargs": {**SMALL, "n_quantiles": 7}}),
    "qrdqn-cnn": ("QRDQN", "cnn/discrete", {**REPLAY, "policy_kwargs": {**IMAGE, "n_quantiles": 5}}),
    "ppo-mlp": ("PPO", "mlp/discrete", {**ROLLOUT, "policy_kwargs": {"net_arch": {"pi": [16], "vf": [12, 8]}}}),
    "ppo-box": ("PPO", "mlp/box", {**ROLLOUT, "policy_kwargs": SMALL}),
    "ppo-normalized": ("PPO", "mlp/box", {**ROLLOUT, "policy_kwargs": SMALL, "normalize": True}),
    "ppo-relu": ("PPO", "plain_dict/box", {**ROLLOUT, "policy_kwargs": {**SMALL, "activation_fn": "ReLU"}}),
    "ppo-cnn": ("PPO", "cnn/discrete", {**ROLLOUT, "policy_kwargs": IMAGE}),
    "ppo-cnn-apart": ("PPO", "cnn/box", {**ROLLOUT, "policy_kwargs": {**IMAGE, "share_features_extractor": False}}),
    "ppo-cnn-default": ("PPO", "cnn/discrete", ROLLOUT),
    "ppo-dict": ("PPO", "dict/box", {**ROLLOUT, "policy_kwargs": DICT}),
    "ppo-choice": ("PPO", "choice/discrete", {**ROLLOUT, "policy_kwargs": SMALL}),
    "ppo-multi": ("PPO", "mlp/multi", {**ROLLOUT, "policy_kwargs": SMALL}),
    "ppo-bits": ("PPO", "mlp/bits", {**ROLLOUT, "policy_kwargs": SMALL}),
    "ppo-sde": ("PPO", "mlp/box", {**ROLLOUT, "policy_kwargs": SMALL, "use_sde": True}),
    "ppo-sde-squashed": (
        "PPO",
        "mlp/box",
        {**ROLLOUT, "policy_kwargs": {**SMALL, "squash_output": True}, "use_sde": True},
    ),
    "a2c-mlp": ("A2C", "mlp/discrete", {"policy_kwargs": SMALL}),
    "a2c-adam": ("A2C", "mlp/box", {"policy_kwargs": SMALL, "use_rms_prop": False}),
    "a2c-cnn": ("A2C", "cnn/discrete", {"policy_kwargs": IMAGE}),
    "a2c-sde": ("A2C", "mlp/box", {"policy_kwargs": SMALL, "use_sde": True}),
    "trpo-mlp": ("TRPO", "mlp/box", {**ROLLOUT, "policy_kwargs": SMALL}),
    "trpo-cnn": ("TRPO", "cnn/discrete", {**ROLLOUT, "policy_kwargs": IMAGE}),
    "trpo-dict": ("TRPO", "dict/discrete", {**ROLLOUT, "policy_kwargs": DICT}),
    "trpo-sde": ("TRPO", "mlp/box", {**ROLLOUT, "policy_kwargs": SMALL, "use_sde": True}),
    "sac-mlp": ("SAC", "mlp/box", {**REPLAY, "policy_kwargs": SMALL}),
    "sac-cnn": ("SAC", "cnn/box", {**REPLAY, "policy_kwargs": IMAGE}),
    "sac-normalized": ("SAC", "mlp/box", {**REPLAY, "policy_kwargs": SMALL, "normalize": True, "ent_coef": "auto_0.1"}),
    "sac-her": ("SAC", "goal/box", {**REPLAY, "policy_kwargs": SMALL, "replay_buffer_class": "HerReplayBuffer"}),
    "sac-sde": ("SAC", "mlp/box", {**REPLAY, "policy_kwargs": SMALL, "use_sde": True}),
    "td3-mlp": ("TD3", "mlp/box", {**REPLAY, "policy_kwargs": {"net_arch": {"pi": [16], "qf": [12, 8]}}}),
    "td3-dict": ("TD3", "dict/box", {**REPLAY, "policy_kwargs": DICT}),
    "ddpg-mlp": ("DDPG", "mlp/box", {**REPLAY, "policy_kwargs": SMALL}),
    "tqc-mlp": ("TQC", "mlp/box", {**REPLAY, "policy_kwargs": {**SMALL, "n_quantiles": 5}}),
    "tqc-dict": ("TQC", "plain_dict/box", {**REPLAY, "policy_kwargs": {**SMALL, "n_critics": 3, "n_quantiles": 4}}),
    "crossq-mlp": ("CrossQ", "mlp/box", {**REPLAY, "policy_kwargs": SMALL}),
    "crossq-unit": ("CrossQ", "mlp/unit", {**REPLAY, "policy_kwargs": SMALL}),
    "recurrent-mlp": ("RecurrentPPO", "mlp/discrete", {**ROLLOUT, "policy_kwargs": LSTM}),
    "recurrent-dict": ("RecurrentPPO", "goal/box", {**ROLLOUT, "policy_kwargs": LSTM}),
    "recurrent-shared": (
        "RecurrentPPO",
        "mlp/discrete",
        {**ROLLOUT, "policy_kwargs": {**LSTM, "shared_lstm": True, "enable_critic_lstm": False}},
    ),
    "recurrent-cnn": (
        "RecurrentPPO",
        "cnn/discrete",
        {**ROLLOUT, "policy_kwargs": {**LSTM, "features_extractor_kwargs": {"features_dim": 16}}},
    ),
    "maskable-mlp": ("MaskablePPO", "mlp/discrete", {**ROLLOUT, "policy_kwargs": SMALL}),
    "maskable-multi": ("MaskablePPO", "mlp/multi", {**ROLLOUT, "policy_kwargs": SMALL}),
    "maskable-dict": ("MaskablePPO", "dict/discrete", {**ROLLOUT, "policy_kwargs": DICT}),
}


def make(folder: Path, only: tuple[str, ...]) -> None:
    """Trains the agents and records their actions and values."""
    import stable_baselines3
    import torch

    print("stable-baselines3", stable_baselines3.__version__)
    folder.mkdir(parents=True, exist_ok=True)
    for name, (algorithm, space_names, settings) in AGENTS.items():
        if only and name not in only:
            continue
        np.random.seed(0)  # noqa: NPY002 - of the spaces of old versions
        torch.manual_seed(0)
        try:
            make_one(folder / name, algorithm, space_names, dict(settings))
        except (AttributeError, ImportError, TypeError, ValueError, AssertionError) as error:
            print(name, "is not possible in this version:", str(error)[:100])


def make_one(path: Path, algorithm: str, space_names: str, settings: dict[str, Any]) -> None:
    """Trains one agent and writes its files."""
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    module = "stable_baselines3" if algorithm in ("DQN", "PPO", "A2C", "SAC", "TD3", "DDPG") else "sb3_contrib"
    cls = getattr(__import__(module), algorithm)
    shape = dict(settings.pop("policy_kwargs", {}))
    if "activation_fn" in shape:
        shape["activation_fn"] = getattr(torch.nn, shape["activation_fn"])
    if settings.get("replay_buffer_class"):
        from stable_baselines3 import HerReplayBuffer

        settings["replay_buffer_class"] = HerReplayBuffer
    env: Any = DummyVecEnv([lambda: make_env(space_names)])
    if settings.pop("normalize", False):
        env = VecNormalize(env, clip_obs=5.0)
    names = {"cnn": "CnnPolicy", "mlp": "MlpPolicy", "choice": "MlpPolicy"}
    policy = names.get(space_names.partition("/")[0], "MultiInputPolicy")
    if algorithm == "RecurrentPPO":
        policy = policy.replace("Policy", "LstmPolicy")
    model = cls(policy, env, policy_kwargs=shape, device="cpu", seed=0, **settings)
    model.learn(STEPS)
    model.save(str(path))
    if isinstance(env, VecNormalize):
        env.save(f"{path}.pkl")
    record = recorded(model, algorithm, space_names, env if isinstance(env, VecNormalize) else None)
    if algorithm in ("DQN", "DDPG"):
        record |= updated(model)
    np.savez_compressed(f"{path}.npz", **record)
    print(path.name, "written")


def recorded(model: Any, algorithm: str, space_names: str, scaler: Any) -> dict[str, np.ndarray]:
    """Returns observations with the actions, values and log-probabilities of the agent."""
    import torch

    space = make_env(space_names).observation_space
    space.seed(1)
    samples = [space.sample() for _ in range(N)]
    flat = isinstance(samples[0], dict)
    obs = {key: np.stack([sample[key] for sample in samples]) for key in samples[0]} if flat else np.stack(samples)
    policy_obs = obs if scaler is None else scaler.normalize_obs(obs)
    if flat:
        policy_obs = {key: x.transpose(0, 3, 1, 2) if x.ndim == 4 else x for key, x in policy_obs.items()}
    elif policy_obs.ndim == 4:
        policy_obs = policy_obs.transpose(0, 3, 1, 2)
    result = {f"obs.{key}": value for key, value in obs.items()} if flat else {"obs": obs}
    policy = model.policy
    policy.set_training_mode(False)
    tensor = policy.obs_to_tensor(policy_obs)[0]
    row_of = lambda i: {key: x[i : i + 1] for key, x in policy_obs.items()} if flat else policy_obs[i : i + 1]  # noqa: E731
    with torch.no_grad():
        if algorithm == "RecurrentPPO":
            starts = np.arange(N) % 50 == 0
            state, actions, values, log_probs, sampled = None, [], [], [], []
            for i in range(N):
                begin = torch.as_tensor(starts[i : i + 1]).float()
                now = policy.obs_to_tensor(row_of(i))[0]
                memory = policy_memory(policy, state)
                distribution, _ = policy.get_distribution(now, memory[0], begin)
                value = policy.predict_values(now, memory[1], begin)
                _, _, _, both = policy.forward(now, RNN(memory), begin)
                action = distribution.sample()
                actions.append(distribution.get_actions(deterministic=True).numpy())
                sampled.append(action.numpy())
                log_probs.append(distribution.log_prob(action).numpy())
                values.append(value.numpy().ravel())
                state = both
            result |= {"starts": starts, "actions": np.concatenate(actions), "values": np.concatenate(values)}
            return result | {"sampled": np.concatenate(sampled), "log_probs": np.concatenate(log_probs)}
        masks = None
        if algorithm == "MaskablePPO":
            rng = np.random.default_rng(2)
            masks = rng.random((N, 4 if "discrete" in space_names else 5)) < 0.6
            masks[:, [0] if "discrete" in space_names else [0, 3]] = True
            result["masks"] = masks
        extra = {} if masks is None else {"action_masks": masks}
        result["actions"] = model.predict(policy_obs, deterministic=True, **extra)[0]
        if algorithm in ("PPO", "A2C", "TRPO", "MaskablePPO"):
            if model.use_sde:
                policy.reset_noise(N)
            distribution = policy.get_distribution(tensor, **extra)
            result |= drawn(distribution, bool(getattr(policy, "squash_output", False)))
            result["values"] = policy.predict_values(tensor).numpy().ravel()
        elif algorithm in ("DQN", "QRDQN"):
            values = model.q_net(tensor) if algorithm == "DQN" else model.quantile_net(tensor).mean(dim=1)
            result["values"] = values.numpy()
        else:
            action = torch.as_tensor(policy.scale_action(result["actions"]))
            values = model.critic(tensor, action)
            result["values"] = (
                np.stack([q.numpy().mean(axis=-1) for q in values])
                if algorithm != "TQC"
                else (values.numpy().mean(axis=-1).T)
            )
            if hasattr(model.actor, "log_std"):
                if model.use_sde:
                    model.actor.reset_noise(N)
                mean, log_std, more = model.actor.get_action_dist_params(tensor)
                result |= drawn(model.actor.action_dist.proba_distribution(mean, log_std, **more), True)
    return result


def updated(model: Any) -> dict[str, np.ndarray]:
    """Returns a batch, and the weights after one more gradient step on it; no random numbers enter into the step."""
    batch = model.replay_buffer.sample(32)
    model.replay_buffer.sample = lambda *_, **__: batch
    model.train(gradient_steps=1, batch_size=32)
    names = {"obs": batch.observations, "action": batch.actions, "next_obs": batch.next_observations}
    names |= {"reward": batch.rewards, "done": batch.dones}
    after = {f"after.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    return {f"batch.{key}": value.numpy() for key, value in names.items()} | after


def drawn(distribution: Any, squashes: bool) -> dict[str, np.ndarray]:
    """Returns sampled actions and their log-probabilities; of squashed ones both before the tanh.

    The tanh adds a term in which Stable-Baselines3 has 1e-6 against infinities, and rejeu an exact form.
    """
    if not squashes:
        action = distribution.sample()
        return {"sampled": action.numpy(), "log_probs": distribution.log_prob(action).numpy()}
    normal = distribution.distribution
    action = normal.sample()
    return {"sampled": action.numpy(), "log_probs": normal.log_prob(action).sum(dim=-1).numpy()}


def policy_memory(policy: Any, state: Any) -> Any:
    """Returns the memory of a recurrent policy and of its value."""
    import torch

    zeros = lambda: torch.zeros(policy.lstm_hidden_state_shape[0], 1, policy.lstm_hidden_state_shape[2])  # noqa: E731
    return ((zeros(), zeros()), (zeros(), zeros())) if state is None else (state.pi, state.vf)


def RNN(memory: Any) -> Any:  # noqa: N802
    """Returns the memory in the form of sb3-contrib."""
    from sb3_contrib.common.recurrent.type_aliases import RNNStates

    return RNNStates(*memory)


def compare(folder: Path, only: tuple[str, ...]) -> None:
    """Prints the largest differences of each agent, and adds them to ``RESULTS``."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from provenance import provenance, read, write

    from tests.sb3_models import difference_from, loaded

    print(f"{'agent':20} {'actions':>9} {'values':>9} {'log-probs':>9}  optimizer, notes")
    worst, refused = 0.0, 0
    results = read(RESULTS).get("agents", {})
    for path in sorted(folder.glob("*.npz")):
        if only and path.stem not in only:
            continue
        began = time.perf_counter()
        with zipfile.ZipFile(path.with_suffix(".zip")) as archive:
            version = archive.read("_stable_baselines3_version").decode()
        result = results.setdefault(version, {})
        try:
            agent = loaded(path.with_suffix(""))
            differences = difference_from(agent, dict(np.load(path)))
        except ValueError as error:
            refused += 1
            result[path.stem] = {"refused": str(error).rpartition("Stable-Baselines3: ")[2]}
            print(f"{path.stem:20} refused: {error}")
            continue
        worst = max(worst, *differences.values())
        result[path.stem] = {key: float(f"{value:.1e}") for key, value in differences.items()} | {"notes": agent.notes}
        shown = " ".join(f"{differences.get(key, float('nan')):9.1e}" for key in ("actions", "values", "log_probs"))
        steps = f"{agent.num_timesteps} steps, {agent.n_updates} updates"
        print(
            f"{path.stem:20} {shown}  {steps}, {time.perf_counter() - began:.1f} s; {'; '.join(agent.notes)}",
            flush=True,
        )
    largest = {"largest": by_algorithm(results), "agents": results}
    write(RESULTS, provenance({str(folder): "FOLDER"}) | largest)
    print(f"largest difference {worst:.1e}, {refused} refused")


def by_algorithm(results: dict[str, Any]) -> dict[str, Any]:
    """Returns the number of files of each algorithm, and the largest differences among them."""
    largest: dict[str, Any] = {}
    for agents in results.values():
        for name, differences in agents.items():
            row = largest.setdefault(AGENTS[name][0], {"files": 0, "actions": 0.0, "values": 0.0})
            row["files"] += 1
            for key in differences.keys() & {"actions", "values", "log_probs"}:
                row[key] = max(row.get(key, 0.0), differences[key])
    return largest


def small(folder: Path, only: tuple[str, ...]) -> None:
    """Makes the files of the tests: fewer observations, and zip files whose members are compressed."""
    global N
    N = 100
    make(folder, only)
    for path in folder.glob("*.zip"):
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members.items():
                archive.writestr(name, content)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    command, folder, *names = sys.argv[1:]
    {"make": make, "small": small, "compare": compare}[command](Path(folder), tuple(names))
