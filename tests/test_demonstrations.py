"""Demonstrations: recorded, read, imitated, and learned from."""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu import demonstrations
from rejeu.algorithms import iql
from rejeu.callbacks import Checkpoint
from rejeu.demonstrations import Demonstrations, Episode, clone, dagger, learn_offline, read, record
from rejeu.networks import action_values
from tests.environments import Reach, Timed
from tests.sharing import shared_learners
from tests.tiers import exhaustive, only, only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [16]}, "seed": 0}
ACTIONS: dict[str, gym.Space] = {
    "Box": gym.spaces.Box(-2.0, 6.0, (2,)),
    "Discrete": gym.spaces.Discrete(3, start=-1),
    "MultiDiscrete": gym.spaces.MultiDiscrete([2, 3]),
    "MultiBinary": gym.spaces.MultiBinary(2),
}


class Target(Timed):
    """Episodes of 5 steps, in which the best action depends on the observation alone."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    length = 5

    def __init__(self, kind: str = "Box") -> None:
        self.action_space = ACTIONS[kind]

    def best(self, obs: np.ndarray) -> Any:
        space = self.action_space
        if isinstance(space, gym.spaces.Box):
            return (2.0 + 3.0 * obs).astype(np.float32)
        if isinstance(space, gym.spaces.Discrete):
            return int(np.digitize(obs[0], [-0.3, 0.3])) - 1
        return (obs > 0).astype(space.dtype)

    def reward(self, action: Any) -> float:
        return -float(np.abs(np.asarray(action) - self.best(self.obs)).sum())

    def observe(self) -> np.ndarray:
        self.obs = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.obs


class Expert:
    """Plays the best action."""

    def __init__(self, env: Target) -> None:
        self.env = env

    def predict(self, obs: np.ndarray, deterministic: bool = True) -> tuple[Any, None]:
        return self.env.best(obs), None


def shown(kind: str, episodes: int = 40) -> tuple[Target, Demonstrations]:
    env = Target(kind)
    return env, record(Expert(env), env, episodes, seed=1)


IMITATORS = [
    *((name, "Box") for name in ("PPO", "A2C", "TRPO", "SAC", "TD3", "DDPG", "TQC", "IQL", "TD3BC", "ReBRAC")),
    *((name, "Discrete") for name in ("PPO", "A2C", "TRPO", "SAC", "DDPG", "DQN", "QRDQN", "IQN", "PQN")),
    *((name, kind) for name in ("PPO",) for kind in ("MultiDiscrete", "MultiBinary")),
]


@pytest.mark.parametrize(
    ("name", "kind"),
    only_tuples([("SAC", "Box"), ("DQN", "Discrete"), ("PPO", "MultiDiscrete")], IMITATORS),
)
def test_every_agent_imitates(name: str, kind: str) -> None:
    env, shown_to_it = shown(kind)
    with shared_learners():
        agent = getattr(rejeu, name)("MlpPolicy", env, **SMALL)
    before = agent.evaluate(20, env=Target(kind), seed=0).mean_return
    clone(agent, shown_to_it, 400, learning_rate=1e-2)
    after = agent.evaluate(20, env=Target(kind), seed=0).mean_return
    assert after > 0.35 * before, (before, after)  # both are negative


@pytest.mark.parametrize("name", only(["CrossQ"], ["CrossQ", "XQC", "FlashSAC"]))
def test_a_clone_with_batch_normalization_stays_one_in_training(name: str) -> None:
    """Its statistics and norms are those of training, so that updates that learn nothing leave it as it is."""
    env, shown_to_it = shown("Box")
    agent = getattr(rejeu, name)("MlpPolicy", env, learning_rate=1e-9, policy_delay=1, learning_starts=0, **SMALL)
    clone(agent, shown_to_it, 500, learning_rate=1e-2)
    before = agent.evaluate(20, env=Target(), seed=0).mean_return
    learn_offline(agent, shown_to_it, 200)
    after = agent.evaluate(20, env=Target(), seed=0).mean_return
    assert before > -3.0
    assert after > before - 1.0


def test_normalized_agents_imitate_by_their_own_statistics() -> None:
    env, shown_to_it = shown("Box")
    agent = rejeu.PPO("MlpPolicy", env, normalize=True, **SMALL)
    clone(agent, shown_to_it, 400, learning_rate=1e-2)
    seen = np.concatenate([episode.observations[:-1] for episode in shown_to_it.episodes])
    np.testing.assert_allclose(agent.learner.state(agent.run.state).statistics.obs[0].mean, seen.mean(0), atol=1e-5)
    assert agent.evaluate(20, env=Target(), seed=0).mean_return > -2.0


def test_target_networks_follow_a_clone() -> None:
    env, shown_to_it = shown("Box", 2)
    agent = rejeu.TD3("MlpPolicy", env, **SMALL)
    clone(agent, shown_to_it, 3)
    state = agent.learner.state(agent.run.state)
    assert eqx.tree_equal(state.actor, state.target_actor)


@exhaustive
@pytest.mark.parametrize(
    ("name", "normalize"), only_tuples([("SAC", True)], [("SAC", True), ("TD3", False), ("TQC", False)])
)
def test_critics_learn_what_was_recorded_while_the_policy_is_kept(name: str, normalize: bool) -> None:
    """With ``gamma=0`` the value of a recorded action is its reward."""
    env = Target()
    mixed = record(Anywhere(env), env, 100, seed=0)
    agent = getattr(rejeu, name)("MlpPolicy", env, gamma=0.0, learning_rate=3e-3, normalize=normalize, **SMALL)
    clone(agent, mixed, 3)
    actor = agent.learner.algorithm.actor(agent.learner.state(agent.run.state))
    assert learn_offline(agent, mixed, 1500, keep_policy=True).keys() >= {"critic_loss", "actor_loss"}
    assert eqx.tree_equal(actor, agent.learner.algorithm.actor(agent.learner.state(agent.run.state)))
    obs = np.concatenate([episode.observations[:-1] for episode in mixed.episodes])
    actions = np.concatenate([episode.actions for episode in mixed.episodes])
    rewards = np.concatenate([episode.rewards for episode in mixed.episodes])
    assert np.corrcoef(agent.q_values(obs, actions), rewards)[0, 1] > 0.9


class Corridor(gym.Env):
    """Walk along y = 0. An expert that starts there never shows the way back."""

    observation_space = gym.spaces.Box(-10.0, 10.0, (2,))
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.obs = np.zeros(2, np.float32)
        return self.obs, {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        drift = 0.6 * np.sin(self.obs[0] * 7)
        self.obs = np.array([self.obs[0] + 0.1, self.obs[1] + 0.5 * (action - 1) + drift], np.float32)
        return self.obs, float(abs(self.obs[1]) < 1), False, bool(self.obs[0] > 5), {}


@exhaustive
def test_dagger_asks_the_expert_where_the_agent_came() -> None:
    asked: list[np.ndarray] = []

    def expert(obs: np.ndarray) -> int:
        asked.append(obs)
        return int(np.sign(-np.round(obs[1])) + 1)

    agent = rejeu.PPO("MlpPolicy", Corridor(), **SMALL)
    rounds: list[tuple[int, int]] = []
    say = lambda i, known: rounds.append((i, len(known.episodes)))  # noqa: E731
    labeled = dagger(agent, expert, Corridor(), rounds=3, steps=100, updates=300, after_round=say)
    assert rounds == [(1, 2), (2, 4), (3, 6)]
    assert len(asked) == labeled.n_steps >= 300
    assert [int(a) for e in labeled.episodes for a in e.actions] == [int(np.sign(-np.round(o[1])) + 1) for o in asked]
    assert agent.evaluate(5, env=Corridor()).mean_return > 40


class InPlace(gym.Env):
    """Counts its steps, always in the same array."""

    observation_space, action_space = gym.spaces.Box(0.0, 9.0, (1,)), gym.spaces.Box(0.0, 9.0, (1,))

    def __init__(self) -> None:
        self.obs = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.obs[:] = 0.0
        return self.obs, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.obs += 1.0
        return self.obs, 1.0, False, bool(self.obs[0] == 6), {}


def test_what_is_played_keeps_arrays_that_environment_and_agent_write_to_again() -> None:
    class Repeats:
        action = np.zeros(1, np.float32)

        def predict(self, obs: np.ndarray, deterministic: bool = True) -> tuple[np.ndarray, None]:
            self.action[:] = obs
            return self.action, None

    for episode in record(Repeats(), InPlace(), 2, seed=0).episodes:
        np.testing.assert_array_equal(episode.observations[:, 0], np.arange(7))
        np.testing.assert_array_equal(episode.actions[:, 0], np.arange(6))
    parts, _ = demonstrations.play(InPlace(), Repeats(), lambda obs, own: None if obs[0] == 3 else own)
    assert [part.observations[:, 0].tolist() for part in parts] == [[0, 1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("takes_over", [False, True])
def test_answers_to_actions_that_were_not_taken_are_cloned_and_not_replayed(takes_over: bool, tmp_path: Path) -> None:
    """Rewards and next observations follow from the agent's actions; where the expert takes over they are its own."""
    env = Target()
    agent = rejeu.SAC("MlpPolicy", env, **SMALL)
    answers = dagger(agent, env.best, env, takes_over=takes_over, rounds=1, steps=5, updates=1)
    taken = record(Expert(env), env, 1, seed=0)
    assert {episode.is_labeled for episode in answers.episodes} == {not takes_over}
    for known in (answers, taken + answers, answers + taken):
        if takes_over:
            assert agent.replay_of(known, agent.run.env).size() == known.n_steps
            continue
        with pytest.raises(ValueError, match="clone them, or record"):
            learn_offline(agent, known, 1)
    assert not any(episode.is_labeled for episode in taken.episodes)


def test_an_expert_that_never_answers_labels_nothing() -> None:
    agent, env, seeds = rejeu.PPO("MlpPolicy", Target(), **SMALL), Target(), []
    reset = env.reset
    env.reset = lambda *, seed=None, options=None: (seeds.append(seed), reset(seed=seed))[1]  # type: ignore[method-assign]
    found = dagger(agent, lambda obs: None, env, rounds=2, steps=11, seed=7)
    assert str(found) == "0 episodes, 0 steps, mean return nan"
    assert seeds == [1007, 1008, 1009, 2007, 2008, 2009]  # no episode is played twice


def test_a_dataset_is_read_as_it_was_recorded(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    env = Target()
    recorded = record(Expert(env), env, 3, tmp_path / "shown", seed=0)
    found = read(tmp_path / "shown")
    assert found.observation_space == env.observation_space
    assert len(found.episodes) == 3
    for one, other in zip(recorded.episodes, found.episodes, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.actions, other.actions)
        np.testing.assert_array_equal(one.rewards, other.rewards)
        assert one.terminated == other.terminated
    with pytest.raises(FileExistsError):
        record(Expert(env), env, 1, tmp_path / "shown")
    with pytest.raises(TypeError, match="one Gymnasium environment, got InProcess"):
        record(Expert(env), rejeu.make_vector(Target, 2), 1)
    with pytest.raises(FileNotFoundError, match="holds no Minari dataset"):
        read(tmp_path / "nothing")
    for name, content in (("main_data.hdf5", "cut"), ("metadata.json", "{}"), ("metadata.json", "")):
        next((tmp_path / "shown").rglob(f"data/{name}")).write_text(content)
        with pytest.raises(ValueError, match="data is damaged"):
            read(tmp_path / "shown")


def by_hand(n: int, terminated: bool, first: float = 0.0) -> Episode:
    """An episode whose observations count its steps."""
    obs = np.stack([first + np.arange(n + 1), np.zeros(n + 1)], axis=1).astype(np.float32)
    return Episode(obs, np.full((n, 2), 2.0, np.float32), np.arange(n, dtype=np.float32), terminated)


def test_every_recorded_episode_has_a_seed_of_its_own() -> None:
    begins = [episode.observations[0].tolist() for episode in shown("Box", 3)[1].episodes]
    assert begins[0] != begins[1] != begins[2]


def test_a_replay_buffer_holds_the_steps() -> None:
    env = Target()
    agent = rejeu.SAC("MlpPolicy", env, gamma=0.5, **SMALL)
    both = Demonstrations((by_hand(3, True), by_hand(2, False, 10.0)), env.observation_space, env.action_space)
    replay = agent.replay_of(both, agent.run.env)
    batch = replay.sample(np.random.default_rng(0), (200,))
    x = batch.obs[:, 0]
    assert set(x) == {0.0, 1.0, 2.0, 10.0, 11.0}
    assert replay.size() == 5
    np.testing.assert_array_equal(batch.next_obs[:, 0], x + 1)
    np.testing.assert_array_equal(batch.reward, x % 10)
    np.testing.assert_array_equal(batch.discount, np.where(x == 2, 0.0, 0.5))
    np.testing.assert_array_equal(batch.action, 0)  # 2 is the middle of the range


def test_every_batch_has_its_share(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    env = Reach()
    shown_to_it = record(Anywhere(env), env, 3, tmp_path / "shown", seed=0)
    agent = rejeu.SAC(
        "MultiInputPolicy",
        env,
        demonstrations=tmp_path / "shown",
        demonstration_share=0.25,
        replay_buffer_class="HerReplayBuffer",
        learning_starts=20,
        batch_size=32,
        **SMALL,
    ).learn(30)
    replay = agent.replay_buffer
    assert isinstance(replay, demonstrations.WithDemonstrations)
    assert "25% of each batch" in repr(replay)
    batch = replay.sample(np.random.default_rng(0), (4, 32))
    assert batch.reward.shape == (4, 32)
    recorded = {float(x) for episode in shown_to_it.episodes for x in episode.observations["observation"].ravel()}
    is_recorded = np.vectorize(lambda x: float(x) in recorded)(batch.obs["observation"][..., 0])
    assert is_recorded[:, 24:].all()
    assert not is_recorded[:, :24].any()
    assert (batch.reward == 0).any(axis=1).all()  # of goals in hindsight


@pytest.mark.parametrize("is_clone", only([True], [False, True]))
def test_a_run_with_demonstrations_resumes_equal(tmp_path: Path, is_clone: bool) -> None:
    pytest.importorskip("minari")
    env = gym.make("Pendulum-v1")
    data = record(Anywhere(env), env, 1, tmp_path / "shown", seed=0)
    settings: dict[str, Any] = {**SMALL, "demonstrations": tmp_path / "shown", "learning_starts": 20, "batch_size": 32}

    def made() -> rejeu.SAC:
        agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", **settings)
        if is_clone:
            clone(agent, data, 5)
            learn_offline(agent, data, 5, keep_policy=True)
        return agent

    with shared_learners():
        whole = made().learn(80)
        stop = lambda agent, turn: turn.step < 50  # noqa: E731
        made().learn(80, [Checkpoint(tmp_path / "run", every=1000), stop])
        resumed = rejeu.SAC.resume(tmp_path / "run").learn()
    assert eqx.tree_equal(whole.learner.state(whole.run.state), resumed.learner.state(resumed.run.state))


class Anywhere:
    """Plays random actions."""

    def __init__(self, env: gym.Env) -> None:
        self.space = env.action_space
        self.space.seed(0)

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[Any, None]:
        return self.space.sample(), None


def test_losses_of_iql() -> None:
    """Equation 5 by hand."""
    observed, recorded = jnp.zeros((2, 1)), jnp.array([3.0, -1.0])
    loss, _ = iql.value_loss(lambda obs: jnp.array([[1.0], [1.0]]), observed, recorded, 0.9)  # type: ignore[arg-type]
    assert float(loss) == pytest.approx((0.9 * 2**2 + 0.1 * 2**2) / 2)


@pytest.mark.parametrize("inverse_temperature", only([2.0], [0.0, 2.0, 50.0]))
def test_good_actions_of_iql_weigh_more(inverse_temperature: float) -> None:
    """The gradient of the policy's mean is that of equation 7, from the networks of before and the value of after."""
    env = Target()
    settings: dict[str, Any] = {"inverse_temperature": inverse_temperature, "expectile": 0.8, "optimizer": "sgd"}
    agent = rejeu.IQL("MlpPolicy", env, learning_rate=1.0, policy_kwargs={"net_arch": []}, seed=0, **settings)
    algorithm, before = agent.learner.algorithm, agent.learner.state(agent.run.state)
    rng = np.random.default_rng(0)
    obs, action, following = (rng.uniform(-1, 1, (5, 2)).astype(np.float32) for _ in range(3))
    reward, discount = rng.normal(size=5).astype(np.float32), np.full(5, 0.9, np.float32)
    batch = rejeu.Transition(obs, action, reward, following, discount)
    after, metrics = jax.jit(algorithm.update)(before, batch, rejeu.Clock(np.uint32(0), np.uint32(0), np.float32(0)))

    q = np.min(action_values(before.target_critics, obs, action), axis=0)
    advantage = q - np.asarray(before.value(obs))[:, 0]
    slope = -2 * np.abs(0.8 - (advantage < 0)) * advantage
    moved = np.asarray(before.value.head.bias - after.value.head.bias)
    np.testing.assert_allclose(moved, [slope.mean()], rtol=1e-4)

    weight = np.minimum(np.exp(inverse_temperature * (q - np.asarray(after.value(obs))[:, 0])), 100.0)
    output = np.asarray(before.actor.network(obs))
    mean = np.tanh(output)
    slope = -(weight[:, None] * (action - mean) * (1 - mean**2)).mean(0)  # of standard deviation 1
    np.testing.assert_allclose(
        before.actor.network.head.bias - after.actor.network.head.bias, slope, rtol=1e-4, atol=1e-7
    )

    target = reward + discount * np.asarray(after.value(following))[:, 0]
    errors = np.asarray(action_values(before.critics, obs, action)) - target
    assert float(metrics["critic_loss"]) == pytest.approx(float((errors**2).mean(axis=1).sum()), rel=1e-4)


NESTED = gym.spaces.Dict(a=gym.spaces.Discrete(2), b=gym.spaces.Box(-1.0, 1.0, (2,)))
SPACES: list[tuple[str, gym.Space, gym.Space]] = [
    ("action space", gym.spaces.Discrete(3), gym.spaces.Discrete(4)),
    ("action space", gym.spaces.MultiDiscrete([2, 3]), gym.spaces.MultiDiscrete([2, 5])),
    ("action space", gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Box(-9.0, 9.0, (2,))),
    ("action space", gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Discrete(2)),
    ("action space", NESTED, NESTED),  # of several parts
    ("observation space", gym.spaces.Discrete(3), gym.spaces.Discrete(4)),
    ("observation space", gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), gym.spaces.Box(0.0, 1.0, (8, 8, 3))),
]


@pytest.mark.parametrize(("kind", "own", "theirs"), SPACES)
def test_spaces_that_mean_something_else_are_refused(kind: str, own: gym.Space, theirs: gym.Space) -> None:
    env, known = shown("Box", 1)
    setattr(env, kind.replace(" ", "_"), own)
    other = dataclasses.replace(known, **{kind.replace(" ", "_"): theirs})
    with pytest.raises(ValueError, match="cannot be learned from" if own == theirs else kind):
        clone(rejeu.PPO("MlpPolicy", env, **SMALL), other, 1)


MEMORY: dict[str, Any] = {"seed": 0, "policy_kwargs": {"lstm_hidden_size": 8, "net_arch": [8]}}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env, known: clone(rejeu.RecurrentPPO("MlpPolicy", env, **SMALL), known, 1), "has a memory"),
        (lambda env, known: learn_offline(rejeu.SAC("MlpPolicy", env, **MEMORY), known, 1), "has a memory"),
        (lambda env, known: learn_offline(rejeu.PPO("MlpPolicy", env, **SMALL), known, 1), "has no replay buffer"),
        (
            lambda env, known: learn_offline(rejeu.PPO("MlpPolicy", env, **SMALL), known, 1, keep_policy=True),
            "PPO has no critics",
        ),
        (
            lambda env, known: rejeu.SAC("MlpPolicy", env, demonstrations="shown", priorities={}),
            "cannot be combined",
        ),
    ],
)
def test_agents_and_settings_that_do_not_go_with_it_are_refused(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(*shown("Box", 1))


def test_damaged_demonstrations_are_refused() -> None:
    env, known = shown("Discrete", 1)
    agent = rejeu.PPO("MlpPolicy", env, **SMALL)
    (episode,) = known.episodes
    damaged = {
        "NaN or infinite": dataclasses.replace(episode, observations=episode.observations * np.nan),
        "actions from 9 to 9": dataclasses.replace(episode, actions=np.full_like(episode.actions, 9)),
        "5 rewards, 3 actions": dataclasses.replace(episode, actions=episode.actions[:3]),
        "hold no step": dataclasses.replace(episode, rewards=episode.rewards[:0]),
    }
    for message, one in damaged.items():
        with pytest.raises(ValueError, match=message):
            clone(agent, dataclasses.replace(known, episodes=(one,)), 1)
    with pytest.raises(TypeError, match="what read"):
        clone(agent, "shown", 1)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["terminations", "truncations"])
def test_a_recorded_episode_that_goes_on_after_its_end_is_refused_by_its_name(kind: str, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("minari")
    env = Target()
    record(Expert(env), env, 2, tmp_path / "shown", seed=0)
    (main,) = tmp_path.rglob("main_data.hdf5")
    with h5py.File(main, "r+") as file:
        file[f"episode_1/{kind}"][2] = True
    with pytest.raises(ValueError, match=rf"episode_1 of .*shown has {kind} at step 2 of 5; an episode ends where one"):
        read(tmp_path / "shown")


def test_a_clone_that_diverges_leaves_the_agent_as_it_was() -> None:
    env, known = shown("Box", 1)
    agent = rejeu.PPO("MlpPolicy", env, **SMALL)
    before = agent.run.state
    with pytest.raises(ValueError, match="try a learning_rate below"):
        clone(agent, known, 100, learning_rate=1e38)
    assert agent.run.state is before


def test_an_agent_with_a_memory_remembers_while_it_is_recorded() -> None:
    class Counts:
        def predict(self, obs: Any, state: Any = None, deterministic: bool = True) -> tuple[np.ndarray, int]:
            n = 0 if state is None else state
            return np.full(2, n, np.float32), n + 1

    recorded = record(Counts(), Target(), 2, seed=0)
    for episode in recorded.episodes:
        np.testing.assert_array_equal(episode.actions[:, 0], np.arange(5))


class OneAllowed(Target):
    """Allows the actions in turn."""

    def action_masks(self) -> np.ndarray:
        return np.arange(3) == self.time % 3


def test_an_agent_with_masks_is_recorded_with_them() -> None:
    env = OneAllowed("Discrete")
    (episode,) = record(rejeu.PPO("MlpPolicy", env, action_masks=True, **SMALL), env, 1).episodes
    assert episode.actions.tolist() == [-1, 0, 1, -1, 0]
    assert episode.observations.shape == (6, 2)
    dqn = rejeu.DQN("MlpPolicy", env, action_masks=True, **SMALL)
    shown_to_it = Demonstrations((episode,), env.observation_space, env.action_space)
    assert np.isfinite(clone(dqn, shown_to_it, 3))
    with pytest.raises(ValueError, match="has no masks"):
        learn_offline(dqn, shown_to_it, 3)


def test_demonstrations_are_found_from_another_folder() -> None:
    assert rejeu.SAC.algorithm.Config(demonstrations="shown").demonstrations == str(Path.cwd() / "shown")
    with pytest.raises(TypeError, match="must be the folder"):
        rejeu.SAC.algorithm.Config(demonstrations=shown("Box", 1)[1])


def test_dagger_counts_each_step_once_in_the_statistics() -> None:
    env, recorded = shown("Box", 2)
    agent = rejeu.PPO("MlpPolicy", env, normalize=True, **SMALL)
    known = dagger(agent, env.best, env, recorded, rounds=3, steps=10, updates=2)
    statistics = agent.learner.state(agent.run.state).statistics
    assert known.n_steps == 40
    assert statistics.obs[0].n_seen == statistics.returns.n_seen == 40
    obs = np.concatenate([episode.observations[:-1] for episode in known.episodes])
    np.testing.assert_allclose(statistics.obs[0].mean, obs.mean(0), atol=1e-5)


def test_demonstrations_have_no_infos_of_the_training_environment() -> None:
    env = Reach()
    known = record(Anywhere(env), env, 1, seed=0)
    settings = {"copy_info_dict": True}
    agent = rejeu.SAC(
        "MultiInputPolicy", env, replay_buffer_class="HerReplayBuffer", replay_buffer_kwargs=settings, **SMALL
    )
    agent.learn(3)
    infos = agent.replay_of(known, agent.run.env).infos
    assert [info for info in infos if info] == []


def test_an_agent_without_an_environment_does_not_learn_offline(tmp_path: Path) -> None:
    env, known = shown("Box", 1)
    path = rejeu.IQL("MlpPolicy", env, **SMALL).save(tmp_path / "model")
    with pytest.raises(ValueError, match="has no environment"):
        learn_offline(rejeu.load(path), known, 1)
    with pytest.raises(ValueError, match="steps=0"):
        dagger(rejeu.IQL("MlpPolicy", env, **SMALL), Expert(env).predict, env, known, steps=0)
