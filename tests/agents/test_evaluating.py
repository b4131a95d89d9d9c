"""Agents evaluated in environments of any kind, also their own and also while they learn."""

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.envs.make import InProcess, make_vector
from rejeu.sb3.common.callbacks import BaseCallback, EvalCallback
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.vec_env import DummyVecEnv
from tests.environments import Counter, Timed
from tests.helpers import assert_same_parameters, small_sac
from tests.tiers import crossed, only

NEVER = 10**6
"""``learning_starts`` of agents that only act at random."""


def every(n, action):
    """A callback that does ``action(agent)`` every ``n`` turns."""
    turns = iter(range(1, 10**9))

    def callback(agent, progress):
        if next(turns) % n == 0:
            action(agent)

    return callback


# Seeds.

PENDULUM = {
    "a Gymnasium environment": lambda: gym.make("Pendulum-v1"),
    "a function": lambda: lambda: gym.make("Pendulum-v1"),
    "DummyVecEnv": lambda: DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2),
    "SyncVectorEnv": lambda: gym.make_vec("Pendulum-v1", 2, vectorization_mode="sync"),
    "EnvPool": lambda: make_vector("Pendulum-v1", 2, "envpool"),
    "an id": lambda: "Pendulum-v1",
}


@pytest.mark.parametrize("kind", only(["SyncVectorEnv", "EnvPool", "an id"], PENDULUM))
def test_a_seed_determines_an_evaluation_in_the_agents_own_and_in_a_given_environment(kind):
    agent, env = small_sac(PENDULUM[kind]()), PENDULUM[kind]()
    for given in (None, env, *([agent.get_env()] if kind == "EnvPool" else [])):
        first, again, other = (agent.evaluate(2, env=given, seed=seed).returns for seed in (7, 7, 8))
        np.testing.assert_array_equal(first, again)
        assert (first != other).all()


# While the agent learns. Counter refuses to be stepped once an episode is over.

OWN = {
    "evaluate()": lambda agent, env: agent.evaluate(2),
    "evaluate(env=the same)": lambda agent, env: agent.evaluate(2, env=env),
    "evaluate_policy": lambda agent, env: evaluate_policy(agent, env, 2),
    "evaluate_policy(get_env())": lambda agent, env: evaluate_policy(agent, agent.get_env(), 2),
}


every_way = pytest.mark.parametrize("how", OWN)


@every_way
def test_an_off_policy_agent_may_be_evaluated_in_its_own_environment_while_it_learns(how):
    env = Counter((5,))
    agent = small_sac(env, learning_starts=NEVER).learn(23, every(7, lambda agent: OWN[how](agent, env)))
    assert agent.num_timesteps == agent.replay_buffer.size() == 23
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (300,))
    np.testing.assert_array_equal(batch.next_obs[:, 1], batch.obs[:, 1] + 1)
    np.testing.assert_array_equal(batch.next_obs[:, 0], batch.obs[:, 0])
    # Turns 7, 14 and 21 cut episodes off two steps after their begin; each evaluation played two.
    assert [e.length for e in agent.history.episodes] == [5, 5, 5]


@every_way
def test_an_on_policy_agent_may_be_evaluated_in_its_own_environment_while_it_learns(how):
    env, seen = Counter((5,)), []
    agent = rejeu.A2C("MlpPolicy", env, n_steps=12, policy_kwargs={"net_arch": [4]}, seed=0)
    update = agent.learner.update

    def keep(state, batch, clock):
        seen.append(jax.tree.map(np.array, batch))
        return update(state, batch, clock)

    agent.learner.update = keep
    agent.learn(24, every(8, lambda agent: OWN[how](agent, env)))
    assert agent.num_timesteps == 24
    assert [batch.ended[:, 0].nonzero()[0].tolist() for batch in seen] == [[4, 7], [0, 3, 8]]
    for batch in seen:
        goes_on = ~batch.ended[:-1, 0]
        np.testing.assert_array_equal(batch.obs[1:, 0][goes_on], batch.next_obs[:-1, 0][goes_on])
        np.testing.assert_array_equal(batch.next_obs[:, 0, 1], batch.obs[:, 0, 1] + 1)


pytestmark = pytest.mark.usefixtures("learners_are_shared")

LEARNERS = {
    "DQN, EnvPool": lambda: rejeu.DQN(
        "MlpPolicy", make_vector("CartPole-v1", 2, "envpool", seed=0), learning_starts=8, batch_size=4, seed=0
    ),
    "DQN, an id": lambda: rejeu.DQN("MlpPolicy", "CartPole-v1", learning_starts=8, batch_size=4, seed=0),
    "PPO, EnvPool": lambda: rejeu.PPO(
        "MlpPolicy", make_vector("CartPole-v1", 2, "envpool", seed=0), n_steps=16, batch_size=16, seed=0
    ),
    "PPO, whole episodes": lambda: rejeu.PPO("MlpPolicy", gym.make("CartPole-v1"), n_episodes=1, seed=0),
    "RecurrentPPO": lambda: rejeu.RecurrentPPO(
        "MlpPolicy", gym.make("CartPole-v1"), n_steps=16, policy_kwargs={"lstm_hidden_size": 4}, seed=0
    ),
}


@pytest.mark.parametrize("name", only(["PPO, EnvPool", "PPO, whole episodes"], LEARNERS))
def test_every_loop_goes_on_after_an_evaluation_in_a_callback(name):
    agent, results = LEARNERS[name](), []
    agent.learn(41, every(9, lambda agent: results.append(agent.evaluate(2, seed=5))))
    assert agent.num_timesteps >= 41
    assert len(results) >= 2
    assert agent.history["length"].sum() <= agent.num_timesteps


def test_callbacks_after_one_that_evaluated_see_observations_of_new_episodes():
    class Look(BaseCallback):
        def _on_step(self):
            seen.append(self.locals["new_obs"][0].tolist())
            return True

    seen: list[list[float]] = []
    evaluate = every(3, lambda agent: agent.evaluate(1))
    small_sac(Counter((5,)), learning_starts=NEVER).learn(4, [evaluate, Look()])
    assert [obs[:2] for obs in seen] == [[0, 1], [0, 2], [2, 0], [2, 1]]


@pytest.mark.parametrize(
    ("kind", "env"),
    crossed(["SAC", "PPO"], [lambda: gym.make("Pendulum-v1"), lambda: make_vector("Pendulum-v1", 1, "envpool")]),
)
def test_a_checkpoint_right_after_an_evaluation_is_resumed_exactly(tmp_path, kind, env):
    def make(env):
        if kind == "SAC":
            return small_sac(env)
        return rejeu.PPO("MlpPolicy", env, n_steps=16, batch_size=16, policy_kwargs={"net_arch": [4]}, seed=0)

    evaluate = lambda: every(20, lambda agent: agent.evaluate(1))  # noqa: E731
    one = make(env()).learn(50, evaluate())
    make(env()).learn(50, [evaluate(), Checkpoint(tmp_path), lambda agent, turn: turn.step < 20])
    agent = rejeu.AGENTS[kind].resume(tmp_path, env())
    assert (agent.resumed.step, agent.resumed.exact) == (20, True)
    agent.learn(callback=evaluate())
    assert_same_parameters(agent, one)


def test_an_environment_that_breaks_in_an_evaluation_ends_training_with_its_own_error():
    class Breaking(Counter):
        def step(self, action):
            if self.episode >= 1:
                raise ArithmeticError("broken")
            return super().step(action)

    with pytest.raises(ArithmeticError, match="broken"):
        small_sac(Breaking((5,)), learning_starts=NEVER).learn(9, every(3, lambda agent: agent.evaluate(1)))


def test_a_replay_buffer_may_be_loaded_while_the_agent_learns(tmp_path):
    path = small_sac(Counter((5,)), learning_starts=NEVER).learn(12).save_replay_buffer(tmp_path / "replay")
    agent = small_sac(Counter((5,)))
    agent.learn(10, every(6, lambda agent: agent.load_replay_buffer(path)))
    assert agent.replay_buffer.size() == 12 + 4


def test_other_environments_are_refused_while_the_agent_learns_and_the_fix_is_said():
    agent = small_sac(Counter((5,)), learning_starts=NEVER)
    with pytest.raises(RuntimeError, match=r"stop training first .* reset_num_timesteps=False"):
        agent.learn(9, every(3, lambda agent: agent.set_env(Counter((4,)))))
    agent.set_env(Counter((4,)))
    agent.learn(9)


# Between two calls of learn.


@every_way
def test_training_goes_on_in_new_episodes_after_its_environment_was_played_in(how):
    env = Counter((5,))
    agent = small_sac(env, learning_starts=NEVER).learn(7)
    OWN[how](agent, env)
    agent.learn(6, reset_num_timesteps=False)
    assert [e.length for e in agent.history.episodes] == [5, 5]


def test_playing_in_other_environments_leaves_running_episodes_alone():
    agent = small_sac(Counter((5,)), learning_starts=NEVER).learn(7)
    agent.evaluate(1, env=Counter((5,)))
    evaluate_policy(agent, Counter((5,)), 1)
    agent.learn(6, reset_num_timesteps=False)
    assert [e.length for e in agent.history.episodes] == [5, 5]
    assert [e.step for e in agent.history.episodes] == [5, 10]


# Action masks.


class One(Timed):
    """Allows one of ten actions at a time and counts the others; episodes of 6 steps."""

    action_space = gym.spaces.Discrete(10)
    length = 6
    taken = illegal = 0

    def reward(self, action):
        self.taken += 1
        self.illegal += action != self.allowed
        return float(action == self.allowed)

    def info(self):
        self.allowed = int(self.np_random.integers(10))
        return {"action_mask": np.arange(10) == self.allowed}


@pytest.fixture(scope="module")
def masked():
    """An agent that takes masks; tests may train it."""
    return rejeu.MaskablePPO("MlpPolicy", One(), n_steps=12, batch_size=12, policy_kwargs={"net_arch": [4]}, seed=0)


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize(
    "wrap", [lambda env: env, lambda env: DummyVecEnv([lambda: env]), lambda env: InProcess([env])]
)
def test_evaluate_policy_keeps_to_the_masks(masked, wrap, deterministic):
    env = One()
    mean, _ = evaluate_policy(masked, wrap(env), 3, deterministic)
    assert (env.taken, env.illegal) == (18, 0)
    assert mean == 6.0


def test_eval_callback_keeps_to_the_masks(masked):
    env = One()
    from rejeu.sb3.common.vec_env import VecMonitor

    callback = EvalCallback(VecMonitor(DummyVecEnv([lambda: env])), eval_freq=12, n_eval_episodes=3, verbose=0)
    masked.learn(24, callback=callback)
    assert (env.taken, env.illegal) == (36, 0)
    assert callback.best_mean_reward == 6.0


def test_a_masked_agent_may_be_evaluated_in_its_own_environment_while_it_learns(masked):
    env = masked.env.inner.envs[0].env
    masked.learn(24, every(7, lambda agent: (agent.evaluate(1, env=env), evaluate_policy(agent, env, 1))))
    assert env.illegal == 0


def test_training_does_not_go_on_from_the_seed_of_an_evaluation():
    env = Starts()
    agent = rejeu.A2C("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [4]})
    agent.learn(60, lambda agent, turn: turn.step % 20 or agent.evaluate(1, seed=7) is not None)
    evaluated = [i for i, seed in enumerate(env.seeds) if seed == 7]
    assert len(evaluated) == 3
    after = [env.starts[i + 1] for i in evaluated]
    assert len({*after}) == 3


class Starts(Timed):
    """Episodes of five steps that begin at random; remembers where, and by what seeds it was reset."""

    action_space = gym.spaces.Discrete(2)
    length = 5

    def __init__(self):
        self.seeds, self.starts = [], []

    def begin(self, seed):
        self.seeds.append(seed)
        self.starts.append(float(self.np_random.random()))
