"""Steps and episodes on the device against counting them one by one."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.envs.functional.vector import reset_all
from rejeu.training.compiled.program import Carry, EpisodeState, Loop, empty_log, step_envs
from tests.jax_environments import Reach

N_ENVS, LENGTH, GAMMA = 3, 3, 0.5


def test_steps_and_episodes_are_counted_and_logged() -> None:
    env = Reach(max_episode_steps=LENGTH)
    program: Any = SimpleNamespace(n_envs=N_ENVS, config=SimpleNamespace(gamma=GAMMA, action_share=1.0))
    vstate, zeros = reset_all(env, jax.random.key(0), N_ENVS), jnp.zeros(N_ENVS)
    state = EpisodeState(vstate, vstate.obs, zeros == 0, zeros, jnp.zeros(N_ENVS, int), zeros, jnp.uint32(0))
    step = jax.jit(lambda loop, turn: step_envs(program, env, loop, jnp.ones((N_ENVS, 1)), turn))
    for n_finished in (0, N_ENVS):
        returns, running = np.zeros(N_ENVS), np.zeros(N_ENVS)
        log: Any = empty_log(LENGTH, N_ENVS)
        for turn in range(LENGTH):
            carry: Any = Carry(None, None, None, None, state, None, None, {})
            loop, result = step(Loop(carry, None, None, log, jnp.bool(False)), jnp.int32(turn))
            state, log = loop.carry.episodes, loop.log
            is_end, reward = turn == LENGTH - 1, np.asarray(result.reward)
            returns, running = returns + reward, GAMMA * running + reward
            np.testing.assert_allclose(state.running_return, running)
            np.testing.assert_array_equal(state.length, 0 if is_end else turn + 1)
            np.testing.assert_array_equal(state.ended, is_end)
            np.testing.assert_array_equal(log.length[turn], LENGTH if is_end else 0)
            assert int(state.n_finished) == n_finished + (N_ENVS if is_end else 0)
        np.testing.assert_allclose(log.episode_return[-1], returns)
