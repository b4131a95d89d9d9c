"""One update of every algorithm that rejeu shares with Stable-Baselines3 and its Contrib package, against the original.

Hindsight, n-step returns and running statistics are compared too, and prioritized replay with a reference in NumPy.

The two parts run in the environments of the two libraries::

    python trials/verify.py record FOLDER             # with stable-baselines3 and sb3-contrib
    python trials/verify.py compare FOLDER            # with rejeu

``record`` makes a small model of each algorithm, moves its targets away from its networks, and lets it learn three times: from
three batches, or from three rollouts in a made-up environment. It writes the zip files before, after the first and after the
third update, and an npz file of the batches or rollouts, the losses and the noise that was drawn. The library is unchanged
except for the source of this noise and of the order of minibatches, and that CrossQ takes the biased variance of a batch.

``compare`` reads the first zip file, takes the same updates from the same numbers, and reads the other zip files as well.
Since optimizers are read too, the gradient of the first update is compared by Adam's first moment. It prints the largest
differences and writes them to ``trials/results/verify.json``, from which the page "How we check" has its table.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np

RESULTS = Path(__file__).parent / "results" / "verify.json"
OBS, ACTIONS, CHOICES, BATCH, STEPS, ENVS, UPDATES = 3, 2, 4, 16, 16, 2, 3
ALPHA = {"ent_coef": "auto_0.3"}
OFF: dict[str, dict[str, Any]] = {
    "DQN": {"target_update_interval": 1000, "max_grad_norm": 0.1},
    "QRDQN": {"target_update_interval": 1000, "max_grad_norm": 0.1},
    "SAC": {"tau": 0.1, **ALPHA},
    "TD3": {"tau": 0.1, "policy_delay": 2},
    "DDPG": {"tau": 0.1},
    "TQC": {"tau": 0.1, "top_quantiles_to_drop_per_net": 2, **ALPHA},
    "CrossQ": {"policy_delay": 1, **ALPHA},
}
WHOLE = {"n_steps": STEPS, "normalize_advantage": False, "gae_lambda": 0.9}
JOINT = {**WHOLE, "batch_size": STEPS * ENVS, "ent_coef": 0.02}
ON: dict[str, dict[str, Any]] = {
    "PPO": {**JOINT, "n_epochs": 3, "clip_range": 0.1},
    "PPO, Discrete": {**JOINT, "n_epochs": 3, "clip_range_vf": 0.1},
    "A2C": {**WHOLE, "ent_coef": 0.02, "use_rms_prop": False},
    "RecurrentPPO": {**JOINT, "n_epochs": 2},
    "MaskablePPO": {**JOINT, "n_epochs": 3},
    "TRPO": {**WHOLE, "batch_size": STEPS * ENVS, "n_critic_updates": 2},
    "TRPO, Discrete": {**WHOLE, "batch_size": STEPS * ENVS, "n_critic_updates": 2},
}
BOX = ("SAC", "TD3", "DDPG", "TQC", "CrossQ", "PPO", "A2C", "RecurrentPPO", "TRPO")
"""Those with Box actions; the others have Discrete ones."""
LOSSES = (
    "policy_loss",
    "policy_gradient_loss",
    "value_loss",
    "entropy_loss",
    "approx_kl",
    "clip_fraction",
    "loss",
    "critic_loss",
    "actor_loss",
    "ent_coef",
    "ent_coef_loss",
    "policy_objective",
    "kl_divergence_loss",
)


def spaces_of(name: str) -> tuple[Any, Any]:
    """Returns the spaces of observations and actions."""
    from gymnasium import spaces

    action = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32) if name in BOX else spaces.Discrete(CHOICES)
    return spaces.Box(-5.0, 5.0, (OBS,), np.float32), action


def history() -> list[dict[str, np.ndarray]]:
    """Returns steps of environments whose episodes have 1 to 9 steps, the last of which is terminated or truncated.

    Observations and goals are numbers of ``goal_observation``, and differ from each other.
    """
    rng = np.random.default_rng(0)
    episode, time, length = np.arange(ENVS), np.zeros(ENVS, int), rng.integers(1, 10, ENVS)
    steps = []
    for _ in range(200):
        last, terminated = time + 1 == length, rng.random(ENVS) < 0.5
        numbers = {"obs": 100 * episode + time, "next_obs": 100 * episode + time + 1, "goal": episode + 0.5}
        ends = {"terminated": last & terminated, "truncated": last & ~terminated}
        steps.append({**numbers, **ends, "action": rng.uniform(-1, 1, ENVS), "reward": rng.normal(size=ENVS)})
        episode, time = np.where(last, episode + ENVS, episode), np.where(last, 0, time + 1)
        length = np.where(last, rng.integers(1, 10, ENVS), length)
    return steps


def goal_observation(position: np.ndarray, goal: np.ndarray) -> dict[str, np.ndarray]:
    """Returns observations ``(n, 1)`` of positions, with the goals that they achieve."""
    parts = {"observation": position, "achieved_goal": -position, "desired_goal": goal}
    return {key: values.astype(np.float32)[:, None] for key, values in parts.items()}


def goal_space() -> Any:
    """Returns the space of these observations."""
    from gymnasium import spaces

    box = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    return spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), box))


def goal_reward(achieved: np.ndarray, desired: np.ndarray, info: Any = None) -> np.ndarray:
    """Returns another number for every pair of goals, ``float32 (n,)``."""
    return (achieved[:, 0] - 2 * desired[:, 0]).astype(np.float32)


HINDSIGHT, KEPT, DRAWS = ("future", "final", "episode"), 100, (100, 250)
"""Strategies that both have, steps that a buffer keeps of each environment, and batches and their size."""


def table(*columns: Any) -> np.ndarray:
    """Returns the rows of these arrays ``(n, 1)`` and observations, each once, in order; the first is the position."""
    keys = ("observation", "achieved_goal", "desired_goal")
    parts = [
        array
        for column in columns
        for array in ([column[key] for key in keys] if isinstance(column, dict) else [column])
    ]
    return np.unique(np.concatenate([np.asarray(array, np.float32).reshape(-1, 1) for array in parts], axis=1), axis=0)


# With Stable-Baselines3.


def made_up(name: str) -> Any:
    """Returns an environment of random numbers whose episodes end by terminal states, with masks of actions."""
    import gymnasium as gym

    class MadeUp(gym.Env):
        observation_space, action_space = spaces_of(name)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            return self.seen(), {}

        def seen(self) -> np.ndarray:
            return self.np_random.normal(size=OBS).astype(np.float32)

        def step(self, action: Any) -> Any:
            over = bool(self.np_random.random() < 0.2)
            return self.seen(), float(self.np_random.normal()), over, False, {}

        def action_masks(self) -> np.ndarray:
            return np.arange(CHOICES) != self.np_random.integers(CHOICES)

    return MadeUp


def record(folder: Path) -> None:
    """Writes the files of every algorithm to ``folder``."""
    import sb3_contrib
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.vec_env import DummyVecEnv

    folder.mkdir(parents=True, exist_ok=True)
    for name, settings in (OFF | ON).items():
        torch.manual_seed(0)
        algorithm_name = name.split(",")[0]
        cls = getattr(sb3, algorithm_name, None) or getattr(sb3_contrib, algorithm_name)
        envs = DummyVecEnv([made_up(name)] * (1 if name in OFF else ENVS))
        shape: dict[str, Any] = {"net_arch": [5, 4]}
        shape |= {"lstm_hidden_size": 6, "net_arch": [5]} if algorithm_name == "RecurrentPPO" else {}
        shape |= {"n_quantiles": 7} if algorithm_name in ("QRDQN", "TQC") else {}
        policy = "MlpLstmPolicy" if algorithm_name == "RecurrentPPO" else "MlpPolicy"
        model = cls(policy, envs, learning_rate=1e-2, gamma=0.9, seed=0, device="cpu", policy_kwargs=shape, **settings)
        model.set_logger(Logger(None, []))
        perturb(model, torch)
        model.save(folder / f"{name}.0.zip")
        data: dict[str, Any] = {}
        if algorithm_name == "CrossQ":
            torch.Tensor.var = lambda self, dim=None: torch.var(self, dim, unbiased=False)
        for k in range(UPDATES):
            recorded = (off_policy if name in OFF else on_policy)(model, algorithm_name, k, torch)
            logged = {key.removeprefix("train/"): value for key, value in model.logger.name_to_value.items()}
            recorded |= {key: np.float64(value) for key, value in logged.items() if key in LOSSES}
            data |= {f"{k}.{key}": value for key, value in recorded.items()}
            if k in (0, UPDATES - 1):
                model.save(folder / f"{name}.{k + 1}.zip")
        np.savez_compressed(folder / f"{name}.npz", **data)
        print("recorded", name)
    parts(folder)
    versions = {
        "stable-baselines3": sb3.__version__,
        "sb3-contrib": sb3_contrib.__version__,
        "torch": torch.__version__,
    }
    (folder / "versions.json").write_text(json.dumps(versions))


def perturb(model: Any, torch: Any) -> None:
    """Moves targets away from their networks, and the policy's standard deviation away from 1."""
    rng = np.random.default_rng(1)
    names = ("q_net_target", "quantile_net_target", "actor_target", "critic_target")
    with torch.no_grad():
        for target in filter(None, (getattr(model, name, None) for name in names)):
            for value in target.parameters():
                value += 0.3 * torch.tensor(rng.normal(size=value.shape), dtype=torch.float32)
        if hasattr(getattr(model, "actor", None), "log_std"):
            model.actor.log_std.bias -= 1.5
        if hasattr(model.policy, "log_std"):
            model.policy.log_std -= 0.7


def off_policy(model: Any, algorithm_name: str, k: int, torch: Any) -> dict[str, Any]:
    """Takes an update on a random batch, and returns the batch."""
    rng = np.random.default_rng(k)
    f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    is_box = algorithm_name in BOX
    data = {
        "obs": 0.5 * f32(BATCH, OBS),
        "action": np.tanh(f32(BATCH, ACTIONS)) if is_box else rng.integers(CHOICES, size=BATCH),
        "reward": 2.0 * f32(BATCH),
        "next_obs": 0.5 * f32(BATCH, OBS),
        "terminated": np.arange(BATCH) % 3 == 0,
        "actor_noise": f32(BATCH, ACTIONS),
        "target_noise": f32(BATCH, ACTIONS),
    }
    order = ["target_noise", "actor_noise"] if algorithm_name == "CrossQ" else ["actor_noise", "target_noise"]
    noises = iter([data[noise_name] for noise_name in order])
    drawn = torch.distributions.normal._standard_normal, torch.Tensor.normal_
    torch.distributions.normal._standard_normal = lambda shape, dtype, device: torch.tensor(next(noises))
    torch.Tensor.normal_ = lambda self, mean=0.0, std=1.0: self.copy_(mean + std * torch.tensor(data["target_noise"]))
    batch = SimpleNamespace(
        observations=torch.tensor(data["obs"]),
        actions=torch.tensor(data["action"]).reshape(BATCH, -1),
        rewards=torch.tensor(data["reward"])[:, None],
        next_observations=torch.tensor(data["next_obs"]),
        dones=torch.tensor(data["terminated"], dtype=torch.float32)[:, None],
        discounts=None,
    )
    model.replay_buffer = SimpleNamespace(sample=lambda size, env=None: batch)
    model.train(1, BATCH)
    torch.distributions.normal._standard_normal, torch.Tensor.normal_ = drawn
    return data


def on_policy(model: Any, algorithm_name: str, k: int, torch: Any) -> dict[str, Any]:
    """Collects a rollout, takes an update on it, and returns the rollout."""
    from stable_baselines3.common.callbacks import ConvertCallback

    if k == 0:
        model._setup_learn(10**6)
    callback = ConvertCallback(None)
    callback.init_callback(model)
    memory = getattr(model, "_last_lstm_states", None)
    recorded = {}
    if memory is not None:
        cells = [("pi", memory.pi), ("vf", memory.vf)]
        recorded = {
            f"memory.{who}.{i}": tensor[0].numpy().copy() for who, both in cells for i, tensor in enumerate(both)
        }
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    buffer = model.rollout_buffer
    starts = np.concatenate([buffer.episode_starts, model._last_episode_starts[None]]).astype(bool)
    obs = np.concatenate([buffer.observations, model._last_obs[None]])
    recorded |= {
        "obs": obs[:-1].copy(),
        "next_obs": obs[1:].copy(),
        "action": buffer.actions.copy(),
        "reward": buffer.rewards.copy(),
        "started": starts[0].copy(),
        "ended": starts[1:].copy(),
        "advantage": buffer.advantages.copy(),
        "target": buffer.returns.copy(),
    }
    if algorithm_name == "MaskablePPO":
        recorded["mask"] = buffer.action_masks.reshape(STEPS, ENVS, CHOICES).astype(bool)
    with mock.patch(
        "numpy.random.randint", return_value=0
    ):  # RecurrentPPO's batches begin in the middle of an environment
        model.train()
    return recorded


def parts(folder: Path) -> None:
    """Records n-step returns, and observations and rewards that ``VecNormalize`` scaled."""
    import gymnasium as gym
    from stable_baselines3.common.buffers import NStepReplayBuffer
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    rng = np.random.default_rng(0)
    space = gym.spaces.Box(-5.0, 5.0, (1,), np.float32)
    buffer = NStepReplayBuffer(200, space, space, device="cpu", n_steps=3, gamma=0.9)
    ends = rng.random(100) < 0.2
    rewards = rng.normal(size=100).astype(np.float32)
    for i in range(100):
        row = lambda x: np.array([[x]], np.float32)  # noqa: E731
        buffer.add(row(i), row(i + 0.5), row(0), rewards[i : i + 1], ends[i : i + 1], [{}])
    sampled = buffer._get_samples(np.arange(97))
    names = ("rewards", "dones", "discounts", "next_observations")
    n_step = {name: getattr(sampled, name).numpy().ravel() for name in names}

    import torch
    from sb3_contrib import ARS

    model = ARS("LinearPolicy", made_up("PPO")(), n_delta=8, n_top=5, delta_std=0.05, learning_rate=0.02, seed=0)
    model._setup_learn(100)
    deltas, returns = rng.normal(size=(8, model.n_params)), 10 * rng.normal(size=16)
    before = model.weights.numpy().copy()
    model.evaluate_candidates = lambda weights, callback, async_eval: torch.tensor(returns, dtype=torch.float32)
    with mock.patch.object(torch, "normal", return_value=torch.tensor(deltas, dtype=torch.float32)):
        model._do_one_update(None, None)
    ars = {"ars.deltas": deltas, "ars.returns": returns, "ars.step": model.weights.numpy() - before}

    envs = VecNormalize(DummyVecEnv([made_up("PPO")] * ENVS), gamma=0.9)
    envs.seed(0)
    recorded: dict[str, list[Any]] = {name: [] for name in ("raw", "scaled", "reward", "scaled_reward", "ended")}
    recorded["scaled"].append(envs.reset())
    recorded["raw"].append(envs.get_original_obs())
    for _ in range(200):
        scaled, reward, ended, _ = envs.step(np.zeros((ENVS, ACTIONS), np.float32))
        for name, value in {
            "raw": envs.get_original_obs(),
            "scaled": scaled,
            "reward": envs.get_original_reward(),
            "scaled_reward": reward,
            "ended": ended,
        }.items():
            recorded[name].append(value.copy())
    normalized = {f"normalized.{name}": np.array(values) for name, values in recorded.items()}
    n_step = {f"n_step.{name}": value for name, value in n_step.items()}
    others = {**ars, **n_step, **normalized, **hindsight()}
    np.savez_compressed(folder / "parts.npz", ends=ends, rewards=rewards, **others)


def hindsight() -> dict[str, np.ndarray]:
    """Records the different transitions that ``HerReplayBuffer`` returns, by strategy."""
    import gymnasium as gym
    from stable_baselines3 import HerReplayBuffer

    env: Any = SimpleNamespace(env_method=lambda _, achieved, desired, infos, indices: [goal_reward(achieved, desired)])
    actions = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    np.random.seed(0)  # noqa: NPY002
    transitions = {}
    for strategy in HINDSIGHT:
        buffer = HerReplayBuffer(KEPT * ENVS, goal_space(), actions, env, "cpu", ENVS, goal_selection_strategy=strategy)
        for step in history():
            obs, next_obs = (goal_observation(step[key], step["goal"]) for key in ("obs", "next_obs"))
            infos = [{"TimeLimit.truncated": bool(is_cut)} for is_cut in step["truncated"]]
            done = step["terminated"] | step["truncated"]
            buffer.add(obs, next_obs, step["action"][:, None], step["reward"], done, infos)
        parts = []
        for _ in range(DRAWS[0]):
            obs, action, next_obs, done, reward, *_ = buffer.sample(DRAWS[1])
            parts.append(table(obs, next_obs, action, reward, 1 - done))
        transitions[f"hindsight.{strategy}"] = np.unique(np.concatenate(parts), axis=0)
    return transitions


# With rejeu.


def compare(folder: Path) -> None:
    """Takes the updates and writes the table."""
    import subprocess

    import jax

    import rejeu

    rows = []
    for row in itertools.chain(({"algorithm": n} | compared(folder, n) for n in (*OFF, *ON)), compared_parts(folder)):
        rows.append(row)
        shown = [f"{key} {value:.1e}" for key, value in row.items() if isinstance(value, float)]
        print(f"{row['algorithm']:15} {'  '.join(shown)}  {row['note']}", flush=True)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=RESULTS.parent, capture_output=True, text=True, check=True
    )
    versions = json.loads((folder / "versions.json").read_text())
    versions |= {"rejeu": rejeu.__version__, "jax": jax.__version__}
    content = {
        "command": "python trials/verify.py compare FOLDER",
        "commit": commit.stdout.strip(),
        "date": time.strftime("%Y-%m-%d"),
        "versions": versions,
        "rows": rows,
    }
    RESULTS.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


NOTES = {
    "TQC": "the losses of the critics are summed, and their mean there: gradients are compared after that factor",
    "TRPO": "target_kl and cg_damping times the action dimensions, over which sb3-contrib takes the mean of the divergence",
    "TRPO, Discrete": "conjugate gradients in single precision",
    "CrossQ": "with the biased variance of a batch there, where sb3-contrib has the unbiased one",
    "A2C": "with Adam, whose first moment tells the gradient",
}


def compared(folder: Path, name: str) -> dict[str, Any]:
    """Returns the largest differences of an algorithm's losses, gradients and weights, relative to numbers above 1."""
    import jax

    import rejeu.algorithms.actor_critic.steps as steps
    from rejeu.agents.zip_files import load_zip
    from rejeu.core.checkpoint import tree_to_arrays

    with np.load(folder / f"{name}.npz", allow_pickle=False) as file:
        data = dict(file)
    changes = {"target_kl": 0.01 * ACTIONS, "cg_damping": 0.1 * ACTIONS} if name == "TRPO" else {}
    agent, first, last = (load_zip(folder / f"{name}.{k}.zip", **changes) for k in (0, 1, UPDATES))
    algorithm_name = name.split(",")[0]
    algorithm = agent.algorithm.make(agent.config, *spaces_of(name))
    state, differences = agent.state, {"losses": 0.0, "gradients": 0.0, "weights": 0.0, "weights after 3": 0.0}
    normal = jax.random.normal
    for k in range(UPDATES):
        recorded = {key.removeprefix(f"{k}."): value for key, value in data.items() if key.startswith(f"{k}.")}
        if name in OFF:
            noise_names = ("target_noise",) if algorithm_name == "TD3" else ("target_noise", "actor_noise")
            noises = iter([recorded[noise_name] for noise_name in noise_names])
            jax.random.normal = lambda key, shape=(), dtype=None, noises=noises: jax.numpy.array(next(noises))
            batch = transition(recorded, algorithm_name)
        else:
            batch = rollout(recorded, algorithm_name, agent)
            if algorithm_name != "RecurrentPPO":
                ours = steps.samples(state.network, batch, agent.config.gae_lambda)
                for field in ("advantage", "target"):
                    computed = np.asarray(getattr(ours, field)).reshape(STEPS, ENVS)
                    differences["advantages"] = max(
                        differences.get("advantages", 0.0), difference(computed, recorded[field])
                    )
        try:
            with jax.disable_jit():
                state, metrics = algorithm.update(state, batch, clock(k))
        finally:
            jax.random.normal = normal
        for loss in LOSSES:
            if loss in metrics and loss in recorded and (algorithm_name, loss) not in UNLIKE:
                factor = 2.0 if (algorithm_name, loss) == ("TQC", "critic_loss") else 1.0
                differences["losses"] = max(
                    differences["losses"], difference(float(metrics[loss]), factor * float(recorded[loss]))
                )
        if k in (0, UPDATES - 1):
            updated, theirs = tree_to_arrays(state), tree_to_arrays((first if k == 0 else last).state)
            for key, value in theirs.items():
                if value.dtype != np.float32 or key in ("actor_loss", "entropy"):
                    continue
                if "optimizer" in key:
                    if k == 0 and ".mu." in f"{key}.":
                        factor = 2.0 if algorithm_name == "TQC" and key.startswith("critics") else 1.0
                        decay = 0.5 if algorithm_name == "CrossQ" and "alpha" not in key else 0.9
                        apart = difference(updated[key] / (1 - decay), factor * value / (1 - decay))
                        differences["gradients"] = max(differences["gradients"], apart)
                else:
                    measure = "weights" if k == 0 else "weights after 3"
                    differences[measure] = max(differences[measure], difference(updated[key], value))
    return differences | {"note": NOTES.get(name, "")}


UNLIKE = {
    (algorithm_name, loss)
    for algorithm_name in ("PPO", "RecurrentPPO", "MaskablePPO")
    for loss in ("loss", "approx_kl")
} | {("TRPO", "kl_divergence_loss")}
"""Metrics that are something else there: those of the last minibatch or epoch, and the divergence in the other direction."""


def clock(k: int) -> Any:
    """Returns the clock of an update; the environment steps are such that DQN's target does not move."""
    from rejeu.core.algorithm import Clock

    return Clock(np.uint32(1), np.uint32(0), np.float32(0.0))


def difference(value: Any, reference: Any) -> float:
    """Returns the largest difference, relative to numbers above 1."""
    value, reference = np.float64(value), np.float64(reference)
    return float(np.max(np.abs(value - reference) / np.maximum(1.0, np.abs(reference)), initial=0.0))


def transition(recorded: dict[str, Any], algorithm_name: str) -> Any:
    """Returns a recorded batch."""
    from rejeu.core.algorithm import Transition

    discount = np.where(recorded["terminated"], 0.0, 0.9).astype(np.float32)
    action = recorded["action"].astype(np.float32 if algorithm_name in BOX else np.int32)
    return Transition(recorded["obs"], action, recorded["reward"], recorded["next_obs"], discount)


def rollout(recorded: dict[str, Any], algorithm_name: str, agent: Any) -> Any:
    """Returns a recorded rollout."""
    from rejeu.core.algorithm import Masked, Rollout

    memory: Any = ()
    if algorithm_name == "RecurrentPPO":
        memory = tuple(tuple(recorded[f"memory.{who}.{i}"] for i in (0, 1)) for who in ("pi", "vf"))
    obs, next_obs = recorded["obs"], recorded["next_obs"]
    if "mask" in recorded:
        obs, next_obs = Masked(obs, recorded["mask"]), Masked(next_obs, np.ones_like(recorded["mask"]))
    return Rollout(
        obs=obs,
        action=recorded["action"]
        if algorithm_name in BOX and recorded["action"].shape[-1] == ACTIONS
        else recorded["action"][..., 0].astype(np.int32),
        reward=recorded["reward"],
        next_obs=next_obs,
        discount=np.where(recorded["ended"], 0.0, 0.9).astype(np.float32),
        ended=recorded["ended"],
        valid=np.ones((STEPS, ENVS), bool),
        running_return=np.zeros((STEPS, ENVS), np.float32),
        started=recorded["started"],
        carry=memory,
    )


def compared_parts(folder: Path) -> list[dict[str, Any]]:
    """Returns rows for n-step returns and for running statistics."""
    import gymnasium as gym
    import jax.numpy as jnp

    from rejeu.algorithms import ars
    from rejeu.core import spaces
    from rejeu.core.normalization import NormalizationConfig, Normalizer, Statistics, merged, no_moments
    from rejeu.replay.ring import Ring
    from rejeu.replay.uniform import ReplayBuffer

    with np.load(folder / "parts.npz", allow_pickle=False) as file:
        data = dict(file)
    space = gym.spaces.Box(-5.0, 5.0, (1,), np.float32)
    ring = Ring(400, 1, spaces.leaves(space), spaces.structure(space), (1,), np.float32)
    row = lambda x: np.array([[x]], np.float32)  # noqa: E731
    ring.begin(row(0))
    times = []
    for i, (end, reward) in enumerate(zip(data["ends"], data["rewards"], strict=True)):
        times.append(int(ring.head[0]))
        ring.add(row(0), np.array([reward]), np.array([end]), row(i + 0.5))
        if end:
            ring.begin(row(i + 1))
    buffer = ReplayBuffer(ring, 0.9, n_steps=3)
    n = len(data["n_step.rewards"])
    rows = ring.at(np.zeros(n, np.int64), np.array(times[:n]))
    batch = buffer.batch((n,), rows, ring.read(rows.position), None)
    discount = data["n_step.discounts"] * (1 - data["n_step.dones"])
    goes_on = discount > 0
    apart = [difference(batch.reward, data["n_step.rewards"]), difference(batch.discount, discount)]
    apart.append(difference(batch.next_obs[goes_on, 0], data["n_step.next_observations"][goes_on]))
    plus, minus = jnp.asarray(data["ars.returns"].reshape(2, 8), jnp.float32)
    weight, _ = ars.weights(plus, minus, 5)
    weight = np.float64(weight) / np.sqrt(10 / 9)  # the deviation of 10 returns, divided by 10 and not by 9
    results = [{"algorithm": "ARS", "weights": difference(0.02 * weight @ data["ars.deltas"], data["ars.step"])}]
    results[0]["note"] = "with the unbiased deviation of the returns, which is biased here"
    results += [{"algorithm": "n-step returns", "numbers": max(apart), "note": "NStepReplayBuffer"}]

    recorded = {key.removeprefix("normalized."): value for key, value in data.items() if key.startswith("normalized.")}
    normalizer = Normalizer([0], {0: (OBS,)}, NormalizationConfig(), 1.0)
    obs_moments, returns, running, everyone = no_moments((OBS,)), no_moments(()), np.zeros(ENVS), jnp.ones(ENVS)
    apart = []
    for t, raw in enumerate(recorded["raw"]):
        obs_moments = merged(obs_moments, jnp.asarray(raw), everyone)
        statistics = Statistics((obs_moments,), returns)
        if t >= 100:  # there statistics begin with a count of 1e-4
            apart.append(difference(normalizer.obs(statistics, jnp.asarray(raw)), recorded["scaled"][t]))
        if t:
            reward = recorded["reward"][t - 1]
            running = 0.9 * running + reward
            returns = merged(returns, jnp.asarray(running, jnp.float32), everyone)
            if t >= 100:
                ours = normalizer.reward(Statistics((obs_moments,), returns), jnp.asarray(reward))
                apart.append(difference(ours, recorded["scaled_reward"][t - 1]))
            running[recorded["ended"][t - 1]] = 0.0
    note = "VecNormalize, from the 100th step on: its statistics begin with a count of 1e-4"
    results += [{"algorithm": "normalization", "numbers": max(apart), "note": note}]
    return [*results, compared_hindsight(data), compared_priorities()]


def filled(buffer: Any, steps: list[dict[str, np.ndarray]]) -> Any:
    """Returns a buffer after these steps of ``history``."""
    for step in steps:
        if buffer.ring.head[0] < 0:
            buffer.begin(goal_observation(step["obs"], step["goal"]))
        next_obs = goal_observation(step["next_obs"], step["goal"])
        buffer.add(step["action"][:, None], step["reward"], step["terminated"], next_obs)
        if (done := step["terminated"] | step["truncated"]).any():
            episode = step["goal"] - 0.5 + ENVS
            buffer.begin(goal_observation(100 * episode, episode + 0.5), np.flatnonzero(done))
    return buffer


def goal_ring(rows: int, counters: tuple[str, ...] = ()) -> Any:
    """Returns a ring of ``rows`` rows for each environment."""
    from rejeu.core import spaces
    from rejeu.replay.ring import Ring

    space = goal_space()
    return Ring(rows * ENVS, ENVS, spaces.leaves(space), spaces.structure(space), (1,), np.float32, counters=counters)


def compared_hindsight(data: dict[str, Any]) -> dict[str, Any]:
    """Returns the row of hindsight: the transitions that may be drawn must be the same, in every number."""
    from rejeu.envs.goals import GoalFunctions
    from rejeu.replay.hindsight import HerReplayBuffer, HindsightConfig, counters

    apart, n_compared, rng = [], 0, np.random.default_rng(0)
    for strategy in HINDSIGHT:
        config = HindsightConfig(goal_selection_strategy=strategy)
        ring = goal_ring(KEPT * 13 // 10, counters(config))  # there, final observations take no rows
        buffer = filled(HerReplayBuffer(ring, 0.9, config, GoalFunctions(goal_reward)), history())
        drawn = [buffer.sample(rng, DRAWS[1:]) for _ in range(DRAWS[0])]
        parts = [table(batch.obs, batch.next_obs, batch.action, batch.reward, batch.discount > 0) for batch in drawn]
        theirs = data[f"hindsight.{strategy}"]
        ours = np.unique(np.concatenate(parts), axis=0)
        ours = ours[np.isin(ours[:, 0], theirs[:, 0])]
        apart.append(difference(ours, theirs) if ours.shape == theirs.shape else np.inf)
        n_compared += len(theirs)
    note = (
        f"HerReplayBuffer: the {n_compared} transitions with their own and all possible goals, by future, final and episode, "
        "of whole episodes; those that still run, or are overwritten in part, are not sampled there"
    )
    return {"algorithm": "hindsight", "numbers": max(apart), "note": note}


def compared_priorities() -> dict[str, Any]:
    """Returns the row of prioritized replay, beside the equations of the paper in NumPy."""
    from rejeu.replay.prioritized import Priorities, PriorityConfig
    from rejeu.replay.uniform import ReplayBuffer

    alpha, beta, epsilon, size = 0.7, 0.5, 1e-2, 32
    ring = goal_ring(KEPT)
    buffer = ReplayBuffer(ring, 0.9, priorities=Priorities(ring, PriorityConfig(alpha, beta, epsilon)))
    rng, again = np.random.default_rng(0), np.random.default_rng(0)
    largest, apart = 1.0, []
    rows: list[list[float]] = [[], []]  # the priority of each step, and 0 for each final observation
    for step in history():
        filled(buffer, [step])
        for env, over in enumerate(step["terminated"] | step["truncated"]):
            rows[env] += [largest, 0.0] if over else [largest]
        p = np.zeros(KEPT * ENVS)
        at = {
            KEPT * env + i % KEPT: (env, i)
            for env, priorities in enumerate(rows)
            for i in range(len(priorities))[1 - KEPT :]
        }
        for position, (env, i) in at.items():
            p[position] = rows[env][i]
        n_steps = np.count_nonzero(p)
        p /= p.sum()
        batch, drawn = buffer.draw(rng, (size,))
        expected = np.searchsorted(np.cumsum(p), (np.arange(size) + again.random(size)) / size, side="right")
        again.shuffle(expected)
        weight = (n_steps * p[expected]) ** -beta
        apart += [difference(drawn.position, expected), difference(batch.weight, weight / weight.max())]
        td_error = np.abs(np.sin(expected + ring.head[0]))
        buffer.update_priorities([(drawn, td_error)])
        for position, new in zip(expected, (td_error + epsilon) ** alpha, strict=True):
            env, i = at[position]
            rows[env][i], largest = new, max(largest, new)
    note = "the equations of the paper in NumPy: choices, importance weights and new priorities; neither library has it"
    return {"algorithm": "prioritized replay", "numbers": max(apart), "note": note}


if __name__ == "__main__":
    {"record": record, "compare": compare}[sys.argv[1]](Path(sys.argv[2]))
