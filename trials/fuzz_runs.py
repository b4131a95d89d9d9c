"""The targets ``run`` and ``rows`` of ``trials/fuzz.py``, which read checkpoints of complete runs.

An input of ``run`` replaces the file of a run whose rows are valid. An input of ``rows`` replaces a file of rows of a
valid run. Both are read by ``Agent.resume(folder)``. The only exception allowed is ``CheckpointError``.
``FileNotFoundError`` is not allowed, because the file always exists. A resumed run must train for some steps with
checkpoints in the same folder, and these checkpoints must load again with equal contents. During training,
``NonFiniteError`` and ``BadEnvironmentError`` are also allowed. Weights and states of environments may be any finite
numbers, and results computed from them may overflow. The error of the ball for actions that are NaN is allowed too,
because such weights can cause it.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

N_STEPS = 8
"""Environment steps for which a resumed run must train."""
BALL, BITS, CART_POLE = "rejeu/Ball-v0", "fuzz/Bits-v0", "rejeu/CartPoleNoVelocity-v0"
DIVERGED = "is not a number; the policy has diverged"
"""Message of the ball for an action that is NaN."""
COSTLY = {"batch_size": 64, "n_steps": 64, "gradient_steps": 16, "n_epochs": 8, "n_episodes": 8, "n_quantiles": 64}
"""Hyperparameters that increase the cost of training, with the largest values for which training is run here."""
MOST_EXTRA_STEPS = 100
"""Maximum number of pending gradient steps in a file for which training is run here."""
LEARN_ONE_IN = 12
"""Runs with other configurations than the seeds must be compiled. Only one in this many of them trains."""
LAST_STEP = 2**32 - 2**16
"""Runs are limited to about four billion steps. Runs close to the limit do not train here."""


def make_runs(folder: Path) -> list[tuple[Path, list[Path]]]:
    """Creates the runs in a folder. Returns, for each, its newest file and its files of rows, oldest first."""
    import gymnasium as gym

    import rejeu
    from rejeu.agents.run_files import run_files
    from rejeu.callbacks import Checkpoint

    if BITS not in gym.registry:
        gym.register(BITS, bits, max_episode_steps=4)
    small: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}, "seed": 3}
    off = {**small, "learning_starts": 6, "batch_size": 4, "buffer_size": 24}
    on = {**small, "n_steps": 8, "batch_size": 8, "n_epochs": 1}
    noise = rejeu.OrnsteinUhlenbeckActionNoise([0.0] * 2, [0.2] * 2)
    hindsight = {"replay_buffer_class": rejeu.HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 2}}
    cases: list[tuple[str, str, int, dict[str, Any]]] = [
        ("SAC", BALL, 1, off),
        ("DQN", BITS, 2, {**off, **hindsight}),
        ("DQN", CART_POLE, 2, {**off, "priorities": {}, "n_steps": 3}),
        ("TD3", BALL, 1, {**off, "action_noise": noise, "train_freq": (1, "episode"), "gradient_steps": -1}),
        ("PPO", BALL, 2, {**on, "normalize": True}),
        ("A2C", BITS, 2, {**small, "n_episodes": 1}),
        ("RecurrentPPO", CART_POLE, 2, {**on, "policy_kwargs": {"net_arch": [4], "lstm_hidden_size": 4}}),
    ]
    found = []
    for i, (name, env_id, n_envs, settings) in enumerate(cases):
        policy = "MultiInputPolicy" if env_id == BITS else "MlpPolicy"
        env = rejeu.make_vector(env_id, n_envs, "gymnasium", seed=1)
        agent = rejeu.AGENTS[name](policy, env, **settings)
        agent.made_from_id = True  # created from its id, so resume() needs no environment
        watching: list[Any] = [evaluation()] if i == 0 else []
        run = folder / str(i)
        agent.learn(60, [*watching, Checkpoint(run, every=8, keep=1), lambda agent, turn: turn.step < 26])
        found.append((run_files(run)[0], sorted(run.glob("rows_*"))))
    return found


def bits() -> Any:
    """Returns a bit-flipping environment whose state can be saved."""
    from tests.bit_flipping import BitFlipping

    class Bits(BitFlipping):
        def get_state(self) -> dict[str, Any]:
            own = {"state": self.state, "goal": self.goal, "time": self.time}
            return own | {"rng": self.np_random.bit_generator.state}

        def set_state(self, state: dict[str, Any]) -> None:
            for key in ("state", "goal"):
                is_int = state[key].dtype == "int8"
                if not is_int or state[key].shape != (self.n_bits,) or not {*state[key].tolist()} <= {0, 1}:
                    raise ValueError(f"{key} is no {self.n_bits} bits")
            self.state, self.goal, self.time = state["state"], state["goal"], int(state["time"])
            self.np_random.bit_generator.state = state["rng"]

    return Bits(4)


def evaluation() -> Any:
    """Returns a callback with state."""
    from rejeu.callbacks import Evaluate

    return Evaluate(BALL, every=20, episodes=1, seed=0)


class Runs:
    """Complete runs in a folder, and a function that reads one of them with a file replaced."""

    def __init__(self, folder: Path) -> None:
        """Creates the runs and a seed for each file."""
        from rejeu.io import checkpoint

        share_compiled()
        self.whole = folder / "whole"
        self.runs = make_runs(self.whole)
        self.folder = folder / "resumed"
        self.folder.mkdir()
        self.evaluate = evaluation()
        self.rows: dict[str, Path] = {path.name: path for _, rows in self.runs for path in rows}
        self.headers = [checkpoint.read_header(path, "run") for path, _ in self.runs]
        self.configs = {json.dumps(header["config"]) for header in self.headers}

    def seeds(self, target: str) -> list[bytes]:
        """Returns the seeds. Files of rows are marked with their run and their position."""
        from tests import hostile_files

        if target == "run":
            return [path.read_bytes() for path, _ in self.runs]
        seeds = []
        for i, (_, rows) in enumerate(self.runs):
            for j, path in enumerate(rows):
                parts = hostile_files.take_apart(path.read_bytes())
                seeds.append(hostile_files.put_together(parts._replace(header={**parts.header, "of": [i, j]})))
        return seeds

    def read_run(self, path: Path) -> None:
        """Resumes and uses a run with this file."""
        header = header_of(path, "run")
        name = header.get("algorithm")
        self.put_files(self.rows.values())
        shutil.copyfile(path, self.folder / self.runs[0][0].name)
        self.resume(name if isinstance(name, str) else "", path)

    def read_rows(self, path: Path) -> None:
        """Resumes and uses a run with this file of rows."""
        try:
            i, j = header_of(path, "rows")["of"]
            run, rows = self.runs[i]
            replaced = rows[j]
        except (KeyError, IndexError, TypeError, ValueError):
            i, (run, rows) = 0, self.runs[0]
            replaced = rows[0]
        self.put_files([run, *(one for one in rows if one != replaced)])
        shutil.copyfile(path, self.folder / replaced.name)
        self.resume(self.headers[i]["algorithm"], path)

    def put_files(self, paths: Any) -> None:
        """Empties the folder and adds the valid files. These are only replaced, never modified."""
        for path in self.folder.iterdir():
            path.unlink()
        for path in paths:
            os.link(path, self.folder / path.name)

    def resume(self, name: str, path: Path) -> None:
        """Resumes the run in the folder, trains, and reads the new checkpoints.

        Raises:
            CheckpointError: if the run is rejected.
        """
        import rejeu
        from rejeu.errors import BadEnvironmentError, CheckpointError, NonFiniteError

        kind = rejeu.AGENTS.get(name, rejeu.SAC)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            agent = kind.resume(self.folder)
            if not self.is_affordable(agent, path):
                return
            try:
                self.learn_on(agent)
            except CheckpointError as error:
                if "the saved state of" in str(error):  # callbacks validate their own state once they are given
                    raise
                raise AssertionError(f"it was resumed, but: {error}") from error
            except (NonFiniteError, BadEnvironmentError):
                return
            except ValueError as error:
                if DIVERGED not in str(error):
                    raise
                return
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                again = kind.resume(self.folder)
            except CheckpointError as error:
                raise AssertionError(f"what a resumed run saved is refused: {error}") from error
        if passed_over := [str(one.message) for one in said if "before it" in str(one.message)]:
            raise AssertionError(f"what a resumed run saved is refused: {passed_over[0]}")
        if again.run.step != agent.run.step:
            raise AssertionError(f"{again.run.step} steps were read where {agent.run.step} were written")

    def learn_on(self, agent: Any) -> None:
        """Continues the interrupted call of ``learn``, if any steps remain, with checkpoints in the run's folder."""
        from rejeu.callbacks import Checkpoint

        run, call, before = agent.run, agent.training_call, agent.run.step
        stop = lambda agent, turn: turn.step < before + N_STEPS  # noqa: E731
        is_over = call is None or call.is_over(run.step, run.episode)
        agent.report_folder = self.folder
        agent.learn(
            N_STEPS if is_over else None,
            [*([self.evaluate] if run.env.env_id == BALL else []), stop, Checkpoint(self.folder, every=5)],
            reset_num_timesteps=False,
        )
        if not run.step > before:
            raise AssertionError("nothing was learnt")
        agent.predict(agent.observation_space.sample())

    def is_affordable(self, agent: Any, path: Path) -> bool:
        """Returns whether to train: if training is cheap and, in most cases, already compiled."""
        from rejeu.algorithms import config as configs

        config, run = vars(agent.config), agent.run
        asked = {key: config.get(key) or 0 for key in COSTLY}
        extra = run.steps_since_update if config.get("gradient_steps") == -1 else 0
        frequent = config.get("train_freq", 1)
        extra += run.owed // (frequent if isinstance(frequent, int) else frequent[0])
        little = all(value <= COSTLY[key] for key, value in asked.items()) and extra <= MOST_EXTRA_STEPS
        if not little or run.step > LAST_STEP or run.env.n_envs > 4:
            return False
        if json.dumps(configs.to_json(agent.config)) in self.configs:
            return True
        return zlib.crc32(path.read_bytes()) % LEARN_ONE_IN == 0


def header_of(path: Path, kind: str) -> dict[str, Any]:
    """Returns the header of a file, empty if there is none."""
    from rejeu.io import checkpoint

    try:
        return checkpoint.read_header(path, kind)
    except checkpoint.CheckpointError:
        return {}


def share_compiled() -> None:
    """Lets agents with equal configurations share compiled functions, because compilation takes most of the time."""
    import jax

    from rejeu import spaces
    from rejeu.agents.agent import Agent
    from rejeu.algorithms import config as configs

    build, kept = Agent.build, {}

    def build_once(self: Agent, observation_space: Any, action_space: Any) -> None:
        described = [spaces.describe(observation_space), spaces.describe(action_space)]
        key = json.dumps([self.name, configs.to_json(self.config), described])
        if key in kept:
            self.observation_space, self.action_space = observation_space, action_space
            self.obs_leaves, self.learner = spaces.leaves(observation_space), copy.copy(kept[key])
            return
        if len(kept) > 200:
            kept.clear()
            jax.clear_caches()
        build(self, observation_space, action_space)
        kept[key] = self.learner

    Agent.build = build_once  # type: ignore[method-assign]


def reader(target: str, folder: Path) -> tuple[list[bytes], Callable[[Path], None]]:
    """Returns the seeds of a target and a function that reads an input."""
    runs = Runs(folder)
    return runs.seeds(target), runs.read_run if target == "run" else runs.read_rows
