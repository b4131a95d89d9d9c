"""Several runs in one program: each is the run that would have been trained alone."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from tests.jax_environments import Forbidden, Reach
from tests.sharing import shared_learners

SMALL: dict[str, Any] = {
    "buffer_size": 200,
    "learning_starts": 20,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [8]},
}
ON_POLICY: dict[str, Any] = {"n_steps": 16, "batch_size": 16, "n_epochs": 2, "policy_kwargs": {"net_arch": [8]}}


def assert_same_runs(together: Any, alone: Any) -> None:
    """Asserts that two agents have the same episodes, counters and, up to rounding, parameters."""
    np.testing.assert_array_equal(together.history.table()[:, [0, 1, 3]], alone.history.table()[:, [0, 1, 3]])
    assert together.num_timesteps == alone.num_timesteps
    assert together.n_updates == alone.n_updates
    for name, value in together.get_parameters().items():
        np.testing.assert_allclose(value, alone.get_parameters()[name], rtol=1e-3, atol=1e-4, err_msg=name)


def train_alone(kind: Any, env: Any, n_steps: int, n_envs: int, seed: int, settings: dict[str, Any]) -> Any:
    """Returns an agent that was trained alone."""
    policy = "MultiInputPolicy" if isinstance(env, Reach) else "MlpPolicy"
    with shared_learners():
        return kind(policy, rejeu.make_vector(env, n_envs), seed=seed, **settings).learn(n_steps)


@pytest.mark.parametrize(
    ("kind", "env", "settings", "differing"),
    [
        (rejeu.DQN, "jax/CartPole-v1", SMALL, {"learning_rate": [1e-4, 1e-3]}),
        pytest.param(rejeu.PPO, "jax/CartPole-v1", ON_POLICY, {}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.PQN, "jax/CartPole-v1", ON_POLICY, {}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.MaskablePPO, Forbidden(), ON_POLICY, {}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.DQN, "jax/CartPole-v1", {**SMALL, "priorities": {}}, {}, marks=pytest.mark.exhaustive),
        pytest.param(
            rejeu.A2C,
            "CartPole-v1",
            {"n_steps": 5, "policy_kwargs": {"net_arch": [8]}},
            {"ent_coef": [0.0, 0.1]},
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(rejeu.SAC, "jax/Pendulum-v1", SMALL, {"tau": [0.01, 0.1]}, marks=pytest.mark.exhaustive),
        pytest.param(
            rejeu.DDPG,
            Reach(),
            {**SMALL, "replay_buffer_class": "HerReplayBuffer", "action_noise": 0.3},
            {},
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(
            rejeu.PPO, "jax/CartPole-v1", ON_POLICY, {"ent_coef": [0.0, 0.1], "vf_coef": [0.5, 0.1]},
            marks=pytest.mark.exhaustive,
        ),
    ],
)  # fmt: skip
def test_each_run_equals_the_one_trained_alone(
    kind: Any, env: Any, settings: dict[str, Any], differing: dict[str, list[float]]
) -> None:
    policy = "MultiInputPolicy" if isinstance(env, Reach) else "MlpPolicy"
    agents = rejeu.train_seeds(kind, policy, env, 120, seeds=[4, 9], n_envs=2, **settings, **differing)
    assert len(agents) == 2 * int(np.prod([len(values) for values in differing.values()], dtype=int))
    for agent in agents[-2:]:
        values = {name: getattr(agent.config, name) for name in differing}
        assert_same_runs(agent, train_alone(kind, env, 120, 2, agent.seed, {**settings, **values}))


@pytest.mark.exhaustive
@pytest.mark.parametrize("env", ["jax/CartPole-v1", pytest.param("CartPole-v1", marks=pytest.mark.exhaustive)])
def test_runs_have_callbacks_of_their_own_and_can_be_saved(tmp_path: Any, env: str) -> None:
    evaluations: dict[int, Evaluate] = {}

    def callbacks(agent: Any) -> list[Any]:
        evaluations[agent.seed] = Evaluate(
            "jax/CartPole-v1", every=50, episodes=2, best_path=tmp_path / f"{agent.seed}"
        )
        return [evaluations[agent.seed], lambda agent, progress: agent.seed != 1 or progress.step < 50]

    agents = rejeu.train_seeds(rejeu.DQN, "MlpPolicy", env, 120, seeds=3, callback=callbacks, **SMALL)
    assert [agent.num_timesteps for agent in agents] == [120, 50, 120]
    assert [result.step for result in evaluations[2].results] == [50, 100]
    assert [agent.run.replay.size() for agent in agents] == [120, 50, 120]
    loaded = rejeu.load(agents[2].save(tmp_path / "agent"))
    for name, value in agents[2].get_parameters().items():
        np.testing.assert_array_equal(value, loaded.get_parameters()[name])
    assert agents[1].learn(20, reset_num_timesteps=False).num_timesteps == 70


def test_a_run_of_several_that_resumes_continues_alone_and_is_the_uninterrupted_one_up_to_rounding(
    tmp_path: Any,
) -> None:
    def interrupted(agent: Any) -> list[Any]:
        return [Checkpoint(tmp_path / str(agent.seed), every=20), lambda agent, progress: progress.step < 40]

    together = {"env": "jax/CartPole-v1", "total_timesteps": 120, "seeds": 2, **SMALL}
    whole = rejeu.train_seeds(rejeu.DQN, "MlpPolicy", **together)
    stopped = rejeu.train_seeds(rejeu.DQN, "MlpPolicy", callback=interrupted, **together)
    for agent, before in zip(whole, stopped, strict=True):
        with pytest.warns(UserWarning, match="one of 2 runs in one program"):
            resumed = rejeu.DQN.resume(tmp_path / str(agent.seed))
        assert (resumed.num_timesteps, resumed.resumed.exact) == (40, False)
        for name, value in before.get_parameters().items():
            np.testing.assert_array_equal(value, resumed.get_parameters()[name])
        assert_same_runs(agent, resumed.learn(callback=Checkpoint(tmp_path / str(agent.seed), every=20)))
    assert rejeu.DQN.resume(tmp_path / "1").resumed.exact  # of a run that continued alone


@pytest.mark.parametrize(
    ("env", "settings", "message"),
    [
        ("jax/CartPole-v1", {"train_freq": (1, "episode")}, "updates depend on episodes"),
        ("jax/CartPole-v1", {"gamma": [0.9, 0.99]}, "gamma cannot differ"),
        ("jax/CartPole-v1", {"batch_size": [8, 16]}, "batch_size cannot differ"),
        ("jax/CartPole-v1", {"verbose": [0, 1]}, "verbose is no hyperparameter of DQN"),
        ("jax/CartPole-v1", {"seed": 3}, "seed=3: the runs have different seeds; give them as seeds"),
    ],
)
def test_what_cannot_be_one_program_is_refused(env: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rejeu.train_seeds(rejeu.DQN, "MlpPolicy", env, 60, seeds=2, **{**SMALL, **settings})


@pytest.mark.parametrize(
    ("env", "seeds", "message"),
    [
        (gym.make("CartPole-v1"), 2, "env is a TimeLimit.* every run needs environments of its own; give an id"),
        (rejeu.make_vector("CartPole-v1", 2), 2, "env is a InProcess.* give an id, such as 'Pendulum-v1'"),
        (rejeu.make_vector("jax/CartPole-v1"), 2, "env is a JaxVector.* or a FunctionalEnv"),
        *(("jax/CartPole-v1", seeds, "seeds=.* must be") for seeds in (0, True, 2.5, "2", [], [1, 1])),
        ("jax/CartPole-v1", [1, -1], "seed=-1 must be a whole number"),
    ],
)
def test_environments_that_would_be_shared_and_wrong_seeds_are_refused(env: Any, seeds: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        rejeu.train_seeds(rejeu.DQN, "MlpPolicy", env, 60, seeds=seeds, **SMALL)
    assert "\n" not in str(raised.value)


@pytest.mark.exhaustive
def test_an_error_of_one_run_names_it() -> None:
    numbers: dict[str, Any] = {"learning_rate": [1e-3, 1e30], **SMALL}
    with pytest.raises(rejeu.NonFiniteError, match="in the environment steps") as raised:
        rejeu.train_seeds(rejeu.DQN, "MlpPolicy", "jax/CartPole-v1", 120, seeds=1, **numbers)
    assert str(raised.value).startswith("seed 0, learning_rate=1e+30: ")
