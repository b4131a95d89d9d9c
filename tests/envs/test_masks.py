"""Action masks: what is forbidden is never done nor learnt from, and who says what is allowed, and when."""

import functools

import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import rejeu
from rejeu.algorithms import ppo
from rejeu.algorithms.actor_critic.steps import samples
from rejeu.core.algorithm import Clock, Masked
from rejeu.core.errors import BadEnvironmentError, WorkerError
from rejeu.envs.make import InProcess, make_vector
from rejeu.envs.masks import flat_mask, make_masked
from rejeu.sb3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor
from rejeu.training.learner import Readings
from tests.environments import Counter
from tests.helpers import assert_same_parameters
from tests.tiers import crossed, exhaustive, only
from tests.worker_environments import ACTIONS, Leaving, Rules, Silent, sizes

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.0))
pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [4]}, "n_steps": 64, "batch_size": 64, "n_epochs": 1, "seed": 0}


def small(env, **settings):
    return rejeu.MaskablePPO("MlpPolicy", env, **{**SMALL, **settings})


def vector(kind, by="info", n_envs=3):
    return InProcess([Rules(kind, by) for _ in range(n_envs)], seed=0)


# What is forbidden is not done: the environment itself checks every action.


NEVER = [("multi", "info", 3), *(pytest.param(kind, "method", 1, marks=exhaustive) for kind in ACTIONS)]


@pytest.mark.parametrize(("kind", "by", "n_envs"), NEVER)
def test_what_is_forbidden_is_never_done(kind, by, n_envs):
    env = vector(kind, by, n_envs)
    agent = small(env).learn(600)
    assert sum(one.taken for one in env.envs) == agent.num_timesteps >= 600  # whole rollouts
    assert len(agent.history) > 60
    other = vector(kind, by, n_envs)
    for deterministic in (True, False):
        agent.evaluate(60, env=other, deterministic=deterministic)
    assert sum(one.taken for one in other.envs) > 200
    assert all(np.isfinite(value).all() for value in agent.get_parameters().values())


@exhaustive
def test_a_rollout_of_whole_episodes_keeps_to_the_masks():
    env = vector("multi")
    small(env, n_episodes=2, n_steps=6).learn(300)
    assert sum(one.taken for one in env.envs) >= 300


def with_spawn(mode):
    return lambda fns: AsyncVectorEnv(fns, autoreset_mode=mode, context="forkserver")


ELSEWHERE = {
    "workers": lambda fns: make_vector(fns[0], 2, "gymnasium-async"),
    "subproc": SubprocVecEnv,
    "wrapped": lambda fns: VecMonitor(DummyVecEnv(fns)),
    "async same step": with_spawn(AutoresetMode.SAME_STEP),
    "async next step": with_spawn(AutoresetMode.NEXT_STEP),
    "async disabled": with_spawn(AutoresetMode.DISABLED),
    "sync": SyncVectorEnv,
}


@pytest.mark.parametrize(("where", "by"), crossed(list(ELSEWHERE), ["info", "method"]))
def test_masks_of_environments_elsewhere_are_those_of_environments_in_this_process(where, by):
    fns = [functools.partial(Rules, "multi", by)] * 2
    here, there = make_masked(fns[0], 2), make_masked(ELSEWHERE[where](fns))
    try:
        shown, seen = here.reset(5), there.reset(5)
        for _ in range(20):
            np.testing.assert_array_equal(seen.obs, shown.obs)
            np.testing.assert_array_equal(seen.mask, shown.mask)
            action = np.stack([part.argmax(axis=1) for part in np.split(seen.mask, [2, 5], axis=1)], axis=1)
            step, other = here.step(action), there.step(action)
            done = step.terminated | step.truncated
            np.testing.assert_array_equal(other.obs.obs, step.obs.obs)
            np.testing.assert_array_equal(other.obs.mask[~done], step.obs.mask[~done])
            expected = step.obs.mask if by == "info" or where == "sync" else np.ones((2, 9), bool)
            np.testing.assert_array_equal(other.obs.mask[done], expected[done])
            shown, seen = step.obs, other.obs
            if done.any():
                shown, seen = here.reset_done(done), there.reset_done(done)
    finally:
        there.close()


@exhaustive
def test_an_agent_learns_with_the_masks_of_worker_processes():
    env = SubprocVecEnv([functools.partial(Rules, "discrete", "method")] * 2)
    try:
        agent = small(env, n_steps=16).learn(64)
        assert agent.env.inner.venv is env
    finally:
        env.close()


def test_masks_that_workers_do_not_have_are_asked_for():
    vector = SubprocVecEnv([Silent])
    try:
        with pytest.raises(BadEnvironmentError, match=r'put info\["action_mask"\] into what reset and step return'):
            make_masked(vector).reset()
    finally:
        vector.close()


class Mistaken(Silent):
    def action_masks(self):
        return self.allowed_moves()


def test_an_attribute_error_in_the_mask_of_an_environment_is_its_own():
    with pytest.raises(AttributeError, match="no attribute 'allowed_moves'"):
        make_masked(Mistaken()).reset()
    vector = make_masked(make_vector(Mistaken, 1, "gymnasium-async"))
    try:
        with pytest.raises(BadEnvironmentError, match="does not return action masks") as caught:
            vector.reset()
        assert "no attribute 'allowed_moves'" in str(caught.value.__cause__)
    finally:
        vector.close()


@exhaustive
def test_a_lost_worker_with_masks_is_started_anew_where_that_is_asked_for():
    env = make_masked(Leaving, 2, "gymnasium-async", seed=0, worker_timeout=60.0, restart_workers=1)
    try:
        env.reset()
        with pytest.warns(RuntimeWarning, match=r"restarted \(1 of at most 1 times\)"):
            step = env.step(np.array([0, 1]))
        assert step.truncated.tolist() == [False, True]
        assert env.reset_done(step.truncated).mask.tolist() == [[True, True]] * 2
        with pytest.raises(WorkerError, match="and 1 restarts are spent"):
            env.step(np.array([0, 1]))
    finally:
        env.close()


@pytest.mark.parametrize("normalize", only([True], [True, {"norm_reward": False}]))
def test_masks_and_normalisation_go_together(normalize):
    env = vector("discrete")
    agent = small(env, normalize=normalize).learn(384)
    statistics = agent.state.statistics
    assert [m.mean.shape for m in statistics.obs] == [(2,)]
    assert float(statistics.obs[0].n_seen) == 384
    agent.evaluate(20, env=vector("discrete"))


# What is learnt from.


@functools.cache
def recorded(kind):
    """An agent's state before its first update, the rollout that it is about to learn from, and the environments."""
    env = vector(kind, n_envs=2)
    agent = small(env, n_steps=32)
    rollouts = []

    def keep(state, batches, clock):
        rollouts.append((agent.state, jax.tree.map(np.array, batches)))
        return state, Readings((), np.zeros(1)), None

    agent.learner.update = keep
    agent.learn(64)
    return rollouts[0], env


@pytest.mark.parametrize("kind", only({"discrete", "multi"}, ACTIONS))
def test_masks_are_stored_with_the_step_that_they_belong_to(kind):
    (_, rollout), env = recorded(kind)
    mask = rollout.obs.mask
    assert mask.dtype == bool
    space = ACTIONS[kind]
    for e, one in enumerate(env.envs):
        shown = iter(one.masks)
        for t in range(32):
            assert np.array_equal(mask[t, e], next(shown)), (t, e)
            following = next(shown)
            assert np.array_equal(rollout.next_obs.mask[t, e], following)
            if not rollout.ended[t, e]:
                shown = iter([following, *shown])
            own = type("", (), {})()
            own.mask, own.action_space = mask[t, e], space
            start = space.start if isinstance(space, spaces.Discrete) else 0
            action = rollout.action[t, e] + start
            assert Rules.allows(own, action)


def allowed_distribution(logits, mask, space):
    """Probabilities of each part over the allowed possibilities alone, in float64."""
    parts, at = [], 0
    for n in sizes(space):
        x, m = np.float64(logits[at : at + n]), mask[at : at + n]
        if isinstance(space, spaces.MultiBinary):
            parts.append(
                np.array([1.0, 0.0]) if not m[0] else np.array([1 - 1 / (1 + np.exp(-x[0])), 1 / (1 + np.exp(-x[0]))])
            )
        else:
            p = np.where(m, np.exp(x - x[m].max()), 0.0)
            parts.append(p / p.sum())
        at += n
    return parts


@pytest.mark.parametrize("kind", only({"discrete", "multi"}, ACTIONS))
def test_learning_knows_the_probabilities_among_what_was_allowed(kind):
    (state, rollout), _ = recorded(kind)
    space = ACTIONS[kind]
    bold = jax.tree.map(lambda x: 3.0 * x, state.network)
    data = samples(bold, rollout, 0.95)
    distribution = bold.policy(data.obs)
    raw = bold.head(bold.hidden(data.obs.obs))
    raw, entropy = np.float64(raw), np.asarray(distribution.entropy())
    action = np.asarray(data.action).reshape(64, -1)
    for i in range(64):
        parts = allowed_distribution(raw[i], np.asarray(data.obs.mask)[i], space)
        log_prob = sum(np.log(p[a]) for p, a in zip(parts, action[i], strict=True))
        assert float(data.log_prob[i]) == pytest.approx(log_prob, abs=2e-5)
        h = -sum((p[p > 0] * np.log(p[p > 0])).sum() for p in parts)
        assert float(entropy[i]) == pytest.approx(h, abs=2e-5)


def test_what_is_forbidden_gets_no_gradient():
    (state, rollout), _ = recorded("discrete")
    mask = np.ones((32, 2, 5), bool)
    mask[..., 3] = False
    action = np.where(rollout.action == 3, 0, rollout.action)
    rollout = rollout._replace(obs=Masked(rollout.obs.obs, mask), action=action)
    data = samples(state.network, rollout, 0.95)
    config = ppo.Config(ent_coef=0.1)
    _, slope = ppo.gradient(state.network, data, config, CLOCK)
    weight = np.asarray(slope.head.weight)
    assert np.abs(weight[:, 3]).max() == 0.0
    assert np.abs(np.delete(weight, 3, axis=1)).min() > 0.0


@exhaustive
def test_the_best_of_what_is_allowed_is_learnt():
    """Rewards are the action itself: with the mask in hand the best is the largest that is allowed."""
    agent = small(vector("discrete"), gamma=0.0, learning_rate=0.02, n_steps=128, n_epochs=4).learn(4000)
    rng = np.random.default_rng(0)
    mask = rng.random((100, 5)) < 0.5
    mask[np.arange(100), rng.integers(0, 5, 100)] = True
    action, _ = agent.predict(rng.normal(size=(100, 2)).astype(np.float32), deterministic=True, action_masks=mask)
    best = [np.flatnonzero(m)[-1] for m in mask]
    assert np.mean(action == best) > 0.9


# Predict.


def test_predict_keeps_to_the_mask_that_it_is_given():
    agent = small(vector("shifted"))
    obs = np.random.default_rng(0).normal(size=(300, 2)).astype(np.float32)
    mask = np.tile([0, 1, 0, 1], (300, 1))
    for deterministic in (True, False):
        action, _ = agent.predict(obs, deterministic=deterministic, action_masks=mask)
        assert set(action.tolist()) <= {-1, 1}
    assert set(agent.predict(obs, action_masks=mask)[0].tolist()) == {-1, 1}
    assert set(agent.predict(obs)[0].tolist()) == {-2, -1, 0, 1}  # without a mask all is allowed
    assert agent.predict(obs[0], action_masks=[0, 0, 1, 0])[0] == 0


def test_predict_refuses_a_mask_of_another_length_and_other_agents_take_none():
    with pytest.raises(ValueError, match=r"action_masks has shape \(3,\), expected \(1, 4\)"):
        small(vector("shifted")).predict(np.zeros(2, np.float32), action_masks=[1, 1, 1])
    with pytest.raises(TypeError, match="made without action_masks=True"):
        rejeu.A2C("MlpPolicy", Rules(), policy_kwargs={"net_arch": [4]}).predict(
            np.zeros(2, np.float32), action_masks=np.ones(5)
        )


def test_a_file_keeps_all_of_it(tmp_path):
    agent = small(vector("multi")).learn(192)
    loaded = rejeu.load(agent.save(tmp_path / "model"), env=vector("multi"))
    assert isinstance(loaded, rejeu.MaskablePPO)
    assert_same_parameters(agent, loaded)
    rng = np.random.default_rng(1)
    obs, mask = rng.normal(size=(20, 2)).astype(np.float32), np.ones((20, 9), bool)
    mask[:, [0, 2, 7]] = False
    one, other = (a.predict(obs, deterministic=True, action_masks=mask)[0] for a in (agent, loaded))
    assert np.array_equal(one, other)
    loaded.learn(192)


def test_a_registered_environment_is_made_anew_for_evaluation():
    gym.register("rejeu-test/Rules-v0", functools.partial(Rules, "discrete"), max_episode_steps=50)
    agent = small("rejeu-test/Rules-v0")
    assert agent.env.max_episode_steps == 50
    one, other = (agent.evaluate(8, seed=3).returns for _ in range(2))
    assert np.array_equal(one, other)


def test_a_file_names_the_arguments_of_environments_that_were_made_before_masks_were_asked_for():
    gym.register("rejeu-test/Rules-v1", Rules, max_episode_steps=50)
    agent = small(rejeu.make_vector("rejeu-test/Rules-v1", 1, "gymnasium", kind="discrete"))
    assert agent.origin == ("rejeu-test/Rules-v1", {"kind": "discrete"})


# Where masks come from.


def test_environments_seeded_before_masks_were_asked_for_stay_seeded():
    agent = small(vector("discrete"))
    seeds = []
    for seed in (4, 4, 5):
        env = InProcess([Rules(), Rules()], seed)
        seeds.append([agent.evaluate(10, env=env).returns.tolist(), env.envs[1].seeds[0]])
    assert seeds[0] == seeds[1] != seeds[2]
    assert seeds[0][1] == 5


def test_an_episode_may_end_where_nothing_is_allowed():
    env = InProcess([Rules(all_at_end=False) for _ in range(2)], seed=0)
    agent = small(env).learn(64)
    agent.evaluate(4, env=InProcess([Rules(all_at_end=False)], seed=0))
    assert all(np.isfinite(value).all() for value in agent.get_parameters().values())


class Fixed(Counter):
    """A counter that always shows the same mask."""

    def __init__(self, mask, space=None):
        super().__init__((4,))
        self.action_space = spaces.Discrete(3) if space is None else space
        self.action_masks = lambda: mask


def test_masks_may_come_as_a_list_of_parts():
    env = Fixed([np.array([1, 0]), [False, True]], spaces.MultiDiscrete([2, 2]))
    assert make_masked(env).reset().mask.tolist() == [[True, False, False, True]]


@pytest.mark.parametrize("mask", [[0, 0, 1, 1], [1, 1, 0, 0]])
def test_every_choice_needs_an_option(mask):
    with pytest.raises(BadEnvironmentError, match="Fixed allows no action"):
        flat_mask(mask, spaces.MultiDiscrete([2, 2]), "Fixed", over=False)


class Mute(Fixed):
    def step(self, action):
        return (*super().step(action)[:4], None if self.time == 3 else {})


@pytest.mark.parametrize(
    ("env", "error", "message"),
    [
        (lambda: Fixed([0, 0, 0]), BadEnvironmentError, r"Fixed allows no action: its mask is \[0, 0, 0\]"),
        (lambda: Fixed([1, 1]), BadEnvironmentError, "Fixed gave a mask of 2 entries, expected 3"),
        (lambda: Mute([1, 1, 0]), BadEnvironmentError, "Mute, environment 0, step 3: step returned the info None"),
        (Silent, BadEnvironmentError, r'put info\["action_mask"\] into what reset and step return'),
        # the id of one of EnvPool's environments is made where its masks can be reached
        (lambda: "CartPole-v1", BadEnvironmentError, "CartPole-v1 does not return action masks"),
        (Counter, ValueError, "masks need Discrete, MultiDiscrete or MultiBinary actions; Counter has"),
        (lambda: make_vector("CartPole-v1", 2, "envpool"), TypeError, "masks of EnvPool cannot be accessed"),
        (lambda: 3, TypeError, "must be an id, an environment or a function that makes one, got int"),
    ],
)
def test_environments_whose_masks_cannot_be_had_or_kept_to_are_refused(env, error, message):
    with pytest.raises(error, match=message):
        small(env(), n_steps=4).learn(4)


# Who looks on.


class Drawn(Rules):
    """Can be filmed."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)


def test_films_keep_to_the_masks(tmp_path):
    agent = small(vector("multi"))
    env = Drawn("multi")
    rejeu.record_video(agent, tmp_path / "film.mp4", env, episodes=20, seed=0)
    assert env.taken > 20


def test_predict_takes_what_an_environment_with_its_mask_shows():
    agent = small(vector("discrete"))
    shown = {"observation": np.zeros(2, np.float32), "action_mask": np.array([0, 0, 0, 1, 0], np.int8)}
    assert agent.predict(shown)[0] == 3
    shown = agent.get_env().reset()
    for _ in range(20):
        actions, _ = agent.predict(shown)
        assert shown.mask[np.arange(3), actions].all()
