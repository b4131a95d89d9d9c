"""Which programs a training step runs on the device, counted by JAX's own events of compilations.

After ``jax.clear_caches()`` every program must be compiled again. So the number of compilations in a few turns is the number
of different programs that run in them: nothing else is dispatched, no arithmetic on device arrays either.
"""

from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.environments import Reach, Sampled
from tests.tiers import only

COMPILED = "/jax/core/compile/backend_compile_duration"
_compilations: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: _compilations.append(event) if event == COMPILED else None
)


def sampled(n_envs: int = 1, n_actions: int | None = None) -> InProcess:
    """Environments with 3 numbers to see, 1 or a choice to do, and episodes of 5 steps."""
    actions = None if n_actions is None else gym.spaces.Discrete(n_actions)
    return InProcess([Sampled(gym.spaces.Box(-1.0, 1.0, (3,)), actions) for _ in range(n_envs)], seed=0)


OFF = {"learning_starts": 4, "batch_size": 4, "buffer_size": 300, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
ON = {"n_steps": 4, "policy_kwargs": {"net_arch": [8]}, "seed": 0}


class Case(NamedTuple):
    make: Any
    programs: int
    """How many different programs its turns run: act and update; observe to normalize."""
    n_envs: int = 1


HER = {"replay_buffer_class": "HerReplayBuffer", **OFF}
DISCRETE = {"train_freq": 1, **OFF}

CASES = {
    "SAC": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), **OFF), 2),
    "SAC, 3 environments": Case(lambda: rejeu.SAC("MlpPolicy", sampled(3), **OFF), 2, n_envs=3),
    "SAC, 4 gradient steps": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), gradient_steps=4, **OFF), 2),
    "SAC, skipping": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), nonfinite="skip", **OFF), 2),
    "SAC with hindsight": Case(lambda: rejeu.SAC("MultiInputPolicy", InProcess([Reach()]), **HER), 2),
    "SAC, normalized": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), normalize=True, **OFF), 3),
    "TD3": Case(lambda: rejeu.TD3("MlpPolicy", sampled(), **OFF), 2),
    "DQN, 2 environments": Case(lambda: rejeu.DQN("MlpPolicy", sampled(2, 3), **DISCRETE), 2, n_envs=2),
    "DQN with priorities": Case(lambda: rejeu.DQN("MlpPolicy", sampled(1, 3), priorities={}, **DISCRETE), 2),
    "PPO": Case(lambda: rejeu.PPO("MlpPolicy", sampled(), batch_size=4, n_epochs=2, **ON), 2),
    "PPO, 3 environments": Case(lambda: rejeu.PPO("MlpPolicy", sampled(3), batch_size=4, n_epochs=2, **ON), 2, 3),
    "A2C, 3 environments": Case(lambda: rejeu.A2C("MlpPolicy", sampled(3, 3), **ON), 2, 3),
    "PQN, 3 environments": Case(lambda: rejeu.PQN("MlpPolicy", sampled(3, 3), batch_size=4, **ON), 2, 3),
}


@pytest.mark.parametrize("name", only(["SAC, normalized", "PPO, 3 environments"], CASES))
def test_after_the_first_steps_nothing_is_compiled_and_few_programs_run(name):
    """Nothing is compiled where episodes end, in a last turn that keeps some of its steps, or in a further ``learn``."""
    case = CASES[name]
    agent, n = case.make(), case.n_envs
    agent.learn(12 * n + (n > 1))  # includes a last turn that keeps some of its steps, and the remainders of scans
    agent.learn(8 * n, reset_num_timesteps=False)
    agent.learner.copy(agent.run.state)  # as where the best weights are kept
    before = len(_compilations)
    agent.learn(9 * n + (n > 1), reset_num_timesteps=False)
    agent.learn(11 * n, reset_num_timesteps=False)
    assert len(_compilations) == before

    jax.clear_caches()
    agent.learn(8 * n, reset_num_timesteps=False)
    assert len(_compilations) - before == case.programs


def test_a_further_program_is_counted():
    """Arithmetic on an array of the device is a program."""
    agent = CASES["SAC"].make()
    agent.learn(12)
    vector = jnp.ones(7) * 3
    jax.clear_caches()
    before = len(_compilations)
    agent.learn(4, lambda *_: bool((vector * 2.5).shape), reset_num_timesteps=False)
    assert len(_compilations) - before > CASES["SAC"].programs


def test_a_further_compilation_is_counted():
    agent = CASES["SAC"].make()
    agent.learn(12)
    before = len(_compilations)
    agent.predict(np.zeros((5, 3), np.float32), deterministic=True)  # a new batch size
    assert len(_compilations) == before + 1
